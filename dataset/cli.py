"""The root command `spikerig`: it finds its verbs among the installed entry points and imports only those asked for.

Entry points of the group `spikerig.commands` have dotted names, `noun.verb = "module:function"` (or just
`verb`). Any package may add one. A function is a plain typer command: annotated parameters and a docstring.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points, version

import typer

from spikerig.dataset.errors import RigError, UsageError
from spikerig.dataset.terminal import emit, note

GROUP = "spikerig.commands"
NOUNS = {
    "rig": "The rig: find, probe and drive its devices.",
    "sim": "Simulate captures: photons to spikes and blurry frames.",
    "data": "Files: look at, convert, build, verify.",
    "calib": "When, where and how the two cameras agree.",
    "train": "Learn a sharp scene from blurry pictures and spikes; render and score it.",
    "cost": "What accuracy costs in time: sweeps and benchmarks.",
}
TOP = {
    "doctor": "Check this machine and installation; every problem at once, each with its fix.",
    "demo": "The whole road on one command: photons to a sharper picture, with the numbers.",
}


def commands() -> dict[str, EntryPoint]:
    """Installed verbs by dotted name, sorted; a name offered twice by different packages is an error."""
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda p: (p.name, p.value)):
        if point.name in found and found[point.name].value != point.value:
            raise UsageError(
                f"two packages offer the command '{point.name.replace('.', ' ')}'",
                value=f"{found[point.name].value} and {point.value}",
                expected="one package a command",
                next="pip uninstall one of them",
            )
        found[point.name] = point
    return found


def _stub(name: str) -> Callable[[], None]:
    def stub() -> None:
        raise AssertionError(f"{name} was listed, not loaded")

    return stub


def assemble(argv: list[str]) -> typer.Typer:
    """A typer app for this command line: the verbs of the noun it names are loaded, the others only listed."""
    app = typer.Typer(
        add_completion=False,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help="spikerig: photons -> spikes -> take -> scene -> pair -> texture -> pose -> loss -> picture.",
    )

    @app.callback(invoke_without_command=True)
    def root(
        show_version: bool = typer.Option(False, "--version", help="Print the version and stop.", is_eager=True),
    ) -> None:
        if show_version:
            typer.echo(version("spikerig"))
            raise typer.Exit

    asked = next((word for word in argv if not word.startswith("-")), "")
    groups: dict[str, typer.Typer] = {}
    for name, point in commands().items():
        noun, _, verb = name.partition(".")
        if not verb:
            load = point.load() if asked == noun else _stub(name)
            app.command(noun, help=None if asked == noun else TOP.get(noun, ""))(load)
            continue
        if noun not in groups:
            groups[noun] = typer.Typer(
                no_args_is_help=True, rich_markup_mode=None, help=NOUNS.get(noun, f"Commands of '{noun}'.")
            )
            app.add_typer(groups[noun], name=noun)
        groups[noun].command(verb)(point.load() if asked == noun else _stub(name))
    return app


def run(argv: list[str]) -> int:
    """Run one command line and return its exit code; no traceback reaches the user.

    Args:
        argv: the words after `spikerig`.

    Returns:
        0 ok, 1 findings, 2 usage, 3 device, 4 data, 5 numerics, 6 this machine, 70 our bug, 130 interrupted.
    """
    as_json = "--json" in argv
    try:
        result = assemble(argv)(args=argv, standalone_mode=False, prog_name="spikerig")
        if result == 130:  # typer's own way to tell of an interrupt
            return _interrupted(as_json)
        return result if isinstance(result, int) else 0
    except RigError as error:
        return _tell(error.as_json(), str(error), error.exit_code, as_json)
    except typer.TyperException as error:  # usage faults found by the parser
        what = error.format_message() or type(error).__name__
        if type(error).__name__ == "NoArgsIsHelpError":
            note(what)
            return 2
        wrong = UsageError(what, next=f"spikerig {' '.join(_verbs(argv))} --help".replace("  ", " "))
        return _tell(wrong.as_json(), str(wrong), 2, as_json)
    except typer.Exit as leave:
        return leave.exit_code
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted(as_json)
    except BrokenPipeError:  # `spikerig ... | head`
        sys.stderr.close()
        return 0
    except MemoryError:
        what = {"type": "HostError", "exit_code": 6, "what": "out of memory"}
        return _tell(what, "out of memory", 6, as_json)
    except Exception as error:
        return _bug(error, argv, as_json)


def _verbs(argv: list[str]) -> list[str]:
    words: list[str] = []
    for word in argv[:2]:
        if word.startswith("-"):
            break
        words.append(word)
    return words


def _tell(record: dict[str, object], text: str, code: int, as_json: bool) -> int:
    if as_json:
        emit("spikerig.error/1", {"error": record})
    note("error: " + text)
    return code


def _interrupted(as_json: bool) -> int:
    return _tell({"type": "Interrupted", "exit_code": 130, "what": "interrupted"}, "interrupted", 130, as_json)


def _bug(error: Exception, argv: list[str], as_json: bool) -> int:
    import platform
    import tempfile
    import traceback

    with tempfile.NamedTemporaryFile(
        "w", prefix="spikerig-report-", suffix=".txt", delete=False, encoding="utf-8"
    ) as report:
        report.write(f"spikerig {version('spikerig')}, {platform.platform()}, Python {sys.version}\n")
        report.write(f"command: {argv!r}\n\n")
        traceback.print_exception(error, file=report)
    what = f"spikerig has a bug here: {type(error).__name__}: {error}"
    record = {"type": "Bug", "exit_code": 70, "what": what, "report": report.name}
    return _tell(record, f"{what}\n  report:   {report.name}", 70, as_json)


def main() -> None:
    """Entry point of the console script."""
    sys.exit(run(sys.argv[1:]))
