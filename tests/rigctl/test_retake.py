"""Pictures without poses retaken as spikes: exact against the oracle, cut where asked, in blocks, and to files."""

import json
import os
import signal
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spikerig.dataset import oracles
from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import linear_from_srgb, read_image, write_image
from spikerig.dataset.kernels import unpack
from spikerig.dataset.spikes import open_spikes
from spikerig.rigctl.sim.rgb import encode
from spikerig.rigctl.sim.sensor import spike_light
from spikerig.rigctl.sim.sources import retake as module
from spikerig.rigctl.sim.sources.moving import Look, Moving, open_moving
from spikerig.rigctl.sim.sources.retake import Exposures, Retake, knots, spikes_of
from spikerig.rigctl.sim.spec import Sensor

RNG = np.random.default_rng(0)
WEIGHTS = np.array([0.299, 0.587, 0.114])


def moving(pictures: np.ndarray, times: list[float], last: float = 0.01, kind: str = "video") -> Moving:
    shown = [(Fraction(t).limit_denominator(10**6), p) for t, p in zip(times, pictures, strict=True)]
    h, w = pictures.shape[1:3]
    return Moving(kind, w, h, None, Fraction(last).limit_denominator(10**6), iter(shown), lambda: None, {})


def made(source: Moving, retake: Retake, exposures: Exposures | None = None) -> tuple[np.ndarray, dict[str, Any]]:
    blocks: list[np.ndarray] = []
    told = spikes_of(source, retake, blocks.append, exposures)
    return np.concatenate(blocks), told


