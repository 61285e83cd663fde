"""The scene file: what to simulate, as one tree of frozen records read from TOML."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset.bayer import PATTERNS, Bayer
from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.caster.world import Vec3, World, read_world, stands_in
from spikerig.rigctl.sim.effects import Effect, effect_class, in_order, read_effects, settled
from spikerig.rigctl.sim.events import EventCamera
from spikerig.rigctl.sim.limits import Faults, limits, nearest, read_record
from spikerig.rigctl.sim.orbit import Orbit, orbit_pose
from spikerig.rigctl.sim.presets import PRESETS, preset_effects, preset_names


@dataclass(frozen=True, slots=True)
class Lens:
    """`[camera]`: size in pixels and horizontal field of view."""

    width: int = limits(200, 1, 8192, "px")
    height: int = limits(125, 1, 8192, "px")
    fov_deg: float = limits(60.0, 1, 170, "degrees")
    samples: int = limits(2, 1, 16, "rays a pixel along each axis")


@dataclass(frozen=True, slots=True)
class Shake:
    """`[shake]`: hand shake over one exposure, a cubic spline of rotation and translation.

    Args:
        path_px: the image centre's path over the exposure, drawn evenly from this range for each view.
        curvature: 0 moves straight and evenly; 1 is as much bend as motion.
        translation: share of the path that comes from moving rather than turning the camera.
        roll: turning about the optical axis beside turning across it.
    """

    path_px: tuple[float, float] = limits((6.0, 11.0), 0, 1000, "px")
    curvature: float = limits(0.35, 0, 10)
    translation: float = limits(0.2, 0, 1)
    roll: float = limits(0.3, 0, 10)


@dataclass(frozen=True, slots=True)
class Exposure:
    """`[exposure]`: timing of one view.

    Args:
        protocol: `rig` (40 kHz over a real exposure) or `paper` (18 one-bit samples an exposure, threshold 2); a
            protocol only sets defaults.
        exposure_ms, rate_hz: their product is the ticks of an exposure, a whole number.
        sub_poses: pictures cast over an exposure, ends included (`linear`) or one a slot (`hold`); 0 for as many as
            the view's motion asks for, one every 0.25 px, which is the default with `effects = "auto"`.
        margin_ticks: spikes kept on each side of the exposure.
        light: between sub-poses the light is `linear` in time, or each `hold`s for its slot.
        label: the instant a view is labelled with and its sharp truth is cast: `mid` exposure, or its `first` sub-pose.
        phase: charge of a pixel before its first tick: `random` or `zero`.
        period_ms: from one view's exposure to the next.
    """

    protocol: str = limits("rig", choices=("rig", "paper"))
    exposure_ms: float = limits(8.0, 1e-3, 1e5, "ms")
    rate_hz: float = limits(40_000.0, 1, 1e8, "Hz")
    sub_poses: int = limits(17, 0, 100_000)
    margin_ticks: int = limits(256, 0, 1_000_000, "ticks")
    light: str = limits("linear", choices=("linear", "hold"))
    label: str = limits("mid", choices=("mid", "first"))
    phase: str = limits("random", choices=("random", "zero"))
    period_ms: float = limits(1000.0, 1e-2, 1e7, "ms")

    @property
    def ticks(self) -> int:
        """Ticks of an exposure."""
        return round(self.exposure_ms * 1e-3 * self.rate_hz)

    @property
    def tick_ns(self) -> float:
        """Nanoseconds a tick."""
        return 1e9 / self.rate_hz


PAPER: Mapping[str, Any] = {"exposure_ms": 0.45, "sub_poses": 18, "margin_ticks": 0, "light": "hold"}


@dataclass(frozen=True, slots=True)
class Sensor:
    """`[sensor]`: light to charge.

    Args:
        preset: a published spike camera: its effects become those to choose from, its settings the defaults.
        map: with `vidar-map`, the sensor's own maps (.npz; see effect `sensor_map`); its path from the scene file.
        gain: spikes a tick at RGB white (1 / threshold in the paper's units); 0.4, or 0.5 for `paper`.
        response: of the spike camera to linear red, green and blue, where its colour is `mono`.
        colour: `mono`, or `bayer`: each pixel sees one colour only.
        pattern: of `bayer`, the colours of the first two pixels of the first two rows.
        channel_gain: of `bayer`, of red, green and blue pixels, times `gain`.
    """

    preset: str = limits("", choices=preset_names("spike"))
    map: str = limits("", unit="a .npz file")
    gain: float = limits(0.4, 1e-9, 1e9, "spikes a tick at white")
    response: Vec3 = limits((0.299, 0.587, 0.114), 0, 100)
    colour: str = limits("mono", choices=("mono", "bayer"))
    pattern: str = limits("rggb", choices=PATTERNS)
    channel_gain: Vec3 = limits((1.0, 1.0, 1.0), 1e-6, 1e6)

    @property
    def bayer(self) -> Bayer | None:
        """The colours of its pixels; None where each sees all."""
        return Bayer(self.pattern, self.channel_gain) if self.colour == "bayer" else None


@dataclass(frozen=True, slots=True)
class RgbCamera:
    """`[rgb]`: the other camera.

    Args:
        preset: a published RGB camera: its effects become those to choose from.
    """

    preset: str = limits("", choices=preset_names("rgb"))


@dataclass(frozen=True, slots=True)
class Tolerance:
    """`[tolerance]`: with `effects = "auto"`, how much all that is left out may change 95 % of the pixels.

    Args:
        spikes: of the count of one exposure.
        dn: of an RGB value.
    """

    spikes: float = limits(1.0, 0, 1e9, "spikes an exposure")
    dn: float = limits(1.0, 0, 1e9, "digital numbers of 255")


@dataclass(frozen=True, slots=True)
class Cloud:
    """`[points]`: noisy surface points; `depth_noise` is relative, colours come from the blurry pictures."""

    count: int = limits(7200, 0, 100_000_000)
    depth_noise: float = limits(0.01, 0, 1)


@dataclass(frozen=True, slots=True)
class Settings:
    """The part of a scene file that does not say where the light comes from."""

    name: str
    seed: int
    exposure: Exposure
    sensor: Sensor
    cloud: Cloud
    effects: tuple[Effect, ...]
    rgb: RgbCamera = RgbCamera()
    tolerance: Tolerance | None = None
    events: EventCamera | None = None


@dataclass(frozen=True, slots=True)
class SceneSpec:
    """A whole scene file.

    Args:
        effects: in the order in which they act: those to simulate, or with a tolerance those to choose from.
        tolerance: of `effects = "auto"`; None once the effects are chosen, or were listed.
        events: an event camera in the spike camera's place; None without.
        others: as in the file.
    """

    name: str
    seed: int
    lens: Lens
    orbit: Orbit
    shake: Shake
    exposure: Exposure
    sensor: Sensor
    cloud: Cloud
    world: World
    effects: tuple[Effect, ...]
    rgb: RgbCamera = RgbCamera()
    tolerance: Tolerance | None = None
    events: EventCamera | None = None


@dataclass(frozen=True, slots=True)
class _Top:
    name: str = limits("")
    seed: int = limits(0, 0, 2**32 - 1)
    effects: Any = limits(None)
    consider: Any = limits(())
    tolerance: Any = limits({})
    exposure: Any = limits({})
    sensor: Any = limits({})
    rgb: Any = limits({})
    events: Any = limits(None)
    points: Any = limits({})


@dataclass(frozen=True, slots=True)
class _TopScene(_Top):
    camera: Any = limits({})
    orbit: Any = limits({})
    shake: Any = limits({})
    world: Any = limits({})


def builtin_names() -> list[str]:
    """Names of the scenes that come with the package."""
    return sorted(
        p.name[:-5] for p in files("spikerig.rigctl.sim").joinpath("scenes").iterdir() if p.name[-5:] == ".toml"
    )


def load_scene_toml(path_or_name: str | Path) -> SceneSpec:
    """The scene of a TOML file, or of a built-in name such as `demo`.

    Raises:
        UsageError: no such file or name, not TOML, unknown keys, wrong types, values out of range: all told at once.
    """
    return read_scene(scene_table(path_or_name), str(path_or_name))


def scene_table(path_or_name: str | Path) -> dict[str, Any]:
    """What a scene file (or a built-in scene's) holds, not looked at yet; faults as `load_scene_toml`."""
    text_name = str(path_or_name)
    if text_name in builtin_names():
        text = files("spikerig.rigctl.sim").joinpath(f"scenes/{text_name}.toml").read_text(encoding="utf-8")
    else:
        try:
            text = Path(path_or_name).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(
                "cannot read the scene file",
                value=f"{text_name} ({getattr(error, 'strerror', None) or 'not UTF-8 text'})",
                expected=f"a TOML file, or a built-in scene: {', '.join(builtin_names())}",
                cause="" if text_name.endswith(".toml") else nearest(text_name, builtin_names()),
            ) from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError("the scene file is not valid TOML", value=f"{text_name}: {error}") from None


def read_settings(table: Mapping[str, Any], source: str) -> Settings:
    """Settings from a parsed TOML table: name, seed, exposure, sensor, points, effects; faults as `load_scene_toml`."""
    faults = Faults(source)
    settings = _settings(read_record(_Top, table, "", faults), faults)
    faults.raise_any()
    return settings


def _settings(top: _Top, faults: Faults) -> Settings:
    paper = isinstance(top.exposure, Mapping) and top.exposure.get("protocol") == "paper"
    follow = {"sub_poses": 0} if top.effects == "auto" else None  # light samples as the motion asks
    exposure = read_record(Exposure, top.exposure, "exposure", faults, PAPER if paper else follow)
    sensor = read_record(Sensor, top.sensor, "sensor", faults, _sensor_defaults(top.sensor, paper))
    rgb = read_record(RgbCamera, top.rgb, "rgb", faults)
    cloud = read_record(Cloud, top.points, "points", faults)
    tolerance = read_record(Tolerance, top.tolerance, "tolerance", faults)
    effects = _effects(top, preset_effects(sensor.preset, rgb.preset, map=sensor.map), exposure.phase, faults)
    if (sensor.preset == "vidar-map") != bool(sensor.map):
        faults.add("sensor.map", f"is '{sensor.map}', preset '{sensor.preset}': a map and preset vidar-map go together")
    _check_exposure(exposure, faults)
    if sum(sensor.response) <= 0:
        faults.add("sensor.response", "is all zero: the spike camera would be blind")
    for name in ("pattern", "channel_gain") if sensor.colour == "mono" else ():
        if isinstance(top.sensor, Mapping) and name in top.sensor:
            faults.add(f"sensor.{name}", 'is for colour = "bayer"; this sensor sees gray')
    auto = tolerance if top.effects == "auto" else None
    events = None if top.events is None else read_record(EventCamera, top.events, "events", faults)
    return Settings(top.name, top.seed, exposure, sensor, cloud, effects, rgb, auto, events)


def _sensor_defaults(table: Any, paper: bool) -> Mapping[str, Any]:
    name = table.get("preset") if isinstance(table, Mapping) else None
    preset = PRESETS[name].settings if isinstance(name, str) and name in PRESETS else {}
    return {**({"gain": 0.5} if paper else {}), **preset}


def _effects(top: _Top, presets: list[Mapping[str, Any]], phase: str, faults: Faults) -> tuple[Effect, ...]:
    """Those listed; or, of the words `auto` and `all` (and of a preset alone), those considered: what differs from the
    preset's parameters is said in `consider`."""
    if top.effects in ("auto", "all") or (top.effects is None and presets):
        found = {**read_effects(presets, faults, "preset"), **read_effects(top.consider, faults, "consider")}
        if top.effects == "auto" and not found and not (top.consider or presets):
            faults.add("effects", 'is "auto" with nothing to choose from; name a sensor.preset, or list `consider`')
    else:
        if top.consider not in ((), []):
            faults.add("consider", 'is for effects = "auto" or "all"; list the effects wanted in one place')
        found = read_effects(top.effects if top.effects is not None else (), faults)
    if "initial_phase" in found and phase == "zero":
        faults.add("effects", "list initial_phase, but exposure.phase is zero: these contradict each other")
    if phase == "random" and "initial_phase" not in found:
        found["initial_phase"] = effect_class("initial_phase")()
    return in_order(settled(found, Path(faults.source).parent, faults))


def _check_exposure(exposure: Exposure, faults: Faults) -> None:
    ticks = exposure.exposure_ms * 1e-3 * exposure.rate_hz
    if ticks < 0.5 or abs(ticks - round(ticks)) > 1e-6 * ticks:
        faults.add("exposure.exposure_ms", f"x rate_hz is {ticks:g} ticks, expected a whole number, at least 1")
    span_ms = exposure.exposure_ms + 2e3 * exposure.margin_ticks / exposure.rate_hz
    if exposure.period_ms < span_ms:
        faults.add("exposure.period_ms", f"is {exposure.period_ms:g}, less than exposure and margins, {span_ms:g} ms")


def read_scene(table: Mapping[str, Any], source: str = "the scene") -> SceneSpec:
    """A scene from a parsed TOML table; see `load_scene_toml`."""
    faults = Faults(source)
    top = read_record(_TopScene, table, "", faults)
    settings = _settings(top, faults)
    spec = SceneSpec(
        name=top.name or Path(source).stem,
        seed=top.seed,
        lens=read_record(Lens, top.camera, "camera", faults),
        orbit=read_record(Orbit, top.orbit, "orbit", faults),
        shake=read_record(Shake, top.shake, "shake", faults),
        exposure=settings.exposure,
        sensor=settings.sensor,
        cloud=settings.cloud,
        world=read_world(top.world, faults),
        effects=settings.effects,
        rgb=settings.rgb,
        tolerance=settings.tolerance,
        events=settings.events,
    )
    if not faults.found:
        _check_views(spec, faults)
    faults.raise_any()
    return spec


def _check_views(spec: SceneSpec, faults: Faults) -> None:
    """Faults that need more than one table to see."""
    orbit, n = spec.orbit, spec.exposure.sub_poses
    if n > spec.exposure.ticks + (spec.exposure.light == "linear"):
        faults.add("exposure.sub_poses", f"is {n}, more than fit the {spec.exposure.ticks} ticks of an exposure")
    if spec.shake.path_px[0] > spec.shake.path_px[1]:
        faults.add("shake.path_px", f"is {list(spec.shake.path_px)}, expected [low, high]")
    rolling: Any = next((e for e in spec.effects if e.name == "rolling_shutter"), None)
    if rolling is not None and (
        trouble := rolling.beyond(spec.lens.height, spec.exposure.margin_ticks, spec.exposure.tick_ns)
    ):
        faults.add("exposure.margin_ticks", trouble)
    for k in orbit.test:
        if k != int(k) or k >= orbit.views:
            faults.add("orbit.test", f"holds {k:g}, expected view numbers 0 to {orbit.views - 1}")
    if len(orbit.held_out()) >= orbit.views:
        faults.add("orbit.test_every", "leaves no view to train on")
    for number in sorted({round(k) for k in np.linspace(0, orbit.views - 1, 64)}):
        pose = orbit_pose(orbit, number)
        trouble = stands_in(spec.world, -pose[:, :3].T @ pose[:, 3])
        if trouble:
            faults.add("orbit", f"view {number} stands {trouble}")
            return


def with_changes(spec: SceneSpec, *, seed: int | None = None, views: int | None = None, rig: str = "") -> SceneSpec:
    """The scene with another seed (shake, noise, points; not the world), number of views on the same arc, rig."""
    if rig:
        from spikerig.rigctl.sim.pairs import rig_effects

        spec = dataclasses.replace(spec, effects=rig_effects(rig, spec.effects))
    if seed is not None:
        if not 0 <= seed < 2**32:
            raise UsageError("a seed is a whole number", value=seed, expected="0 to 4294967295")
        spec = dataclasses.replace(spec, seed=seed)
    if views is not None:
        if not 1 <= views <= 100_000:
            raise UsageError("too few or too many views", value=views, expected="1 to 100000")
        spec = dataclasses.replace(spec, orbit=dataclasses.replace(spec.orbit, views=views))
        faults = Faults("--views")
        _check_views(spec, faults)
        faults.raise_any()
    return spec
