"""`spikerig cost stream`: every case in one document, with the figures it promises."""

import json

import pytest

from spikerig.dataset.cli import run
from spikerig.rigctl.streamcost import CASES, stream_cost

SMALL = ["--width", "31", "--height", "5", "--seconds", "0.01", "--rounds", "2", "--block", "64"]


def test_json_has_every_case(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "stream", *SMALL, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "spikerig.cost.stream/1"
    assert document["ticks"] == 400
    assert [row["case"] for row in document["rows"]] == list(CASES)
    for row in document["rows"]:
        assert row["real_time"] == pytest.approx(400 / row["wall_seconds"] / 40_000)
        assert row["ns_per_pixel_tick"] == pytest.approx(1e9 * row["cpu_seconds"] / (400 * 31 * 5))
        assert row["fill_share"] > 0


def test_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "stream", *SMALL]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in CASES)


def test_memory_is_that_of_a_block_and_its_pictures() -> None:
    """Four times as long a stream holds no more; a larger block does."""
    short, long, large = (
        {r["case"]: r["peak_bytes"] for r in stream_cost(40, 64, ticks=n, every=8, block_ticks=b, rounds=1)["rows"]}
        for n, b in ((256, 64), (1024, 64), (1024, 512))
    )
    for case in CASES:
        assert long[case] < 1.1 * short[case]
        assert large[case] > 2 * long[case]


@pytest.mark.parametrize("bad", ["--width", "--rounds", "--block"])
def test_nothing_of_nothing(bad: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "stream", bad, "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