@pytest.mark.parametrize("hold", [False, True])
def test_spikes_are_those_of_the_oracle(hold: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, whatever the length of a block."""
    pictures = RNG.random((4, 5, 11, 3), np.float32)
    retake = Retake(rate_hz=10_000, gain=0.7, hold=hold, phase="zero")
    times = [0.0, 0.013, 0.02, 0.05]
    bits, told = made(moving(pictures, times), retake)
    ticks = [0, 130, 200, 500] + ([600] if hold else [])
    light = spike_light(pictures.copy(), Sensor(gain=0.7))
    np.testing.assert_allclose(light, 0.7 * pictures @ WEIGHTS, rtol=1e-5)
    expected = oracles.fire(light, np.array(ticks), np.zeros((5, 11), np.uint32), hold=hold)[0]
    assert told["ticks"] == ticks[-1] == len(bits)
    assert np.array_equal(bits, expected)
    assert told["spikes_per_tick"] == pytest.approx(unpack(bits, 11).mean())
    monkeypatch.setattr(module, "BLOCK", 64)
    again, _ = made(moving(pictures, times), retake)
    assert np.array_equal(again, expected)


def test_the_phase_is_seeded() -> None:
    pictures = np.full((2, 4, 6, 3), 0.3, np.float32)
    runs = [made(moving(pictures, [0, 0.01]), Retake(seed=s))[0] for s in (1, 1, 2)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    zero = unpack(made(moving(pictures, [0, 0.01]), Retake(phase="zero"))[0], 6)
    assert np.ptp(zero.reshape(len(zero), -1), axis=1).max() == 0, "all pixels fire together"


def test_saturated_light_is_counted() -> None:
    bits, told = made(moving(np.full((2, 2, 8, 3), 5.0, np.float32), [0, 0.01]), Retake(phase="zero"))
    assert unpack(bits, 8).all()
    assert told["clipped_share"] == pytest.approx(0.5)  # two thresholds a tick, one spike


def test_a_limit_cuts_between_pictures() -> None:
    pictures = np.stack([np.zeros((2, 3, 3), np.float32), np.ones((2, 3, 3), np.float32)])
    for hold, light in ((False, 0.25), (True, 0.0)):
        got = list(knots(moving(pictures, [0, 0.1]), Retake(rate_hz=1000, limit_s=0.025, hold=hold)))
        assert [t for t, _ in got] == [0, 25]
        np.testing.assert_allclose(got[1][1], light, rtol=1e-6)
    got = list(knots(moving(pictures, [0, 0.1]), Retake(rate_hz=1000, limit_s=0.1)))
    assert [t for t, _ in got] == [0, 100]
    got = list(knots(moving(pictures, [0, 0.1], last=0.05), Retake(rate_hz=1000, hold=True, limit_s=9)))
    assert [t for t, _ in got] == [0, 100, 150]


def test_one_picture_stands() -> None:
    one = np.full((1, 2, 3, 3), 0.5, np.float32)
    assert [t for t, _ in knots(moving(one, [0], kind="picture"), Retake())] == [0, 4000]
    assert [t for t, _ in knots(moving(one, [0], kind="picture"), Retake(limit_s=0.2))] == [0, 8000]
    assert [t for t, _ in knots(moving(one, [0], last=0.04), Retake())] == [0, 1600]


def test_more_pictures_than_ticks() -> None:
    with pytest.raises(UsageError, match="faster than ticks"):
        list(knots(moving(np.ones((3, 2, 2, 3), np.float32), [0, 1e-5, 2e-5]), Retake(rate_hz=1000)))


@pytest.mark.parametrize("hold", [False, True])
def test_exposures_are_the_mean_of_the_light(hold: bool) -> None:
    """Against a sum over every tick; exposures cross several pictures, and the unfinished one is not given."""
    pictures = RNG.random((6, 3, 4, 3), np.float32)
    times = [0, 0.011, 0.02, 0.037, 0.04, 0.075]
    kept: list[tuple[int, int, int, np.ndarray]] = []
    camera = Exposures(1000.0, 50.0, 17.0, hold, lambda *frame: kept.append(frame))
    made(moving(pictures, times, last=0.005), Retake(rate_hz=1000, hold=hold), camera)
    ticks = [round(1000 * t) for t in times]
    light = np.empty((80 if hold else 75, 3, 4, 3))
    for k in range(len(light)):
        j = max(i for i, t in enumerate(ticks) if t <= k)
        if hold or j == 5:
            light[k] = pictures[j]
        else:
            u = (k + 0.5 - ticks[j]) / (ticks[j + 1] - ticks[j])
            light[k] = pictures[j] * (1 - u) + pictures[j + 1] * u
    assert [(n, a, b) for n, a, b, _ in kept] == [(k, 20 * k, 20 * k + 17) for k in range(4 if hold else 3)]
    for _, a, b, mean in kept:
        np.testing.assert_allclose(mean, light[a:b].mean(0), rtol=1e-5)


@pytest.mark.parametrize(
    "bad",
    [
        {"rate_hz": 0},
        {"rate_hz": np.nan},
        {"gain": -1},
        {"limit_s": 0},
        {"limit_s": np.inf},
        {"phase": "x"},
        {"seed": -1},
    ],
)
def test_settings_out_of_range(bad: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Retake(**bad)
    with pytest.raises(UsageError):
        Exposures(40_000, 30, 40.0, False, print)
    with pytest.raises(UsageError):
        Exposures(40_000, 0, 1.0, False, print)
    for look in ({"fps": 0}, {"size": (0, 3)}, {"bad_values": "x"}):
        with pytest.raises(UsageError):
            Look(**look)  # type: ignore[arg-type]


def pictures_in(root: Path, suffix: str, count: int = 12) -> np.ndarray:
    """A folder of pictures whose names sort by number only; returns their linear light."""
    root.mkdir()
    light = []
    for k in range(count):
        pixels = RNG.integers(0, 256, (10, 16, 3), np.uint8)
        shown = linear_from_srgb(pixels)
        write_image(root / f"f{k}{suffix}", pixels if suffix == ".png" else shown)
        light.append(shown)
    (root / ".hidden.png").write_bytes(b"x")
    (root / "notes.txt").write_text("x")
    return np.stack(light)


@pytest.mark.parametrize("ending", [".dat", ".npz", ".h5"])
@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_folder_becomes_a_file_of_spikes(
    tmp_path: Path, suffix: str, ending: str, capfd: pytest.CaptureFixture[str]
) -> None:
    light = pictures_in(tmp_path / "in", suffix)
    out, frames = tmp_path / f"o{ending}", tmp_path / "rgb"
    words = ["sim", "spikes", str(tmp_path / "in"), "-o", str(out), "--fps", "100", "--size", "16x10", "--json"]
    more = [
        "--rate-hz",
        "10000",
        "--phase",
        "zero",
        "--frames-out",
        str(frames),
        "--rgb-fps",
        "25",
        "--exposure-ms",
        "20",
    ]
    assert run([*words, *more]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["schema"] == "spikerig.sim.spikes/1"
    assert (told["kind"], told["pictures"], told["ticks"], told["rgb_frames"]) == ("folder", 12, 1100, 3)
    knot = np.arange(12) * 100
    weights = WEIGHTS.astype(np.float32) * np.float32(0.4)
    expected = oracles.fire(light @ weights, knot, np.zeros((10, 16), np.uint32), hold=False)[0]
    layout: dict[str, Any] = {"height": 10, "width": 16, "row_bits": 16} if ending == ".dat" else {}
    with open_spikes(out, **layout) as file:
        stream = file.read()
    assert stream.rate_hz == (None if ending == ".dat" else 10_000)
    assert np.abs(unpack(stream.bits, 16).sum(0, dtype=int) - unpack(expected, 16).sum(0, dtype=int)).max() <= 1
    listed = json.loads((frames / "frames.json").read_text())
    assert [f["ticks"] for f in listed["frames"]] == [[0, 200], [400, 600], [800, 1000]]
    assert listed["frames"][1] | {} == {
        "file": "000001.png",
        "start_ns": 40_000_000,
        "exposure_ns": 20_000_000,
        "ticks": [400, 600],
    }
    mean = (light[4] / 2 + light[5] + light[6] / 2) / 2
    assert np.abs(read_image(frames / "000001.png").astype(int) - encode(mean)).max() <= 1
    # a second time: refused; with force: replaced
    assert run([*words, *more]) == 2
    assert "exists already" in json.loads(capfd.readouterr().out)["error"]["what"]
    assert run([*words, *more, "--force", "--hold", "--limit", "0.05"]) == 0
    assert json.loads(capfd.readouterr().out)["ticks"] == 500
    assert sorted(p.name for p in frames.iterdir()) == ["000000.png", "frames.json"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", out.name, "rgb"]


def test_one_picture_and_awkward_ones(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    light = np.full((10, 16, 3), 0.5, np.float32)
    light[0, 0, 0], light[0, 0, 1], light[1, 1, 2] = np.nan, np.inf, -1
    write_image(tmp_path / "x.exr", light)
    words = ["sim", "spikes", str(tmp_path / "x.exr"), "-o", str(tmp_path / "o.h5"), "--size", "source", "--json"]
    assert run(words) == 5
    assert "--bad-values zero or clip" in json.loads(capfd.readouterr().out)["error"]["next"]
    assert run([*words, "--bad-values", "zero"]) == 0
    out = capfd.readouterr()
    told = json.loads(out.out)
    assert told["bad_values"] == {"how": "zero", "pictures": 1, "nan": 1, "infinite": 1, "negative": 1}
    assert "mended (zero) in 1 pictures" in out.err
    assert (told["ticks"], told["width"], told["height"]) == (4000, 16, 10)
    assert told["spikes_per_tick"] == pytest.approx(0.4 * 0.5, rel=0.02)


def test_sources_that_cannot_be(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    light = pictures_in(tmp_path / "in", ".png", 3)
    assert light.shape == (3, 10, 16, 3)
    with pytest.raises(UsageError, match="do not say when"):
        open_moving(tmp_path / "in")
    with pytest.raises(UsageError, match="no such source"):
        open_moving(tmp_path / "none.mp4")
    (tmp_path / "void").mkdir()
    with pytest.raises(DataError, match="holds no pictures"):
        open_moving(tmp_path / "void")
    write_image(tmp_path / "in" / "f1.png", np.zeros((9, 16, 3), np.uint8), force=True)
    os.remove(tmp_path / "in" / "f2.png")
    write_image(tmp_path / "in" / "f5.png", np.zeros((10, 16, 3), np.uint8))
    source = open_moving(tmp_path / "in", Look(fps=10))
    assert source.facts["missing_numbers"] == 3
    with pytest.raises(DataError, match="different sizes"):
        list(source.pictures)
    base = ["sim", "spikes", str(tmp_path / "in"), "--fps", "10"]
    assert run([*base, "-o", str(tmp_path / "o.txt")]) == 2
    assert run([*base, "-o", str(tmp_path / "o.h5"), "--size", "4by5"]) == 2
    assert run([*base, "-o", str(tmp_path / "o.h5"), "--background", "2"]) == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    assert run([*base, "-o", str(tmp_path / "o.h5"), "--frames-out", str(tmp_path / "mine"), "--force"]) == 2
    assert run([*base, "-o", str(tmp_path / "o.h5"), "--rate-hz", "1e8", "--limit", "1e6"]) == 6  # more than any disk
    assert "do not fit on the disk" in capfd.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "mine", "void"]


def test_an_interrupt_leaves_nothing_half(tmp_path: Path) -> None:
    pictures_in(tmp_path / "in", ".png", 3)
    words = ["sim", "spikes", str(tmp_path / "in"), "-o", str(tmp_path / "o.npz"), "--fps", "0.5", "--size", "160x100"]
    code = (
        "import signal, sys; from spikerig.dataset.cli import run; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "  # a background shell job ignores it
        "sys.exit(run(sys.argv[1:]))"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code, *words, "--frames-out", str(tmp_path / "rgb")], stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 60
    # not at its first breath: Cython's modules (numpy.random) swallow an interrupt while they are imported
    while (
        not any(p.stat().st_size for p in tmp_path.glob(".o.*"))
        and time.monotonic() < deadline
        and child.poll() is None
    ):
        time.sleep(0.02)
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=60)
    assert child.returncode == 130, err
    assert b"Traceback" not in err
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
