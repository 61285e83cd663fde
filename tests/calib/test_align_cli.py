"""`spikerig calib align`: a simulated, misaligned scene is put right in place, or refused."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
from calib_takes import SCENE, misaligned, rig_of
from hard_sim import small

from spikerig.calib.bundle import turn
from spikerig.calib.rig import write_calibration
from spikerig.dataset import cli
from spikerig.dataset.flat import FlatField, write_flat
from spikerig.dataset.scene import Pose
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.rigctl.sim.capture import capture


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """raw.h5, whose RGB arm is turned; good.h5, whose arms agree; calib.json, the true rig."""
    folder = tmp_path_factory.mktemp("takes")
    misaligned(folder / "raw.h5")
    capture(small(**SCENE, effects=["threshold_fpn"]), folder / "good.h5", workers=1)
    write_calibration(folder / "calib.json", rig_of(folder / "raw.h5"))
    return folder


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, dict]:
    code = cli.run(["calib", "align", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_a_misaligned_scene_is_put_right(takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, sheet, overlays = tmp_path / "out.h5", tmp_path / "sheet.html", tmp_path / "overlays"
    code, told = run(capsys, takes / "raw.h5", "--with", takes / "calib.json", "-o", out, "--sheet", sheet,
                     "--overlays", overlays)  # fmt: skip
    assert code == 0
    assert told["schema"] == "spikerig.calib.align/1"
    assert told["accepted"] is True
    assert told["edges_px"]["median"] < 0.3
    assert verify_scene(out) == []
    with open_scene(takes / "raw.h5") as raw, open_scene(takes / "good.h5") as good, open_scene(out) as found:
        assert found.names == raw.names
        assert found.info["align"]["calibration"] == told["calibration"]
        assert found.calibration is not None
        assert found.calibration["id"] == told["calibration"]
        for name in found.train:
            a, b, c = raw.view(name), good.view(name), found.view(name)
            assert c.spikes is not None
            assert a.spikes is not None
            np.testing.assert_array_equal(c.spikes.bits, a.spikes.bits)
            np.testing.assert_array_equal(c.pose.cam_from_world, a.pose.cam_from_world)
            assert 0.8 < c.valid.mean() < 1
            before = np.abs(a.frame.pixels.astype(float) - b.frame.pixels)[c.valid].mean()
            after = np.abs(c.frame.pixels.astype(float) - b.frame.pixels)[c.valid].mean()
            assert after < 0.25 * before
            np.testing.assert_array_equal(found.truth_light(name), raw.truth_light(name))
    page = sheet.read_text(encoding="utf-8")
    assert all(word in page for word in ("TFP", "TFI", "red-cyan", "<svg", told["calibration"][:16]))
    assert "http" not in page
    assert len(list(overlays.glob("*.png"))) == 2 * len(told["edges_px"]["views"])
    code, told = run(capsys, out, "--with", takes / "calib.json")
    assert code == 2
    assert "already" in told["error"]["what"]


def test_in_place_only_when_whole(takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                  monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    from spikerig.calib import aligned_scene

    path = tmp_path / "scene.h5"
    path.write_bytes((takes / "raw.h5").read_bytes())
    before = path.read_bytes()

    def fails(*told: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(aligned_scene, "_truth", fails)
        assert cli.run(["calib", "align", str(path), "--with", str(takes / "calib.json")]) == 130
    real = os.replace

    def stopped(source: str | Path, target: str | Path) -> None:
        if Path(target) == path:
            raise KeyboardInterrupt
        real(source, target)

    with monkeypatch.context() as broken:
        broken.setattr(os, "replace", stopped)
        assert cli.run(["calib", "align", str(path), "--with", str(takes / "calib.json")]) == 130
    capsys.readouterr()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["scene.h5"]
    code, told = run(capsys, path, "--with", takes / "calib.json")
    assert code == 0
    assert told["written"] == str(path)
    assert path.read_bytes() != before
    assert verify_scene(path) == []


def test_a_rig_that_was_touched_since_is_refused_or_refined(
    takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true, out = rig_of(takes / "raw.h5"), tmp_path / "out.h5"
    M = true.spike_from_rgb.cam_from_world
    knocked = np.concatenate([turn(np.radians([0.3, 0.3, 0.0])) @ M[:, :3], M[:, 3:]], 1)
    write_calibration(tmp_path / "old.json", dataclasses.replace(true, spike_from_rgb=Pose(knocked)))
    words = (takes / "raw.h5", "--with", tmp_path / "old.json", "-o", out)
    code, told = run(capsys, *words)
    assert code == 4
    assert told["accepted"] is False
    assert not out.exists()
    code, told = run(capsys, *words, "--refine")
    assert code == 0
    assert told["edges_px"]["median"] < 0.4
    code, told = run(capsys, *words, "--force")
    assert code == 0
    assert told["forced"] is True
    with open_scene(out) as scene:
        assert scene.info["align"]["forced"] is True


def test_what_cannot_be_aligned(takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = dataclasses.replace(rig_of(takes / "raw.h5").rgb, width=320)
    write_calibration(tmp_path / "wide.json", dataclasses.replace(rig_of(takes / "raw.h5"), rgb=other))
    code, told = run(capsys, takes / "raw.h5", "--with", tmp_path / "wide.json", "-o", tmp_path / "o.h5")
    assert code == 4
    assert "size" in told["error"]["what"]
    (tmp_path / "regions.json").write_text('[{"arm": "left", "polygon_px": []}]')
    code, told = run(capsys, takes / "raw.h5", "--with", takes / "calib.json", "--check", "--regions",
                     tmp_path / "regions.json")  # fmt: skip
    assert code == 4
    assert "regions" in told["error"]["what"]
    (tmp_path / "regions.json").write_text('[{"arm": "rgb", "polygon_px": [[10, 10], [60, 10], [60, 40], [10, 40]]}]')
    code, told = run(capsys, takes / "raw.h5", "--with", takes / "calib.json", "--check", "--regions",
                     tmp_path / "regions.json")  # fmt: skip
    assert code == 0
    assert told["written"] is None
    assert told["valid"] < 0.92


def test_textures_are_evened_out_on_request(takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    ones = np.ones((100, 160), np.float32)
    rough = np.where(rng.random(ones.shape) < 0.5, 0.4, 1.6).astype(np.float32)
    for name, gain in (("even", ones), ("rough", rough)):
        write_flat(tmp_path / f"{name}.npz", FlatField(gain, 0 * ones, ones > 0, ones))
    words = (takes / "raw.h5", "--with", takes / "calib.json")
    score = {}
    for name in ("even", "rough"):
        code, told = run(capsys, *words, "--check", "--flat", tmp_path / f"{name}.npz", "--force")
        assert code == 0
        score[name] = told["edges_px"]["median"]
    assert score["even"] == run(capsys, *words, "--check")[1]["edges_px"]["median"]
    assert score["rough"] is None or score["rough"] > score["even"]  # a wrong map spoils the edges: it was used
    code, told = run(capsys, *words, "-o", tmp_path / "out.h5", "--flat", tmp_path / "even.npz")
    assert code == 0
    with open_scene(tmp_path / "out.h5") as scene:
        assert scene.info["align"]["files"]["flat"]["name"] == "even.npz"
        assert len(scene.info["align"]["files"]["flat"]["sha256"]) == 64
    small = FlatField(*(a[:50] for a in (ones, ones, ones > 0, ones)))
    write_flat(tmp_path / "small.npz", small)
    code, told = run(capsys, *words, "--check", "--flat", tmp_path / "small.npz")
    assert code == 2
    assert "another sensor" in told["error"]["what"]
