"""The verb that looks at the noise of a stream of spikes: `spikerig sim statistics`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.dataset.spikes import SpikeStream

COLUMNS = ("rate", "regular", "count_variance", "phase_variance", "fpn")


def statistics(
    source: Annotated[str, typer.Argument(help="A file of spikes, or a scene (TOML or built-in name): its view 0.")],
    preset: Annotated[
        list[str] | None, typer.Option(help="Also of a simulated twin: the same light, seen by this sensor preset.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the twin's noise.")] = 0,
    axes: Annotated[str | None, typer.Option(help="Order of a foreign .npz array: THW or HWT.")] = None,
    height: Annotated[int | None, typer.Option(help="Of a raw raster.")] = None,
    width: Annotated[int | None, typer.Option(help="Of a raw raster.")] = None,
    row_bits: Annotated[int | None, typer.Option(help="Of a raw raster: 400 or 416 for a Vidar.")] = None,
    ticks: Annotated[int, typer.Option(help="Of the file that are looked at, from its start.")] = 4000,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Statistics of spikes: rate, regular intervals, count variance, fixed pattern; docs/sensor_statistics.md."""
    from spikerig.dataset.spikes import open_spikes
    from spikerig.rigctl.sim.spec import builtin_names

    if ticks < 1:
        raise UsageError("ticks are counted from 1", value=ticks)
    if source.lower().endswith(".toml") or source in builtin_names():
        stream = _played(source)
    else:
        with open_spikes(source, axes=axes, height=height, width=width, row_bits=row_bits) as file:
            stream = file.read(0, min(ticks, file.ticks))
    rows = {"spikes": _both(stream)}
    for name in preset or ():
        rows[name] = _both(_twin(stream, name, seed))
    if as_json:
        emit("spikerig.sim.statistics/1", {"source": source, "ticks": stream.ticks, "statistics": rows})
    note(f"{source}: {stream.ticks} ticks of {stream.width}x{stream.height}")
    note(f"{'':28s}{'pixels':>8s}" + "".join(f"{name:>16s}" for name in COLUMNS))
    for name, both in rows.items():
        for where, found in both.items():
            if found is not None:
                values = "".join(f"{found[key]:16.4f}" for key in COLUMNS)
                note(f"{name + ', ' + where:28s}{found['pixels']:8d}{values}")


def _both(stream: SpikeStream) -> dict[str, dict[str, Any] | None]:
    from dataclasses import asdict

    from spikerig.rigctl.sim.statistics import statistics as look

    found: dict[str, dict[str, Any] | None] = {"all": asdict(look(stream)), "flat": None}
    try:
        found["flat"] = asdict(look(stream, flat=True))
    except DataError:
        pass  # nothing is flat: null says so
    return found


def _twin(stream: SpikeStream, preset: str, seed: int) -> SpikeStream:
    from spikerig.rigctl.sim.presets import sensor_effects
    from spikerig.rigctl.sim.statistics import twin

    return twin(stream, sensor_effects(preset), seed)


def _played(source: str) -> SpikeStream:
    from spikerig.rigctl.sim.capture import take_view
    from spikerig.rigctl.sim.spec import load_scene_toml

    spec = load_scene_toml(source)
    held_out = spec.orbit.held_out()
    number = next(k for k in range(spec.orbit.views) if k not in held_out)
    spikes = take_view(spec, number).view.spikes
    if spikes is None:
        raise DataError("the view has no spikes", value=source)
    return spikes
