"""`spikerig cost tolerance`: what leaving effects out saves, against what it changes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset import cost
from spikerig.dataset.texture_cost import finish

TOLERANCES = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


def settings(scene: str, views: int) -> list[cost.Setting]:
    """The plan's choice at each tolerance: change of counts and of RGB values, against all effects."""
    from spikerig.rigctl.sim.judge.check_scenes import case_named, scene_of
    from spikerig.rigctl.sim.judge.effects_check import lights_of, outputs
    from spikerig.rigctl.sim.judge.facts import told
    from spikerig.rigctl.sim.judge.plan import judged, plan
    from spikerig.rigctl.sim.spec import Tolerance

    spec = scene_of(case_named(scene))
    made, lights = plan(spec), lights_of(spec, views)
    bounds = {row.effect.name: row.bound for row in made.rows}
    whole = outputs(spec, lights, spec.effects)
    found = []
    for series, key in (("spikes an exposure", "counts"), ("RGB values, digital numbers", "values")):
        for t in TOLERANCES:
            chosen = judged(made.looked, spec.effects, Tolerance(t, t), bounds).effects
            found.append(
                cost.Setting(
                    f"{scene}: {series}",
                    f"{t:g} ({len(chosen)} on)",
                    lambda chosen=chosen: outputs(spec, lights, chosen),
                    lambda seen, key=key: told(getattr(seen, key) - getattr(whole, key)),
                )
            )
    return found


def tolerance(
    scene: Annotated[str, typer.Option(help="One of the scenes of cost effects.")] = "plain-faint",
    views: Annotated[int, typer.Option(help="How many of its views to simulate.")] = 1,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for NAME.json and NAME.svg.")] = None,
    repeats: Annotated[int, typer.Option(help="Timed runs of each setting.")] = 3,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep the tolerance of effects = "auto": what changes in 95 % of the pixels over the seconds of simulation."""
    finish(
        "tolerance",
        lambda: cost.sweep(
            "tolerance",
            f"Effects left out of '{scene}' by their tolerance",
            settings(scene, views),
            knob="tolerance",
            error_unit="see series; below 1 the share of pixels that change, over 5 %",
            reference="all effects, paired random streams",
            repeats=repeats,
            omissions=("casting the light, which is the same for all",),
        ),
        out,
        force,
        as_json,
    )
