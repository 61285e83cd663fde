"""`spikerig cost events`: pictures an exposure, against the error they leave in an event camera's events."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset import cost
from spikerig.dataset.texture_cost import finish

PICTURES = (3, 5, 9, 17, 33, 65, 129)
REFERENCE = 1025
BINS = 4  # of E2NeRF's default
TICK_HZ = 1e9


def settings(scene: str, view: int) -> list[cost.Setting]:
    """Pictures an exposure: error of the signed sums of four bins a pixel, and share of events that are missing."""
    import numpy as np

    from spikerig.rigctl.sim.capture import camera_of, view_path
    from spikerig.rigctl.sim.caster.light import Stage
    from spikerig.rigctl.sim.events import EventCamera, simulate_events
    from spikerig.rigctl.sim.spec import load_scene_toml

    spec = load_scene_toml(scene)
    stage, path, camera = Stage(spec.world), view_path(spec, view), camera_of(spec)
    ideal = spec.events or EventCamera()
    ideal = replace(ideal, threshold_sd=0.0, leak_hz=0.0, noise_hz=0.0)
    response = np.array(spec.sensor.response, np.float32)

    def see(pictures: int) -> Any:
        phases = np.linspace(0, 1, pictures)
        gray = np.stack([stage.picture(camera, p, spec.lens.samples) @ response for p in path.poses(phases)])
        knots = np.rint(phases * spec.exposure.exposure_ms * 1e-3 * TICK_HZ).astype(np.int64)
        return simulate_events(gray, knots, TICK_HZ, ideal)

    def bins(seen: Any) -> Any:
        return seen.bins(np.linspace(seen.t0_ns, seen.t1_ns, BINS + 1).astype(np.int64)).astype(np.float64)

    finest = see(REFERENCE)
    fine = bins(finest)

    def sums_off(seen: Any) -> float:
        return float(np.sqrt(np.mean((bins(seen) - fine) ** 2)))

    def missing(seen: Any) -> float:
        return abs(1 - len(seen) / max(len(finest), 1))

    found = [cost.Setting(f"RMS of the signed sums of {BINS} bins", n, lambda n=n: see(n), sums_off) for n in PICTURES]
    return found + [cost.Setting("share of events missing", n, lambda n=n: see(n), missing) for n in PICTURES]


def events(
    scene: Annotated[str, typer.Option(help="A scene file, or the name of a built-in one.")] = "demo",
    view: Annotated[int, typer.Option(help="Which view to simulate.")] = 0,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for events.json and events.svg.")] = None,
    repeats: Annotated[int, typer.Option(help="Timed runs of each setting.")] = 3,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep pictures an exposure under an ideal event camera: error against far more pictures over seconds."""
    finish(
        "events",
        lambda: cost.sweep(
            "events",
            f"Events of a view of '{scene}': pictures an exposure",
            settings(scene, view),
            knob="pictures",
            error_unit="see series",
            reference=f"{REFERENCE} pictures",
            repeats=repeats,
        ),
        out,
        force,
        as_json,
    )
