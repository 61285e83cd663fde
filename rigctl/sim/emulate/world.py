"""What the emulated cameras look at: a built-in scene from viewpoint to viewpoint, under hand shake that never ends."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.kernels import fire
from spikerig.dataset.scene import Camera
from spikerig.rigctl.host import Host
from spikerig.rigctl.sim.caster.light import Stage, stage_of
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate.panel_light import PanelInView
from spikerig.rigctl.sim.emulate.sensors import Sensors
from spikerig.rigctl.sim.rgb import encode
from spikerig.rigctl.sim.shake import ShakePath
from spikerig.rigctl.sim.spec import SceneSpec, load_scene_toml, with_changes
from spikerig.rigctl.sim.stream import Account, opened, spike_blocks
from spikerig.rigctl.sim.viewpoint import camera_of, view_path

PICTURES = 17  # along a path, both ends included
KEPT = 3  # viewpoints whose pictures are in memory
BLACK = 0.02  # linear light of the panel's face
GRID_NS = 500_000  # between the knots of the spike camera's light

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PanelSeen:
    """The panel in both pictures.

    Args:
        spike, rgb: where it stands, its light in spikes a tick and in linear light.
        dark: bool[H,W], its black face.
        box_ns: the panel's time at true times.
    """

    spike: PanelInView
    rgb: PanelInView
    dark: NDArray[np.bool_]
    box_ns: Callable[[NDArray[np.int64]], NDArray[np.int64]]


@dataclass
class World:
    """A scene and a rig that is carried through it.

    The camera goes along the scene's shake path of a viewpoint, back along it, and so on: a cycle of two exposures.
    Light is linear between the pictures cast along the path, for both cameras: they are coaxial and alike.

    Args:
        spec: the scene; its camera is that of both arms.
        host: whose time is true time.
        panel: the LED panel (or the LED) before both cameras; it stands still in their pictures.
        sensors: what both cameras' sensors and optics do to the light; None: nothing.

    Attributes:
        moved: (true time, viewpoint) of each time the rig was brought somewhere.
    """

    spec: SceneSpec
    host: Host
    panel: PanelSeen | None = None
    sensors: Sensors | None = None
    moved: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.camera: Camera = camera_of(self.spec)
        self.leg_ns = round(self.spec.exposure.exposure_ms * 1e6)  # one way along the path
        self._stage: Stage | None = None
        self._cast: OrderedDict[int, NDArray[np.float32]] = OrderedDict()
        self._gray: OrderedDict[int, NDArray[np.float32]] = OrderedDict()
        if not self.moved:
            self.moved.append((self.host.now_ns(), 0))

    def place(self, number: int) -> None:
        """The rig is brought to a viewpoint, now."""
        self.moved.append((self.host.now_ns(), number))

    def number_at(self, true_ns: int) -> int:
        """The viewpoint at a true time."""
        return self.moved[max(bisect_right(self.moved, true_ns, key=lambda m: m[0]) - 1, 0)][1]

    def phase_at(self, true_ns: NDArray[np.int64] | int) -> Floats:
        """Where on its path the rig is at true times, 0 to 1."""
        turn = np.mod(np.asarray(true_ns, np.int64), 2 * self.leg_ns) / self.leg_ns
        return 1 - np.abs(1 - turn)

    def poses(self, number: int, true_ns: NDArray[np.int64]) -> Floats:
        """cam_from_world float64[N,3,4] at true times while the rig is at a viewpoint."""
        return self.path(number).poses(self.phase_at(true_ns))

    def path(self, number: int) -> ShakePath:
        """The way along which it shakes."""
        return view_path(self.spec, number)

    def pictures(self, number: int) -> NDArray[np.float32]:
        """Linear light along a viewpoint's path, float32[17,H,W,3]."""
        if number not in self._cast:
            poses = self.path(number).poses(np.linspace(0, 1, PICTURES))
            self._cast[number] = np.stack([self.sharp(pose) for pose in poses])
            if self.panel is not None:
                self._cast[number][:, self.panel.dark] = BLACK
            while len(self._cast) > KEPT:
                self._cast.popitem(last=False)
        return self._cast[number]

    def sharp(self, pose: Floats) -> NDArray[np.float32]:
        """Linear light at a pose, float32[H,W,3]."""
        if self._stage is None:
            self._stage = stage_of(self.spec.world)
        return self._stage.picture(self.camera, pose, self.spec.lens.samples)

    def thresholds(self, true_ns: int) -> NDArray[np.float32]:
        """Light on the spike camera at a true time, float32[H,W] thresholds a tick of its nominal rate."""
        number = self.number_at(true_ns)
        if number not in self._gray:
            weights = np.asarray(self.spec.sensor.response, np.float32) * np.float32(self.spec.sensor.gain)
            gray = np.asarray(self.pictures(number) @ weights, np.float32)
            self._gray[number] = gray if self.sensors is None else self.sensors.spike_light(gray)
            while len(self._gray) > KEPT:
                self._gray.popitem(last=False)
        return _between(self._gray[number], float(self.phase_at(true_ns)))

    def frame(self, start_ns: int, exposure_ns: int, row_ns: float) -> NDArray[np.uint8]:
        """What the RGB camera shows, sRGB uint8[H,W,3]: row r is exposed from start + r * row_ns on."""
        pictures = self.pictures(self.number_at(start_ns + exposure_ns // 2))
        height = pictures.shape[1]
        begin = start_ns + row_ns * np.arange(height)
        steps = max(8, min(64, exposure_ns * PICTURES // self.leg_ns * 2))
        at = begin[:, None] + (np.arange(steps) + 0.5) / steps * exposure_ns
        where = self.phase_at(at.astype(np.int64)) * (PICTURES - 1)
        low = np.clip(np.floor(where).astype(int), 0, PICTURES - 2)
        weights = np.zeros((height, PICTURES))
        rows = np.broadcast_to(np.arange(height)[:, None], low.shape)
        np.add.at(weights, (rows, low), 1 - (where - low))
        np.add.at(weights, (rows, low + 1), where - low)
        mean = np.einsum("hk,khwc->hwc", (weights / steps).astype(np.float32), pictures, optimize=True)
        if self.panel is not None:
            view, rows = self.panel.rgb, begin.astype(np.int64)
            on, off = self.panel.box_ns(rows), self.panel.box_ns(rows + exposure_ns)
            mean[view.rows, view.columns] += view.of_rows(on, off - on)[:, None]
        return encode(mean) if self.sensors is None else self.sensors.picture(mean)


class Ticker:
    """The spike camera's sensor in a world: packed ticks as they are asked for, forwards only.

    Args:
        world: what it sees.
        tick_ns: true time of a tick's beginning; set once the camera's clock is made.
        seed: of the charge at the start.
    """

    def __init__(self, world: World, seed: int = 0) -> None:
        self.world = world
        self.tick_ns: Callable[[int], int] = lambda tick: 0
        size = (world.camera.height, world.camera.width)
        self._account: Account = opened(stream(seed, "emulated charge").random(size))
        self._panel_charge: NDArray[Any] | None = None

    def __call__(self, t0: int, t1: int) -> NDArray[np.uint8]:
        """Ticks [t0, t1), uint8[n,H,ceil(W/8)]; what was skipped since the last call was dark."""
        begin, end = self.tick_ns(t0), self.tick_ns(t1)
        count = max(1, round((end - begin) / GRID_NS))
        ticks = np.unique(np.rint(np.linspace(t0, t1, count + 1)).astype(int))
        sensors = self.world.sensors
        light = [(int(t), self.world.thresholds(self.tick_ns(int(t)))) for t in ticks]  # draws go by absolute ticks
        pixel = sensors.pixel if sensors else None
        bits = np.concatenate(list(spike_blocks(light, self._account, hold=False, block_ticks=1 << 16, pixel=pixel)))
        if self.world.panel is not None:
            bits = self._with_panel(bits, self.world.panel, t0, begin, end)
        return bits if sensors is None else sensors.read(bits, self.world.camera.width)

    def _with_panel(self, bits: NDArray[np.uint8], seen: PanelSeen, t0: int, begin: int, end: int) -> NDArray[np.uint8]:
        """The LEDs' pixels fired anew under the black face's light and the panel's, exact within each tick."""
        view = seen.spike
        bounds = seen.box_ns(np.linspace(begin, end, len(bits) + 1).astype(np.int64))
        spec = self.world.spec.sensor
        light = view.of_ticks(bounds) + np.float32(BLACK * spec.gain * sum(spec.response))
        count = len(view.rows)
        if self._panel_charge is None:
            self._panel_charge = stream(1, "panel charge").integers(0, 1 << 32, count, dtype=np.uint32)
        if self.world.sensors is None:
            told, left, _ = fire(light[:, None, :], np.arange(len(light) + 1), self._panel_charge[None], hold=True)
            fired, self._panel_charge = told[:, 0], left[0].astype(np.uint32)
        else:
            felt = self.world.sensors.rows_of(view.rows, view.columns, light)
            fired, self._panel_charge = self.world.sensors.fire_rows(felt, t0, self._panel_charge)
        rows, where = np.unique(view.rows, return_inverse=True)
        pixels = np.unpackbits(bits[:, rows], axis=2, bitorder="little")
        pixels[:, where, view.columns] = np.unpackbits(fired, axis=1, bitorder="little", count=count)
        bits[:, rows] = np.packbits(pixels, axis=2, bitorder="little")
        return bits


def _between(pictures: NDArray[np.float32], phase: float) -> NDArray[np.float32]:
    at = phase * (len(pictures) - 1)
    low = min(int(at), len(pictures) - 2)
    share = np.float32(at - low)
    return pictures[low] * (1 - share) + pictures[low + 1] * share


def world_of(scene: str, views: int, size: tuple[int, int], rate_hz: float, host: Host, seed: int | None) -> World:
    """A world from a built-in scene (or a scene file), seen by a camera of another size at another rate.

    Raises:
        UsageError: no such scene, or numbers out of range.
    """
    spec = load_scene_toml(scene)
    width, height = size
    scale = width / spec.lens.width
    shake = replace(spec.shake, path_px=(spec.shake.path_px[0] * scale, spec.shake.path_px[1] * scale))
    gain = min(0.8, spec.sensor.gain * spec.exposure.rate_hz / rate_hz)
    spec = replace(
        spec, lens=replace(spec.lens, width=width, height=height), shake=shake, sensor=replace(spec.sensor, gain=gain)
    )
    spec = with_changes(spec, seed=seed, views=views)
    return World(replace(spec, exposure=replace(spec.exposure, rate_hz=rate_hz, sub_poses=PICTURES)), host)
