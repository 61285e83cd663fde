"""What is left between the arms: found to hundredths of a pixel, taken away, and refused where it cannot be told."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spikerig.dataset.errors import DataError
from spikerig.dataset.images import linear_from_srgb, srgb8_from_linear
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train import arms
from spikerig.train.gauge import Gauge
from spikerig.train.methods import configure
from spikerig.train.targets import load_targets

UNIT = Gauge((0.0, 0.0, 0.0), 1.0)
GRAY = np.array([0.3, 0.6, 0.1, 0.01])


def waves(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """A smooth picture [H,W,3] at any (fractional) pixels."""
    rng = np.random.default_rng(seed)
    picture = np.full((*x.shape, 3), 0.4)
    for _ in range(6):
        fx, fy, phase = *rng.uniform(-0.25, 0.25, 2), rng.uniform(0, 6)
        picture += 0.05 * np.sin(fx * x + fy * y + phase)[..., None] * rng.uniform(0.5, 1, 3)
    return picture


def pair(matrix: np.ndarray, seed: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A frame, and the spikes' gray of what the frame shows `matrix` further on; exact, nothing is resampled."""
    height, width = 60, 90
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    base = np.stack([np.ones_like(x), x / width * 2 - 1, (2 * y - height) / width])
    u, v = np.tensordot(matrix, base, 1)
    gray = waves(x + u, y + v, seed) @ GRAY[:3] + GRAY[3]
    return waves(x, y, seed), gray + np.random.default_rng(seed).normal(0, noise, gray.shape)


@pytest.mark.parametrize(
    ("kind", "matrix"),
    [
        ("shift", [[0.8, 0, 0], [-0.55, 0, 0]]),
        ("shift", [[4.2, 0, 0], [2.5, 0, 0]]),
        ("affine", [[0.8, 0.5, -0.3], [-0.55, 0.2, 0.6]]),
    ],
)
def test_the_motion_between_the_arms_is_found(kind, matrix):
    pairs = [pair(np.array(matrix), seed, 0.004) for seed in range(4)]
    frames, spikes = zip(*pairs, strict=True)
    found = arms.motion_of(list(frames), list(spikes), [np.ones((60, 90), bool)] * 4, GRAY, kind)
    assert found.matrix == pytest.approx(np.array(matrix), abs=0.03)
    assert found.rms_after == pytest.approx(0.004, abs=0.0005)
    assert found.rms_before > found.rms_after
    assert found.as_json()["shift_px"] == list(found.shift_px)


def test_pixels_outside_the_masks_have_no_say():
    frame, gray = pair(np.array([[0.8, 0, 0], [0.3, 0, 0]]), 1)
    gray[:, 30:50] = 0.9
    mask = np.ones((60, 90), bool)
    mask[:, 30:50] = False
    found = arms.motion_of([frame], [gray], [mask], GRAY, "shift")
    assert found.shift_px == pytest.approx((0.8, 0.3), abs=0.02)


def test_no_texture_and_too_far_are_told():
    flat = np.full((60, 90, 3), 0.5)
    with pytest.raises(DataError, match="registered"):
        arms.motion_of([flat], [np.full((60, 90), 0.5)], [np.ones((60, 90), bool)], GRAY, "shift")
    frame, gray = pair(np.array([[0.5, 0, 0], [0.5, 0, 0]]), 1)
    with pytest.raises(DataError, match="registered"):
        arms.motion_of([frame], [gray], [np.zeros((60, 90), bool)], GRAY, "shift")
    x, y = np.meshgrid(np.arange(90.0), np.arange(60.0))

    def bowl(by: float) -> np.ndarray:
        return np.stack([((x + by) / 90) ** 2, (y / 60) ** 2, 0 * x], -1)

    with pytest.raises(DataError, match="apart"):
        arms.motion_of([bowl(0)], [bowl(18) @ GRAY[:3] + GRAY[3]], [np.ones((60, 90), bool)], GRAY, "shift")


def test_a_moved_picture_is_that_of_the_frame_further_on():
    frame, _ = pair(np.zeros((2, 3)), 3)
    there = arms.moved(frame, np.array([[2.0, 0, 0], [-1.0, 0, 0]]))
    assert there[10:-10, 10:-10] == pytest.approx(frame[9:-11, 12:-8], abs=1e-5)
    assert arms.moved(frame, np.zeros((2, 3))) == pytest.approx(frame)


def test_frames_of_a_scene_are_brought_to_its_spikes(tiny, tmp_path):
    """Frames moved by hand come back; what left the picture is not valid; a remark tells."""
    hand = np.array([[1.3, 0, 0], [-0.7, 0, 0]])
    with open_scene(tiny) as file:
        scene = file.read()
    views = []
    for view in scene.views:
        light = arms.moved(linear_from_srgb(view.frame.pixels / 255), -hand).clip(0, 1)
        views.append(replace(view, frame=replace(view.frame, pixels=srgb8_from_linear(light))))
    write_scene(tmp_path / "off.h5", replace(scene, views=tuple(views)))

    def error(path, kind: str) -> tuple[float, tuple[str, ...]]:
        with open_scene(path) as opened:
            made = load_targets(opened, configure("ours", "draft", align_arms=kind), UNIT)
        rows = [
            (a.frame - torch.from_numpy(b.frame.pixels / 255).float())[6:-6, 6:-6].abs().mean()
            for a, b in zip(made.views, (v for v in scene.views if v.split == "train"), strict=True)
        ]
        if kind != "off":
            assert made.views[0].valid is not None
            assert made.views[0].valid[:, :-2].any()
            assert not made.views[0].valid[:, -1].any()
        return float(np.mean(rows)), made.remarks

    off, silent = error(tmp_path / "off.h5", "off")
    for kind in ("shift", "affine"):
        aligned, told = error(tmp_path / "off.h5", kind)
        assert aligned < off / 3
        assert "moved by +1." in told[0]
    assert not silent
