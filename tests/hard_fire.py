"""Hard inputs of the firing kernels, and light of whole 2^-32 thresholds to feed them."""

import numpy as np

UNIT = 2.0**-32


def levels(rng: np.random.Generator, shape: tuple[int, ...], bits: int, top: int) -> np.ndarray:
    """Light that float32 and the fixed point both hold exactly: whole multiples of 2^-bits, below `top` of them."""
    return rng.integers(0, top, shape) * 2.0**-bits


def hdr(height: int, width: int, top: float = 0.9) -> np.ndarray:
    """Light of 1e6 to 1 in one frame."""
    return np.logspace(-6, 0, height * width).reshape(height, width) * top


FILE = "numerics/test_fire.py::"
ROWS = [
    ("no light", "fire, fire_noisy", "no spike, the charge unchanged, whatever the shot noise", FILE + "test_no_light"),
    (
        "light exactly at the threshold, a hair below, a hair above",
        "fire, fire_noisy",
        "a spike every tick and nothing clipped; one tick missed in 2^24; the hair clipped, to the last unit",
        FILE + "test_at_the_threshold",
    ),
    (
        "light of two thresholds a tick and more, up to 2^18",
        "fire",
        "a spike every tick; in = fired + left + clipped in integers",
        FILE + "test_far_above_the_threshold",
    ),
    (
        "a ramp that crosses the threshold within a segment",
        "fire",
        "clipped only while above, exactly; the next tick below fires by its charge",
        FILE + "test_a_ramp_through_the_threshold",
    ),
    (
        "saturation, clipped or carried",
        "fire(carry)",
        "clipped: spikes end with the light; carried: they go on until all is fired, nothing lost",
        FILE + "test_saturation_clipped_and_carried",
    ),
    (
        "2,000,000 ticks of dim light",
        "fire, spike_blocks",
        "counts and charge equal Python's integers where float32 sums stand still",
        FILE + "test_two_million_dim_ticks",
    ),
    (
        "2,000,000 ticks of a ramp of next to nothing",
        "fire",
        "light never falls below zero, counts within half a unit a tick of the exact integral",
        FILE + "test_two_million_ticks_of_a_ramp",
    ),
    ("odd sizes, one pixel", "fire, fire_noisy", "the same bits as inside a wide picture", FILE + "test_odd_sizes"),
    ("T = 0 and T = 1", "fire, fire_noisy", "no bits; one decision", FILE + "test_no_tick_and_one_tick"),
    (
        "light in float32 against float64",
        "fire",
        "spikes move only where the charge is within the rounding of a threshold; counts differ by one at most there",
        FILE + "test_float32_moves_only_crossings",
    ),
    ("HDR 1e6:1 in one frame", "fire, fire_noisy", "each count within one of its light", FILE + "test_hdr"),
    (
        "few electrons, many electrons, next to none",
        "philox.poisson",
        "mean, variance and skewness of the Poisson distribution from 0.01 to 1e4",
        "dataset/test_philox.py::test_poisson_has_the_moments_of_its_distribution",
    ),
    (
        "blocks of any length, threads, instruction sets, start ticks beyond 2^32",
        "fire_noisy",
        "the same bits",
        "dataset/test_sim_kernels.py::test_spans_of_any_length_give_the_same_bits",
    ),
    (
        "a minute of ticks at 40 kHz",
        "spike_blocks",
        "bounded memory, counts of integers",
        "rigctl/test_stream.py::test_a_minute_at_40_khz_in_bounded_memory",
    ),
    (
        "charge that nobody can count",
        "fire(carry)",
        "at most 2^30 thresholds wait; what is beyond is counted as clipped",
        "dataset/test_kernels.py::test_fire_carries_no_more_than_fits",
    ),
]
