"""The watch over the framing: it finds what is missing, in time, and is silent on pictures that move."""

from math import floor

import numpy as np
import pytest
from framing_scenes import light, wire_bytes
from vidar_bench import K20

from spikerig.dataset.framing import byte_counts, find_shift
from spikerig.rigctl.profiles import PROFILES
from spikerig.rigctl.sim.emulate.spikewire import encode_ticks
from spikerig.rigctl.sim.stream import spike_blocks
from spikerig.rigctl.slip_watch import Refound, Slip, SlipWatch

K416, M1 = PROFILES["vidar-400x250-20k-416"], PROFILES["m1k40-1000x1000-20k"]


def chunks(data, profile, ticks=1024, at=0):
    """(byte index, bytes) of whole chunks."""
    size = ticks * profile.tick_bytes
    return [(at + k, data[k : k + size]) for k in range(0, len(data), size)]


def run(profile, parts, watch=None):
    watch = watch or SlipWatch(profile)
    return watch, [t for t in (watch.add(0, at, data) for at, data in parts) if t]


def still(profile, kind, ticks, seed=0):
    once = wire_bytes(profile, kind, 256, seed)
    return np.tile(once, -(-ticks // 256))[: ticks * profile.tick_bytes]


def moving(profile, rows_s, columns_s, ticks, kind="texture", seed=0):
    """A picture that moves evenly; light is a crop of a larger one."""
    big = light(2 * profile.height, 2 * profile.width, kind, seed).astype(np.float32)
    step = 64
    pictures = []
    for t in range(0, ticks + 1, step):
        y, x = (t / profile.rate_hz * v for v in (rows_s, columns_s))
        i, j = floor(y) % profile.height, floor(x) % profile.width
        u, v = y - floor(y), x - floor(x)
        crop = big[i : i + profile.height + 1, j : j + profile.width + 1]
        mix = (1 - u) * ((1 - v) * crop[:-1, :-1] + v * crop[:-1, 1:]) + u * (
            (1 - v) * crop[1:, :-1] + v * crop[1:, 1:]
        )
        pictures.append((t, np.ascontiguousarray(mix, np.float32)))
    start = np.random.default_rng(seed).random((profile.height, profile.width)) * 0.999
    return encode_ticks(np.concatenate(list(spike_blocks(pictures, start, hold=False))), profile)


@pytest.mark.parametrize("profile", [K20, K416], ids=lambda p: p.name)
@pytest.mark.parametrize("kind", ["texture", "object"])
@pytest.mark.parametrize("lost", [12, 3, 6000, 12_499])
@pytest.mark.parametrize("tick", [500, 1300, 2047])
def test_a_loss_is_found_in_its_chunk(profile, kind, lost, tick):
    data = still(profile, kind, 3200)
    cut = tick * profile.tick_bytes + 777
    came = np.concatenate([data[:cut], data[cut + lost :]])
    watch, told = run(profile, chunks(came, profile))
    row = profile.row_bits // 8
    if kind == "object" and lost % row in (0, row - 1):  # may as well be a picture that moved by rows: not told
        assert told == []
        return
    (slip,) = told
    assert isinstance(slip, Slip)
    assert slip.after <= cut <= slip.before
    assert slip.before - slip.after <= 100 * profile.tick_bytes
    assert (slip.lost + slip.shift) % profile.tick_bytes == 0
    assert (slip.lost - lost) % profile.tick_bytes in (0, row, profile.tick_bytes - row)
    if kind == "texture":
        assert slip.lost == lost % profile.tick_bytes
    assert slip.confidence >= 0.999
    assert watch.untested == 0


@pytest.mark.parametrize("kind", ["texture", "object", "flat"])
def test_a_whole_stream_is_silent(kind):
    watch, told = run(K20, chunks(still(K20, kind, 4096, seed=2), K20))
    assert told == []
    assert watch.looks == 4
    assert watch.suspicions == 0


def test_noise_and_the_dark_are_silent():
    rng = np.random.default_rng(1)
    for data in (rng.integers(0, 256, 3000 * 12_500, dtype=np.uint8), np.zeros(3000 * 12_500, np.uint8)):
        watch, told = run(K20, chunks(data, K20))
        assert (told, watch.suspicions) == ([], 0)
        assert watch.looks == 3


@pytest.mark.parametrize(
    ("rows_s", "columns_s"), [(20, 0), (-20, 0), (45, 7), (0, 160), (150, 400), (-333, 90), (900, 1500)]
)
@pytest.mark.parametrize("kind", ["texture", "object"])
def test_a_moving_picture_is_no_loss(rows_s, columns_s, kind):
    data = moving(K20, rows_s, columns_s, 3 * 1024, kind)
    watch, told = run(K20, chunks(data, K20))
    assert told == []
    assert watch.looks == 3


def test_a_loss_in_a_moving_picture_is_found():
    data = moving(K20, 45, 30, 3 * 1024)
    cut = 1500 * K20.tick_bytes + 31
    _, (slip,) = run(K20, chunks(np.concatenate([data[:cut], data[cut + 28 :]]), K20))
    assert slip.after <= cut <= slip.before
    assert slip.lost == 28


def test_tests_are_rationed_and_what_was_not_tested_is_counted():
    watch, tested, told = SlipWatch(K20), [], []
    test = watch._test

    def counted(before: int, at: int, shift: int) -> Slip | None:
        left = watch.untested
        slip = test(before, at, shift)
        tested.append(watch.untested == left)
        return slip

    watch._test = counted
    data = moving(K20, 900, 400, 2048)
    for k in range(24):  # carried about: each look sees another place
        part = data[k % 2 * 1024 * K20.tick_bytes :][: 1024 * K20.tick_bytes]
        told.append(watch.add(0, k * len(part), part))
    assert told == [None] * 24
    assert watch.untested == tested.count(False) > 0
    assert 4 <= tested.count(True) <= 2 * (4 + watch.looks // 16 + 1)


def test_pieces_of_any_size_are_followed():
    data = still(K20, "texture", 2600)
    cut = 1500 * K20.tick_bytes + 99
    came = np.concatenate([data[:cut], data[cut + 20 :]])
    watch, told, at = SlipWatch(K20), [], 12_345
    for size in np.random.default_rng(0).integers(1, 300 * K20.tick_bytes, 60):
        told.append(watch.add(0, at, came[at : at + size]))
        at += size
    (slip,) = [t for t in told if t]
    assert slip.after <= cut <= slip.before
    assert slip.lost == 20


def test_after_a_told_loss_the_framing_is_found_again_with_its_confidence():
    watch = SlipWatch(K20)
    data = still(K20, "object", 2048)
    watch.add(0, 0, data[: 1024 * K20.tick_bytes])
    found = watch.add(1, 0, data[1024 * K20.tick_bytes + 5000 :])
    assert isinstance(found, Refound)
    assert (found.epoch, found.shift) == (1, K20.tick_bytes - 5000)
    assert found.confidence > 0.999
    assert watch.add(1, len(data), data) is None  # what lies between is not judged
    other = SlipWatch(K20)
    other.add(0, 0, data[: 1024 * K20.tick_bytes])
    found = other.add(1, 0, still(K20, "texture", 1024, seed=9))
    assert found.confidence < 0.9  # another view: no answer


def test_tags_of_megapixel_blocks_need_no_picture():
    data = wire_bytes(M1, "texture", 40)[64:]
    size, step = M1.tick_bytes, 10 * M1.tick_bytes
    watch = SlipWatch(M1)
    late = round(0.06 * M1.bytes_s)
    assert watch.add(0, 0, data[:step]) is None
    assert watch.add(0, step, data[640:step]) is None  # too soon for another look
    at = late // size * size
    slip = watch.add(0, at, data[640 : 640 + step])
    assert (slip.lost, slip.shift, slip.confidence) == (640, size - 640, 1.0)
    assert watch.add(0, 2 * at, data[:step]) is None  # told once
    found = watch.add(1, 0, data[1280 : 1280 + step])
    assert isinstance(found, Refound)


def test_a_cheap_picture_of_bytes_is_the_sum_of_their_bits():
    data = wire_bytes(K416, "texture", 20)
    bits = np.unpackbits(data.reshape(20, -1), axis=1).reshape(20, -1, 8).sum(axis=(0, 2))
    assert np.array_equal(byte_counts(data, K416.tick_bytes), bits)
    later = byte_counts(data[5 * 52 :][: 19 * K416.tick_bytes], K416.tick_bytes)
    assert find_shift(later, bits) == K416.tick_bytes - 5 * 52
    assert find_shift(bits, bits) == 0
    assert find_shift(np.random.default_rng(0).permutation(later), bits) == 0
