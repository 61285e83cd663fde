"""From a raw take to a scene: frames and spikes cut by the clock map, view by view, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.build import area_resize
from spikerig.dataset.clocktime import NS, ClockModel, tick_from_ns
from spikerig.dataset.errors import DataError, RefusedError
from spikerig.dataset.gopro_file import GoProClip, open_gopro
from spikerig.dataset.gopro_pictures import read_pictures
from spikerig.dataset.images import linear_from_srgb, srgb8_from_linear
from spikerig.dataset.marks import Sight
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes, open_take
from spikerig.dataset.scene import Camera, Frame, Pose, View
from spikerig.dataset.store_write import SceneWriter
from spikerig.dataset.stream import SpikeStream
from spikerig.dataset.wire import WireProfile
from spikerig.dataset.wire_ticks import ticks_from_wire
from spikerig.rigctl.ingest_led import LedSights, led_sights
from spikerig.rigctl.ingest_sights import panel_in_view, panel_mask, sights
from spikerig.rigctl.ingest_slips import mended
from spikerig.rigctl.ingest_times import LATE_TICKS, Framing, Times, read_truth
from spikerig.rigctl.ingest_truth import TrueWorld
from spikerig.rigctl.led_view import led_plan

MARGIN_TICKS = 256


@dataclass(frozen=True, slots=True)
class IngestConfig:
    """How to make a scene of a take.

    Args:
        frames: pictures a viewpoint, about its middle.
        margin_ticks: spikes kept at least on each side of an exposure.
        test_every: of the viewpoints, held out; None: as the plan says, 0: none.
        fov_deg: horizontal, of the spike camera, where no calibration is known: a guess.
        truth: take poses, sharp pictures and points from an emulated rig's truth; None: where there is one.
        name: of the scene; empty: the plan's.
    """

    frames: int = 1
    margin_ticks: int = MARGIN_TICKS
    test_every: int | None = None
    fov_deg: float = 60.0
    truth: bool | None = None
    name: str = ""


@dataclass(frozen=True, slots=True)
class Cut:
    """A frame of a view, the RGB sensor's row of each of its rows, the spikes around it, all in rig time; how good
    the clocks are, and what tied the frame to rig time ("sights" or "truth")."""

    frame: Frame
    rows: NDArray[np.float32]
    spikes: SpikeStream
    sigma_ns: float
    how: str


def ingest(
    folder: str | Path,
    out: str | Path,
    config: IngestConfig | None = None,
    *,
    force: bool = False,
    begin: Callable[[str, int], Callable[[], None]] = lambda what, total: lambda: None,
) -> dict[str, Any]:
    """Make a scene of a take.

    Args:
        folder: of the take.
        out: the scene; it appears whole or not at all.
        config: how.
        force: replace an existing scene.
        begin: called with what begins and the number of viewpoints; gives what is called after each.

    Returns:
        JSON-ready: views, those left out and why, lost ticks, how the clocks were tied, their uncertainty.

    Raises:
        UsageError: no take, or the scene exists.
        DataError: damaged, or no view can be made.
        RefusedError: clocks or framing cannot be told.
    """
    config = config or IngestConfig()
    take = open_take(folder)
    views = [v for v in take.views() if v.kept]
    if not views:
        raise DataError("the take has no viewpoint that was kept", value=take.folder)
    truth = read_truth(take)
    times = Times(take, truth)
    wire, views = mended(take, views)
    panel, led = panel_in_view(take.plan), led_plan(take.plan)
    framing = Framing(wire, [s for v in views for s in v.spikes], panel.pairs if panel else ())
    wanted = bool(truth) if config.truth is None else config.truth
    blinked: LedSights | None = None
    seen: list[Sight] = []
    done = begin("reading the panel" if led is None else "reading the LED", len(views))
    if led is not None:
        blinked = led_sights(take, views, led, times.marks, wire, framing, done)
        seen, times.missing = blinked.sights, blinked.missing
    elif panel is not None:
        seen, times.missing = sights(take, views, panel, times.marks, wire, framing, done)
    if seen:
        times.fit(seen)
    world = TrueWorld(take, times, truth) if wanted else None
    size = take.profile
    camera = world.camera if world else Camera.pinhole(size.width, size.height, config.fov_deg)
    held = _held_out(take, config)
    info = _info(take, times, config, world is not None)
    told: dict[str, Any] = {
        "views": 0, "test": [], "left_out": {}, "lost_ticks": 0, "sigma_us": 0.0, "rgb_times": {},
        "sights": len(seen), "panel_unread": times.missing, "slips": [asdict(s) for s in wire.slips],
        "led": None if blinked is None else blinked.as_json(),
    }  # fmt: skip
    done = begin("cutting", len(views))
    hidden = panel_mask(take)
    more = {"light_gain": world.light_gain, "truth": world.truth} if world else {}
    with SceneWriter(out, config.name or str(take.plan["name"]), camera, **more, force=force, keep=False) as writer:
        for view in views:
            try:
                cuts = list(cut_view(take, view, times, wire, framing, config))
            except (RefusedError, DataError) as error:
                told["left_out"][view.name] = f"{error.what}: {error.value}"
                done()
                continue
            for number, cut in enumerate(cuts):
                name = view.name if config.frames == 1 else f"{view.name}-{number}"
                split = "test" if view.name in held else "train"
                dark = blinked.hidden(view.name, size.height, size.width) if blinked else hidden
                _add(writer, _plain(name, cut, split, dark), view, cut, world, told)
            done()
        if not told["views"]:
            raise DataError("no view can be made of this take", value="; ".join(
                dict.fromkeys(told["left_out"].values())))  # fmt: skip
        info["clocks"]["rgb"] = told["rgb_times"]
        writer.info = {**info, "left_out": told["left_out"], "slips": told["slips"], "led": told["led"]}
        if world:
            writer.points = world.points()
    return {"scene": str(out), **told}


def _plain(name: str, cut: Cut, split: Any, hidden: NDArray[np.bool_] | None) -> View:
    """A view without its pose; pixels that the panel lights are not valid."""
    height, width = cut.frame.pixels.shape[:2]
    rows = np.repeat(cut.rows[:, None], width, 1)
    valid = np.ones((height, width), bool) if hidden is None else ~hidden
    return View(name, cut.frame, cut.spikes, rows, valid, Pose(np.eye(3, 4)), None, split)


def _add(
    writer: SceneWriter, plain: View, view: TakenView, cut: Cut, world: TrueWorld | None, told: dict[str, Any]
) -> None:
    told["lost_ticks"] += int((cut.spikes.lost[:, 1] - cut.spikes.lost[:, 0]).sum())
    told["sigma_us"] = max(told["sigma_us"], cut.sigma_ns / 1e3)
    told["rgb_times"][cut.how] = told["rgb_times"].get(cut.how, 0) + 1
    told["views"] += 1
    if plain.split == "test":
        told["test"].append(plain.name)
    if world is None:
        writer.add(plain)
        return
    true = world.view(plain, view)
    writer.add(true.view, light=true.light, at_ns=true.at_ns, trajectory=true.trajectory)


def cut_view(
    take: RawTake, view: TakenView, times: Times, wire: WireBytes, framing: Framing, config: IngestConfig
) -> list[Cut]:
    """The frames nearest the middle of a viewpoint whose exposures its spikes cover, with those spikes.

    A frame of whose exposure no tick is left says nothing: the next one is taken.

    Raises:
        DataError: no clip, no such frame, or damaged files.
        RefusedError: clocks or framing cannot be told.
    """
    if not view.clips or view.clip is None:
        raise DataError("its clip is not in the take", value=view.name, next="spikerig rig record ... --resume fetches")
    if not view.spikes:
        raise DataError("it has no spikes", value=view.name)
    clip = open_gopro([take.folder / "rgb" / name for name in view.clips])
    if clip.exposure_ns is None or clip.row_ns is None:
        raise DataError("the clip does not tell exposures or read-out", value=view.clips[0])
    tied = times.rgb(clip, view.clips[0], int(view.clip["start_ns"][0]))
    rgb = tied.model
    epoch, start, stop = max(view.spikes, key=lambda s: s[2] - s[1])
    profile = take.profile
    offset = framing.offset(epoch)
    first = -(-(start - offset) // profile.tick_bytes)
    last = (stop - offset) // profile.tick_bytes
    spike = times.spike(epoch, device_ns(profile, start))
    rig_of = _tick_times(profile, spike, offset)
    begin, end = (int(t) for t in rig_of(np.array([first, last])))
    likely = _frames(clip, rgb, begin, end, config, profile, spike, view.name)
    found: dict[int, tuple[SpikeStream, float]] = {}
    for number in likely:
        media = int(clip.start_ns[number])
        starts, ends = (int(t) for t in _exposed(clip, rgb, np.array([number]))[:, 0])
        margin = _margin_ns(config, profile, spike, rgb, media, device_ns(profile, start))
        t0 = max(first, int(np.floor(_tick_at(rig_of, first, last, starts - margin))))
        t1 = min(last, int(np.ceil(_tick_at(rig_of, first, last, ends + margin))))
        spikes = _spikes(wire, epoch, offset, t0, t1, rig_of)
        if not _blind(spikes, starts, ends):
            sigma = float(np.hypot(spike.sigma_at(device_ns(profile, start)), rgb.sigma_at(media)))
            found[number] = spikes, sigma
        if len(found) == config.frames:
            break
    if not found:
        raise DataError("every tick of its exposures is lost", value=f"{view.name}, {len(likely)} frames")
    cuts = []
    for number, frame in read_pictures(clip, sorted(found)):
        rows = (np.arange(profile.height, dtype=np.float32) + 0.5) * (clip.height / profile.height) - 0.5
        starts = int(rgb.rig_from_device(frame.start_ns))
        cuts.append(Cut(_sized(frame, starts, profile), rows, *found[number], tied.how))
    return cuts


def device_ns(profile: WireProfile, byte: float) -> int:
    """The spike camera's own time at a byte of an epoch."""
    return round(byte / profile.tick_bytes / profile.rate_hz * NS)


