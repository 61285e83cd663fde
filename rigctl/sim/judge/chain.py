"""Bounds of effects that act on one another: each is judged on what reaches it from those before it.

A lamp that flickers makes a late clock matter; dark current makes spikes in the dark for others to change; a coded file
turns a change of one digital number into one of several.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.images import linear_from_srgb
from spikerig.rigctl.sim.effects import Effect, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import RARE, Bound, Facts, told
from spikerig.rigctl.sim.judge.looks import Looked, spread
from spikerig.rigctl.sim.rgb import encode
from spikerig.rigctl.sim.schedule import start_ns
from spikerig.rigctl.sim.simulate import lit

LIT = 6  # looks under a light that changes: every view has it at another phase
STEPS = (0.2, 1.0, 4.0)  # digital numbers (below 1: see Bound) whose way through a file is tried

Floats = NDArray[np.floating]


def bounds_of(looked: Looked, effects: Sequence[Effect]) -> dict[str, Bound]:
    """The bound of each effect, all others being there.

    Args:
        looked: the scene.
        effects: all there may be, in the order in which they act.
    """
    before = with_dark(looked.facts, effects)
    after = with_dark(with_lamps(looked, effects), effects)
    first = [e for e in effects if not _codes(e)]
    found = {}
    for k, e in enumerate(first):
        facts = before if e.stage == Stage.LIGHT else after
        if getattr(e, "on_noise", False):  # it changes the noise that reaches it, even in the dark
            facts = _noisy(looked, after, [c for c in first[:k] if c.stage == Stage.RGB])
        found[e.name] = e.magnitude(facts)
    if len(first) < len(effects):
        files = [e for e in effects if _codes(e)]
        seen, picture = _developed(looked, after, [e for e in first if e.stage == Stage.RGB])
        through = _through(picture, [h.coded for h in _hooks(looked, files) if h.coded is not None])
        found = {name: _coded(bound, through, files[-1].name) for name, bound in found.items()}
        found |= {e.name: e.magnitude(seen) for e in files}
    return {e.name: found[e.name] for e in effects}


def with_lamps(looked: Looked, effects: Sequence[Effect]) -> Facts:
    """Facts under the light as the effects on it leave it, at the times of several views."""
    lamps = [e for e in effects if e.stage == Stage.LIGHT]
    if not lamps:
        return looked.facts
    looks = []
    for k, number in enumerate(spread(looked.train, LIT)):
        look = looked.looks[k % len(looked.looks)]
        light = replace(look.light, t0_ns=start_ns(looked.exposure, number))
        looks.append(replace(look, light=lit(light, _hooks(looked, lamps, number))))
    return looked.surveyed(looks)


def with_dark(facts: Facts, effects: Sequence[Effect]) -> Facts:
    """Facts with the charge that comes without light: it makes spikes for others to change, even in the dark."""
    height, width = facts.size
    site = Site(height, width, 0, 0, facts.rate_hz, 0.0, facts.ticks + 2 * facts.margin_ticks)
    dark = np.zeros((1, height, width), np.float32)
    for effect in effects:
        hooks = effect.begin(site) if effect.stage == Stage.CHARGE else None
        if hooks is not None and hooks.light is not None:
            hooks.light(dark)
    mean = float(dark.mean())
    return replace(facts, light=facts.light + mean, light_max=facts.light_max + mean) if mean > 0 else facts


def _noisy(looked: Looked, facts: Facts, camera: Sequence[Effect]) -> Facts:
    """Facts whose pictures are as these effects leave the linear light on the RGB sensor."""
    means = []
    for k, (gray, rgb) in enumerate(facts.means):
        light = rgb.astype(np.float32)
        for hooks in _hooks(looked, camera, k):
            light = light if hooks.linear is None else hooks.linear(light)
        means.append((gray, light.astype(np.float64)))
    seen = np.concatenate([light.reshape(-1, 3) for _, light in means]) if means else facts.rgb
    return replace(facts, means=tuple(means), rgb=seen)


def _hooks(looked: Looked, effects: Sequence[Effect], number: int = 0) -> list[Hooks]:
    exposure, camera = looked.exposure, looked.camera
    ticks = exposure.ticks + 2 * exposure.margin_ticks
    t0_s = start_ns(exposure, number) * 1e-9
    site = Site(camera.height, camera.width, number, looked.seed, exposure.rate_hz, t0_s, ticks, camera)
    return [effect.begin(site) for effect in effects]


def _codes(effect: Effect) -> bool:
    """Whether an effect is a file's coding, which acts on whole pictures after all else."""
    return effect.stage == Stage.RGB and hasattr(effect, "through")


def _developed(looked: Looked, facts: Facts, camera: Sequence[Effect]) -> tuple[Facts, NDArray[Any]]:
    """Facts whose pictures are as the RGB camera's effects leave them, noise and all; and one of these pictures."""
    means, first = [], None
    for k, (gray, rgb) in enumerate(facts.means):
        pixels = encode(rgb, _hooks(looked, camera, k))
        first = pixels if first is None else first
        means.append((gray, linear_from_srgb(pixels).astype(np.float64)))
    return replace(facts, means=tuple(means)), np.zeros((1, 1, 3), np.uint8) if first is None else first


def _through(pixels: NDArray[Any], codings: Sequence[Callable[..., Any]]) -> Callable[[float], float]:
    """What becomes of a change on its way through a file: digital numbers before -> after, both as bounds tell them.

    Args:
        pixels: a picture as it goes into the file.
        codings: of the file.
    """

    def coded(picture: NDArray[Any]) -> Floats:
        for coding in codings:
            picture = coding(picture)
        return picture.astype(np.float64)

    full = np.iinfo(pixels.dtype).max
    unit, rng = full / 255, np.random.default_rng(95)
    plain, values = coded(pixels), pixels.astype(np.float64)
    smooth, rough = values / max(values.max(), 1.0), rng.uniform(-1, 1, pixels.shape)
    sparse = np.sign(rough) * (rng.random(pixels.shape) < STEPS[0] * RARE)
    after = [0.0]
    for step in STEPS:
        changes = [sparse] if step < 1 else [step * smooth, step * rough]
        moved = (np.rint(np.clip(values + unit * change, 0, full)).astype(pixels.dtype) for change in changes)
        after.append(max(told((coded(one) - plain) / unit) for one in moved))
    before = [0.0, *STEPS]
    return lambda dn: max(dn, float(np.interp(dn, before, after)) + max(dn - STEPS[-1], 0.0))


def _coded(bound: Bound, through: Callable[[float], float], name: str) -> Bound:
    dn = through(bound.dn)
    return bound if dn == bound.dn else replace(bound, dn=dn, formula=f"{bound.formula}; through {name} {dn:.3g} DN")
