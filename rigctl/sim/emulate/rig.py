"""A whole emulated rig from SPEC.toml: world, spike camera, GoPro and clock box on one emulated time."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib.resources import files
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, TypeVar

import numpy as np

from spikerig.calib.panel_read import Spot
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError
from spikerig.dataset.panel import Led, Panel
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.gopro import GoProSource
from spikerig.rigctl.gopro_http import Web
from spikerig.rigctl.gopro_radio import Radio
from spikerig.rigctl.led_view import LedPlan, led_mask
from spikerig.rigctl.panel_view import PanelPlan, centres, mask
from spikerig.rigctl.sim.emulate.gopro_air import Air
from spikerig.rigctl.sim.emulate.gopro_camera import Faults as RgbFaults
from spikerig.rigctl.sim.emulate.gopro_camera import GoProCamera, Nature
from spikerig.rigctl.sim.emulate.gopro_web import AirWifi, WebServer
from spikerig.rigctl.sim.emulate.harpbox import BoxFaults, HarpBoxWire
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.panel_light import PanelInView
from spikerig.rigctl.sim.emulate.sensors import Sensors, effects_of
from spikerig.rigctl.sim.emulate.serialport import device_errors
from spikerig.rigctl.sim.emulate.spike_bench import bridge_of
from spikerig.rigctl.sim.emulate.spikewire import SpikeWire
from spikerig.rigctl.sim.emulate.usb import EmulatedUsb
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.sim.emulate.world import PanelSeen, Ticker, world_of
from spikerig.rigctl.sim.limits import Faults, limits, read_record
from spikerig.rigctl.syncbox import HarpBox
from spikerig.rigctl.take_plan import TakePlan
from spikerig.rigctl.tally import Rig
from spikerig.rigctl.vidar import VidarSource

R = TypeVar("R")
SHIPPED = {"demo": "demo.toml"}
LED_SPIKES, LED_LIGHT = 0.4, 0.6  # of an LED that is on: spikes a tick, linear light
CLOCK = ("offset_ns", "ppm", "ramp_ppm_per_min", "walk")


@dataclass(frozen=True, slots=True)
class RigSpec:
    """An emulated rig's file.

    Args:
        scene: a built-in scene of the simulator, or a scene file.
        seed: of shake, clocks, latencies.
        start_s: the host's clock at first.
        spike: table of `spike_bench.bridge_of`, without the profile: the plan names it.
        rgb: ppm and the like of its crystal; nature, faults: tables of `gopro_camera`.
        effects: of optics and sensors, as a scene file lists them, or "scene": those of the scene. They cost what
            docs/effects.md says; none unless asked for.
        led: of a plan without a clock box: ppm and the like of the LED's crystal; period_ms, spike, rgb (x and y),
            radius_px, where they are not the plan's.
        box: ppm and the like; firmware, start_second; to_box, to_host: tables of `Latency`; faults: of `BoxFaults`.
    """

    scene: str = limits("demo")
    seed: int = limits(0, 0, 2**32 - 1)
    start_s: float = limits(1000.0, 0, 1e9, "s")
    spike: Any = limits({})
    rgb: Any = limits({})
    box: Any = limits({})
    led: Any = limits({})
    effects: Any = limits(())


def load_rig_spec(path: str | Path) -> RigSpec:
    """A spec from TOML, or a shipped one by name.

    Raises:
        UsageError: no such file, no TOML, or faults in it, all at once.
    """
    name = str(path)
    try:
        if name in SHIPPED:
            text = files("spikerig.rigctl.sim.emulate").joinpath(SHIPPED[name]).read_text(encoding="utf-8")
        else:
            text = Path(path).read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            "cannot read the emulated rig's file", value=f"{name} ({getattr(error, 'strerror', None) or 'not UTF-8'})",
            expected=f"a TOML file, or a shipped one: {', '.join(SHIPPED)}",
        ) from None  # fmt: skip
    except tomllib.TOMLDecodeError as error:
        raise UsageError("the emulated rig's file is not valid TOML", value=f"{name}: {error}") from None
    faults = Faults(name, next="the keys are in docs/operator.md")
    spec = read_record(RigSpec, table, "", faults)
    for key in ("spike", "rgb", "box", "led"):
        if not isinstance(getattr(spec, key), Mapping):
            faults.add(key, "is not a table")
    faults.raise_any()
    return spec


def open_emulated(spec: RigSpec, plan: TakePlan, *, card: Path, after_ns: int = 0) -> Rig:
    """The rig of a spec, for a plan: its viewpoints, profile and sync mode.

    Args:
        spec: the rig.
        plan: what it is for.
        card: folder that stands for the RGB camera's memory card.
        after_ns: host time of what was recorded before, for a take that is gone on with.

    Raises:
        UsageError: keys or values that are wrong.
        DeviceError: faults of the spec that meet the drivers when they open.
    """
    start_ns = max(round(spec.start_s * NS), after_ns + 60 * NS if after_ns else 0)
    host = VirtualHost(start_ns)
    wire = plan.profile
    size = (wire.width, wire.height)
    world = world_of(spec.scene, len(plan.viewpoints), size, wire.rate_hz, host, spec.seed or None)
    if spec.effects:
        effects = effects_of(spec.effects, world.spec, "the emulated rig's file")
        world.sensors = Sensors(effects, world.camera, wire.rate_hz, spec.seed)
    box = _box(spec, host) if plan.sync.mode == "box" else None
    if box is not None and plan.panel is not None:
        world.panel = _panel(plan.panel, box, size)
    if plan.sync.mode == "optical":
        world.panel = _led(spec, plan.led or LedPlan(), size)
    ticker = Ticker(world, spec.seed)
    bridge = bridge_of({"seed": spec.seed, **spec.spike, "profile": _wire_table(wire)}, start_ns, ticker, "spike")
    ticker.tick_ns = bridge.wire.tick_true_ns
    usb = EmulatedUsb(host, [bridge])
    camera = _camera(spec, host, world.frame, card) if plan.rgb.use else None
    spike = VidarSource(wire, host, usb, serial=plan.spike.serial)
    rgb = None
    if camera is not None:
        rgb = GoProSource(host, Web(AirWifi(WebServer(camera)), host), Radio(Air(camera).dial, host))
    sync = None if box is None else HarpBox(device_errors(box.port), host, address="emulated")

    def truth() -> dict[str, Any]:
        return {
            "spec": {f.name: getattr(spec, f.name) for f in fields(RigSpec)},
            "start_ns": start_ns, "end_ns": host.now_ns(),
            "world": {"scene": spec.scene, "views": len(plan.viewpoints), "seed": spec.seed, "moved": world.moved},
            "spike": list(usb.truth()),
            "rgb": [] if camera is None else camera.truth,
            "spike_clock": _stream_clock(bridge.wire, start_ns, host.now_ns()),
            "box": None if box is None else {"events": box.truth, "clock": _knots(box, start_ns, host.now_ns())},
        }  # fmt: skip

    return Rig(host, spike, rgb, sync, world.place, truth)


@dataclass(frozen=True, slots=True)
class Transports:
    """What the drivers of an emulated rig would talk to, without a scene: for finding and probing.

    Args:
        host: time.
        usb: a pyusb backend.
        profile: of the spike camera on it.
        web, radio: to the GoPro.
        ports: serial ports as `serial_ports.find` takes them.
        opener_of: of a port.
        card: folder that stands for the RGB camera's card; whoever asked for it removes it.
    """

    host: VirtualHost
    usb: EmulatedUsb
    profile: WireProfile
    web: Web
    radio: Radio
    ports: tuple[tuple[str, str], ...]
    opener_of: Callable[[str], Any]
    card: Path


def transports_of(spec: RigSpec) -> Transports:
    """The devices of a spec with nobody driving them; the spike camera sees a looped texture.

    Args:
        spec: the rig; `spike` may name a wire profile.

    Raises:
        UsageError: keys or values that are wrong.
    """
    host = VirtualHost(round(spec.start_s * NS))
    bridge = bridge_of({"seed": spec.seed, **spec.spike}, host.now_ns(), where="spike")
    camera, box = _camera(spec, host, _nothing, Path(mkdtemp(prefix="spikerig-card-"))), _box(spec, host)
    web, radio = Web(AirWifi(WebServer(camera)), host), Radio(Air(camera).dial, host)
    ports = (("emulated", "emulated"),)
    return Transports(
        host,
        EmulatedUsb(host, [bridge]),
        bridge.wire.profile,
        web,
        radio,
        ports,
        lambda _: device_errors(box.port),
        camera.card,
    )


def _nothing(*_: Any) -> Any:
    raise UsageError("an emulated rig without a scene records no pictures")


def _panel(plan: PanelPlan, box: HarpBoxWire, size: tuple[int, int]) -> PanelSeen:
    """The panel in pictures of the world's size: both arms are alike."""
    width, height = size
    panel = plan.panel
    spike, rgb = (
        PanelInView(panel, centres(panel, corners), radius, light, height, width)
        for corners, radius, light in (
            (plan.spike, plan.spike_radius_px, LED_SPIKES), (plan.rgb, plan.rgb_radius_px, LED_LIGHT)
        )
    )  # fmt: skip
    dark = mask(panel, plan.spike, plan.spike_radius_px, height, width)
    dark |= mask(panel, plan.rgb, plan.rgb_radius_px, height, width)
    return PanelSeen(spike, rgb, dark, box.box_ns)


