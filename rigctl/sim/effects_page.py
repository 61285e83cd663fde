"""The page docs/effects.md, made from the classes: `python -m spikerig.rigctl.sim.effects_page > docs/effects.md`."""

from __future__ import annotations

from typing import Any

from spikerig.rigctl.sim.effects import EFFECTS, Stage, effect_class
from spikerig.rigctl.sim.page import about, rows
from spikerig.rigctl.sim.presets import PRESETS

STAGES = {
    Stage.LIGHT: "the scene's light, before the two arms part",
    Stage.OPTICS: "the beam splitter, the lenses, and how the two cameras stand to one another",
    Stage.PHOTONS: "light that arrives in portions",
    Stage.CHARGE: "inside the spike camera's pixels",
    Stage.SPIKES: "spikes before they leave the sensor",
    Stage.WIRE: "spikes on their way to the disk",
    Stage.CLOCK: "the spike camera's time against the rig's",
    Stage.RGB: "the RGB camera, from its rows to its files",
}

HEAD = """# Effects

What real light, optics, sensors, wires and clocks do, one small class each (`rigctl/sim/effects/`); off is off, bit for
bit, and not imported. Each draws from its own random stream of (seed, name, view), so that adding one leaves the draws
of the others as they were. Blur by motion is none of them: it is the exposure itself. This page is made by
`python -m spikerig.rigctl.sim.effects_page > docs/effects.md`.

## Only those that a scene calls for

A scene file lists `effects = [...]`, or says `effects = "auto"` with a `[tolerance]` in what comes out: the spike count
of one exposure, and an RGB value in digital numbers of 255. Then

1. a few looks are taken at the scene (three training views, a picture every 2 px of motion, or the folder's own);
2. each effect to choose from bounds its change of both outputs in 95 % of the pixels, all others being there: a lamp
   that flickers makes a late clock matter, dark current makes spikes for others to change, a coded file makes one
   digital number several;
3. effects are left out, the smallest bound (in parts of the tolerance) first, while the sum of what is left out stays
   within the tolerance in both outputs.

Counts and digital numbers are whole. A bound from 1 on is what 95 % of the values stay within; below 1 it is the share
of values that change at all, over 5 %, so that small bounds may be summed: 0.4 is 2 % of the pixels. Where a scene has
few values (every pixel starting empty) only whole steps of the tolerance are used.

    spikerig sim effects demo                       # each effect: on or off, bound, why, CPU seconds
    spikerig sim effects scene.toml --write out.toml  # the same scene with the chosen effects listed
    spikerig sim effects FOLDER                     # of a folder of frames and its settings
    spikerig cost effects -o docs                   # the plan checked: effects_check.md

`sim capture`, `sim dataset` and `sim frames` make the same plan, tell it in a line, and keep it in the scene's `info`.
Seconds are predicted from small measurements in the same process, because machines differ; the costs below are from
one. How well all this holds is measured in [effects_check.md](effects_check.md).

**Light samples.** With `effects = "auto"`, or `exposure.sub_poses = 0`, each view gets as many pictures as its motion
asks for: 0.25 px a step at most, at any pixel; effects on the light ask for more where they need them. What the steps
leave: a change of light d falls anywhere in a step, 1/n of the exposure, and is taken as even over it, so the mean is
off by a standard deviation of d / (n sqrt 12); over a path, 2 ticks sqrt(sum d^2 / 12) / n bounds 95 % of the counts.
"""


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for stage, words in STAGES.items():
        parts.append(f"## {stage.name}: {words}\n")
        for name in EFFECTS:
            effect: Any = effect_class(name)
            if effect.stage == stage:
                parts.append(_effect(name, effect))
    parts.append("## Presets\n\n`sensor.preset` and `rgb.preset` of a scene file.\n")
    for name, preset in PRESETS.items():
        parts.append(_preset(name, preset))
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def _effect(name: str, effect: Any) -> str:
    return (
        f"### `{name}`\n\n{about(effect)}{rows(effect)}\n"
        f"- Vanishes: {effect.vanishes}\n- Source: {effect.source}\n"
        f"- Bound: {_first(effect.magnitude.__doc__)}\n"
        f"- Cost: about {effect.cost_ns:g} ns a pixel and {PER[effect.per]}\n"
    )


PER = {"tick": "tick", "knot": "light sample", "frame": "picture"}


def _first(doc: str | None) -> str:
    return " ".join((doc or "").strip().split("\n\n")[0].split()).rstrip(".")


def _preset(name: str, preset: Any) -> str:
    listed = []
    for row in preset.effects:
        values = ", ".join(f"{key} = {value}" for key, value in row.items() if key != "name")
        listed.append(f"`{row['name']}`" + (f" ({values})" if values else ""))
    settings = "".join(f" Sets {key} = {value}." for key, value in preset.settings.items())
    return (
        f"### `{name}` ({preset.arm} camera)\n\nSource: {preset.source}.{settings}\n\n"
        f"Effects: {', '.join(listed) or 'none'}.\n"
    )


if __name__ == "__main__":
    print(page(), end="")
