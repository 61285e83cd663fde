"""`spikerig cost kernels`: one document with every kernel in it."""

import json

import pytest

from spikerig.dataset import bench as spike_bench
from spikerig.dataset.cli import run
from spikerig.train import bench as train_bench


def row(kernel: str) -> dict:
    return {
        "kernel": kernel, "seconds": 0.04, "oracle_seconds": 4.0, "ratio": 100.0, "size": "400x250", "isa": "plain",
        "threads": 1,
    }  # fmt: skip


@pytest.fixture(autouse=True)
def measured(monkeypatch: pytest.MonkeyPatch) -> None:
    spikes = [row(k) for k in ("unpack", "count", "tfi_at", "tfi_all")]
    spikes.append(row("fire") | {"ticks_per_second": 7e4, "ns_per_pixel_tick": 0.14})
    raster = row("raster") | {"absgrad_seconds": 0.042, "consulted_per_pixel": 320.0, "splat_pixels_per_second": 7e8}
    splats = [raster, row("ssim")]
    monkeypatch.setattr(spike_bench, "rows", lambda quick: spikes)
    monkeypatch.setattr(train_bench, "rows", lambda quick: splats)


def test_json_lists_every_kernel(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "kernels", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "spikerig.cost.kernels/1"
    names = [r["kernel"] for r in document["kernels"]]
    assert names == ["unpack", "count", "tfi_at", "tfi_all", "fire", "raster", "ssim"]
    assert document["machine"]["isa"] in ("plain", "avx2", "avx512")


def test_table_tells_what_is_special_to_a_kernel(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "kernels"]) == 0
    out = capsys.readouterr().out
    assert "raster              40.000" in out
    assert "70000 ticks/s, 0.14 ns a pixel and tick" in out
    assert "320 splats consulted a pixel, 700 M splat-pixels/s, with absgrad 42.00 ms" in out
