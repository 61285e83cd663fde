"""The numbers of a table from the records of its cells: each cell, means over scenes, what equal dB cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from statistics import fmean, stdev
from typing import Any

from spikerig.dataset import machine
from spikerig.train.table import PAPER, Plan

METRICS = ("psnr", "ssim", "lpips", "luma_psnr")
PARTS = ("blur", "novel", "other")
COSTS = ("cpu_seconds", "renders")
Doc = Mapping[str, Any]


def document(plan: Plan, records: Mapping[str, Doc], status: str) -> dict[str, Any]:
    """All of table.json but the claims.

    Args:
        plan: of the table.
        records: of cells by name; cells without one are "not run".
        status: "running" or "complete".
    """
    order = plan.order
    doc: dict[str, Any] = {
        "status": status,
        "command": machine.command(),
        "machine": machine.describe(),
        "field": order.field,
        "preset": order.preset,
        "length": _length(plan),
        "seeds": list(order.seeds),
        "settings": list(order.settings),
        "extra": {k: list(v) for k, v in order.extra.items()},
        "ssim_variant": next((r["own"]["ssim_variant"] for r in records.values() if r["status"] == "done"), order.ssim),
        "lpips_variant": next((r["own"]["lpips_variant"] for r in records.values() if r["status"] == "done"), None),
        "scenes": [asdict(place) for place in plan.scenes],
        "rows": [
            {"name": r.name, "method": r.method, "label": r.label, "paper": PAPER.get(r.method)} for r in plan.rows
        ],
        "cells": [
            {"scene": c.scene, "row": c.row.name, "seed": c.seed, "sha256": c.sha256, **_cell(records.get(c.name))}
            for c in plan.cells
        ],
    }  # fmt: skip
    doc["means"] = {row["name"]: means(doc, row["name"]) for row in doc["rows"]}
    doc["reach"] = equal_dB(doc)
    return doc


def _length(plan: Plan) -> str:
    order = plan.order
    if order.seconds is not None:
        return f"{order.seconds:g} s"
    return f"{order.steps or plan.cells[0].identity['config']['steps']} steps"


def _cell(record: Doc | None) -> dict[str, Any]:
    if record is None:
        return {"status": "not run", "error": {"what": "not run"}}
    told: dict[str, Any] = {"status": record["status"], "error": record.get("error"), "folder": None}
    if record["status"] != "done":
        return told
    fit, own = record["fit"], record["own"]
    spent = [a for a in record["attempts"] if a["what"] == "fit"]
    return told | {
        "blur": _part(own["blur_view"]),
        "novel": _part(own["novel_view"]),
        "other": _part(record["other"]["novel_view"]) if "other" in record else None,
        "cost": {
            "steps": fit["steps"],
            "renders": fit["renders"],
            "renders_of": fit["renders_of"],
            "train_cpu_seconds": fit["train_cpu_seconds"],
            "train_seconds": fit["train_seconds"],
            "fit_cpu_seconds": sum(a["cpu_seconds"] for a in spent),
            "fit_wall_seconds": sum(a["wall_seconds"] for a in spent),
            "fit_peak_bytes": max(a["peak_bytes"] for a in spent),
            "attempts": len(spent),
            "unmeasured": bool(record.get("unmeasured")),
            "score_cpu_seconds": sum(a["cpu_seconds"] for a in record["attempts"] if a["what"] != "fit"),
        },
        "pose_label": fit["pose_label"],
        "effective_tfs_weight": fit["effective_tfs_weight"],
        "model_sha256": fit["model_sha256"],
        "history": fit["history"],
    }


def _part(graded: Doc | None) -> dict[str, Any] | None:
    if graded is None:
        return None
    kept = (*METRICS, "against", "predictions_sha256", "truth_sha256")
    return {k: graded.get(k) for k in kept} | {"views": len(graded["views"])}  # each view's: in the cell's record


def cells_of(doc: Doc, row: str, scene: str | None = None) -> list[dict[str, Any]]:
    """A row's finished cells, of one scene or all."""
    return [c for c in doc["cells"] if c["row"] == row and scene in (None, c["scene"]) and c["status"] == "done"]


def score_of(doc: Doc, row: str, scene: str, part: str = "novel", metric: str = "psnr") -> float | None:
    """A row's number on a scene, mean over seeds; None where there is none."""
    return average(c[part][metric] for c in cells_of(doc, row, scene) if c.get(part))


