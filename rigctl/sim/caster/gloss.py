"""Glossy surfaces: the lamp's highlight and a mirror of the room, whose light is taken from the matt part."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.hits import Axes, dot3
from spikerig.rigctl.sim.caster.pattern import Texture
from spikerig.rigctl.sim.caster.world import World

Floats = NDArray[np.floating]  # float32 unless said


def exponent(rough: float) -> float:
    """Of the Blinn-Phong lobe nearest to a GGX one of alpha = rough^2."""
    return 2 / rough**4 - 2


def fresnel(head_on: Floats, cosine: Floats) -> Floats:
    """Schlick's share of light that is mirrored.

    Args:
        head_on: that share seen head-on, [3,1] or [3,n].
        cosine: between the light and the mirror's normal, [n].
    """
    away = 1 - np.clip(cosine, 0, 1)
    away2 = away * away
    return head_on + (1 - head_on) * (away2 * away2 * away)


def glossy(
    world: World,
    texture: Texture,
    colour: Floats,
    p: Axes,
    n: Axes,
    eye: Axes,
    light: tuple[Floats, Floats],
    around: Callable[[Axes, Axes], Floats],
) -> Floats:
    """Light that points of a glossy surface send to an eye.

    Args:
        world: lamp and ambient light.
        texture: gloss, rough, metal.
        colour: albedo float32[3,n].
        p, n: points and unit normals on the eye's side, float32[n] an axis.
        eye: where it is.
        light: `shade.irradiance` of the points: of the lamp, and the open share of the ambient light.
        around: light float32[3,n] that arrives at points from directions.

    Returns:
        float32[3,n].

    Source:
        Blinn-Phong lobe normalised to at most 1 at every angle, (m + 2)(m + 4) / (8 pi (2^(-m/2) + m)); Schlick 1994.
    """
    view = [np.float32(eye[k]) - p[k] for k in range(3)]
    size = 1 / np.sqrt(dot3(view, view))
    view = [c * size for c in view]
    facing = dot3(view, n)
    head_on = np.float32(texture.gloss) * (1 + np.float32(texture.metal) * (colour - 1))
    share = fresnel(head_on, facing)
    mirrored = around(p, [2 * facing * n[k] - view[k] for k in range(3)])
    direct, open_ = light
    ambient = np.array(world.ambient, np.float32)[:, None]
    power = np.array(world.lamp.power, np.float32)[:, None]
    blur = np.float32(1 - (1 - texture.rough) ** 2)
    mirrored = (mirrored + (ambient - mirrored) * blur) * open_
    matt = (1 - share) * (colour * np.float32(1 - texture.metal)) * (ambient * open_ + power * direct)
    return matt + share * mirrored + highlight(world, texture, head_on, p, n, view) * direct * power


def highlight(world: World, texture: Texture, head_on: Floats, p: Axes, n: Axes, view: Axes) -> Floats:
    """What the lobe multiplies the lamp's light on the surface (of a white matt one) with, float32[3,n]."""
    to = [np.float32(world.lamp.position[k]) - p[k] for k in range(3)]
    size = 1 / np.sqrt(dot3(to, to))
    half = [to[k] * size + view[k] for k in range(3)]
    size_h = 1 / np.sqrt(np.maximum(dot3(half, half), np.float32(1e-12)))
    m = exponent(texture.rough)
    lobe = np.maximum(dot3(half, n) * size_h, 0) ** np.float32(m)
    lobe *= np.float32((m + 2) * (m + 4) / (8 * (2 ** (-m / 2) + m)))
    return fresnel(head_on, dot3(half, view) * size_h) * lobe
