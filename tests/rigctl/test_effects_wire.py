"""Between camera and disk: lost blocks, bit flips, rows wider than the picture."""

import numpy as np
import pytest
from hard_sim import steady

from spikerig.dataset.errors import UsageError
from spikerig.dataset.spikes import SpikeStream, open_spikes
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.effects.blocks import LostBlocks, merged
from spikerig.rigctl.sim.effects.flips import BitFlips
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.effects.rows import WideRows, wire_bytes
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Sensor

ONE = Sensor(gain=1.0, response=(1.0, 0.0, 0.0))


def run(light: Light, *effects: Effect, seed: int = 3, view: int = 0) -> SpikeStream:
    return simulate(light, ONE, effects, seed, view).spikes


@pytest.mark.parametrize("effect", [LostBlocks(0.0), BitFlips(0.0), WideRows(), WideRows(0)], ids=lambda e: e.name)
def test_the_limit_of_an_effect_is_its_absence(effect: Effect) -> None:
    light = steady(0.3, 70, 5, 13)
    a, b = run(light, InitialPhase(), effect), run(light, InitialPhase())
    assert np.array_equal(a.bits, b.bits)
    assert np.array_equal(a.lost, b.lost)


def test_lost_ticks_are_zero_and_listed() -> None:
    ticks = 20_000
    seen = run(steady(1.0, ticks, 2, 5), LostBlocks(0.002, 30.0))
    lost = np.zeros(ticks, bool)
    for first, stop in seen.lost:
        assert 0 <= first < stop <= ticks
        assert not lost[first:stop].any()
        lost[first:stop] = True
    assert (seen.lost[1:, 0] > seen.lost[:-1, 1]).all()  # apart and in order
    assert np.array_equal(lost, ~seen.bits.any(axis=(1, 2)))
    # a tick is there when no block began k ticks before and lasted longer: P = prod (1 - chance (1 - 1/mean)^k)
    kept = np.exp(-0.002 * 30)
    assert 1 - lost.mean() == pytest.approx(kept, abs=5 * np.sqrt(0.06 * 2 * 30 / ticks))


def test_blocks_have_the_mean_length_asked_for() -> None:
    rng = np.random.default_rng(1)
    lengths = np.concatenate([np.diff(LostBlocks(1e-4, 8.0).lost(rng, 100_000))[:, 0] for _ in range(60)])
    assert lengths.mean() == pytest.approx(8, abs=5 * 8 / np.sqrt(len(lengths)))


def test_everything_lost() -> None:
    seen = run(steady(1.0, 50), LostBlocks(1.0))
    assert seen.lost.tolist() == [[0, 50]]
    assert not seen.bits.any()
    assert run(steady(1.0, 1), LostBlocks(1.0)).lost.tolist() == [[0, 1]]


def test_merged_ranges() -> None:
    assert merged(np.array([[5, 9], [1, 3], [3, 4], [20, 20], [7, 12]])).tolist() == [[1, 4], [5, 12]]
    assert merged(np.zeros((0, 2), np.int64)).shape == (0, 2)


@pytest.mark.parametrize("chance", [1e-3, 0.5, 1.0])
def test_flips_have_their_chance_and_spare_the_padding(chance: float) -> None:
    light = steady(0.3, 900, 10, 13)
    bits = [
        np.unpackbits(run(light, InitialPhase(), *e).bits, axis=2, bitorder="little") for e in ([], [BitFlips(chance)])
    ]
    wrong = bits[0] != bits[1]
    assert not wrong[:, :, 13:].any()
    total = 900 * 130
    assert abs(wrong.sum() - chance * total) <= 5 * np.sqrt(chance * (1 - chance) * total)
    assert (chance < 1) or wrong[:, :, :13].all()


def test_flips_are_everywhere_and_their_own_in_each_view() -> None:
    light = steady(0.0, 12_000, 12, 16)  # drawn for in parts
    first, second = (run(light, BitFlips(0.01), view=v) for v in (0, 1))
    ones = np.unpackbits(first.bits, axis=2, bitorder="little")
    for axes in ((1, 2), (0, 2), (0, 1)):
        parts = np.array_split(ones.sum(axis=axes), 4)
        assert max(p.sum() for p in parts) < 1.2 * min(p.sum() for p in parts)
    assert not np.array_equal(first.bits, second.bits)


def test_flips_in_blocks_that_never_arrive_do_not_show() -> None:
    """Whatever the order in the list, the wire flips first and then loses."""
    for effects in ([LostBlocks(0.05, 10.0), BitFlips(0.5)], [BitFlips(0.5), LostBlocks(0.05, 10.0)]):
        seen = run(steady(0.3, 300, 4, 9), *effects)
        assert len(seen.lost)
        for first, stop in seen.lost:
            assert not seen.bits[first:stop].any()


@pytest.mark.parametrize(("height", "width", "row_bits"), [(250, 400, 416), (3, 8, 24), (3, 9, 20), (2, 5, 5)])
def test_bytes_on_the_wire_decode_to_the_same_spikes(tmp_path, height: int, width: int, row_bits: int) -> None:
    stream = SpikeStream.from_pixels(np.random.default_rng(0).random((7, height, width)) < 0.3)
    data = wire_bytes(stream, row_bits, seed=5)
    assert len(data) == 7 * ((height * row_bits + 7) // 8)
    path = tmp_path / "s.dat"
    path.write_bytes(data)
    with open_spikes(path, height=height, width=width, row_bits=row_bits) as file:
        assert np.array_equal(file.read().bits, stream.bits)
    assert (data == wire_bytes(stream, row_bits, seed=6)) == (row_bits == width)
    assert data == wire_bytes(stream, row_bits, seed=5)


def test_trailers_are_not_zero() -> None:
    rows = np.frombuffer(wire_bytes(SpikeStream.from_pixels(np.zeros((40, 250, 400), bool))), np.uint8)
    rows = np.unpackbits(rows.reshape(-1, 52), axis=1, bitorder="little")
    assert not rows[:, :400].any()
    assert rows[:, 400:].mean() == pytest.approx(0.5, abs=0.01)


def test_rows_narrower_than_the_picture() -> None:
    with pytest.raises(UsageError, match="hold the width"):
        wire_bytes(SpikeStream.from_pixels(np.zeros((1, 2, 9), bool)), 8)
