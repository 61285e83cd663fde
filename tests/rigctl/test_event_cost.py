"""`spikerig cost events`: the error falls with the pictures, against the same pose path."""

import json

import pytest

from spikerig.dataset.cli import run
from spikerig.rigctl import event_cost

SCENE = """
[camera]
width = 40
height = 25
samples = 1
[orbit]
views = 2
target = [0, 0, 0.4]
test_every = 0
[[world.solids]]
kind = "room"
lo = [-3, -3, 0]
hi = [3, 3, 2.6]
walls = { kind = "noise", size = 0.2 }
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(SCENE)
    return path


def test_more_pictures_leave_less_error(scene, monkeypatch, capsys):
    monkeypatch.setattr(event_cost, "PICTURES", (2, 9, 33))
    monkeypatch.setattr(event_cost, "REFERENCE", 129)
    assert run(["cost", "events", "--scene", str(scene), "--repeats", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    errors = {(r["series"], r["value"]): r["error"] for r in rows}
    for series in {r["series"] for r in rows}:
        assert errors[series, 2] > errors[series, 9] > errors[series, 33]
    assert errors["RMS of the signed sums of 4 bins", 33] < 0.3 * errors["RMS of the signed sums of 4 bins", 2]
