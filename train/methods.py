"""Presets and methods: functions that return or adjust a config, and `configure`, which puts them together."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import fields, replace
from typing import Any

from spikerig.dataset.errors import UsageError
from spikerig.train.config import FAST_ONLY, RAYS_ONLY, SPLAT_ONLY, FitConfig
from spikerig.train.raypresets import FAST, NERF, nerf, nerf_fast


def draft() -> FitConfig:
    """Minutes on two cores: 12k splats, one colour each, no densification."""
    return FitConfig(preset="draft")


def standard() -> FitConfig:
    """A quarter of an hour at 400x250: 30k splats grown by MCMC, view-dependent colour of degree 1."""
    return FitConfig(
        preset="standard",
        steps=10_000,
        splats=30_000,
        sh_degree=1,
        densify="mcmc",
        lr_end=0.1,
        opacity_reg=0.01,
        scale_reg=0.01,
    )


def full() -> FitConfig:
    """Hours on a CPU: 100k splats, degree 3, antialiased, 30,000 steps."""
    return replace(standard(), preset="full", steps=30_000, splats=100_000, sh_degree=3, antialias=True, lr_end=0.03)


def paper() -> FitConfig:
    """Field nerf as the paper has it: 200,000 steps of 1024 rays; weeks on a CPU, hours on a GPU."""
    return FitConfig(preset="paper", steps=200_000)


PRESETS: dict[str, Callable[[], FitConfig]] = {"draft": draft, "standard": standard, "full": full, "paper": paper}
FIELDS: dict[str, tuple[Callable[[str], dict[str, Any]], Collection[str]]] = {  # settings by preset, presets
    "splat": (lambda preset: {}, ("draft", "standard", "full")),
    "nerf": (nerf, NERF),
    "nerf-fast": (nerf_fast, FAST),
}


def plain(config: FitConfig) -> FitConfig:
    """Blurry RGB, one pose a view: what anyone gets without spikes."""
    return replace(config, method="plain")


def average(config: FitConfig) -> FitConfig:
    """Blurry RGB explained by 5 known sub-poses averaged in linear light: the honest baseline without spikes.

    One of the five is rendered a step, as in spike-hybrid: at equal seconds that is its strongest form.
    """
    return replace(config, method="average", poses_per_view=5, fresh_poses=1)


def bad(config: FitConfig) -> FitConfig:
    """BAD-NeRF and BAD-Gaussians: blurry RGB explained by a linear path of 10 sub-poses found from the mid pose alone.

    Source: Wang et al. 2023, Zhao et al. 2024: L1 + 0.2 D-SSIM for splats, L2 for rays; rate 1e-3 to 1e-5.
    """
    return replace(config, method="bad", poses_per_view=10, trajectory="linear", path_from="mid")


def spikenerf(config: FitConfig) -> FitConfig:
    """The paper's TfS loss, 1x: one pose, one texture; L2 colour, as an L1 would keep pulling to the blur."""
    return replace(config, method="spikenerf", colour_loss="l2", tfs_weight=20.0)


def spikenerf_5x(config: FitConfig) -> FitConfig:
    """The paper's 5x: 5 sub-poses rendered and averaged for colour, a texture at each."""
    return replace(config, method="spikenerf-5x", poses_per_view=5, textures_per_view=5, tfs_weight=20.0)


def spike_ratio(config: FitConfig) -> FitConfig:
    """Ours: the frame times the ratio of texture to exposure mean, at a random instant of 5 a step."""
    return replace(config, method="spike-ratio", ratio_until=1.0, textures="tfi-window", texture_window=24)


def spike_hybrid(config: FitConfig) -> FitConfig:
    """Ours, with colour restored: a short start by spike-ratio, then the 9-pose average with TfS, one render a step."""
    return replace(
        config,
        method="spike-hybrid",
        ratio_until=0.1,
        ratio_instants=9,
        poses_per_view=9,
        textures_per_view=9,
        fresh_poses=1,
        tfs_weight=40.0,
        textures="tfi-window",
        texture_window=24,
    )


def ours(config: FitConfig) -> FitConfig:
    """Ours taken further: every instant restored, luma from its spikes, colour from the model's own blur."""
    return replace(
        config,
        method="ours",
        fresh_poses=1,
        restore_instants=5,
        texture_window=24,
        highlights="keep",
    )


