"""The doctor finds what is wrong, all of it, and says how to mend it."""

import json
from pathlib import Path

import pytest

from spikerig.dataset import cli, doctor


def test_a_sound_machine_has_every_package_and_kernels() -> None:
    report = doctor.examine(Path("."))
    assert not [p for p in report["problems"] if "not installed" in p["what"]]
    assert report["kernels"]["isa"] in report["kernels"]["usable"]
    assert report["libusb"]["library"]
    assert all(p["loaded_from"] for p in report["packages"].values())


def test_every_problem_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(doctor.PACKAGES, "no-such-dist", ("no_such_module", "nothing"))
    monkeypatch.setattr(doctor, "WANTED_FREE", 2**80)
    monkeypatch.setattr(doctor, "WANTED_WRITE", 2**80)
    report = doctor.examine(tmp_path)
    said = " | ".join(p["what"] for p in report["problems"])
    assert "no-such-dist" in said
    assert "GiB free" in said
    assert "MiB/s" in said
    assert all(p["fix"] for p in report["problems"])
    assert not list(tmp_path.iterdir()), "the disk test leaves nothing behind"


def test_problems_are_exit_1_and_json(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["doctor", "--folder", str(tmp_path / "absent"), "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "spikerig.doctor/1"
    assert "absent" in document["problems"][0]["what"]


def test_write_speed_is_positive(tmp_path: Path) -> None:
    assert doctor.write_speed(tmp_path, 2**20) > 0
