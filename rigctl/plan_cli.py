"""`spikerig sim effects`: which effects a scene calls for, why, and what they cost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.outfile import refuse_existing, whole_file
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.rigctl.sim.judge.calibrate import Costs, Work
    from spikerig.rigctl.sim.judge.plan import Plan


def effects(
    scene: Annotated[str, typer.Argument(help="A scene file (TOML), a built-in scene, or a folder of frames.")],
    settings: Annotated[
        Path | None, typer.Option(help="Of a folder of frames, as for sim frames; else FOLDER/capture.toml.")
    ] = None,
    write: Annotated[
        Path | None, typer.Option(help="Write the scene file (or settings) with the chosen effects listed.")
    ] = None,
    seconds: Annotated[bool, typer.Option(help="Predict CPU seconds by small measurements here and now.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Say of each effect whether a scene calls for it: a bound on what it changes, its formula, its cost, the reason.

    With effects = "auto" those that change too little are left out, the smallest first, while all that is left out
    stays within [tolerance] in 95 % of pixels; the same happens in sim capture and sim frames.
    """
    if write is not None:
        refuse_existing(write, force)
    source = _folder(Path(scene), settings) if Path(scene).is_dir() else _scene(scene, settings)
    made, costs = source.plan(), None
    if seconds:
        from spikerig.rigctl.sim.judge.calibrate import predict

        costs = predict(source.work(made), made)
    if write is not None:
        from spikerig.rigctl.sim.judge.tomltext import toml_text

        with whole_file(write, force=force) as part:
            part.write_text(toml_text(source.resolved(made)), encoding="utf-8")
    if as_json:
        emit("spikerig.sim.effects/1", as_document(scene, made, costs) | {"written": None if write is None else write})
    else:
        note("\n".join(table(made, costs)))
        if write is not None:
            note(f"wrote {write}")


class _Source(NamedTuple):
    """A scene file or a folder: how to plan it, what its capture does, and its table with the effects chosen."""

    plan: Callable[[], Plan]
    work: Callable[[Plan], Work]
    resolved: Callable[[Plan], dict[str, Any]]


def _scene(scene: str, settings: Path | None) -> _Source:
    from spikerig.rigctl.sim.judge.casting import work_of
    from spikerig.rigctl.sim.judge.plan import plan, resolved_table
    from spikerig.rigctl.sim.spec import load_scene_toml, scene_table

    if settings is not None:
        raise UsageError("settings are for a folder of frames", value=settings, expected=f"{scene} to be a folder")
    spec = load_scene_toml(scene)
    return _Source(
        lambda: plan(spec), lambda made: work_of(spec, made), lambda made: resolved_table(scene_table(scene), made)
    )


def _folder(folder: Path, settings: Path | None) -> _Source:
    from spikerig.rigctl.sim.judge.folder_plan import plan_folder, work_folder
    from spikerig.rigctl.sim.judge.plan import resolved_table
    from spikerig.rigctl.sim.sources.folder import read_folder, settings_table

    found = read_folder(folder, settings)
    return _Source(
        lambda: plan_folder(found),
        lambda made: work_folder(found, made),
        lambda made: resolved_table(settings_table(folder, settings), made),
    )


def as_document(scene: str, made: Plan, costs: Costs | None) -> dict[str, Any]:
    """The plan and what it costs, JSON-ready."""
    told = {"scene": scene, **made.as_json()}
    for row in told["effects"]:
        row["cpu_seconds"] = None if costs is None else costs.effects[row["name"]]
    cost = None if costs is None else {"parts": costs.parts, "total": costs.total, "predicting": costs.spent}
    return {**told, "cpu_seconds": cost}


def table(made: Plan, costs: Costs | None) -> list[str]:
    """The plan for people: a row an effect, the light samples, and sums."""
    rows = [("effect", "stage", "", "spikes", "DN", "CPU s", "why", "bound")]
    for row in made.rows:
        name, bound = row.effect.name, row.bound
        spent = "" if costs is None else f"{costs.effects[name]:.3f}"
        rows.append(
            (name, row.effect.stage.name, "on" if row.on else "off", f"{bound.spikes:.3g}", f"{bound.dn:.3g}", spent,
             row.reason, bound.formula)
        )  # fmt: skip
    widths = [max(len(row[k]) for row in rows) for k in range(7)]
    lines = ["  ".join([*(c.ljust(w) for c, w in zip(row, widths, strict=False)), row[7]]).rstrip() for row in rows]
    lines.append(samples_line(made))
    if made.tolerance is not None:
        t = made.tolerance
        lines.append(
            f"left out: at most {made.left[0]:.3g} spikes and {made.left[1]:.3g} DN in 95 % of pixels, of "
            f"{made.room[0]:.3g} and {made.room[1]:.3g} (tolerance {t.spikes:g} and {t.dn:g}; both outputs are whole)"
        )
    if costs is not None:
        parts = ", ".join(f"{key} {value:.2f}" for key, value in costs.parts.items())
        on = sum(costs.effects[effect.name] for effect in made.effects)
        lines.append(
            f"predicted CPU seconds of one process: {costs.total:.2f} ({parts}, effects {on:.2f}); measured here in "
            f"{costs.spent:.2f} s"
        )
    return lines


def samples_line(made: Plan) -> str:
    """What the light samples are, and the error they leave."""
    s = made.samples
    count = f"{s.least}" if s.least == s.most else f"{s.least} to {s.most}"
    how = "as the motion asks" if s.chosen else "as given"
    return (
        f"light samples: {count} an exposure, {how}: {s.step_px:.2f} px a step of {s.motion_px:.1f} px at most; they "
        f"leave {s.spikes:.3g} spikes, {s.dn:.3g} DN = {s.formula}"
    )
