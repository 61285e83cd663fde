"""Pictures for features: what is sharp and what is noise; COLMAP's child and what it may not do to us."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spikerig.calib.mapping import Options, build_map, colmap_camera, run_child
from spikerig.calib.pictures import Looks, looks, picture_of, texture_of
from spikerig.calib.poses import quaternion, rig_config
from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.scene import Camera
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture


def checks(noise: float, blur: int, seed: int = 0) -> np.ndarray:
    y, x = np.mgrid[:80, :120]
    p = 60.0 + 120 * ((y // 10 + x // 10) % 2)
    for _ in range(blur):
        p = (np.roll(p, 1, 1) + 2 * p + np.roll(p, -1, 1)) / 4
    return np.clip(np.rint(p + noise * np.random.default_rng(seed).normal(size=p.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_noise_is_measured_beside_edges(noise: float) -> None:
    assert looks([checks(noise, 0)], "x").noise == pytest.approx(noise, abs=0.3 + 0.15 * noise)


def blobs(shift: float, noise: float, soft: float, seed: int) -> np.ndarray:
    """Sixty spots of two sizes, moved by a shift, with noise of their own."""
    y, x = np.mgrid[:120, :160]
    p, rng = np.full((120, 160), 100.0), np.random.default_rng(5)
    for _ in range(60):
        cx, cy, wide = rng.uniform(8, 150), rng.uniform(8, 112), rng.uniform(1.5, 3)
        spread = wide**2 + soft**2
        p += rng.choice([-90, 90]) * wide**2 / spread * np.exp(-((x - cx - shift) ** 2 + (y - cy) ** 2) / 2 / spread)
    return np.clip(np.rint(p + noise * np.random.default_rng(seed).normal(size=p.shape)), 0, 255).astype(np.uint8)


def test_sharper_and_cleaner_scores_higher() -> None:
    """Features that are found again, and near their place: fewer on soft pictures, and on noisy ones."""

    def look(noise: float, soft: float) -> Looks:
        pair = blobs(0.0, noise, soft, 1), blobs(2.5, noise, soft, 2)
        return looks(pair, "x", [pair])

    sharp, soft, noisy = look(1.0, 0.0), look(1.0, 6.0), look(16.0, 0.0)
    assert sharp.refound > 30
    assert sharp.spread < 0.15
    assert sharp.score > 1.5 * soft.score
    assert sharp.score > 2 * noisy.score
    assert sharp.sharpness > 1.3 * soft.sharpness


def test_nothing_is_found_again_where_nothing_is() -> None:
    flat = np.full((60, 80), 90, np.uint8)
    assert looks([flat], "x", [(flat, flat)]).score == 0
    other = np.random.default_rng(1).integers(0, 255, (120, 160)).astype(np.uint8)
    assert looks([flat], "x", [(blobs(0, 0, 0, 1), other)]).score < 0.3 * looks([flat], "x", [(other, other)]).score


def test_pictures_of_textures() -> None:
    light = np.linspace(0, 0.4, 200, dtype=np.float32).reshape(10, 20)
    known = np.ones((10, 20), bool)
    known[3, 4] = False
    light[3, 4] = np.nan
    picture = picture_of(Texture(light, known, 0, "tfp"))
    assert picture[0, 0] == 0
    assert picture[9, 19] == 255
    assert 150 < picture[3, 4] < 210  # unknown: the median
    assert not picture_of(Texture(light, np.zeros_like(known), 0, "tfp")).any()
    stream = SpikeStream(np.zeros((100, 4, 1), np.uint8), 5, 4e4)
    assert texture_of(stream, 50, "tfp16").method
    for kind in ("tfq5", "tfp", "tfp0", "tfpx", ""):
        with pytest.raises(UsageError, match="kind of texture"):
            texture_of(stream, 50, kind)


def test_rig_configuration() -> None:
    camera = Camera.pinhole(40, 30, 60)
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    rows = rig_config(camera, camera, np.column_stack([R, [1.0, 2, 3]]))[0]["cameras"]
    assert rows[0]["ref_sensor"]
    w, x, y, z = rows[1]["cam_from_rig_rotation"]
    assert np.allclose([w, x, y, z], [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)])
    assert np.allclose(rows[1]["cam_from_rig_translation"], -R.T @ [1, 2, 3])
    assert np.allclose(quaternion(np.diag([1.0, -1, -1])), [0, 1, 0, 0])


@pytest.mark.parametrize(
    ("distortion", "model", "size"),
    [
        ([], "PINHOLE", 4),
        ([0, 0, 0, 0], "PINHOLE", 4),
        ([0.1, 0, 0, 0], "OPENCV", 8),
        ([0.1, 0, 0, 0, 0.2], "FULL_OPENCV", 12),
    ],
)
def test_cameras_for_colmap(distortion: list[float], model: str, size: int) -> None:
    K = np.array([[100.0, 0, 20], [0, 110, 15], [0, 0, 1]])
    told = colmap_camera(Camera(K, np.array(distortion), 40, 30))
    assert told["model"] == model
    assert len(told["params"]) == size
    assert told["params"][:4] == [100, 110, 20, 15]


def test_png_after_pycolmap_in_the_child() -> None:
    """pycolmap first, then the system's zlib, aborts; the child loads zlib before (dependency hazard)."""
    program = (
        "from spikerig.calib import colmap_child\nimport pycolmap, os, zlib, numpy as np, cv2\n"
        "zlib.compress(os.urandom(200000) * 5)\n"
        "assert cv2.imencode('.png', np.zeros((300, 300, 3), np.uint8))[0]\nprint('well')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "well", done.stderr


def test_the_parent_never_imports_pycolmap() -> None:
    program = (
        "import sys\nimport spikerig.calib.poses, spikerig.calib.mapping, spikerig.calib.pose_cli\n"
        "import spikerig.calib.posed_scene\nprint('pycolmap' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "False"


ALIKED = """
import zlib, numpy, cv2, pathlib, sys, pycolmap
root = pathlib.Path(sys.argv[1]).parent
(root / "images").mkdir()
cv2.imwrite(str(root / "images" / "a.png"), numpy.zeros((64, 64), numpy.uint8))
options = pycolmap.FeatureExtractionOptions()
options.type = pycolmap.FeatureExtractorType.ALIKED_N16ROT
pycolmap.extract_features(root / "d.db", root / "images", extraction_options=options)
"""


@pytest.mark.parametrize("program", ["import os, sys; print('boom', file=sys.stderr); os.abort()", ALIKED])
def test_a_child_that_dies_is_one_clear_error(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked for features it was built without, pycolmap ends its process: the parent lives, and reports it."""
    monkeypatch.setattr("spikerig.calib.mapping.CHILD", ("-c", program))
    with pytest.raises(HostError, match="COLMAP's process died") as caught:
        run_child(tmp_path / "job.json")
    assert "SIGABRT" in str(caught.value)


def test_a_job_that_is_wrong_says_how(tmp_path: Path) -> None:
    (tmp_path / "job.json").write_text(json.dumps({"seed": 1}))
    with pytest.raises(HostError, match="KeyError"):
        run_child(tmp_path / "job.json")


def test_too_few_pictures() -> None:
    with pytest.raises(UsageError, match="too few"):
        build_map({"a": checks(1, 0), "b": checks(1, 0)}, None, Options())
    for wrong in ({"pairs": "some"}, {"mapper": "magic"}):
        with pytest.raises(UsageError):
            Options(**wrong)