def colour_spikes(config: FitConfig) -> FitConfig:
    """Spikes of a colour sensor and nothing else: no frame is looked at. One of 5 instants a step."""
    return replace(
        config,
        method="colour-spikes",
        colour_weight=0.0,
        tfs_weight=1.0,
        textures_per_view=5,
        fresh_poses=1,
        textures="tfi-window",
        texture_window=24,
    )


def oracle(config: FitConfig) -> FitConfig:
    """The ceiling: sharp truth at the training poses (simulated scenes only)."""
    return replace(config, method="oracle", colour_target="truth")


def edi(config: FitConfig) -> FitConfig:
    """Frames deblurred by their events in closed form, then plain: EDI-NeRF of the paper."""
    return replace(config, method="edi", colour_target="edi")


def e2_2x(config: FitConfig) -> FitConfig:
    """E2NeRF at its least cost: poses at both ends of the exposure, averaged, and the events between them."""
    return replace(e2_5x(config), method="e2-2x", poses_per_view=2)


def e2_5x(config: FitConfig) -> FitConfig:
    """E2NeRF as published: poses at the ends of 4 event bins, averaged, and the event loss over all 10 pairs.

    Unlike there, light is averaged and compared linear, and thresholds are the scene's own: here blur and events are
    made of linear light, so the published domains and thresholds (docs/baselines.md) would only weaken it.
    """
    return replace(
        config,
        method="e2-5x",
        colour_loss="l2",
        poses_per_view=5,
        instants_rule="endpoints",
        event_weight=0.001,
    )


def deblur(config: FitConfig) -> FitConfig:
    """Deblur-NeRF's sparse kernel: a pixel is a learned mix of 5 displaced ones; no spikes, no trajectory."""
    return replace(config, method="deblur", kernel_points=5)


def mpr(config: FitConfig) -> FitConfig:
    """Frames deblurred one by one by the user's network (--restorer, --trust), then plain: MPR-NeRF of the paper."""
    return replace(config, method="mpr", colour_target="restored")


def d2net(config: FitConfig) -> FitConfig:
    """The same with a network that sees a view's neighbours too: D2Net-NeRF of the paper."""
    return replace(config, method="d2net", colour_target="restored", restorer_frames=3)


METHODS: dict[str, Callable[[FitConfig], FitConfig]] = {
    "plain": plain,
    "average": average,
    "bad": bad,
    "spikenerf": spikenerf,
    "spikenerf-5x": spikenerf_5x,
    "spike-ratio": spike_ratio,
    "spike-hybrid": spike_hybrid,
    "ours": ours,
    "colour-spikes": colour_spikes,
    "oracle": oracle,
    "edi": edi,
    "e2-2x": e2_2x,
    "e2-5x": e2_5x,
    "deblur": deblur,
    "mpr": mpr,
    "d2net": d2net,
}


def configure(method: str = "plain", preset: str = "standard", field: str = "splat", **changes: Any) -> FitConfig:
    """The config of a method at a preset on a field, with changes by name.

    Raises:
        UsageError: an unknown method, preset, field, setting or value; a setting of another field; what makes no sense.
    """
    for name, value, table in (("method", method, METHODS), ("preset", preset, PRESETS), ("field", field, FIELDS)):
        if value not in table:
            raise UsageError(f"no such {name}", value=value, expected=", ".join(table))
    shape, presets = FIELDS[field]
    if preset not in presets:
        raise UsageError(f"field {field} has no such preset", value=preset, expected=", ".join(presets))
    known = {f.name for f in fields(FitConfig)}
    if strange := sorted(set(changes) - known):
        raise UsageError("no such setting", value=", ".join(strange), expected=", ".join(sorted(known)))
    other = {"splat": RAYS_ONLY, "nerf": SPLAT_ONLY | FAST_ONLY | {"sh_degree", "init"}, "nerf-fast": SPLAT_ONLY}[field]
    if strange := sorted(set(changes) & other):
        raise UsageError(
            f"field {field} has no use for these settings", value=", ".join(strange), next="leave them out"
        )
    return replace(METHODS[method](PRESETS[preset]()), **(shape(preset) | changes))
