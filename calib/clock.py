"""When: raw marks in, every clock's map to rig time out, with what it is good to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np

from spikerig.calib.clock_hull import ASSUMED_NS, hull_floor
from spikerig.calib.clock_maps import ClockFit, Clocks, as_fit, compose, invert, joined, shifted
from spikerig.calib.clock_probe import Gated, gate, reweighed
from spikerig.calib.clock_resets import once, parts
from spikerig.calib.clock_sight import ALLOWED_NS, around, named, pooled, sight_pairs
from spikerig.calib.clock_track import Pairs, Track, Wander, track
from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError
from spikerig.dataset.marks import Mark, Probe, Reset, Sight

LEAST_PPM = 2.0  # a camera's clips differ by as much: it warms
LEAST_NS = {"two-way": 100_000.0, "one-way": 1_000_000.0, "sights": 400_000.0}  # smaller steps are not told apart


@dataclass(frozen=True, slots=True)
class Options:
    """How to fit.

    Args:
        wander: what the clocks may do.
        stamp_ns: step of the box's stamps: 32,000 of Harp.
        assumed_ns: what the floor latency of one-way stamps is believed to stay below where nothing proves it.
        origin_ns: rig time 0 on the rig's clock; None: the first mark on it.
    """

    wander: Wander = field(default_factory=Wander)
    stamp_ns: int = 32_000
    assumed_ns: float = ASSUMED_NS
    origin_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of one clock against another: y of the track is `to`'s time."""

    clock: str
    epoch: int
    how: str
    to: str
    track: Track
    bias_ns: float
    proved: bool
    notes: tuple[str, ...]


def fit_rig(marks: Sequence[Mark], options: Options | None = None) -> Clocks:
    """The way to rig time of every clock that has marks.

    Rig time is the box's from the take's start. Where the box began anew, the host carries it over the gap. Without
    a box it is the spike camera's clock, and what both cameras saw of the same LEDs ties them: relative time only.

    Args:
        marks: of a take, in any order.
        options: how to fit.

    Raises:
        DataError: no marks that tie a clock to the rig's.
    """
    options = options or Options()
    marks = once(marks)
    host = fit_clock(marks, "host", options)
    seen = {name: fit_clock(marks, name, options) for name in ("spike", "rgb")}
    if host:
        return _by_box(host, seen, options)
    return _by_sight(seen, options)


def fit_clock(marks: Sequence[Mark], clock: str, options: Options | None = None) -> list[Piece]:
    """One clock against the one it was compared with, a piece an epoch and a part between steps.

    "host" is fitted to the box by two-way probes; a camera to the panel by sights, or else to the host by one-way
    stamps. The list is empty without marks, and in the order of the clock's time within an epoch.
    """
    options = options or Options()
    if clock == "host":
        probes = [m for m in marks if isinstance(m, Probe) and m.clock == "box" and m.sent_ns is not None]
        breaks = sorted(m.host_ns for m in marks if isinstance(m, Reset) and m.clock == "host")
        keyed = _grouped(probes, lambda p: (p.epoch, int(np.searchsorted(breaks, p.received_ns))))
        return [piece for key, group in keyed for piece in _two_way(key[0], group, options)]
    sights = _grouped([m for m in marks if isinstance(m, Sight) and m.clock == clock], lambda s: s.epoch)
    stamps = _grouped([m for m in marks if isinstance(m, Probe) and m.clock == clock], lambda p: p.epoch)
    told = _sights(clock, sights, options)
    have = {piece.epoch for piece in told}
    return told + [p for epoch, group in stamps if epoch not in have for p in _one_way(clock, epoch, group, options)]


def _grouped(marks: Sequence, key) -> list:
    return [(k, list(group)) for k, group in groupby(sorted(marks, key=key), key=key)]


def _two_way(epoch: int, probes: Sequence[Probe], options: Options) -> list[Piece]:
    gated: Gated = gate(probes, options.stamp_ns)
    least = max(LEAST_NS["two-way"], 2 * gated.bias_ns)
    bias = gated.bias_ns
    return _pieces("host", epoch, "two-way", "box", gated.pairs, options, least, bias, True)


