"""`spikerig cost sim`: what light samples, rays, arithmetic and effects cost, against the error they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset import cost
from spikerig.dataset.errors import UsageError
from spikerig.dataset.texture_cost import finish

if TYPE_CHECKING:
    from spikerig.rigctl.sim.effects import Effect
    from spikerig.rigctl.sim.sensor import Light
    from spikerig.rigctl.sim.spec import SceneSpec, Sensor

SUB_POSES = (2, 3, 5, 9, 18, 33, 65)
REFERENCE = 321
SAMPLES = (1, 2, 3, 4, 6)
FINEST = 12
KINDS = {  # what is swept: name of the sweep, its title, its knob, what errors are held against
    "light": (
        "sim",
        "light samples",
        "samples",
        f"float64 sums over every tick of {REFERENCE} sub-poses (or one a tick); {FINEST}x{FINEST} rays a pixel",
    ),
    "arithmetic": ("sim_arithmetic", "arithmetic", "arithmetic", "extended-precision sums of the same light"),
    "effects": ("sim_effects", "effects", "effect", "the same light without any effect"),
}
DIM_TICKS, DIM_LIGHT = 1_000_000, 0.01  # thresholds a tick, with half of it either way


def settings(scene: str, view: int, what: str) -> list[cost.Setting]:
    """Of one kind: `light` (sub-poses an exposure, rays a pixel), `arithmetic`, or `effects` of the scene."""
    from spikerig.rigctl.sim.spec import load_scene_toml

    whole = load_scene_toml(scene)
    # Without noise, with every pixel starting empty and no margins, what differs is the light alone.
    spec = replace(
        whole,
        effects=(),
        tolerance=None,
        lens=replace(whole.lens, samples=1),
        exposure=replace(whole.exposure, margin_ticks=0),
    )
    if what == "light":
        finest = light_of(spec, view, min(REFERENCE, most_pictures(spec)))
        return [*step_settings(spec, view, finest), *ray_settings(spec, view)]
    light = light_of(spec, view, spec.exposure.sub_poses)
    if what == "arithmetic":
        return [*arithmetic_settings(light, spec.sensor), *dim_settings()]
    return effect_settings(light, spec.sensor, whole.effects, spec.seed, view)


def most_pictures(spec: SceneSpec) -> int:
    """How many pictures fit an exposure: one a tick, and one more where light is linear between them."""
    return spec.exposure.ticks + (spec.exposure.light == "linear")


def light_of(spec: SceneSpec, view: int, sub_poses: int) -> Light:
    """The light of one exposure of a view, from so many pictures."""
    import numpy as np

    from spikerig.rigctl.sim.capture import camera_of, view_path
    from spikerig.rigctl.sim.caster.light import stage_of
    from spikerig.rigctl.sim.schedule import schedule
    from spikerig.rigctl.sim.sensor import Light

    exposure = replace(spec.exposure, sub_poses=sub_poses)
    plan, stage, camera = schedule(exposure), stage_of(spec.world), camera_of(spec)
    poses = view_path(spec, view).poses(plan.phases)
    rgb = np.stack([stage.picture(camera, pose, spec.lens.samples) for pose in poses])
    return Light(rgb, plan.knots, (0, exposure.ticks), exposure.rate_hz)


def charge_of(light: Light, sensor: Sensor) -> Any:
    """What an exposure brings to empty pixels, spikes and what is left of the next, float64[H,W]."""
    import numpy as np

    from spikerig.rigctl.sim.sensor import integrate, spike_light

    height, width = light.rgb.shape[1:3]
    bits, left, _ = integrate(spike_light(light.rgb, sensor), light.knots, np.zeros((height, width)))
    return counted(bits, width) + left / 2.0**32


def counted(bits: Any, width: int) -> Any:
    """Spikes a pixel, float64[H,W]."""
    import numpy as np

    from spikerig.dataset.kernels import count

    return count(bits, width, 0, len(bits)).astype(np.float64)


def stepped(light: Light, sensor: Sensor, dtype: Any) -> Any:
    """The same as `charge_of`, tick by tick in one floating-point type: what `charge_of` is held against."""
    import numpy as np

    gray = np.array(sensor.response, dtype) * dtype(sensor.gain)
    rows = light.rgb.astype(dtype) @ gray
    total = np.zeros(rows.shape[1:], dtype)
    for k, ticks in enumerate(np.diff(light.knots)):
        for tick in range(ticks):
            now = rows[k]
            if not light.hold:
                now = now + (rows[k + 1] - now) * dtype((tick + 0.5) / ticks)
            total += np.minimum(now, dtype(1))
    return total


def rms(a: Any, b: Any) -> float:
    """Root of the mean squared difference."""
    import numpy as np

    return float(np.sqrt(np.mean((np.asarray(a, np.longdouble) - b) ** 2)))


def step_settings(spec: SceneSpec, view: int, finest: Light) -> list[cost.Setting]:
    """Pictures an exposure: charge against a float64 sum over every tick of the finest light, then the frame."""
    import numpy as np

    from spikerig.rigctl.sim.rgb import encode, expose

    charge, frame = stepped(finest, spec.sensor, np.float64), encode(expose(finest))

    def spikes(n: int) -> Any:
        return charge_of(light_of(spec, view, n), spec.sensor)

    def picture(n: int) -> Any:
        return encode(expose(light_of(spec, view, n)))

    few = [n for n in SUB_POSES if n < min(REFERENCE, most_pictures(spec))]
    return [
        cost.Setting("sub-poses: RMS spikes an exposure", n, lambda n=n: spikes(n), lambda got: rms(got, charge))
        for n in few
    ] + [
        cost.Setting("sub-poses: RMS of the frame, 8-bit", n, lambda n=n: picture(n), lambda got: rms(got, frame))
        for n in few
    ]


def ray_settings(spec: SceneSpec, view: int) -> list[cost.Setting]:
    """Rays along a pixel's side, against far more."""
    import numpy as np

    from spikerig.rigctl.sim.capture import camera_of, view_path
    from spikerig.rigctl.sim.caster.light import stage_of

    stage, camera = stage_of(spec.world), camera_of(spec)
    pose = view_path(spec, view).poses(0.5)[0]
    truth = stage.picture(camera, pose, FINEST)

    def off(picture: Any) -> float:
        return 255 * rms(np.clip(picture, 0, 1), np.clip(truth, 0, 1))

    label = "rays along a pixel's side: RMS of 255 x linear light"
    return [cost.Setting(label, s, lambda s=s: stage.picture(camera, pose, s), off) for s in SAMPLES]


