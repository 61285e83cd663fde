"""The emulated cameras' sensors with the simulator's effects: noise, fixed patterns, optics; off unless asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import fire
from spikerig.dataset.scene import Camera
from spikerig.dataset.sim_kernels import fire_noisy
from spikerig.rigctl.sim.effects import Effect, Hooks, Site, in_order, read_effects, settled
from spikerig.rigctl.sim.limits import Faults
from spikerig.rigctl.sim.rgb import encode, optics
from spikerig.rigctl.sim.spec import SceneSpec

Floats = NDArray[np.floating]  # float32 unless said
OWN = ("radiance", "wire", "clock_ns", "frame_clock_ns", "row_ns", "levels", "coded", "charge")
"""What an emulated rig has of its own, or cannot have: hooks that nobody would call."""
LED_KEY = 0x9E3779B9  # draws of the LEDs' pixels, which are fired by themselves


class Sensors:
    """Both sensors under some effects; without any, nothing is changed and nothing costs.

    Args:
        effects: in any order.
        camera: of both arms.
        rate_hz, seed: of the spike camera, and of all draws.

    Raises:
        UsageError: an effect that the emulated rig has of its own (wires, clocks, a codec, a rolling shutter), or one
            that needs a scene's time.
    """

    def __init__(self, effects: Sequence[Effect], camera: Camera, rate_hz: float, seed: int) -> None:
        site = Site(camera.height, camera.width, 0, seed, rate_hz, camera=camera)
        self._hooks: list[Hooks] = []
        for effect in in_order(effects):
            hooks = effect.begin(site)
            if effect.name == "misalignment" or any(getattr(hooks, name) for name in OWN):
                raise UsageError("this effect is not one of an emulated rig's sensors", value=effect.name,
                                 next="the rig has clocks, wires and a codec of its own")  # fmt: skip
            self._hooks.append(hooks)
        self.pixel: dict[str, Any] = {key: value for h in self._hooks for key, value in h.pixel.items()}
        self._shape = (camera.height, camera.width)

    def spike_light(self, pictures: Floats) -> Floats:
        """Light [n,H,W] on the spike pixels, thresholds a tick, as it arrives."""
        arrived = optics(pictures[..., None], [h.spike_optics for h in self._hooks])[..., 0]
        return self._felt(np.array(arrived, np.float32)) if self._hooks else pictures

    def _felt(self, light: Floats) -> Floats:
        for h in self._hooks:
            if h.light is not None:
                h.light(light)
        return np.maximum(light, 0)

    def rows_of(self, rows: NDArray[np.int64], columns: NDArray[np.int64], light: Floats) -> Floats:
        """Light [T,N] of some pixels as they feel it: their effects are affine, so two pictures tell them."""
        if not any(h.light is not None for h in self._hooks):
            return light
        ends = np.stack([np.zeros(self._shape, np.float32), np.ones(self._shape, np.float32)])
        for h in self._hooks:
            if h.light is not None:
                h.light(ends)
        dark, gain = ends[0][rows, columns], (ends[1] - ends[0])[rows, columns]
        return np.maximum(light * gain + dark, 0).astype(np.float32)

    def fire_rows(self, light: Floats, first: int, charge: NDArray[Any]) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        """Spikes of some pixels with their own light in every tick.

        Args:
            light: float32[T,N].
            first: number of the first tick.
            charge: [N], uint32 without effects inside the pixel, else int64.

        Returns:
            Bits uint8[T,ceil(N/8)], and the charge to go on with.
        """
        knots = np.arange(first, first + len(light) + 1)
        noisy = {k: v for k, v in self.pixel.items() if k != "reset_loss"}  # LEDs' pixels are few: no memory of spikes
        if not noisy:
            bits, left, _ = fire(light[:, None, :], knots - first, charge.astype(np.uint32)[None], hold=True)
            return bits[:, 0], left[0].astype(np.uint32)
        for name in {"shot", "comparator"} & set(noisy):
            amount, (low, high) = noisy[name]
            noisy[name] = (amount, (low ^ LED_KEY, high))
        bits, left, _ = fire_noisy(light[:, None, :], knots, charge.astype(np.int64)[None], hold=True, **noisy)
        return bits[:, 0], left[0]

    def read(self, bits: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
        """Spikes [T,H,B] as they leave the sensor."""
        for h in self._hooks:
            if h.bits is not None:
                h.bits(bits, width)
        return bits

    def picture(self, linear: Floats) -> NDArray[np.uint8]:
        """Pixels uint8[H,W,3] of the RGB camera of linear light."""
        seen = optics(np.asarray(linear)[None], [h.rgb_optics for h in self._hooks])[0]
        return encode(seen, self._hooks)


def effects_of(told: Any, scene: SceneSpec, source: str) -> tuple[Effect, ...]:
    """Effects as an emulated rig's file tells them: a list as in a scene file, or "scene": those of the scene.

    Raises:
        UsageError: they are none.
    """
    if told == "scene":
        return scene.effects
    faults = Faults(source, next="docs/effects.md has the effects")
    made = settled(read_effects(told, faults), Path(), faults)
    faults.raise_any()
    return tuple(made)
