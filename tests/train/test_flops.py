"""Eq. 11 counted: by hand, and against torch's profiler."""

import json

import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.errors import UsageError
from spikerig.dataset.store import open_scene
from spikerig.train import flops
from spikerig.train.fit import new_state
from spikerig.train.methods import configure
from spikerig.train.run import prepare
from spikerig.train.vanilla import start_vanilla

SMALL = {
    "nerf": {"rays": 16, "coarse": 6, "fine": 5, "width": 16},
    "nerf-fast": {"rays": 16, "coarse": 12, "probes": 7, "fine": 5, "width": 16, "grid_levels": 4, "finest": 64,
                  "table_log2": 10, "occupancy": 16},
}  # fmt: skip


def test_the_papers_network_by_hand():
    params, _ = start_vanilla(configure("plain", "paper", "nerf"))
    places, ways = 3 * (1 + 2 * 10), 3 * (1 + 2 * 4)
    body = places * 256 + 4 * 256 * 256 + (256 + places) * 256 + 2 * 256 * 256
    heads = 256 * 1 + 256 * 256 + (256 + ways) * 128 + 128 * 3
    assert flops.complexity(params, "coarse") == flops.complexity(params, "fine") == body + heads == 593_408


@pytest.mark.parametrize("method", ["plain", "spikenerf-5x"])
@pytest.mark.parametrize("field", SMALL)
def test_the_count_is_the_profilers(tiny, field, method):
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, configure(method, "draft", field, **SMALL[field]))
        row = flops.row(task, new_state(scene.points, task))
    assert row["profiled"] == row["flops"]
    assert row["renders"] == (5 if method == "spikenerf-5x" else 1)


def test_one_render_with_a_texture_costs_only_the_converter_more(tiny):
    names, methods = ("splat", "nerf-fast"), ("plain", "spikenerf", "spikenerf-5x")
    rows = {(r["field"], r["method"]): r for r in flops.count_scene(tiny, methods, names, profile=False)}
    for name in names:
        assert rows[name, "spikenerf"]["over_plain"] == pytest.approx(1, abs=0.02)
        assert rows[name, "spikenerf-5x"]["over_plain"] == pytest.approx(5, rel=0.05)
        assert rows[name, "plain"]["converter_flops"] == 0 < rows[name, "spikenerf"]["converter_flops"]
    assert rows["splat", "plain"]["pairs_a_render"] > 64 * 40


def test_the_command(tiny, capsys):
    words = ["cost", "flops", str(tiny), "--methods", "plain", "--fields", "nerf-fast", "--no-profile", "--json"]
    assert run(words) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["profiled"] is None
    assert row["over_plain"] == 1
    with pytest.raises(UsageError, match="no such field"):
        flops.flops(tiny, "plain", "voxels", profile=False)
