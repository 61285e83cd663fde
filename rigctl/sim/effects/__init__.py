"""Effects: what real optics, sensors and wires do to the light, one small class each, imported only when asked for.

An effect states its stage, source, and the limit in which it vanishes; it draws from its own random stream, bounds its
own effect on the output (`magnitude`), and says what its cost grows with. `begin` makes it ready for one view and
returns hooks; the simulator calls the hooks in the order of the stages.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import RigError
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.limits import Faults, nearest, read_record

if TYPE_CHECKING:
    from spikerig.dataset.scene import Camera
    from spikerig.dataset.spikes import SpikeStream
    from spikerig.rigctl.sim.judge.facts import Bound, Facts

Floats = NDArray[np.floating]  # float32 unless said


class Stage(IntEnum):
    """Where in the chain from light to files an effect acts; a list of effects runs in this order."""

    LIGHT = 0
    OPTICS = 1
    PHOTONS = 2
    CHARGE = 3
    SPIKES = 4
    WIRE = 5
    CLOCK = 6
    RGB = 7


@dataclass(frozen=True, slots=True)
class Site:
    """Where an effect acts.

    Args:
        height, width: of the picture.
        view: its number.
        seed: of the scene.
        rate_hz: spike ticks a second.
        t0_s: the rig's time at the first tick of the view, seconds from the start of the take.
        ticks: of the view's spikes, margins included.
        camera: the pinhole that both arms share before any misalignment.
        own_arm: the RGB arm's light was cast from its own pose already.
    """

    height: int
    width: int
    view: int
    seed: int
    rate_hz: float = 40_000.0
    t0_s: float = 0.0
    ticks: int = 1
    camera: Camera | None = None
    own_arm: bool = False

    def draw(self, effect: str) -> np.random.Generator:
        """The effect's own stream for this view."""
        return stream(self.seed, effect, self.view)

    def draw_fixed(self, effect: str) -> np.random.Generator:
        """The effect's own stream for what stays the same from view to view: the sensor's fixed patterns."""
        return stream(self.seed, effect)

    def key(self, effect: str) -> tuple[int, int]:
        """Two 32-bit words from the effect's own stream for this view: the key of a counter-based generator."""
        low, high = self.draw(effect).integers(0, 2**32, 2)
        return int(low), int(high)


@dataclass(frozen=True, slots=True)
class Hooks:
    """What an effect does to one view; each is None (or zero) where it does nothing.

    Args:
        step_s: longest time between light samples with which `radiance` is well sampled, seconds; 0 asks for none.
        radiance: (rgb [K,H,W,3], at_s float64[K]) changes the scene's light in place, before the arms part; between
            samples the light stays linear in time.
        spike_optics: pictures [n,H,W,C] on the way to the spike sensor -> the pictures after; linear in the light and
            the same at all times, so that it may act on knots. A new array, or the same one changed.
        rgb_optics: the same for the RGB arm; it may see the exposure's mean instead of its samples.
        light: changes light [n,H,W] in place, in thresholds a tick; affine in the light and the same for all ticks, so
            that it may act on knots; each gets what those before it left.
        pixel: arguments of the kernel `fire_noisy`, for what differs from tick to tick inside a pixel.
        charge: changes the initial charge float64[H,W] in place, in thresholds.
        bits: (bits uint8[T,H,B], width) changes spikes in place, before they leave the sensor.
        wire: spikes as they were sent -> as they arrived, with what is known to be lost.
        clock_ns: (rig times int64[n]) -> by how much the spike camera's clock is ahead of the rig's then, float64[n].
        frame_clock_ns: the same for the RGB camera.
        row_ns: read-out time of an RGB row.
        linear: linear light float32[H,W,3] on the RGB sensor -> after; 1.0 = full scale, before any response curve.
        response: linear light -> encoded, in place of sRGB; both float32[H,W,3].
        encoded: changes the encoded picture float32[H,W,3] in place, 0 to 1, before it is rounded.
        levels: steps of the RGB camera's converter, in place of 255.
        coded: pixels uint8[H,W,3] (or uint16 of full scale 65535) -> as they came out of the file.
    """

    step_s: float = 0.0
    radiance: Callable[[Floats, NDArray[np.float64]], None] | None = None
    spike_optics: Callable[[Floats], Floats] | None = None
    rgb_optics: Callable[[Floats], Floats] | None = None
    light: Callable[[Floats], None] | None = None
    pixel: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    charge: Callable[[NDArray[np.float64]], None] | None = None
    bits: Callable[[NDArray[np.uint8], int], None] | None = None
    wire: Callable[[SpikeStream], SpikeStream] | None = None
    clock_ns: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None = None
    frame_clock_ns: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None = None
    row_ns: float = 0.0
    linear: Callable[[Floats], Floats] | None = None
    response: Callable[[Floats], Floats] | None = None
    encoded: Callable[[Floats], None] | None = None
    levels: int = 0
    coded: Callable[[NDArray[Any]], NDArray[Any]] | None = None


