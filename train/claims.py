"""The paper's claims, and ours, held against a table's numbers: each with its verdict and by how much.

Differences are of novel-view PSNR, scene by scene, then averaged over the scenes where both rows finished.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spikerig.train.table_numbers import COSTS, average, cost_to_match, score_of

HOLDS, FAILS, OPEN, ABSENT, TOLD = "holds", "does not hold", "not settled", "not in this table", "told"
SHARE = 0.25  # of E2NeRF 5x's cost
UNITS = {"cpu_seconds": "CPU s", "renders": "renders"}
Doc = Mapping[str, Any]


def claims(doc: Doc) -> list[dict[str, Any]]:
    """Every claim as a JSON-ready record.

    Returns:
        Records with claim, verdict, value, wanted, margin (positive: holds by so much), unit, scenes (value by scene),
        other (the same on the pictures named by --score-on), text (one line).
    """
    labels = {r["label"] for r in doc["rows"]} - {""}
    label = "mid" if "mid" in labels or not labels else min(labels)
    return [
        _gain(doc, "SpikeNeRF >= NeRF on blurry + 4 dB, label mid", ("spikenerf", "mid"), ("plain", "mid"), 4.0),
        _gain(doc, "SpikeNeRF >= NeRF on blurry + 4 dB, label first", ("spikenerf", "first"), ("plain", "first"), 4.0),
        _gain(doc, "the label alone: NeRF on blurry, mid over first", ("plain", "mid"), ("plain", "first"), None),
        _gain(doc, "SpikeNeRF 1x >= E2NeRF 2x + 3 dB", ("spikenerf", label), ("e2-2x", label), 3.0),
        *(_cost(doc, label, cost) for cost in COSTS),
        _gain(doc, "ours >= SpikeNeRF 5x + 1 dB", ("ours", label), ("spikenerf-5x", label), 1.0),
        _gain(doc, "ours >= trained on sharp pictures - 1 dB", ("ours", label), ("oracle", label), -1.0),
    ]


def find(doc: Doc, method: str, label: str) -> str | None:
    """The row of a method under a label; a row in which the label does not enter stands for both."""
    rows = [r["name"] for r in doc["rows"] if r["method"] == method and r["label"] in (label, "")]
    return rows[0] if rows else None


def _absent(doc: Doc, claim: str, wanted: list[tuple[str, str]]) -> dict[str, Any] | None:
    """The record of a claim whose rows are not there, or did not finish anywhere; None where all are."""
    why = []
    for method, label in wanted:
        name = find(doc, method, label)
        if name is None:
            why.append(f"there is no row {method}{'' if method == 'oracle' else '@' + label}")
        elif not any(score_of(doc, name, s["name"]) is not None for s in doc["scenes"]):
            why.append(f"row {name} has no score")
    if not why:
        return None
    return _record(claim, ABSENT, None, None, "dB", text=f"{claim}: {ABSENT} ({', '.join(why)})")


def _gain(doc: Doc, claim: str, one: tuple[str, str], than: tuple[str, str], wanted: float | None) -> dict[str, Any]:
    if (absent := _absent(doc, claim, [one, than])) is not None:
        return absent
    rows = str(find(doc, *one)), str(find(doc, *than))
    scenes = _differences(doc, *rows, "novel")
    other = _differences(doc, *rows, "other")
    value = average(scenes.values())
    if value is None:
        return _record(claim, ABSENT, None, wanted, "dB", text=f"{claim}: {ABSENT} (no scene has both rows)")
    verdict = TOLD if wanted is None else HOLDS if value >= wanted else FAILS
    each = ", ".join(f"{name} {v:+.2f}" for name, v in scenes.items())
    beside = "".join(f"; on the pictures beside '{name}' {v:+.2f}" for name, v in other.items())
    over = "" if len(scenes) == len(doc["scenes"]) else f" over {len(scenes)} of {len(doc['scenes'])} scenes"
    by = "" if wanted is None else f" by {abs(value - wanted):.2f} dB"
    text = f"{claim}: {verdict}{by}; {rows[0]} over {rows[1]} {value:+.2f} dB{over} ({each}{beside})"
    return _record(claim, verdict, value, wanted, "dB", scenes=scenes, other=other, text=text)


def _differences(doc: Doc, one: str, than: str, part: str) -> dict[str, float]:
    found = {}
    for scene in doc["scenes"]:
        pair = [score_of(doc, row, scene["name"], part) for row in (one, than)]
        if pair[0] is not None and pair[1] is not None:
            found[scene["name"]] = pair[0] - pair[1]
    return found


def _cost(doc: Doc, label: str, cost: str) -> dict[str, Any]:
    unit = UNITS[cost]
    claim = f"SpikeNeRF reaches E2NeRF 5x's dB at <= 1/4 of its {unit}"
    wanted = [("spikenerf", label), ("e2-5x", label)]
    if (absent := _absent(doc, claim, wanted)) is not None:
        return absent
    rows = str(find(doc, *wanted[0])), str(find(doc, *wanted[1]))
    ours, theirs = (cost_to_match(doc, row, rows[1], cost, beside=rows[0]) for row in rows)
    if not ours or not theirs or not theirs["spent"]:
        return _record(claim, ABSENT, None, SHARE, "of its cost", text=f"{claim}: {ABSENT} (no scene has both curves)")
    share = ours["spent"] / theirs["spent"]
    verdict = (HOLDS if ours["reached"] else OPEN) if share <= SHARE else FAILS
    spent = f"{ours['spent']:.4g} {unit} of {theirs['spent']:.4g}, {share:.2f} of its cost"
    if not ours["reached"]:
        spent = f"> {spent}, not reached in {ours['cells'] - ours['reached_cells']} of {ours['cells']} cells"
        spent += f"; --set {wanted[0][0]}:steps=N gives it more" if verdict == OPEN else ""
    text = f"{claim}: {verdict}; {rows[0]} {spent}"
    return _record(claim, verdict, share, SHARE, "of its cost", censored=not ours["reached"], text=text)


def _record(
    claim: str, verdict: str, value: float | None, wanted: float | None, unit: str, **more: Any
) -> dict[str, Any]:
    margin = None
    if value is not None and wanted is not None and not more.get("censored"):
        margin = value - wanted if unit == "dB" else wanted - value
    return {
        "claim": claim,
        "verdict": verdict,
        "value": value,
        "wanted": wanted,
        "margin": margin,
        "unit": unit,
        **more,
    }
