"""Spikes in blocks: the bits of one piece, whatever the blocks, in bounded memory."""

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.dataset.kernels import count, fire
from spikerig.dataset.sim_kernels import fire_noisy
from spikerig.rigctl.sim.stream import opened, spike_blocks

SHAPE = (3, 13)
KNOTS = [-7, 0, 1, 40, 300, 301, 530]
NOISE = {"shot": (30.0, (1, 2)), "comparator": (0.05, (3, 4)), "reset_loss": 0.02}
PIXELS = {"ideal": {}, "carry": {"carry": True}, "noisy": NOISE, "noisy, carry": NOISE | {"carry": True}}


def light(top: float = 1.3) -> np.ndarray:
    rng = np.random.default_rng(0)
    return (top * rng.random((len(KNOTS), *SHAPE)) ** 2).astype(np.float32)


def start() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 2**32, SHAPE) / 2.0**32


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("pixel", PIXELS.values(), ids=PIXELS.keys())
@pytest.mark.parametrize("block_ticks", [1, 3, 64, 97, 10_000])
def test_blocks_are_the_bits_of_the_whole(hold: bool, pixel: dict, block_ticks: int) -> None:
    rows, knots = light(), np.array(KNOTS)
    charge = (start() * 2.0**32).astype(np.int64)
    if set(pixel) <= {"carry"}:
        first = charge if pixel else charge.astype(np.uint32)
        bits, left, lost = fire(rows, knots, first, hold=hold, **pixel)
    else:
        bits, left, lost = fire_noisy(rows, knots, charge, hold=hold, **pixel)
    account = opened(start())
    pictures = zip(KNOTS, rows, strict=True)
    blocks = list(spike_blocks(pictures, account, hold=hold, block_ticks=block_ticks, pixel=pixel))
    assert max(map(len, blocks)) <= block_ticks
    assert np.array_equal(np.concatenate(blocks), bits)
    assert np.array_equal(account.charge, left)
    assert np.allclose(account.lost, lost, rtol=1e-13)
    assert account.ticks == len(bits) == KNOTS[-1] - KNOTS[0]


def test_an_account_goes_on() -> None:
    rows = light()
    account = opened(start())
    first = list(spike_blocks(zip(KNOTS[:4], rows[:4], strict=True), account, hold=False, pixel=NOISE))
    second = list(spike_blocks(zip(KNOTS[3:], rows[3:], strict=True), account, hold=False, pixel=NOISE))
    whole = list(spike_blocks(zip(KNOTS, rows, strict=True), start(), hold=False, pixel=NOISE))
    assert np.array_equal(np.concatenate(first + second), np.concatenate(whole))


def test_pictures_at_every_tick_are_held_only_a_few_at_a_time() -> None:
    held: list[int] = []

    def pictures() -> Iterator[tuple[int, np.ndarray]]:
        for tick in range(2001):
            held.append(tick)
            yield tick, np.full((2, 9), 0.3, np.float32)

    most, done = 0, 0
    for block in spike_blocks(pictures(), hold=True):
        done += len(block)
        most = max(most, len(held) - done)
    assert done == 2000
    assert most <= 64


def test_no_light_no_ticks_one_tick() -> None:
    picture = np.full((2, 9), 0.5, np.float32)
    assert list(spike_blocks([], hold=True)) == []
    assert list(spike_blocks([(5, picture)], hold=False)) == []
    (one,) = spike_blocks([(5, picture), (6, picture)], np.full((2, 9), 0.5), hold=False)
    assert one.shape == (1, 2, 2)
    assert (one == [0xFF, 0x01]).all()
    dark = np.concatenate(list(spike_blocks([(0, picture * 0), (9000, picture)], np.full((2, 9), 0.99), hold=True)))
    assert dark.shape == (9000, 2, 2)
    assert not dark.any()


def test_a_minute_at_40_khz_in_bounded_memory() -> None:
    """2,400,000 ticks under light that changes every 1000: the counts of integers, 16 MB at most."""
    height, width, every, ticks = 4, 61, 1000, 2_400_000
    rng = np.random.default_rng(3)
    levels = rng.integers(0, 2**20, (16, height, width)) * (rng.random((height, width)) < 0.9)

    def pictures() -> Iterator[tuple[int, np.ndarray]]:
        for k in range(ticks // every + 1):
            yield k * every, (levels[k % 16] / 2.0**24).astype(np.float32)  # exact in float32

    account, counted = opened(np.zeros((height, width))), np.zeros((height, width), np.int64)
    tracemalloc.start()
    try:
        for block in spike_blocks(pictures(), account, hold=True):
            counted += count(block, width, 0, len(block))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    turns = np.bincount(np.arange(ticks // every) % 16, minlength=16)
    units = (turns[:, None, None] * levels).sum(0) * every * 2**8  # 2^-32 thresholds
    assert np.array_equal(counted, units >> 32)
    assert np.array_equal(account.charge, units & 0xFFFFFFFF)
    assert account.ticks == ticks
    assert peak < 16e6


def test_what_is_refused() -> None:
    picture = np.full((2, 9), 0.5, np.float32)
    for pictures in (
        [(0, picture), (0, picture)],
        [(3, picture), (2, picture)],
        [(0, picture), (4, picture[:1])],
        [(0, picture[0]), (4, picture[0])],
    ):
        with pytest.raises(UsageError):
            list(spike_blocks(pictures, hold=True))
    with pytest.raises(UsageError, match="block"):
        list(spike_blocks([(0, picture), (4, picture)], hold=True, block_ticks=0))
    for bad in (1.0, -0.1, np.nan):
        with pytest.raises(NumericsError, match="charge"):
            opened(np.full((2, 9), bad))
    with pytest.raises(NumericsError, match="light"):
        list(spike_blocks([(0, -picture), (4, picture)], hold=True))
