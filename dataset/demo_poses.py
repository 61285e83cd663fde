"""The demo's other road: a rig that must be calibrated, poses that must be found, and what both cost in dB."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from spikerig.dataset.demo_steps import Step, learn

# Three scenes: by true calibration and poses; by estimated ones, from the same initial points; from COLMAP's points.
TRUE, POSED, FOUND = SCENES = ("true", "posed", "colmap")
METHODS = ("plain", "average", "spikenerf", "spike-ratio", "oracle")
GAUGE = (
    "Estimated poses have a world of their own. One similarity, fitted to the mapped training cameras alone, brings it "
    "into that of the true poses; the held-out cameras took no part in it and keep their true poses there. Both are "
    "scored on the same sharp pictures. What is left of that similarity's error counts against the estimate."
)


def posed_steps(
    out: Path,
    length: tuple[float, int],
    seed: int,
    *,
    scene: str = "demo",
    boards: int = 14,
    methods: tuple[str, ...] = METHODS,
) -> list[Step]:
    """Every command line of the demo with estimated calibration and poses.

    Args:
        out: folder of the run.
        length: (seconds, steps) of each training; steps where not 0.
        seed: of the simulation and of training.
        scene: a built-in scene, or a scene file.
        boards: how many times the board is held up.
        methods: of training; the oracle, which needs the truth, on the true scene alone.
    """

    def at(name: str) -> str:
        return str(out / name)

    rig = ("--rig", "splitter", "--seed", str(seed), "--force", "--json")
    made = ("--force", "--json")
    listed = [
        Step("raw-capture", ("sim", "capture", scene, "-o", at("raw.h5"), *rig),
             "simulate a capture by a rig whose arms differ"),
        Step("raw-boards", ("sim", "boards", scene, "-o", at("boards"), "--views", str(boards), *rig),
             "hold a checkerboard before the same rig"),
        Step("raw-board", ("calib", "board", at("boards/spike"), at("boards/rgb"), "--square-mm", "24",
                           "-o", at("calib.json"), *made), "calibrate the rig from its boards"),
        Step("raw-compare", ("calib", "compare", at("calib.json"), at("boards/true.json"), "--json"),
             "hold the calibration against the truth"),
        Step("true-align", ("calib", "align", at("raw.h5"), "--with", at("boards/true.json"), "-o", at(f"{TRUE}.h5"),
                            *made), "align the capture by the true calibration"),
        Step("colmap-align", ("calib", "align", at("raw.h5"), "--with", at("calib.json"), "-o", at(f"{FOUND}.h5"),
                              *made), "align the capture by the estimated one"),
        # without --force: a refused estimate stops the demo
        Step("colmap-poses", ("calib", "poses", at(f"{FOUND}.h5"), "--write", "--json"),
             "estimate the poses from spikes"),
    ]  # fmt: skip
    for method in methods:
        listed += learn(out, TRUE, method, length, seed)
        if method != "oracle":
            listed += learn(out, POSED, method, length, seed, file=FOUND, exam=TRUE, points=TRUE)
            listed += learn(out, FOUND, method, length, seed, exam=TRUE)
    return listed


def price(results: dict[str, dict[str, Any]], done: dict[str, Any]) -> dict[str, Any] | None:
    """What estimated calibration and poses cost; None where the demo had the true ones only.

    `cost_db` is with the same initial points (the simulator's), `cost_with_points_db` with COLMAP's few.

    Args:
        results: scene -> {"methods": method -> {"psnr"}}.
        done: step key -> {"said": its JSON}.

    Returns:
        JSON-ready: per method the dB of both and the difference; their mean and worst; errors of poses and crop.
    """
    if FOUND not in results:
        return None
    rows = {name: _row(*(results[s]["methods"][name]["psnr"] for s in SCENES)) for name in results[FOUND]["methods"]}
    poses, crop = done["colmap-poses"]["said"], done["raw-compare"]["said"]
    edges = {name: done[f"{name}-align"]["said"]["edges_px"]["median"] for name in (TRUE, FOUND)}
    return {
        "methods": rows,
        "cost_db": _over(rows, "cost_db"),
        "cost_with_points_db": _over(rows, "cost_with_points_db"),
        "poses": {key: poses[key] for key in ("registered", "images", "error_px", "truth", "left_out")},
        "calibration": {key: crop[key] for key in ("crop_px", "lens_px", "focal_ratio", "turn_deg", "same_mirror")},
        "edges_px": edges,
        "gauge": GAUGE,
    }


def _row(true: float, posed: float, found: float) -> dict[str, float]:
    psnr = {"true_db": true, "posed_db": posed, "colmap_db": found}
    return psnr | {"cost_db": true - posed, "cost_with_points_db": true - found}


def _over(rows: dict[str, dict[str, float]], key: str) -> dict[str, float]:
    costs = [row[key] for row in rows.values()]
    return {"mean": sum(costs) / len(costs), "worst": max(costs)}


def sentence(cost: dict[str, Any]) -> str:
    """The price in one line."""
    poses, crop, truth = cost["poses"], cost["calibration"]["crop_px"], cost["poses"]["truth"]
    off = ""
    if truth is not None:
        deg, share = truth["deg"]["median"], 100 * truth["share_of_extent"]["median"]
        off = f", off by {deg:.2f} degrees and {share:.2f} % of the extent (medians)"
    each = ", ".join(f"{name} {row['cost_db']:.2f}" for name, row in cost["methods"].items())
    cost_db, whole = cost["cost_db"], cost["cost_with_points_db"]
    return (
        f"estimated calibration and poses cost {cost_db['mean']:.2f} dB (mean; {each}), with COLMAP's points to start "
        f"from too {whole['mean']:.2f} dB; {poses['registered']} of {poses['images']} views placed{off}; crop off by "
        f"{crop['median']:.3f} px (median), {crop['max']:.3f} at most"
    )


def section(cost: dict[str, Any], names: dict[str, str]) -> str:
    """The price as a part of the report; everything that came from a file is escaped."""
    esc = html.escape
    rows = "".join(
        f"<tr><td>{esc(str(names.get(name, name)))}</td>"
        + "".join(
            f"<td>{row[key]:.2f}</td>" for key in ("true_db", "posed_db", "cost_db", "colmap_db", "cost_with_points_db")
        )
        + "</tr>"
        for name, row in cost["methods"].items()
    )
    heads = "".join(
        f"<th>{h}</th>" for h in ("method", "true, dB", "estimated, dB", "cost, dB", "and its points, dB", "cost, dB")
    )
    return (
        "<h2>What estimated calibration and poses cost</h2>"
        f"<p class='big'><b>{cost['cost_db']['mean']:.2f}</b> dB in the mean, <b>{cost['cost_db']['worst']:.2f}</b> at "
        f"worst; with COLMAP's points to start from <b>{cost['cost_with_points_db']['mean']:.2f}</b> in the mean</p>"
        f"<table><tr>{heads}</tr>{rows}</table><p>{esc(sentence(cost))}.</p><p>{esc(cost['gauge'])}</p>"
    )