def arithmetic_settings(light: Light, sensor: Sensor) -> list[cost.Setting]:
    """One exposure of the same light in the kernel's fixed point and in running sums, against an extended sum."""
    import numpy as np

    truth = stepped(light, sensor, np.longdouble)
    label = "arithmetic, one exposure: RMS spikes"
    return [
        cost.Setting(label, "fixed point", lambda: charge_of(light, sensor), lambda got: rms(got, truth)),
        *(
            cost.Setting(
                label, f"{t.__name__} sums", lambda t=t: stepped(light, sensor, t), lambda got: rms(got, truth)
            )
            for t in (np.float32, np.float64)
        ),
    ]


def dim_settings() -> list[cost.Setting]:
    """A million ticks of light around 0.01: where float32 sums drift."""
    import numpy as np

    from spikerig.dataset.kernels import fire

    exact = DIM_LIGHT * (0.5 + np.random.default_rng(0).random((1, 64)))
    truth = exact.astype(np.longdouble) * DIM_TICKS

    def fixed() -> Any:
        light, start = exact[None].astype(np.float32), np.zeros(exact.shape, np.uint32)
        bits, left, _ = fire(light, np.array([0, DIM_TICKS]), start, hold=True)
        return counted(bits, exact.shape[1]) + left / 2.0**32

    def running(dtype: Any) -> Any:
        total, light = np.zeros(exact.shape, dtype), exact.astype(dtype)
        for _ in range(DIM_TICKS):
            total += light
        return total

    label = f"arithmetic, {DIM_TICKS:,} ticks of light {DIM_LIGHT:g}: RMS spikes"
    return [
        cost.Setting(label, "fixed point", fixed, lambda got: rms(got, truth)),
        *(
            cost.Setting(label, f"{t.__name__} sums", lambda t=t: running(t), lambda got: rms(got, truth))
            for t in (np.float32, np.float64)
        ),
    ]


def effect_settings(
    light: Light, sensor: Sensor, effects: Sequence[Effect], seed: int, view: int = 0
) -> list[cost.Setting]:
    """Each effect by itself: what leaving it out changes in spikes and in the frame, and the seconds of all with it.

    Args:
        light: of one view.
        sensor: of the spike camera.
        effects: to measure one by one; the first row of each series is without any.
        seed, view: as for `simulate`.

    Returns:
        A setting an effect and output that its stage can reach.
    """
    from spikerig.rigctl.sim.effects import Stage
    from spikerig.rigctl.sim.simulate import simulate

    ideal = simulate(light, sensor, (), seed, view)
    width = light.rgb.shape[2]
    before = (Stage.LIGHT, Stage.OPTICS)  # where the arms have not parted, or either may be meant

    def setting(label: str, some: tuple[Effect, ...], off: Any) -> cost.Setting:
        name = some[0].name if some else "none"
        return cost.Setting(label, name, lambda: simulate(light, sensor, some, seed, view), off)

    def spikes_off(seen: Any) -> float:
        return rms(counted(seen.spikes.bits, width), counted(ideal.spikes.bits, width))

    def frame_off(seen: Any) -> float:
        return rms(seen.frame.pixels, ideal.frame.pixels)

    spikes, frame = "an effect left out: RMS spikes an exposure", "an effect left out: RMS of the frame, 8-bit"
    return [
        setting(spikes, (), spikes_off),
        *(setting(spikes, (e,), spikes_off) for e in effects if e.stage != Stage.RGB),
        setting(frame, (), frame_off),
        *(setting(frame, (e,), frame_off) for e in effects if e.stage in (*before, Stage.RGB)),
    ]


def sim(
    scene: Annotated[str, typer.Option(help="A scene file, or the name of a built-in one.")] = "demo",
    view: Annotated[int, typer.Option(help="Which view to simulate.")] = 0,
    what: Annotated[str, typer.Option(help="light, arithmetic or effects.")] = "light",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for NAME.json and NAME.svg.")] = None,
    repeats: Annotated[int, typer.Option(help="Timed runs of each setting.")] = 3,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep light samples and rays, arithmetic, or effects: error against a far finer setting over seconds."""
    if what not in KINDS:
        raise UsageError("unknown kind of sweep", value=what, expected=", ".join(KINDS))
    name, title, knob, reference = KINDS[what]
    finish(
        name,
        lambda: cost.sweep(
            name,
            f"Simulating a view of '{scene}': {title}",
            settings(scene, view, what),
            knob=knob,
            error_unit="see series",
            reference=reference,
            repeats=repeats,
        ),
        out,
        force,
        as_json,
    )
