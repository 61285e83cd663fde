"""Hard inputs of the spike kernels and textures, by name; and the rows that say what must come out."""

import numpy as np

from spikerig.dataset.spikes import SpikeStream

H, W = 3, 21


def _stream(pixels, lost=()):
    return SpikeStream(
        np.packbits(pixels, axis=2, bitorder="little"), pixels.shape[2], 40_000.0, 0, "rig",
        np.array(lost, np.int64).reshape(-1, 2),
    )  # fmt: skip


def _pixels(ticks, fill=0):
    return np.full((ticks, H, W), fill, np.uint8)


def _with(ticks, *at):
    pixels = _pixels(ticks)
    pixels[list(at)] = 1
    return pixels


def _random(ticks):
    return (np.random.default_rng(5).random((ticks, H, W)) < 0.2).astype(np.uint8)


# name -> stream; T, lost ticks and light are at their extremes
STREAMS = {
    "no tick": _stream(_pixels(0)),
    "one dark tick": _stream(_pixels(1)),
    "one bright tick": _stream(_pixels(1, 1)),
    "always dark": _stream(_pixels(600)),
    "a spike every tick": _stream(_pixels(600, 1)),
    "a spike in the first tick only": _stream(_with(300, 0)),
    "a spike in the last tick only": _stream(_with(300, 299)),
    "a spike at both ends": _stream(_with(300, 0, 299)),
    "every tick lost": _stream(_pixels(300), [(0, 300)]),
    "every other tick lost": _stream(_random(301), [(t, t + 1) for t in range(0, 301, 2)]),
    "the ends lost": _stream(_random(300), [(0, 5), (290, 300)]),
    "random": _stream(_random(300)),
}

# name -> light in thresholds a tick at both ends of a ramp
LIGHTS = {
    "black": (0.0, 0.0),
    "the smallest float": (float(np.nextafter(np.float32(0), np.float32(1))),) * 2,
    "one unit of charge a tick": (2.0**-32, 2.0**-32),
    "the last float below a threshold": (float(np.nextafter(np.float32(1), np.float32(0))),) * 2,
    "one threshold a tick": (1.0, 1.0),
    "the first float above a threshold": (float(np.nextafter(np.float32(1), np.float32(2))),) * 2,
    "a ramp from black to a threshold": (0.0, 1.0),
    "a ramp down to black": (1.0, 0.0),
    "a ramp through saturation": (0.25, 40.0),
    "the sun": (2.0**18, 2.0**18),
    "a third": (1 / 3, 1 / 3),
}

_N = "numerics/test_spikes.py"
_T = "dataset/test_texture.py"
_K = "dataset/test_kernels.py"
ROWS: list[tuple[str, str, str, str]] = [
    ("all of `STREAMS`: no tick, dark, saturated, ticks lost", "tfp, tfi, tfi causal, tfp_adaptive", "finite light in "
     "[0, 1]; not known is False and 0, never an infinity", f"{_N}::test_textures_are_finite_and_honest"),
    ("all of `STREAMS`", "count, tfi_at, tfi_all, unpack", "equal to the integer oracle", f"{_N}::test_kernels"),
    ("a dark pixel", "tfi", "not known, not black", f"{_T}::test_dark_and_saturated_pixels_are_finite_and_honest"),
    ("an instant on a lost tick, or an interval over one", "tfp, tfi, tfp_adaptive", "not known",
     f"{_T}::test_lost_ticks_make_textures_unknown_where_they_touch"),
    ("a window that leaves the stream", "tfp", "the part inside counts, by its own length",
     f"{_T}::test_tfp_is_the_count_over_the_part_of_the_window_inside"),
    ("the causal interval", "tfi", "too bright by H_n, as documented",
     f"{_T}::test_causal_tfi_has_the_bias_its_docstring_states"),
    ("a sensor whose pixels start in step", "tfp_adaptive", "the longest window in steady light, error below 1/256",
     f"{_T}::test_adaptive_window_grows_to_the_longest_in_steady_light"),
    ("an interval of 65535 ticks and more", "tfi_all", "65535", f"{_K}::test_tfi_all_saturates_at_65535"),
    ("70,000 ticks with a spike each", "count", "70,000: no plane overflows", f"{_N}::test_count_of_a_long_window"),
    ("all of `LIGHTS`: black, denormal, a threshold a tick, the sun", "fire", "in = fired + left + clipped in "
     "integers; equal to the oracle", f"{_N}::test_fire_conserves_charge_at_the_extremes"),
    ("the sun for 100,000 ticks", "fire", "2^66 units clipped, all counted", f"{_N}::test_the_sun_for_a_long_time"),
    ("light of one unit a tick", "fire", "one spike, at the very last tick", f"{_N}::test_a_unit_of_charge_counts"),
    ("a million ticks of a third", "fire", "333,333 spikes: no drift", f"{_N}::test_fire_does_not_drift"),
    ("a ramp over a million ticks", "fire", "the area of the triangle to a spike",
     f"{_N}::test_a_long_ramp_has_the_area_of_its_triangle"),
    ("a row that ends inside a byte, a vector, a section", "unpack, count, tfi_at, tfi_all, fire",
     "equal to the oracle, padding bits zero", f"{_N}::test_every_width"),
    ("NaN, infinite or negative light", "fire", "NumericsError", f"{_K}::test_fire_refuses_light_that_is_none"),
]  # fmt: skip
