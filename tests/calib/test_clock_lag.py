"""Edges that an encoder makes late: many short clips of one camera, few frames coded by themselves."""

from dataclasses import replace

import numpy as np
import pytest

from spikerig.calib.clock import fit_clock
from spikerig.calib.clock_sight import LAG_NS, pooled
from spikerig.dataset.clocktime import NS
from spikerig.dataset.marks import Sight

LAG, SKEW, RESPONSE = 170_000, -40e-6, 30_000


def clips(many: int, key_every: int, seed: int = 0, seen: int = 24) -> tuple[list[Sight], list[int]]:
    """Sights of clips of 0.4 s whose clocks begin anew, late by LAG where predicted; and the clips' true offsets."""
    rng = np.random.default_rng(seed)
    told, offsets = [], []
    for epoch in range(many):
        offset = int(rng.integers(10**12))
        offsets.append(offset)
        for k, at in enumerate(np.sort(rng.integers(0, 4 * NS // 10, seen)).tolist()):
            rising, late = bool(rng.integers(2)), bool((k + epoch) % key_every)
            off = LAG * late + (RESPONSE if rising else -RESPONSE) + 60_000 * rng.standard_normal()
            panel = offset + at + round(SKEW * at)
            told.append(Sight("rgb", epoch, round(at + off), panel, 60_000.0, rising, 0, 64.0 * (k % 2), late))
    return told, offsets


def judged(told: list[Sight], offsets: list[int]) -> tuple[np.ndarray, np.ndarray]:
    at = np.arange(0, 4 * NS // 10, NS // 100)
    off, claimed = [], []
    for piece in fit_clock(told, "rgb"):
        model = piece.track.model(0, piece.bias_ns)
        off.append(model.rig_from_device(at) - offsets[piece.epoch] - at - np.rint(SKEW * at))
        claimed.append(2 * model.sigma_at(at))
    return np.abs(np.concatenate(off)), np.concatenate(claimed)


@pytest.mark.parametrize("seed", range(3))
def test_all_clips_together_tell_the_lag_and_the_frequency(seed: int) -> None:
    told, offsets = clips(40, 12, seed)
    off, claimed = judged(told, offsets)
    assert np.percentile(off, 99) <= 100_000
    assert np.percentile(claimed, 50) <= 100_000
    assert (off <= claimed).mean() >= 0.95
    # Without the word that frames were predicted all is late by the lag, and nothing tells.
    blind, _ = judged([replace(s, predicted=False) for s in told], offsets)
    assert np.median(blind) > 100_000


def test_without_a_frame_coded_by_itself_the_claim_is_wide() -> None:
    told, offsets = clips(10, 12)
    off, claimed = judged([s for s in told if s.predicted], offsets)
    assert np.median(off) > 100_000
    assert (claimed > 1.5 * LAG_NS).all()
    assert (off <= claimed).all()


def test_one_clip_says_what_it_does_not_know() -> None:
    told, offsets = clips(1, 12)
    off, claimed = judged(told, offsets)
    assert (off <= claimed).all()


def test_pooling_takes_the_prior_off_and_keeps_what_differs() -> None:
    rng = np.random.default_rng(1)
    prior, sd = np.array([100.0]), np.array([80.0])
    own = 50 + 20 * rng.standard_normal((400, 1))
    data = own + sd * rng.standard_normal((400, 1))
    after = 1 / np.sqrt(1 / sd**2 + 1 / prior**2)
    mean, within = pooled(list(data / sd**2 * after**2), [after] * 400, prior)
    assert mean[0] == pytest.approx(50, abs=12)
    assert 5 < within[0] < 45
