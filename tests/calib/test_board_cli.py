"""`spikerig calib board`: pairing, refusals, exits, files."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from spikerig.calib.rig import read_calibration
from spikerig.calib.shots import Reading, moved_px, pair_up, read_light, still_light
from spikerig.dataset import cli
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import read_image
from spikerig.dataset.spikes import SpikeStream, write_spikes
from spikerig.dataset.stream import SpikeFile

pytestmark = pytest.mark.usefixtures("remembered")


def run(folder: Path, out: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, dict]:
    words = ["calib", "board", str(folder / "a"), str(folder / "b"), "-o", str(out), "--json"]
    code = cli.run([*words, "--pattern", "9x6", "--square-mm", "16", *more])
    text = capsys.readouterr().out
    return code, json.loads(text)


def test_a_good_session_is_written_and_not_overwritten(
    shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calib.json"
    code, told = run(shots, out, capsys, "--overlays", str(tmp_path / "see"))
    assert code == 0
    assert len(list((tmp_path / "see").glob("*.png"))) == 10
    red = read_image(tmp_path / "see/cam_a_02.red-cyan.png").astype(int)
    seen = red.sum(2) > 90
    assert seen.mean() > 0.8
    assert np.abs(red[..., 0] - red[..., 1])[seen].mean() < 8  # edges that agree are gray
    assert told["accepted"] is True
    assert told["paired_by"] == "number"
    assert told["views_used"] == 5
    assert read_calibration(out).id == told["id"]
    assert json.loads(out.read_text())["report"]["rms_px"] == told["rms_px"]
    code, told = run(shots, out, capsys)
    assert code == 2
    assert "exists" in told["error"]["what"]


def test_a_refusal_writes_nothing_unless_forced_and_then_says_so(
    shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        shutil.copytree(shots / name, tmp_path / name)
    for path in sorted(tmp_path.glob("?/*.png"))[:]:
        if path.stem.endswith(("03", "04")):
            path.unlink()
    shutil.copy(tmp_path / "a/cam_a_00.png", tmp_path / "a/cam_a_07.png")
    shutil.copy(tmp_path / "b/cam_b_01.png", tmp_path / "b/cam_b_07.png")
    out = tmp_path / "calib.json"
    code, told = run(tmp_path, out, capsys)
    assert code == 4
    assert told["accepted"] is False
    assert told["schema"] == "spikerig.calib.board/1"
    assert {"duplicates", "odd-pairs"} <= set(told["reason_codes"])
    assert len(told["reasons"]) == len(told["reason_codes"])
    assert told["out"] is None
    assert not out.exists()
    code, told = run(tmp_path, out, capsys, "--force")
    assert code == 0
    assert told["accepted"] is False
    assert told["forced"] is True
    assert read_calibration(out).forced == tuple(told["reason_codes"])


@pytest.mark.parametrize(
    "more",
    [["--pattern", "9"], ["--pattern", "1x1"], ["--pattern", "-9x6"], ["--pattern", "1000x1000"], ["--pattern", ""],
     ["--square-mm", "0"], ["--square-mm", "nan"], ["--square-mm", "-16"], ["--square-mm", "inf"],
     ["--square-mm", "1e-300"], ["--mirror", "left"], ["--model", "one"], ["--lens", "3"], ["--window", "2"],
     ["--windows", "0"], ["--charuco", "DICT_9X9_1"], ["--charuco", "DICT_4X4_50", "--marker-mm", "nan"],
     ["--sheet", "sheet.png"], ["--sheet", "/nowhere/sheet.html"], ["-o", "/nowhere/c.json"]],
)  # fmt: skip
def test_wrong_options_are_exit_2(
    more: list[str], shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = run(shots, tmp_path / "c.json", capsys, *more)
    assert code == 2
    assert told["error"]["type"] == "UsageError"


def test_broken_files_are_all_named_at_once(shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        shutil.copytree(shots / name, tmp_path / name)
    (tmp_path / "a/cam_a_01.png").write_bytes(b"not a picture")
    (tmp_path / "b/cam_b_03.png").write_bytes((shots / "b/cam_b_03.png").read_bytes()[:500])
    code, told = run(tmp_path, tmp_path / "c.json", capsys)
    assert code == 4
    assert "cam_a_01" in told["error"]["value"]
    assert "cam_b_03" in told["error"]["value"]


def test_pictures_of_two_sizes_are_refused(shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        shutil.copytree(shots / name, tmp_path / name)
    shutil.copy(shots / "b/cam_b_01.png", tmp_path / "a/cam_a_01.png")
    code, told = run(tmp_path, tmp_path / "c.json", capsys)
    assert code == 4
    assert "size" in told["error"]["what"]


def make(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).write_bytes(b"x")
    return folder


def test_files_are_paired_by_stem_then_number_then_order(tmp_path: Path) -> None:
    a = make(tmp_path / "a", "v10.dat", "v2.dat", "v1.dat", "notes.txt", ".hidden.png")
    pairs, how = pair_up(a, make(tmp_path / "b", "v1.png", "v10.png", "v2.png", "v3.png"))
    assert how == "stem"
    assert [(p.spike.name, p.rgb.name) for p in pairs] == [("v1.dat", "v1.png"), ("v2.dat", "v2.png"),
                                                           ("v10.dat", "v10.png")]  # fmt: skip
    pairs, how = pair_up(a, make(tmp_path / "c", "GX010.png", "GX002.png", "GX001.png"))
    assert how == "number"
    assert [p.rgb.name for p in pairs] == ["GX001.png", "GX002.png", "GX010.png"]
    pairs, how = pair_up(a, make(tmp_path / "d", "x.png", "y.png", "z.png"))
    assert how == "order"
    assert [p.rgb.name for p in pairs] == ["x.png", "y.png", "z.png"]
    for folder in (make(tmp_path / "e", "x.png"), make(tmp_path / "f"), tmp_path / "g",
                   make(tmp_path / "h", "v1.png", "v1.jpg")):  # fmt: skip
        with pytest.raises(UsageError):
            pair_up(a, folder)


def moving(still: int, elsewhere: int = 35, ticks: int = 1024) -> SpikeFile:
    """A bar that stands for `still` ticks about the middle and is elsewhere before and after."""
    bits = np.zeros((ticks, 40, 64), bool)
    rng = np.random.default_rng(0)
    for t in range(ticks):
        at = 20 if abs(t - ticks // 2) <= still // 2 else elsewhere
        bits[t, :, at : at + 12] = rng.random((40, 12)) < 0.4
    stream = SpikeStream.from_pixels(bits, 40_000.0)
    return SpikeFile(Path("x"), "npz", ticks, 40, 64, lambda a, b: stream.bits[a:b], lambda: None, 40_000.0)


def test_short_windows_are_averaged_as_long_as_the_picture_is_still() -> None:
    reading = Reading(window=128, windows=7)
    quiet, brief = still_light(moving(1024), reading), still_light(moving(200), reading)
    assert quiet[:, 22:30].std() == pytest.approx(np.sqrt(0.24 / (7 * 128)), rel=0.25)
    assert brief[:, 22:30].std() == pytest.approx(np.sqrt(0.24 / 128), rel=0.25)
    assert brief[:, 36:46].max() == 0
    nudged = still_light(moving(200, elsewhere=21), reading)
    assert nudged[:, 22:30].std() == pytest.approx(np.sqrt(0.24 / 128), rel=0.25)


def test_how_far_a_picture_has_moved_is_measured_to_a_twelfth() -> None:
    y, x = np.mgrid[0:60, 0:80]

    def waves(dx: float, dy: float) -> np.ndarray:
        return (np.sin((x - dx) / 4) * np.cos((y - dy) / 5)).astype(np.float32)

    for dx, dy in ((0.0, 0.0), (0.3, -0.2), (-1.0, 0.5)):
        assert moved_px(waves(0, 0), waves(dx, dy)) == pytest.approx(np.hypot(dx, dy), rel=0.08, abs=1e-6)
    assert moved_px(waves(0, 0), np.zeros((60, 80), np.float32)) == float("inf")
    assert moved_px(np.ones((60, 80), np.float32), waves(0, 0)) == 0


def test_spike_files_that_show_nothing(tmp_path: Path) -> None:
    short = SpikeStream.from_pixels(np.zeros((4, 40, 64)), 40_000.0)
    write_spikes(tmp_path / "short.npz", short)
    with pytest.raises(DataError, match="few"):
        read_light(tmp_path / "short.npz", Reading())
    lost = SpikeStream(np.zeros((500, 40, 8), np.uint8), 64, 40_000.0, lost=np.array([[240, 260]]))
    write_spikes(tmp_path / "lost.npz", lost)
    with pytest.raises(DataError, match="lost"):
        read_light(tmp_path / "lost.npz", Reading())
    assert read_light(tmp_path / "lost.npz", Reading(at=100)).shape == (40, 64)
