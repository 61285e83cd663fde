"""Fitted clocks as records and files: what was found of each, how maps are put after one another, JSON and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikerig.calib.clock_track import Track
from spikerig.dataset.clocktime import ClockModel, Int64
from spikerig.dataset.errors import DataError, UsageError

SCHEMA = "spikerig.clocks/1"
ONE_SIDED = np.sqrt(3) / 2  # a bound on one side only: twice the sigma must reach it, and needs no more


@dataclass(frozen=True, slots=True)
class ClockFit:
    """The map of one clock to rig time over one part: an epoch, or what lies between two steps of it.

    Args:
        clock, epoch: of the marks.
        how: "two-way", "one-way", "sights" or "rig" (the rig's own clock), and what it was put after.
        model: rig time from the clock's; sigma holds noise, wander and the bias bound. Twice it is what the map is
            good to in at least 95 % of cases.
        valid_ns: first and last mark, the clock's time; outside, the model holds over.
        bias_ns: bound on what no residual shows: half the delay of probes, the floor latency of one-way stamps, an
            allowance for the reading of a panel.
        proved: the bound follows from the marks; else it is assumed.
        skew_ppm, skew_sd_ppm: of rig time against the clock at the last mark.
        residual_ns: rms of the marks used; it is not the accuracy.
        marks, used: how many there were, and how many were not outliers.
        constants: what else was solved for, ns.
        notes: what a person should know.
    """

    clock: str
    epoch: int
    how: str
    model: ClockModel
    valid_ns: tuple[int, int]
    bias_ns: float = 0.0
    proved: bool = True
    skew_ppm: float = 0.0
    skew_sd_ppm: float = 0.0
    residual_ns: float = 0.0
    marks: int = 0
    used: int = 0
    constants: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def uncertainty_ns(self, device_ns: Any) -> Any:
        """What the map is good to at device times: twice the sigma."""
        return 2 * self.model.sigma_at(device_ns)


@dataclass(frozen=True, slots=True)
class Clocks:
    """Every clock's way to rig time.

    Args:
        rig: whose time rig time is: "box", or without one "spike".
        origin_ns: rig time 0 on that clock.
        fits: parts of all clocks.
        notes: breaks, and what was assumed.
    """

    rig: str
    origin_ns: int
    fits: tuple[ClockFit, ...]
    notes: tuple[str, ...] = ()

    def fit(self, clock: str, epoch: int | None = None, at_ns: int | None = None) -> ClockFit:
        """The part of a clock that covers `at_ns`, or is nearest to it; of the only epoch where none is named.

        Raises:
            DataError: there is none, or an epoch must be named.
        """
        found = [f for f in self.fits if f.clock == clock and epoch in (None, f.epoch)]
        if not found:
            raise DataError("no map of this clock", value=f"{clock}, epoch {epoch}", expected=self._have())
        if len({f.epoch for f in found}) > 1:
            raise DataError("this clock has several epochs: name one", value=clock, expected=self._have())
        if at_ns is None:
            return found[-1]
        return min(found, key=lambda f: max(f.valid_ns[0] - at_ns, at_ns - f.valid_ns[1], 0))

    def _have(self) -> str:
        return ", ".join(dict.fromkeys(f"{f.clock} epoch {f.epoch}" for f in self.fits)) or "none at all"


def as_fit(
    clock: str, epoch: int, how: str, track: Track, origin_ns: int, bias_ns: float = 0.0, **more: Any
) -> ClockFit:
    """A track as a fit; `origin_ns` of y is rig time 0."""
    sided = ONE_SIDED if how == "one-way" else 1.0
    return ClockFit(
        clock, epoch, how, track.model(origin_ns, bias_ns * sided), track.valid_ns, bias_ns,
        skew_ppm=track.skew_ppm, skew_sd_ppm=track.skew_sd_ppm, residual_ns=track.residual_ns,
        marks=len(track.used), used=int(track.used.sum()), **more,
    )  # fmt: skip


def compose(outer: ClockModel, inner: ClockModel) -> ClockModel:
    """The map that first goes by `inner`, then by `outer`; knots of both, variances added."""
    of_outer = inner.device_from_rig(outer.device_ns)
    x = np.unique(np.concatenate([inner.device_ns, of_outer]))
    middle = inner.rig_from_device(x)
    y = outer.rig_from_device(middle)
    keep = np.concatenate([[True], (np.diff(y) > 0)])
    sigma = np.hypot(inner.sigma_at(x), outer.sigma_at(middle))
    return ClockModel(x[keep], y[keep], sigma[keep], inner.drift_ppm + outer.drift_ppm)


def invert(model: ClockModel) -> ClockModel:
    """The way back; sigma is the same to the skew."""
    return ClockModel(model.rig_ns, model.device_ns, model.sigma_ns, model.drift_ppm)


def shifted(model: ClockModel, by_ns: int, sigma_ns: float = 0.0) -> ClockModel:
    """The same map with `by_ns` added to rig time, itself known to `sigma_ns`."""
    return ClockModel(
        model.device_ns, model.rig_ns + np.int64(by_ns), np.hypot(model.sigma_ns, sigma_ns), model.drift_ppm
    )


def joined(models: Sequence[ClockModel], starts_ns: Sequence[int]) -> ClockModel:
    """One map from several of the same clock; the k-th holds from `starts_ns[k]` on.

    Raises:
        DataError: rig time would step back at a start.
    """
    xs, ys, ss = [], [], []
    for k, model in enumerate(models):
        low = starts_ns[k] if k else np.iinfo(np.int64).min
        high = starts_ns[k + 1] if k + 1 < len(models) else np.iinfo(np.int64).max
        x = model.device_ns[(model.device_ns >= low) & (model.device_ns < high)]
        ends = [np.int64(v) for v in ((low,) if k else ()) + ((high - 1,) if k + 1 < len(models) else ())]
        x = np.unique(np.concatenate([x, np.array(ends, np.int64)]))
        xs.append(x)
        ys.append(model.rig_from_device(x))
        ss.append(model.sigma_at(x))
    x, y, s = (np.concatenate(v) for v in (xs, ys, ss))
    y = _rising(y)
    return ClockModel(x, y, s, models[-1].drift_ppm)


def _rising(y: Int64) -> Int64:
    """Strictly increasing with as little change as can be: rounding may put two knots on one nanosecond."""
    back = np.diff(y)
    if (back < -1_000_000).any():
        raise DataError("rig time would step back", value=f"{back.min()} ns", cause="a clock's epochs are out of order")
    steps = np.arange(len(y), dtype=np.int64)
    return np.maximum.accumulate(y - steps) + steps


def as_json(clocks: Clocks) -> dict[str, Any]:
    """JSON-ready; `from_json` reads it back exactly."""
    fits = []
    for f in clocks.fits:
        m = f.model
        told = {name: getattr(f, name) for name in ClockFit.__dataclass_fields__ if name != "model"}
        told["constants"] = dict(f.constants)
        model = {"device_ns": m.device_ns.tolist(), "rig_ns": m.rig_ns.tolist(), "sigma_ns": m.sigma_ns.tolist()}
        fits.append({**told, "model": {**model, "drift_ppm": m.drift_ppm}})
    return {
        "schema": SCHEMA, "rig": clocks.rig, "origin_ns": clocks.origin_ns, "notes": list(clocks.notes), "fits": fits
    }  # fmt: skip


def from_json(told: Any) -> Clocks:
    """Clocks from a document of `as_json`.

    Raises:
        DataError: it is no such document.
    """
    try:
        if told["schema"] != SCHEMA:
            raise ValueError(f"schema {told['schema']!r}")
        fits = []
        for f in told["fits"]:
            m = f["model"]
            device, rig = np.array(m["device_ns"], np.int64), np.array(m["rig_ns"], np.int64)
            sigma = np.array(m["sigma_ns"], np.float64)
            if not np.isfinite(sigma).all() or (sigma < 0).any():
                raise ValueError("a sigma is no number")
            model = ClockModel(device, rig, sigma, float(m["drift_ppm"]))
            rest = {k: v for k, v in f.items() if k != "model"}
            rest["valid_ns"], rest["notes"] = tuple(map(int, f["valid_ns"])), tuple(f["notes"])
            fits.append(ClockFit(model=model, **rest))
        return Clocks(str(told["rig"]), int(told["origin_ns"]), tuple(fits), tuple(told["notes"]))
    except (KeyError, TypeError, ValueError, OverflowError, UsageError) as error:
        raise DataError("not a file of fitted clocks", cause=str(error), next="spikerig calib clock TAKE") from error