def _tick_times(profile: WireProfile, model: ClockModel, offset: int) -> Callable[[Any], NDArray[np.int64]]:
    """Rig time at which ticks (counted from the epoch's offset) begin to be exposed."""

    def rig_of(tick: Any) -> NDArray[np.int64]:
        out = (np.asarray(tick, np.float64) + offset / profile.tick_bytes - LATE_TICKS) / profile.rate_hz * NS
        return model.rig_from_device(np.rint(out).astype(np.int64))

    return rig_of


def _tick_at(rig_of: Callable[[Any], NDArray[np.int64]], first: int, last: int, rig_ns: int) -> float:
    """The tick at a rig time, by the line between the span's ends (a fraction of a second: straight)."""
    a, b = (int(t) for t in rig_of(np.array([first, last])))
    return first + (rig_ns - a) * (last - first) / max(b - a, 1)


def _margin_ns(
    config: IngestConfig, profile: WireProfile, spike: ClockModel, rgb: ClockModel, media_ns: int, spike_ns: int
) -> int:
    sigma = float(np.hypot(spike.sigma_at(spike_ns), rgb.sigma_at(media_ns)))
    return round(max(config.margin_ticks / profile.rate_hz * NS, min(3 * sigma, NS / 50)))


def _frames(
    clip: GoProClip, rgb: ClockModel, begin: int, end: int, config: IngestConfig, profile: WireProfile,
    spike: ClockModel, name: str,
) -> list[int]:  # fmt: skip
    """Numbers of the frames that the spikes cover with margins, the nearest to the middle first."""
    margin = round(config.margin_ticks / profile.rate_hz * NS)
    starts, ends = _exposed(clip, rgb, np.arange(clip.frames))
    good = np.flatnonzero((starts - margin >= begin) & (ends + margin <= end))
    if not len(good):
        raise DataError(
            "no frame lies within the viewpoint's spikes",
            value=f"{name}: spikes {begin / NS:.4f} to {end / NS:.4f} s, frames {starts[0] / NS:.4f} to "
            f"{ends[-1] / NS:.4f} s of rig time",
            cause="too short a viewpoint, or clocks that are off",
        )  # fmt: skip
    apart = np.abs((starts + ends)[good] // 2 - (begin + end) // 2)
    return [int(k) for k in good[np.argsort(apart, kind="stable")]]


def _exposed(clip: GoProClip, rgb: ClockModel, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """When frames begin to be exposed, and when their last row ends, int64[2,N] of rig time."""
    starts = rgb.rig_from_device(clip.start_ns[numbers])
    exposure = np.zeros(clip.frames, np.int64) if clip.exposure_ns is None else clip.exposure_ns
    return np.stack([starts, starts + exposure[numbers] + round((clip.row_ns or 0.0) * (clip.height - 1))])


def _blind(spikes: SpikeStream, starts: int, ends: int) -> bool:
    """Whether no tick between two times is left."""
    a, b = np.clip(tick_from_ns([starts, ends], float(spikes.rate_hz or 1), spikes.t0_ns), 0, spikes.ticks)
    gone = np.zeros(spikes.ticks, bool)
    for m, n in spikes.lost:
        gone[m:n] = True
    return bool(gone[int(a) : int(np.ceil(b))].all())


def _sized(frame: Frame, start_ns: int, profile: WireProfile) -> Frame:
    """The picture brought to the spike camera's size by area, in linear light; times are the sensor rows' still."""
    pixels = frame.pixels
    if pixels.shape[:2] != (profile.height, profile.width):
        light = np.asarray(linear_from_srgb(np.asarray(pixels, np.float32) / frame.full), np.float32)
        pixels = srgb8_from_linear(area_resize(light, profile.width, profile.height))
    return replace(frame, pixels=pixels, start_ns=start_ns, clock="rig")


def _spikes(
    wire: WireBytes, epoch: int, offset: int, t0: int, t1: int, rig_of: Callable[[Any], NDArray[np.int64]]
) -> SpikeStream:
    profile = wire.take.profile
    size = profile.tick_bytes
    data, missing = wire.read(epoch, offset + t0 * size, offset + t1 * size)
    missing += wire.suspect(epoch, offset + t0 * size, offset + t1 * size)
    lost = _merged([((a - offset) // size - t0, -(-(b - offset) // size) - t0) for a, b in missing])
    bits = ticks_from_wire(data, profile)
    for a, b in lost:
        bits[a:b] = 0
    a, b = (int(t) for t in rig_of(np.array([t0, t1])))
    return SpikeStream(bits, profile.width, (t1 - t0) / (b - a) * NS, a, "rig", np.array(lost, np.int64).reshape(-1, 2))


def _merged(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    out: list[tuple[int, int]] = []
    for a, b in sorted(ranges):
        if out and a <= out[-1][1]:
            out[-1] = (out[-1][0], max(b, out[-1][1]))
        else:
            out.append((a, b))
    return out


def _held_out(take: RawTake, config: IngestConfig) -> set[str]:
    every = int(take.plan.get("test_every", 0)) if config.test_every is None else config.test_every
    names = [str(n) for n in take.plan["viewpoints"]]
    return set(names[::every]) if every else set()


def _info(take: RawTake, times: Times, config: IngestConfig, true: bool) -> dict[str, Any]:
    fits = [
        {"clock": f.clock, "epoch": f.epoch, "how": f.how, "skew_ppm": f.skew_ppm, "bias_us": f.bias_ns / 1e3,
         "marks": f.marks, "notes": list(f.notes)}
        for f in times.clocks.fits
    ]  # fmt: skip
    return {
        "made_by": "spikerig data ingest",
        "take": {"number": take.number, "status": take.status, "devices": list(take.devices), "plan": dict(take.plan)},
        "clocks": {"rig": times.clocks.rig, "fits": fits, "notes": list(times.clocks.notes)},
        "poses": "truth of the emulated rig" if true else "none: spikerig calib poses finds them",
        "camera": "truth of the emulated rig" if true else f"a guess: {config.fov_deg:g} degrees",
    }