def _led(spec: RigSpec, plan: LedPlan, size: tuple[int, int]) -> PanelSeen:
    """A plain blinking LED at the same place of both pictures, unless told otherwise; half of its period it is on."""
    table = dict(spec.led)
    period_ms = float(table.pop("period_ms", plan.period_ms or 400.0))
    radius = float(table.pop("radius_px", plan.spike_radius_px))
    places = {arm: table.pop(arm, getattr(plan, arm)) or (size[0] / 2, radius + 2) for arm in ("spike", "rgb")}
    clock = _clock(table, spec.seed, "led", "led")
    dark = np.zeros((size[1], size[0]), bool)
    seen = []
    for arm, light in (("spike", LED_SPIKES), ("rgb", LED_LIGHT)):
        at = np.asarray(places[arm], np.float64).reshape(-1, 2)
        leds = tuple(Led(0, False, float(x), float(y)) for x, y in at)
        panel = Panel(round(period_ms * 1e6 / 2), 1, 0, leds)
        seen.append(PanelInView(panel, at, radius, light, size[1], size[0]))
        dark |= led_mask([Spot(0, x, y, radius) for x, y in at.tolist()], size[1], size[0])
    return PanelSeen(seen[0], seen[1], dark, clock.device_from_true)


def _camera(spec: RigSpec, host: VirtualHost, pictures: Any, card: Path) -> GoProCamera:
    table = dict(spec.rgb)
    nature = _of(Nature, table.pop("nature", {}), "rgb.nature")
    faults = _of(RgbFaults, table.pop("faults", {}), "rgb.faults")
    clock = _clock(table, spec.seed, "gopro", "rgb")
    card.mkdir(parents=True, exist_ok=True)
    return GoProCamera(host, card, pictures, clock, nature, faults, spec.seed)