def _sights(clock: str, groups: list[tuple[int, list[Sight]]], options: Options) -> list[Piece]:
    lags = any(s.predicted for _, group in groups for s in group)
    pairs = [(epoch, sight_pairs(group, lags)) for epoch, group in groups]
    rest = (LEAST_NS["sights"], ALLOWED_NS[clock], False)
    if clock == "rgb" and lags and len(pairs) > 1:
        options = replace(options, wander=replace(options.wander, skew_ppm=0.0))
    told = [p for epoch, own in pairs for p in _pieces(clock, epoch, "sights", "box", own, options, *rest)]
    if options.wander.skew_ppm is None:
        return told
    # A clip is short, and few of its frames are coded by themselves: all clips of the camera together tell how late
    # the others are, and how fast its clock runs.
    tracks = [p.track for p in told]
    mean, sd = pooled([t.constants for t in tracks], [t.constants_sd for t in tracks], pairs[0][1].prior)
    wander = options.wander
    (ppm,), (within,) = pooled(
        [np.array([t.skew_ppm]) for t in tracks], [np.array([t.skew_sd_ppm]) for t in tracks], np.array([wander.ppm])
    )
    options = replace(options, wander=replace(wander, skew_ppm=float(ppm), ppm=float(max(within, LEAST_PPM))))
    told = [
        p for epoch, own in pairs
        for p in _pieces(clock, epoch, "sights", "box", around(own, mean, sd), options, *rest)
    ]  # fmt: skip
    return [replace(p, track=replace(p.track, constants=p.track.constants + mean)) for p in told]


def _one_way(clock: str, epoch: int, probes: Sequence[Probe], options: Options) -> list[Piece]:
    found = hull_floor(probes, options.assumed_ns)
    told = _pieces(
        clock, epoch, "one-way", "host", found.pairs, options, LEAST_NS["one-way"], found.bias_ns, found.proved
    )
    return told


def _pieces(
    clock: str, epoch: int, how: str, to: str, pairs: Pairs, options: Options, least_ns: float, bias_ns: float,
    proved: bool,
) -> list[Piece]:  # fmt: skip
    found, burst = parts(pairs, options.wander, least_ns)
    told = []
    for part in found:
        notes = []
        if part.step_ns:
            notes.append(f"a step of {part.step_ns / 1e3:+.0f} us at its start that nobody told of")
        if burst.any():
            notes.append(f"{int(burst.sum())} marks contradict those before and after them: left out")
        if how == "one-way" and not proved:
            notes.append(f"the latency's floor is unknown: assumed below {bias_ns / 1e3:.0f} us")
        own = pairs.take(part.number)
        done = track(own, options.wander)
        if how == "two-way":
            done = track(reweighed(own, done), options.wander)
        if done.scale > 3:
            notes.append(f"marks scatter {done.scale:.0f} times as much as they claim: what they claim was widened")
        told.append(Piece(clock, epoch, how, to, done, bias_ns, proved, tuple(notes)))
    return told


@dataclass(frozen=True, slots=True)
class Stretch:
    """Box times [first, last] to which `add_ns` is added for rig time, itself known to `sigma_ns`."""

    first_ns: int
    last_ns: int
    add_ns: int
    sigma_ns: float


def _by_box(host: list[Piece], seen: dict[str, list[Piece]], options: Options) -> Clocks:
    origin = int(host[0].track.y_ns[0]) if options.origin_ns is None else options.origin_ns
    if options.origin_ns is None:  # the first mark, not the hold-over before it
        first = host[0].track
        origin = int(ClockModel(first.x_ns, first.y_ns, first.sigma_ns).rig_from_device(first.valid_ns[0]))
    models, stretches, notes = _chained(host, origin)
    whole = joined(models, [piece.track.valid_ns[0] for piece in host])
    last = host[-1]
    valid = (host[0].track.valid_ns[0], last.track.valid_ns[1])
    fits = [
        ClockFit(
            "host", 0, "two-way", whole, valid, max(p.bias_ns for p in host), True, last.track.skew_ppm,
            last.track.skew_sd_ppm, last.track.residual_ns, sum(len(p.track.used) for p in host),
            sum(int(p.track.used.sum()) for p in host), {}, tuple(n for p in host for n in p.notes),
        )
    ]  # fmt: skip
    for number, s in enumerate(stretches):
        x = np.array([s.first_ns, s.last_ns + 1], np.int64)
        model = ClockModel(x, x + s.add_ns, np.full(2, s.sigma_ns), 0.0)
        fits.append(ClockFit("box", host[number].epoch, "rig", model, (s.first_ns, s.last_ns), s.sigma_ns))
    for pieces in seen.values():
        fits += [_through(p, whole, stretches) for p in pieces]
    return Clocks("box", origin, tuple(fits), tuple(notes))


