"""The converter from RGB to gray: exact on blurry pairs, sane where not determined, refused where it is nonsense."""

import numpy as np
import pytest

from spikerig.dataset.errors import DataError
from spikerig.dataset.images import linear_from_srgb
from spikerig.train.gray import Pairs, solve
from spikerig.train.methods import configure
from spikerig.train.run import run_fit

TRUE = np.array([0.25, 0.40, 0.35])


def gathered(colour: bool = True, noise: float = 0.0, gain: float = 0.4, seed: int = 0) -> Pairs:
    rng = np.random.default_rng(seed)
    pairs = Pairs()
    for _ in range(4):
        codes = rng.integers(0, 256, (30, 40, 3 if colour else 1), dtype=np.uint8)
        codes = np.broadcast_to(codes, (30, 40, 3))
        light = linear_from_srgb(codes)
        counts = (
            gain * (light @ TRUE + 0.005) + rng.normal(0, noise, (30, 40)) if noise else gain * (light @ TRUE + 0.005)
        )
        pairs.add(codes, light, counts, np.ones((30, 40), bool))
    return pairs


def test_the_true_converter_is_found_with_or_without_the_gain():
    for known in (0.4, None):
        gray = solve(gathered(), "calibrated", known)
        white = 0.4 if known else 0.4 * (TRUE.sum() + 0.005)
        assert gray.white == pytest.approx(white, rel=1e-4)
        assert np.array(gray.weights) * gray.white / 0.4 == pytest.approx(TRUE, abs=1e-4)
        assert gray.bias * gray.white / 0.4 == pytest.approx(0.005, abs=1e-4)
        assert gray.rms < 1e-4


def test_noise_of_counts_hardly_moves_it():
    gray = solve(gathered(noise=0.02), "calibrated", 0.4)
    assert np.array(gray.weights) == pytest.approx(TRUE, abs=0.01)
    assert gray.rms == pytest.approx(0.05, rel=0.1)


def test_a_colourless_scene_falls_back_to_rec601_times_the_gain():
    gray = solve(gathered(colour=False), "calibrated", 0.4)
    assert sum(gray.weights) == pytest.approx(1.0, abs=1e-3)
    assert gray.weights[1] > gray.weights[0] > gray.weights[2] > 0


def test_clipped_pixels_are_left_out():
    codes = np.full((20, 20, 3), 120, np.uint8)
    codes[:, :10] = np.random.default_rng(0).integers(10, 240, (20, 10, 3), dtype=np.uint8)
    light = linear_from_srgb(codes)
    counts = light @ TRUE
    codes = codes.copy()
    codes[:, 10:] = 255
    pairs = Pairs()
    pairs.add(codes, light, counts * np.where(codes[..., 0] == 255, 9, 1), np.ones((20, 20), bool))
    assert pairs.pixels == 200


def test_rec601_needs_no_pixels_where_the_gain_is_known():
    assert solve(Pairs(), "rec601", 0.3).weights == (0.299, 0.587, 0.114)
    with pytest.raises(DataError, match="too few pixels"):
        solve(Pairs(), "rec601", None)


def test_a_black_scene_and_foreign_spikes_are_told():
    with pytest.raises(DataError, match="too few pixels"):
        solve(Pairs(), "calibrated", 0.4)
    pairs, rng = Pairs(), np.random.default_rng(0)
    codes = rng.integers(10, 240, (40, 40, 3), dtype=np.uint8)
    light = linear_from_srgb(codes)
    pairs.add(codes, light, 1 - light @ TRUE, np.ones((40, 40), bool))
    with pytest.raises(DataError, match="do not grow"):
        solve(pairs, "calibrated", None)


@pytest.mark.parametrize("kind", ["constrained", "response"])
def test_held_converters_train_keep_their_sum_and_are_told_in_the_record(tiny, tmp_path, kind):
    done = run_fit(
        tiny,
        configure("spikenerf", "draft", steps=60, splats=300, gray=kind, lr_gray=0.05),
        tmp_path / kind,
        eval_every=0,
    )
    gray = done["learned_gray"]
    assert sum(gray[:3]) == pytest.approx(1.0, abs=1e-5)
    assert min(gray[:3]) > 0
    assert gray != pytest.approx([0.299, 0.587, 0.114, 0.0], abs=1e-3)
    curve = done["learned_response"]
    if kind == "constrained":
        assert curve is None
    else:
        assert curve == sorted(curve)
        assert (curve[0], curve[-1]) == pytest.approx((0, 1), abs=1e-5)