def _box(spec: RigSpec, host: VirtualHost) -> HarpBoxWire:
    table = dict(spec.box)
    there, back = (_of(Latency, table.pop(k, {}), f"box.{k}") for k in ("to_box", "to_host"))
    faults = _of(BoxFaults, table.pop("faults", {}), "box.faults")
    plain = {k: table.pop(k) for k in ("firmware", "start_second", "who", "serial") if k in table}
    clock = _clock(table, spec.seed, "harpbox", "box")
    return HarpBoxWire(host, clock, to_box=there, to_host=back, faults=faults, seed=spec.seed, **plain)


def _clock(table: Mapping[str, Any], seed: int, name: str, where: str) -> Oscillator:
    _known(table, CLOCK, where)
    return Oscillator(seed=seed, name=name, **table)


def _of(kind: type[R], table: Mapping[str, Any], where: str) -> R:
    """A record of plain values from a table; lists become tuples."""
    _known(table, [f.name for f in fields(kind)], where)  # type: ignore[arg-type]
    return kind(**{k: _tuples(v) for k, v in table.items()})


def _known(table: Mapping[str, Any], known: Any, where: str) -> None:
    if strangers := sorted(set(table) - set(known)):
        raise UsageError("the emulated rig has unknown keys", value=f"{where}: {strangers}",
                         expected=", ".join(known))  # fmt: skip


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def _wire_table(wire: Any) -> dict[str, Any]:
    return {f.name: getattr(wire, f.name) for f in fields(wire) if f.name != "sure"}


def _stream_clock(wire: SpikeWire, start_ns: int, end_ns: int) -> list[list[int]]:
    """True time, and the spike camera's own: bytes it has put out over their nominal rate, once a second."""
    at = range(start_ns, end_ns + NS, NS)
    profile = wire.profile
    return [[t, round(wire.made(t) / profile.tick_bytes / profile.rate_hz * NS)] for t in at]


def _knots(box: HarpBoxWire, start_ns: int, end_ns: int) -> list[list[int]]:
    """True time and box time, once a second."""
    at = np.arange(start_ns, end_ns + NS, NS)
    return [[int(t), int(b)] for t, b in zip(at, box.box_ns(at), strict=True)]