def _chained(host: list[Piece], origin: int) -> tuple[list[ClockModel], list[Stretch], list[str]]:
    """Each piece's map host -> rig, and the box's stretches; where the box began anew, the piece before holds over."""
    models: list[ClockModel] = []
    stretches: list[Stretch] = []
    notes: list[str] = []
    add, sigma = -origin, 0.0
    for k, piece in enumerate(host):
        own = piece.track.model(0, piece.bias_ns)
        if k and (piece.epoch != host[k - 1].epoch or "step" in " ".join(piece.notes)):
            at = piece.track.valid_ns[0]
            held = models[-1]
            add = int(held.rig_from_device(at) - own.rig_from_device(at))
            # Both pieces lie by the same path: what its asymmetry does to one it does to the other.
            noise = float(np.hypot(piece.track.model().sigma_at(at), host[k - 1].track.model().sigma_at(at)))
            sigma = float(np.hypot(sigma, noise))
            notes.append(
                f"the box began anew at host time {at}: the host carried rig time over, to {2 * sigma / 1e3:.0f} us"
            )
        models.append(shifted(own, add, sigma))
        ends = own.rig_from_device(np.array(piece.track.valid_ns))
        stretches.append(Stretch(int(ends[0]), int(ends[1]), add, sigma))
    return models, stretches, notes


def _through(piece: Piece, host: ClockModel, stretches: list[Stretch]) -> ClockFit:
    """A camera's piece in rig time."""
    fit = as_fit(
        piece.clock, piece.epoch, piece.how, piece.track, 0, piece.bias_ns, proved=piece.proved, notes=piece.notes,
        constants=named(piece.track) if piece.how == "sights" else {},
    )  # fmt: skip
    if piece.to == "host":
        model = compose(host, fit.model)
    else:
        middle = int(piece.track.y_ns[len(piece.track.y_ns) // 2])
        near = min(stretches, key=lambda s: max(s.first_ns - middle, middle - s.last_ns, 0))
        model = shifted(fit.model, near.add_ns, near.sigma_ns)
    return ClockFit(**{**{n: getattr(fit, n) for n in ClockFit.__dataclass_fields__}, "model": model})


def _by_sight(seen: dict[str, list[Piece]], options: Options) -> Clocks:
    """Without a box: the spike camera's clock is the rig's, and LEDs tie the RGB camera to it."""
    spike, rgb = ([p for p in seen[name] if p.to == "box"] or seen[name] for name in ("spike", "rgb"))
    if not spike:
        raise DataError(
            "nothing ties the clocks", expected="probes of the box, or sightings of an LED by both cameras",
            next="look at marks.jsonl; a take without either has no common time",
        )  # fmt: skip
    origin = spike[0].track.valid_ns[0] if options.origin_ns is None else options.origin_ns
    fits = []
    for p in spike:
        own = ClockModel(p.track.x_ns, p.track.x_ns - np.int64(origin), np.zeros(len(p.track.x_ns)), 0.0)
        fits.append(ClockFit("spike", p.epoch, "rig", own, p.track.valid_ns, marks=len(p.track.used)))
    for p in rgb:
        near = [s for s in spike if s.to == p.to]
        if not near:
            continue
        middle = int(p.track.y_ns[len(p.track.y_ns) // 2])
        other = min(near, key=lambda s: _gap(s.track, middle))
        fit = as_fit(p.clock, p.epoch, p.how, p.track, 0, p.bias_ns, proved=p.proved, notes=p.notes,
                     constants=named(p.track) if p.how == "sights" else {})  # fmt: skip
        model = compose(invert(other.track.model(0, other.bias_ns)), fit.model)
        fits.append(ClockFit(**{**{n: getattr(fit, n) for n in ClockFit.__dataclass_fields__},
                                "model": shifted(model, -origin)}))  # fmt: skip
    return Clocks("spike", int(origin), tuple(fits), ("no box: only the time between the cameras is known",))


def _gap(track: Track, y_ns: int) -> int:
    ends = ClockModel(track.x_ns, track.y_ns, track.sigma_ns).rig_from_device(np.array(track.valid_ns))
    return max(int(ends[0]) - y_ns, y_ns - int(ends[1]), 0)