def average(values: Iterable[float | None]) -> float | None:
    """Mean of the numbers among values; None without any."""
    known = [v for v in values if v is not None]
    return fmean(known) if known else None


def means(doc: Doc, row: str) -> dict[str, Any]:
    """A row's numbers, mean over the scenes that have one (how many: `scenes`), as the paper's table has them.

    `sd_psnr_novel`: over seeds of the mean over scenes, where there are several.
    """
    names = [s["name"] for s in doc["scenes"]]
    found: dict[str, Any] = {"scenes": sum(bool(cells_of(doc, row, name)) for name in names), "of": len(names)}
    for part in PARTS:
        found[part] = {m: average(score_of(doc, row, name, part, m) for name in names) for m in METRICS}
    done = cells_of(doc, row)
    found["cost"] = {
        key: average(c["cost"][key] for c in done)
        for key in ("steps", "renders", "train_cpu_seconds", "fit_cpu_seconds", "fit_wall_seconds")
    } | {"fit_peak_bytes": max((c["cost"]["fit_peak_bytes"] for c in done), default=None)}
    by_seed = [average(c["novel"]["psnr"] for c in done if c["seed"] == s and c["novel"]) for s in doc["seeds"]]
    known = [v for v in by_seed if v is not None]
    found["sd_psnr_novel"] = stdev(known) if len(known) > 1 else None
    return found


def reach(history: Sequence[Doc], target: float, cost: str) -> tuple[float, bool]:
    """What it cost until held-out dB first came to a target, linear between looks.

    Args:
        history: of a fit: rows with psnr and costs.
        target: dB.
        cost: "cpu_seconds" or "renders".

    Returns:
        (cost, True), or (all that was spent, False) where the target was not reached: then it is a lower bound.
    """
    before: Doc | None = None
    for row in (r for r in history if r["psnr"] is not None):
        if row["psnr"] >= target:
            if before is None:
                return float(row[cost]), True
            share = (target - before["psnr"]) / (row["psnr"] - before["psnr"])
            return float(before[cost] + share * (row[cost] - before[cost])), True
        before = row
    return float(history[-1][cost]) if history else 0.0, False


def last_dB(history: Sequence[Doc]) -> float | None:
    """The last held-out dB of a curve."""
    return next((row["psnr"] for row in reversed(history) if row["psnr"] is not None), None)


def cost_to_match(doc: Doc, row: str, target: str, cost: str, beside: str = "") -> dict[str, Any] | None:
    """What a row spends until it has another row's final dB, summed over the scenes and seeds where both finished.

    Args:
        doc: the table's numbers.
        row, target: names of rows.
        cost: "cpu_seconds" or "renders".
        beside: a third row that must have finished there too, for sums that are compared.

    Returns:
        {"spent", "reached", "cells", "reached_cells"}: `reached` is False where any of the cells is censored, and
        `spent` is then a lower bound; None where no cell of both finished.
    """
    goals = {(c["scene"], c["seed"]): last_dB(c["history"]) for c in cells_of(doc, target)}
    there = {(c["scene"], c["seed"]) for c in cells_of(doc, beside or row)}
    mine = [c for c in cells_of(doc, row) if (c["scene"], c["seed"]) in there]
    pairs = [(c["history"], goals.get((c["scene"], c["seed"]))) for c in mine]
    found = [reach(history, goal, cost) for history, goal in pairs if goal is not None]
    if not found:
        return None
    reached = sum(ok for _, ok in found)
    return {
        "spent": sum(spent for spent, _ in found),
        "reached": reached == len(found),
        "cells": len(found),
        "reached_cells": reached,
    }


def targets_of(doc: Doc) -> list[str]:
    """The rows whose dB others are measured to reach: E2NeRF 5x, averaging, plain; of those that finished."""
    wanted = [[r["name"] for r in doc["rows"] if r["method"] == m][:1] for m in ("e2-5x", "average", "plain")]
    return [name for names in wanted for name in names if cells_of(doc, name)] or [doc["rows"][0]["name"]]


def equal_dB(doc: Doc) -> dict[str, Any]:
    """Target row -> row -> cost -> what it took to come to the target's final dB."""
    return {
        target: {r["name"]: {cost: cost_to_match(doc, r["name"], target, cost) for cost in COSTS} for r in doc["rows"]}
        for target in targets_of(doc)
    }