class Effect(Protocol):
    """What every effect class offers, beside its parameters as dataclass fields.

    `per` says what `cost_ns` counts: nanoseconds a pixel and "tick", "knot" (a light sample), or "frame" (a picture).

    Optional are `excludes`, names of effects that would count the same thing twice; `placed(folder)`, the effect with
    its file found from the folder of the scene file (or a RigError); and `on_noise = True` for an RGB effect whose
    bound must be taken with the noise of those before it, because it changes that too.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    per: ClassVar[str]
    source: ClassVar[str]
    vanishes: ClassVar[str]
    cost_ns: ClassVar[float]

    def begin(self, site: Site) -> Hooks:
        """Ready for one view."""
        ...

    def magnitude(self, facts: Facts) -> Bound:
        """A bound on the change of the outputs, good for 95 % of the pixels (three standard deviations for noise)."""
        ...


# name -> module and class. A table, not a registry: importing this module imports no effect.
# Effects of one stage act in the order of the table.
EFFECTS: Mapping[str, tuple[str, str]] = {
    "flicker": ("flicker", "Flicker"),
    "brightness_ramp": ("ramp", "BrightnessRamp"),
    "splitter": ("splitter", "Splitter"),
    "misalignment": ("misalignment", "Misalignment"),
    "ghost": ("ghost", "Ghost"),
    "mirror_flip": ("flip", "MirrorFlip"),
    "distortion": ("distortion", "Distortion"),
    "defocus": ("defocus", "Defocus"),
    "vignetting": ("vignetting", "Vignetting"),
    "shot_noise": ("shot", "ShotNoise"),
    "prnu": ("prnu", "Prnu"),
    "sensor_map": ("maps", "SensorMap"),
    "dark_current": ("dark", "DarkCurrent"),
    "threshold_fpn": ("fpn", "ThresholdFpn"),
    "reset_loss": ("reset", "ResetLoss"),
    "comparator_noise": ("comparator", "ComparatorNoise"),
    "initial_phase": ("phase", "InitialPhase"),
    "saturation": ("saturation", "Saturation"),
    "hot_pixels": ("hot", "HotPixels"),
    "stuck_pixels": ("stuck", "StuckPixels"),
    "row_noise": ("rownoise", "RowNoise"),
    "bit_flips": ("flips", "BitFlips"),
    "lost_blocks": ("blocks", "LostBlocks"),
    "wide_rows": ("rows", "WideRows"),
    "clock_offset": ("clock", "ClockOffset"),
    "clock_skew": ("clock", "ClockSkew"),
    "clock_wander": ("clock", "ClockWander"),
    "clock_jitter": ("clock", "ClockJitter"),
    "clock_reset": ("clock", "ClockReset"),
    "rolling_shutter": ("rolling", "RollingShutter"),
    "rgb_noise": ("rgb_noise", "RgbNoise"),
    "bayer": ("bayer", "Bayer"),
    "white_balance": ("balance", "WhiteBalance"),
    "response_curve": ("response", "ResponseCurve"),
    "read_noise": ("read", "ReadNoise"),
    "bit_depth": ("bits", "BitDepth"),
    "jpeg": ("jpeg", "Jpeg"),
    "video_codec": ("video", "VideoCodec"),
}


def effect_class(name: str) -> type:
    """The class of a named effect; imports its module."""
    module, cls = EFFECTS[name]
    return getattr(import_module(f"{__name__}.{module}"), cls)


def read_effects(rows: Any, faults: Faults, where: str = "effects") -> dict[str, Effect]:
    """Effects of a scene file by name: from a list of names or of tables with a `name` and parameters."""
    if not isinstance(rows, list | tuple):
        faults.add(where, f"is {rows!r}, expected a list of names or tables, or one of the words 'auto', 'all'")
        return {}
    found: dict[str, Effect] = {}
    for k, row in enumerate(rows):
        table = {"name": row} if isinstance(row, str) else row
        if not isinstance(table, Mapping) or not isinstance(table.get("name"), str):
            faults.add(f"{where}[{k}]", f"is {row!r}, expected a name or a table with a name")
            continue
        name = table["name"]
        if name not in EFFECTS:
            faults.add(f"{where}[{k}].name", f"is {name!r}; {nearest(name, EFFECTS)}")
        elif name in found:
            faults.add(f"{where}[{k}].name", f"is '{name}' a second time; an effect is listed once")
        else:
            rest = {key: value for key, value in table.items() if key != "name"}
            found[name] = read_record(effect_class(name), rest, f"{where}[{k}]", faults)
    return found


def settled(found: Mapping[str, Effect], folder: Path, faults: Faults) -> list[Effect]:
    """Effects with their files found from a folder; faults where a file cannot be used or two count the same twice."""
    out: list[Effect] = []
    for name, effect in found.items():
        for other in set(getattr(effect, "excludes", ())) & set(found):
            faults.add("effects", f"list {name} and {other}: the same thing would count twice")
        placed = getattr(effect, "placed", None)
        try:
            out.append(effect if placed is None else placed(folder))
        except RigError as error:
            faults.add(f"effects.{name}", f"{error.what}: {error.value}")
    return out


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects in the order in which they act: by stage, then as the table above lists them."""
    names = list(EFFECTS)
    rank = {name: k for k, name in enumerate(names)}
    return tuple(sorted(effects, key=lambda e: (e.stage, rank.get(e.name, len(names)))))


def parameters(effect: Effect) -> dict[str, Any]:
    """An effect's parameters, JSON-ready."""
    return dataclasses.asdict(effect)  # type: ignore[call-overload]
