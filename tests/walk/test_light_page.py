"""docs/light.md is true: every command it shows exists with the options it shows, every file it names is there."""

import re
from pathlib import Path

import pytest

from spikerig.dataset import cli

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "light.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"^spikerig [^`\n]+|(?<=`)spikerig [^`]+", PAGE, re.M)))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_exists(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    words = command.split()[1:]
    assert ".".join(words[:2]) in cli.commands(), command
    assert cli.run([*words[:2], "--help"]) == 0
    said = capfd.readouterr().out
    for option in (word for word in words if word.startswith("--") or word == "-o"):
        assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", said), (option, command)


def test_every_source_has_one() -> None:
    verbs = {".".join(c.split()[1:3]) for c in COMMANDS}
    assert {"sim.capture", "sim.frames", "sim.spikes", "sim.mitsuba", "train.render"} <= verbs
    assert len(COMMANDS) >= 9


def test_every_file_it_names_is_there() -> None:
    for name in set(re.findall(r"docs/[\w/.]+\.(?:py|xml|toml)", PAGE)):
        assert (ROOT / name).is_file(), name
    for target in re.findall(r"\]\(([\w/.]+)?(#[\w-]+)?\)", PAGE):
        page = ROOT / "docs" / target[0] if target[0] else ROOT / "docs" / "light.md"
        assert page.is_file(), target
        heads = {"#" + re.sub(r"[^\w -]", "", h.lower()).strip().replace(" ", "-") for h in
                 re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)}  # fmt: skip
        assert not target[1] or target[1] in heads, target


def test_the_blender_options_exist(capsys: pytest.CaptureFixture[str]) -> None:
    import runpy

    script = runpy.run_path(str(ROOT / "docs" / "blender" / "render_rs3d.py"))
    with pytest.raises(SystemExit):
        script["arguments"](["--help"])
    said = capsys.readouterr().out
    block = PAGE[PAGE.index("## Blender") :]
    for option in set(re.findall(r"--[a-z-]+(?=[ `\n])", block)) - {"--"}:
        assert option in said, option
