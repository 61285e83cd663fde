"""The root command: light, complete, and honest about its exits."""

import json
import subprocess
import sys

import pytest

from spikerig.dataset import cli
from spikerig.dataset.errors import DataError, DeviceError, HostError, NumericsError, RefusedError, RigError, UsageError

HEAVY = ("torch", "cv2", "pycolmap", "usb", "serial", "h5py", "matplotlib", "OpenEXR", "av", "mitsuba", "dask")


def _python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("words", [["--help"], *[[noun, "--help"] for noun in cli.NOUNS]])
def test_help_imports_nothing_heavy(words: list[str]) -> None:
    nouns = {name.partition(".")[0] for name in cli.commands()}
    if words[0] in cli.NOUNS and words[0] not in nouns:
        return  # a noun without verbs yet has no help
    done = _python(
        f"import sys; from spikerig.dataset import cli; code = cli.run({words!r}); "
        f"print([m for m in {HEAVY!r} if m in sys.modules]); sys.exit(code)"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[-1] == "[]"


def test_every_entry_point_loads_and_documents_itself() -> None:
    points = cli.commands()
    assert "doctor" in points
    for name, point in points.items():
        function = point.load()
        assert callable(function), name
        assert (function.__doc__ or "").strip(), f"{name} has no docstring: --help would be empty"


@pytest.mark.parametrize(
    ("error", "code"),
    [(UsageError, 2), (DeviceError, 3), (DataError, 4), (RefusedError, 4), (NumericsError, 5), (HostError, 6)],
)
def test_errors_become_exit_codes_and_one_json_document(
    error: type[RigError], code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(argv: list[str]) -> None:
        raise error("broken", value=float("nan"), expected="whole", cause="a drop", next="spikerig doctor")

    monkeypatch.setattr(cli, "assemble", fail)
    assert cli.run(["x", "--json"]) == code
    out = capsys.readouterr()
    document = json.loads(out.out)
    assert document["schema"] == "spikerig.error/1"
    assert document["error"]["type"] == error.__name__
    assert document["error"]["next"] == "spikerig doctor"
    assert "Traceback" not in out.err


def test_a_bug_is_exit_70_with_a_report_and_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "assemble", lambda argv: 1 / 0)
    assert cli.run(["x", "--json"]) == 70
    out = capsys.readouterr()
    report = json.loads(out.out)["error"]["report"]
    with open(report, encoding="utf-8") as file:
        assert "ZeroDivisionError" in file.read()
    assert "Traceback" not in out.err


@pytest.mark.parametrize("words", [["doctr"], ["doctor", "--jsn"], ["doctor", "--folder"]])
def test_wrong_usage_is_exit_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(words) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_interrupt_is_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(argv: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "assemble", stop)
    assert cli.run([]) == 130
