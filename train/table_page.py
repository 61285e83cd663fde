"""What people read of a table: table.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset import machine
from spikerig.train.table_numbers import cells_of, score_of

Doc = Mapping[str, Any]
HEAD = (
    "| method | PSNR blur view | PSNR novel view | SSIM blur | SSIM novel | LPIPS blur | LPIPS novel "
    "| steps | renders | CPU s, training | CPU s, whole fit | wall s | peak MB |"
)
NONE = "not computed"


def page(doc: Doc) -> str:
    """The table as Markdown: mean over scenes, each scene, equal dB, claims, how it was made."""
    names = [s["name"] for s in doc["scenes"]]
    parts = [f"# {len(doc['rows'])} methods on {', '.join(names)}", "", _caption(doc), ""]
    if len(names) > 1:
        parts += [f"## Mean over {len(names)} scenes", "", *_block(doc, None), ""]
    for scene in doc["scenes"]:
        size = f"{scene['size'][0]}x{scene['size'][1]}"
        told = f"{size}, {scene['train_views']} views trained on, {scene['test_views']} held out"
        parts += [f"## `{scene['name']}` ({told})", "", *_block(doc, scene["name"]), ""]
        if scene["other"]:
            parts += [*_other(doc, scene), ""]
    parts += _failures(doc)
    parts += ["![dB over CPU seconds and renders](curves.svg)", "", "![crops of held-out views](crops.png)", ""]
    parts += _equal_dB(doc)
    parts += ["## Claims", "", *(f"- {c['text']}" for c in doc["claims"]), ""]
    parts += ["## How it was made", "", *_made(doc), ""]
    return "\n".join(parts)


def _caption(doc: Doc) -> str:
    seeds = ", ".join(map(str, doc["seeds"]))
    return (
        f"One field, `{doc['field']}` (preset {doc['preset']}), for all rows; {doc['length']} a fit; seed {seeds}. "
        "Blur view: sharp truth of the training views at mid-exposure; novel view: sharp held-out views. PSNR in dB, "
        "clipped and rounded to 8 bits, mean over views. `@first`, `@mid`: the pose that blurry views are labelled "
        "with, where it enters. CPU and wall seconds and peak memory are of each fit's own process, as the system "
        "tells them; training leaves out its start, targets and held-out scores."
    )


def _block(doc: Doc, scene: str | None) -> list[str]:
    """The table of one scene, or of the mean over all."""
    lines = [HEAD, "|" + "---|" * HEAD.count(" |")]
    for row in doc["rows"]:
        name = f"`{row['name']}`" + (f" ({row['paper']})" if row["paper"] else "")
        done = cells_of(doc, row["name"], scene)
        if not done:
            error = next(
                (c["error"] for c in doc["cells"] if c["row"] == row["name"] and scene in (None, c["scene"])), None
            )
            lines.append(f"| {name} | {_why(error)} |" + " |" * (HEAD.count(" |") - 2))
            continue
        numbers = doc["means"][row["name"]] if scene is None else None
        short = (
            f" ({numbers['scenes']} of {numbers['of']} scenes)" if numbers and numbers["scenes"] < numbers["of"] else ""
        )
        lines.append(
            f"| {name}{short} | {' | '.join([*_scores(doc, row['name'], scene), *_costs(doc, row['name'], scene)])} |"
        )
    return lines


def _why(error: Doc | None) -> str:
    what = str((error or {}).get("what") or "no number")
    return what if what == "not run" else f"failed: {_cell_text(what)}"


def _cell_text(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _scores(doc: Doc, row: str, scene: str | None) -> list[str]:
    shown = []
    for metric, form in (("psnr", ".2f"), ("ssim", ".4f"), ("lpips", ".4f")):
        for part in ("blur", "novel"):
            value = doc["means"][row][part][metric] if scene is None else score_of(doc, row, scene, part, metric)
            text = NONE if value is None else f"{value:{form}}"
            if (metric, part, scene) == ("psnr", "novel", None) and (
                sd := doc["means"][row]["sd_psnr_novel"]
            ) is not None:
                text += f" ± {sd:.2f}"
            shown.append(text)
    return shown


def _costs(doc: Doc, row: str, scene: str | None) -> list[str]:
    done = [c["cost"] for c in cells_of(doc, row, scene)]

    def mean(key: str) -> float:
        return float(np.mean([cost[key] for cost in done]))

    mark = "*" if any(cost["unmeasured"] for cost in done) else ""
    return [
        f"{mean('steps'):.0f}", f"{mean('renders'):.6g} {done[0]['renders_of']}", f"{mean('train_cpu_seconds'):.1f}",
        f"{mean('fit_cpu_seconds'):.1f}{mark}", f"{mean('fit_wall_seconds'):.1f}{mark}",
        f"{max(cost['fit_peak_bytes'] for cost in done) / 1e6:.0f}",
    ]  # fmt: skip


def _other(doc: Doc, scene: Doc) -> list[str]:
    lines = [
        f"The same runs on the held-out pictures of `{Path(scene['other']).name}`:", "",
        "| method | PSNR novel view | SSIM | LPIPS |", "|---|---|---|---|",
    ]  # fmt: skip
    for row in doc["rows"]:
        values = [score_of(doc, row["name"], scene["name"], "other", m) for m in ("psnr", "ssim", "lpips")]
        if cells_of(doc, row["name"], scene["name"]):
            shown = [NONE if v is None else f"{v:{f}}" for v, f in zip(values, (".2f", ".4f", ".4f"), strict=True)]
            lines.append(f"| `{row['name']}` | {' | '.join(shown)} |")
    return lines


def _failures(doc: Doc) -> list[str]:
    failed = [c for c in doc["cells"] if c["status"] != "done"]
    if not failed:
        return []
    return [
        "## Not finished",
        "",
        *(f"- `{c['row']}` on `{c['scene']}`, seed {c['seed']}: {_why(c['error'])}" for c in failed),
        "",
    ]


def _equal_dB(doc: Doc) -> list[str]:
    lines = ["## What equal dB cost", ""]
    for target, rows in doc["reach"].items():
        lines += [
            f"To the final held-out dB of `{target}`, added up over scenes and seeds (>: not reached with all spent):",
            "", "| method | CPU s | renders | cells that reached it |", "|---|---|---|---|",
        ]  # fmt: skip
        for name, costs in rows.items():
            if (cpu := costs["cpu_seconds"]) is None:
                lines.append(f"| `{name}` | no curve | | |")
                continue
            count = f"{cpu['reached_cells']} of {cpu['cells']}"
            lines.append(f"| `{name}` | {_spent(cpu, '.1f')} | {_spent(costs['renders'], '.0f')} | {count} |")
        lines.append("")
    return lines


def _spent(found: Doc, form: str) -> str:
    return f"{found['spent']:{form}}" if found["reached"] else f"> {found['spent']:{form}}, not reached"


def _made(doc: Doc) -> list[str]:
    lines = [f"`{doc['command']}`", "", f"{machine.caption(dict(doc['machine']))}; {doc['jobs']} cells at a time."]
    spent = sum(
        c["cost"]["fit_cpu_seconds"] + c["cost"]["score_cpu_seconds"] for c in doc["cells"] if c["status"] == "done"
    )
    lines[-1] += (
        f" All cells together: {spent:.0f} CPU s. SSIM: {doc['ssim_variant']}. LPIPS: {_lpips(doc['lpips_variant'])}."
    )
    if any(c["status"] == "done" and c["cost"]["unmeasured"] for c in doc["cells"]):
        lines.append(
            "`*`: the table was killed during a fit; what that attempt used is not in these seconds (training's is)."
        )
    lines += ["", *(f"- `{s['name']}`: {s['path']}, sha256 {s['sha256'][:16]}" for s in doc["scenes"])]
    return lines


def _lpips(variant: Any) -> str:
    if isinstance(variant, Mapping):
        return ", ".join(f"{k} {v}" for k, v in variant.items())
    return str(variant or NONE)
