"""Known answers on boards of others: a real stereo pair, mrcal's synthetic corners, numbers OpenCV published."""

import ast
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calib_rigs import bp

from spikerig.calib.boards import Board, find
from spikerig.calib.bundle import Sight, turn
from spikerig.calib.lens import our_matrix, project
from spikerig.calib.measure import measure, report
from spikerig.calib.mono import fit_lens
from spikerig.calib.optics import fit_arms, sight_of
from spikerig.calib.parity import inverse, times
from spikerig.calib.verdict import Seen
from spikerig.dataset.images import linear_from_srgb, read_image
from spikerig.dataset.scene import Camera

TEMUGE = Board(7, 4, 31.9)
BASELINE_MM = float(np.linalg.norm([301.1818, 88.1455, 10.2754]))  # published


@pytest.fixture(scope="module")
def pairs() -> list[Sight]:
    from conftest import DATA

    folder = DATA / "checkerboards/temuge/frames_pair"
    if not folder.exists():
        pytest.skip(f"third-party data 'checkerboards/temuge' is not here: set SPIKERIG_DATA (looked in {DATA})")
    found = []
    for arm in (0, 1):
        pictures = [linear_from_srgb(read_image(folder / f"camera{arm}_{k}.png")).mean(2) for k in range(4)]
        found.append(sight_of([find(p, TEMUGE) for p in pictures], TEMUGE, 1280, 720))
    return found


def told(first: Sight, second: Sight) -> dict:
    names = [str(k) for k in range(len(first.px))]
    seen = Seen(names, first, second, [(f"a{n}", f"b{n}") for n in names], [])
    return report(measure(TEMUGE, seen))


@pytest.mark.real
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_real_stereo_pair_is_a_valid_rig_mirrored_or_not(pairs: list[Sight], mirrored: bool) -> None:
    first, second = pairs
    if mirrored:  # as a detector would find it: labels run from left to right again
        second = second.flipped()
        second = Sight(np.stack([TEMUGE.relabelled(p, 0, True) for p in second.px]), second.seen, 1280, 720)
    found = told(first, second)
    assert found["accepted"] is True
    assert found["model"] == "stereo"
    assert found["mirrored"] == ("rgb" if mirrored else None)
    assert any("baseline" in w for w in found["warnings"])
    assert found["rms_px"]["spike"] < 0.12  # OpenCV 5: 0.117, 0.154, together 0.525
    assert found["rms_px"]["rgb"] < 0.155
    assert found["rms_px"]["stereo"] < 0.53
    assert found["baseline_mm"] == pytest.approx(BASELINE_MM, rel=0.005)
    if not mirrored:  # published: -301.18, 88.15, -10.28 mm; OpenCV 5 finds -301.0, 88.2, -10.9
        assert np.abs(np.array(found["rgb_from_spike"])[:, 3] - [-301.18, 88.15, -10.28]).max() < 4
    assert found["focal_px"]["spike"] == pytest.approx([903.25, 904.86], rel=0.025)
    assert found["focal_px"]["rgb"] == pytest.approx([985.21, 987.02], rel=0.025)


@pytest.mark.real
def test_the_same_pairs_in_another_order_are_refused(pairs: list[Sight]) -> None:
    first, second = pairs
    found = told(first, Sight(np.roll(second.px, 1, axis=0), second.seen, 1280, 720))
    assert found["reason_codes"] == ["not-one-rig"]
    assert found["rms_px"]["stereo"] > 100 * found["rms_px"]["spike"]


@pytest.mark.real
def test_mrcals_corners_give_mrcals_rig(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("checkerboards/mrcal")
    px: dict[str, list[list[float]]] = {}
    for line in (folder / "synthetic-board-observations.vnl").read_text().splitlines():
        if not line.startswith("#"):
            name, x, y, _ = line.split()
            px.setdefault(name, []).append([float(x) + 0.5, float(y) + 0.5])
    arms = [np.array([px[f"frame{k:06d}-cam{arm}.xxx"] for k in range(3)]) for arm in (0, 1)]
    sights = [Sight(a, np.ones(a.shape[:2], bool), 4000, 2200) for a in arms]
    fit = fit_arms(Board(10, 10, 100.0), *sights, lenses=(8,))
    models = [ast.literal_eval((folder / f"cam{arm}.opencv8.cameramodel").read_text()) for arm in (0, 1)]
    cams = [np.concatenate([turn(np.array(m["extrinsics"][:3])), np.reshape(m["extrinsics"][3:], (3, 1))], 1)
            for m in models]  # fmt: skip
    step = times(cams[1], inverse(cams[0]))
    assert fit.fit.rms_px() == pytest.approx(0.3 * np.sqrt(2), rel=0.06)  # its noise
    assert not fit.match.mirrored
    sd = [fit.sure.sd[f"shift_{a}_mm"] for a in "xyz"]
    assert np.all(np.abs(fit.fit.step[:, 3] - step[:, 3] * 1000) < 4 * np.array(sd))
    assert max(sd) < 30
    for (K, _), m, arm in zip(fit.fit.lenses, models, ("spike", "rgb"), strict=True):
        fx, fy, cx, cy = m["intrinsics"][:4]
        want = {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5}
        have = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        for name, value in want.items():
            assert abs(have[name] - value) < 4 * fit.sure.sd[f"{arm}.{name}_px"], (arm, name)


# opencv/opencv samples/data/left_intrinsics.yml: 13 views of 9x6, 25 mm, 640x480
PER_VIEW = [0.192965463, 1.18204820, 0.173180386, 0.193417311, 0.159574091, 0.179683909, 0.230989486, 0.241952404,
            0.296267658, 0.167184874, 0.202002615, 0.381039530, 0.174401343]  # fmt: skip
PUBLISHED = Camera(
    our_matrix(np.array([[535.91573396163199, 0, 342.28315473308373], [0, 535.91573396163199, 235.57082909788173],
                         [0, 0, 1]])),
    np.array([-0.26637260909660682, -0.038588898922304653, 0.0017831947042852964, -0.00028122100441115472,
              0.23839153080878486]), 640, 480,
)  # fmt: skip


def test_opencvs_published_lens_is_found_again_and_residuals_are_counted_as_opencv_does() -> None:
    board = Board(9, 6, 25.0)
    poses = bp.poses(13, 4, near=330, far=600)
    x = board.points() @ poses[:, :, :3].transpose(0, 2, 1) + poses[:, None, :, 3]
    noise = np.random.default_rng(2).normal(size=(13, 54, 2)) * 0.1
    mono = fit_lens(board.points(), Sight(project(PUBLISHED, x) + noise, np.ones((13, 54), bool), 640, 480), (5,))
    K, c = mono.fit.lenses[0]
    for name, value in {"fx0": K[0, 0] - PUBLISHED.K[0, 0], "cy0": K[1, 2] - PUBLISHED.K[1, 2],
                        "k1_0": c[0] - PUBLISHED.distortion[0]}.items():  # fmt: skip
        assert abs(value) < 4 * mono.fit.sd(name), name
    assert mono.fit.sd("fx0") < 1
    assert np.sqrt((mono.fit.view_rms_px(0) ** 2).mean()) == pytest.approx(mono.fit.rms_px(), rel=1e-9)
    assert np.sqrt((np.array(PER_VIEW) ** 2).mean()) == pytest.approx(0.39259098975581364, rel=1e-6)
