"""Where ticks begin, told from the bits: right on pictures, and humble where there is nothing to tell from."""

import numpy as np
import pytest
from framing_scenes import wire_bytes
from vidar_bench import K20, MID, SMALL

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.framing import find_phase, fold, period_gain, rates_at, row_lag
from spikerig.rigctl.profiles import PROFILES

K416 = PROFILES["vidar-400x250-20k-416"]
M1 = PROFILES["m1k40-1000x1000-20k"]


def noise(profile, ticks, density=0.5, seed=0):
    rng = np.random.default_rng(seed)
    return np.packbits(rng.random(8 * profile.tick_bytes * ticks) < density, bitorder="little")


@pytest.mark.parametrize("profile", [K20, K416, MID], ids=lambda p: p.name)
@pytest.mark.parametrize("kind", ["texture", "ramp"])
def test_the_seam_tells_the_very_byte(profile, kind):
    for seed in range(3):
        data = wire_bytes(profile, kind, 66, seed, trailer=0xA5)
        cut = (profile.tick_bytes * (3 + seed)) // 11
        phase = find_phase(data[cut : cut + 64 * profile.tick_bytes], profile)
        assert phase.offset == profile.tick_bytes - cut
        assert phase.confidence > 0.99
        assert phase.how == "seam"


@pytest.mark.parametrize("profile", [K20, K416, SMALL], ids=lambda p: p.name)
def test_where_no_seam_is_to_be_seen_the_confidence_is_low(profile):
    for kind in ("object", "flat"):
        data = wire_bytes(profile, kind, 66, trailer=0xA5)
        phase = find_phase(data[777 % profile.tick_bytes :][: 64 * profile.tick_bytes], profile)
        assert phase.confidence < 0.5
    for density in (0.5, 0.1, 0.0, 1.0):
        assert find_phase(noise(profile, 64, density), profile).confidence < 0.05


@pytest.mark.parametrize("profile", [K20, K416, MID, SMALL], ids=lambda p: p.name)
@pytest.mark.parametrize("kind", ["texture", "object", "flat"])
def test_an_earlier_picture_tells_it_on_any_scene(profile, kind):
    data = wire_bytes(profile, kind, 130)
    like = rates_at(data[: 64 * profile.tick_bytes], profile, 0)
    for lost in (4, 1280, profile.tick_bytes // 2 // 4 * 4, profile.tick_bytes + 12):
        phase = find_phase(data[64 * profile.tick_bytes + lost :], profile, like)
        assert phase.offset == -lost % profile.tick_bytes
        assert phase.confidence > 0.99
    for density in (0.5, 0.1):
        assert find_phase(noise(profile, 64, density), profile, like).confidence < 0.05


def test_a_picture_of_another_place_is_no_answer():
    like = rates_at(wire_bytes(K20, "texture", 64, seed=1), K20, 0)
    told = [find_phase(wire_bytes(K20, "texture", 64, seed=s)[4000:], K20, like).confidence for s in (2, 3, 4)]
    assert max(told) < 0.9


def test_tags_of_megapixel_blocks_are_sure():
    data = wire_bytes(M1, "texture", 17)
    assert find_phase(data[128_000 - 4320 :], M1).offset == 4320
    assert find_phase(data[64:], M1).confidence == 1.0
    assert find_phase(noise(M1, 17), M1).confidence == 0.0


def test_the_right_period_foretells_and_a_wrong_one_does_not():
    for right, wrong in ((K20, K416), (K416, K20)):
        data = wire_bytes(right, "texture", 128)[1000:]
        assert period_gain(data, right.tick_bytes) > 1000
        assert period_gain(data, wrong.tick_bytes) < period_gain(data, right.tick_bytes) / 10
        lag, out = row_lag(fold(data, right.tick_bytes)[0])
        assert (lag, out > 10) == (right.row_bits, True)
    assert period_gain(noise(K20, 128), K20.tick_bytes) < 0


def test_the_rates_of_a_tick_are_means_of_its_bits():
    data = wire_bytes(SMALL, "texture", 40)
    rates, ticks = fold(data, SMALL.tick_bytes)
    bits = np.unpackbits(data.reshape(40, -1), axis=1, bitorder="little")
    assert ticks == 40
    assert np.array_equal(rates, bits.mean(axis=0))
    with pytest.raises(DataError, match="too few"):
        fold(data[: 15 * SMALL.tick_bytes], SMALL.tick_bytes)
    with pytest.raises(UsageError, match="another size"):
        find_phase(data, SMALL, np.zeros(3))
