"""The demo's report: report.json's numbers, report.html (self-contained), and picture.png."""

from __future__ import annotations

import base64
import html
import io
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import machine
from spikerig.dataset.demo_poses import SCENES, TRUE, price, section, sentence
from spikerig.dataset.errors import DataError, HostError

OURS = ("spike-ratio", "spike-hybrid")
NAMES = {
    "plain": "blurry RGB, one pose",
    "average": "blurry RGB, 5 true sub-poses",
    "spikenerf": "TfS loss, 1x",
    "spike-ratio": "ours: spike-ratio",
    "spike-hybrid": "ours: spike-hybrid",
    "oracle": "trained on sharp truth",
}


def gains(methods: dict[str, dict[str, Any]]) -> dict[str, float | None]:
    """What the demo promises, in dB of held-out PSNR; None where a row is missing.

    Args:
        methods: method -> {"psnr": ...}.
    """

    def psnr(name: str) -> float | None:
        return methods[name]["psnr"] if name in methods else None

    def minus(a: float | None, b: float | None) -> float | None:
        return None if a is None or b is None else a - b

    ours = [methods[m]["psnr"] for m in OURS if m in methods]
    best = max(ours) if ours else None
    return {
        "gain_db": minus(best, psnr("plain")),
        "gain_tfs_db": minus(psnr("spikenerf"), psnr("plain")),
        "gain_over_average_db": minus(best, psnr("average")),
        "gap_to_oracle_db": minus(psnr("oracle"), best),
    }


def build(out: Path, plan: Sequence[Any], done: dict[str, Any]) -> dict[str, Any]:
    """Write report.html and picture.png into `out` and return what belongs into report.json.

    Args:
        out: the demo's folder.
        plan: its steps, for the commands.
        done: step key -> {"seconds", "said": the step's JSON}.

    Raises:
        HostError: matplotlib (extra `plot`) is not installed.
    """
    scenes = list(dict.fromkeys(key.split("-")[0] for key in done if key.endswith("-score")))
    results = {scene: _scene(out, scene, done) for scene in scenes}
    first = results[scenes[0]]
    document = {
        **{k: v for k, v in first.items() if k != "history"},
        "seconds": sum(step["seconds"] for step in done.values()),
        "scenes": {scene: {k: v for k, v in r.items() if k != "history"} for scene, r in results.items()},
        "machine": machine.describe(),
        "commands": [f"spikerig {shlex.join(step.words)}" for step in plan],
    }
    cost = price(results, done)
    document |= {} if cost is None else {"estimated": cost}
    pictures = {scene: _figures(out, scene, results[scene]) for scene in scenes}
    (out / "picture.png").write_bytes(pictures[scenes[0]]["sheet"])
    (out / "report.html").write_text(_page(document, pictures), encoding="utf-8")
    return document


def summary(result: dict[str, Any]) -> list[str]:
    """The numbers as lines for a terminal."""
    lines = []
    for scene, r in result["scenes"].items():
        lines.append(f"{scene} (sharp held-out views, pose label {r['pose_label']}):")
        if r.get("plan"):
            lines.append(f"  {r['plan']}")
        for name, m in r["methods"].items():
            lines.append(
                f"  {named(scene, name):<30} {m['psnr']:6.2f} dB  luma {m['luma_psnr']:6.2f}  SSIM {m['ssim']:.4f}"
                f"  {m['steps']} steps in {m['train_seconds']:.0f} s"
            )
        told = (("gain_db", "gain"), ("gain_tfs_db", "TfS"), ("gain_over_average_db", "over average"))
        parts = [f"{label} {r[key]:+.2f} dB" for key, label in told if r[key] is not None]
        if r["gap_to_oracle_db"] is not None:
            parts.append(f"{r['gap_to_oracle_db']:.2f} dB below the oracle")
        lines.append("  " + ", ".join(parts))
    if "estimated" in result:
        lines.append(sentence(result["estimated"]))
    lines.append(f"{result['seconds']:.0f} s in all; {machine.caption(result['machine'])}")
    return lines


def named(scene: str, method: str) -> str:
    """A method in words, on a scene."""
    return NAMES.get(method, method).replace(
        "true sub-poses", "found sub-poses" if scene in SCENES[1:] else "true sub-poses"
    )


def _scene(out: Path, scene: str, done: dict[str, Any]) -> dict[str, Any]:
    methods, history, label = {}, {}, None
    for key, step in done.items():
        if not key.startswith(f"{scene}-") or not key.endswith("-score"):
            continue
        name = key[len(scene) + 1 : -len("-score")]
        fit, score = done[f"{scene}-{name}-fit"]["said"], step["said"]
        novel = score["novel_view"]
        methods[name] = {
            "psnr": novel["psnr"],
            "ssim": novel["ssim"],
            "luma_psnr": novel["luma_psnr"],
            "chroma_psnr": novel.get("chroma_psnr"),
            "steps": fit["steps"],
            "train_seconds": fit["train_seconds"],
        }
        label = score["pose_label"]
        history[name] = json.loads((out / f"{scene}-{name}" / "history.json").read_text(encoding="utf-8"))
    plan = (done.get(f"{'raw' if scene in SCENES else scene}-capture", {}).get("said") or {}).get("plan_line")
    return {"methods": methods, **gains(methods), "pose_label": label, "plan": plan, "history": history}


def _figures(out: Path, scene: str, result: dict[str, Any]) -> dict[str, bytes]:
    """All pictures of one scene: sheet.png, errors.png, curve.svg."""
    from spikerig.dataset.images import read_image
    from spikerig.dataset.store import open_scene

    exam = TRUE if scene in SCENES else scene  # sharp truth lies on the true camera
    with open_scene(out / f"{exam}.h5") as file:
        held_out = file.test[len(file.test) // 2]
        view = file.view(file.train[len(file.train) // 2])
        truth = _srgb(file.truth_light(held_out))
        sharp = _srgb(file.truth_light(view.name))
        gain = file.light_gain or 1.0
    top = _capture_row(view, sharp, gain)
    renders = {}
    for name in result["methods"]:
        path = out / f"{scene}-{name}" / "pictures" / f"{held_out}.png"
        if not path.exists():
            raise DataError("a render of the demo is missing", value=path, next="spikerig demo --force")
        renders[name] = np.asarray(read_image(path), np.float32)[..., :3] / 255
    plt = _pyplot()
    return {
        "sheet": _sheet(plt, top, renders, truth, result),
        "errors": _errors(plt, renders, truth, result),
        "curve": _curve(plt, result),
    }


def _capture_row(view: Any, sharp: NDArray, gain: float) -> dict[str, NDArray]:
    from spikerig.dataset.texture import tfi, tfp

    stream = view.spikes
    at = stream.tick_at(view.mid_ns)
    one = np.unpackbits(stream.bits[int(at)], axis=-1, bitorder="little")[:, : stream.width]
    return {
        "blurry frame": view.frame.pixels / view.frame.full,
        "spikes, one tick of 25 us": one.astype(np.float32),
        "TFP, 32 ticks": _srgb(tfp(stream, at, 32).light / gain),
        "TFI": _srgb(tfi(stream, at).light / gain),
        "what was there (never trained on)": sharp,
    }


def _srgb(light: NDArray) -> NDArray:
    from spikerig.dataset.images import srgb_from_linear

    return np.clip(srgb_from_linear(np.clip(light, 0, 1)), 0, 1)


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise HostError("the report needs matplotlib", next="pip install 'spikerig[plot]'") from error
    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "spikerig"
    import matplotlib.pyplot as plt

    return plt


def _grid(plt: Any, rows: list[list[tuple[str, NDArray, dict[str, Any]]]]) -> bytes:
    """A sheet of labelled pictures as PNG."""
    columns = max(len(row) for row in rows)
    h, w = rows[0][0][1].shape[:2]
    figure, axes = plt.subplots(
        len(rows),
        columns,
        figsize=(columns * 2.4, len(rows) * (2.4 * h / w + 0.42)),
        layout="constrained",
        squeeze=False,
    )
    for row, line in zip(axes, rows, strict=True):
        for ax in row:
            ax.axis("off")
        for ax, (title, picture, how) in zip(row, line, strict=False):
            ax.imshow(picture, interpolation="nearest", **how)
            ax.set_title(title, fontsize=8)
    data = io.BytesIO()
    figure.savefig(data, dpi=110, format="png")
    plt.close(figure)
    return data.getvalue()


def _sheet(plt: Any, top: dict[str, NDArray], renders: dict[str, NDArray], truth: NDArray, result: dict) -> bytes:
    def how(picture: NDArray) -> dict[str, Any]:
        return {"cmap": "gray", "vmin": 0, "vmax": 1} if picture.ndim == 2 else {}

    captured = [(title, picture, how(picture)) for title, picture in top.items()]
    learnt = [
        (f"{NAMES.get(n, n)}\n{result['methods'][n]['psnr']:.2f} dB", np.clip(p, 0, 1), {}) for n, p in renders.items()
    ]
    return _grid(plt, [captured, [*learnt, ("held-out truth", truth, {})]])


def _errors(plt: Any, renders: dict[str, NDArray], truth: NDArray, result: dict) -> bytes:
    luma = np.array([0.299, 0.587, 0.114], np.float32)
    rows: list[list[tuple[str, NDArray, dict[str, Any]]]] = [[], []]
    for name, picture in renders.items():
        error = picture - truth
        gray = error @ luma
        chroma = np.abs(error - gray[..., None]).mean(-1)
        rows[0].append((f"luma error, {name}", np.abs(gray), {"cmap": "magma", "vmin": 0, "vmax": 0.25}))
        rows[1].append((f"chroma error, {name}", chroma, {"cmap": "magma", "vmin": 0, "vmax": 0.15}))
    return _grid(plt, rows)


def _curve(plt: Any, result: dict[str, Any]) -> bytes:
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, points in result["history"].items():
        rows = [p for p in points if p.get("psnr") is not None]
        axes.plot(
            [p["seconds"] for p in rows], [p["psnr"] for p in rows], "o-", markersize=3, label=NAMES.get(name, name)
        )
    axes.set(xlabel="training seconds (scoring excluded)", ylabel="PSNR of sharp held-out views, dB")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    data = io.BytesIO()
    figure.savefig(data, format="svg", metadata={"Date": None})
    plt.close(figure)
    return data.getvalue()


def _img(data: bytes, kind: str, alt: str) -> str:
    return f'<img alt="{html.escape(alt)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def _page(result: dict[str, Any], pictures: dict[str, dict[str, bytes]]) -> str:
    """report.html; everything that came from a file is escaped."""
    esc = html.escape
    lengths = "steps" if any(" --steps " in command for command in result["commands"]) else "seconds"
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>",
        "<title>spikerig demo</title><style>body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;"
        "padding:0 1em;color:#222}img{max-width:100%}table{border-collapse:collapse}td,th{padding:.25em .8em;"
        "border-bottom:1px solid #ccc;text-align:right}td:first-child,th:first-child{text-align:left}"
        "code{font-size:12px;overflow-wrap:anywhere}.big{font-size:1.25em}</style>",
        "<h1>From photons to a sharper picture</h1>",
        "<p>A simulated rig looked at a scene while a hand shook it: one blurry picture and some 320 one-bit spike "
        f"frames a view. The same 3D model was then trained from the same start for equal {lengths} in each row below, "
        "and scored on sharp views that no row was trained on.</p>",
    ]
    if "estimated" in result:
        parts.append(section(result["estimated"], NAMES))
    for scene, r in result["scenes"].items():
        parts.append(f"<h2>Scene '{esc(scene)}'</h2>")
        told = [
            (r["gain_db"], "dB gained by ours over blurry RGB"),
            (r["gain_tfs_db"], "dB by the paper's TfS loss"),
            (r["gain_over_average_db"], "dB by ours over sub-pose averaging without spikes"),
            (r["gap_to_oracle_db"], "dB left to training on sharp pictures"),
        ]
        parts.append("<p class='big'>" + " · ".join(f"<b>{v:.2f}</b> {t}" for v, t in told if v is not None) + "</p>")
        parts.append(_img(pictures[scene]["sheet"], "png", f"captures and renders of {scene}"))
        parts.append(
            "<table><tr><th>method</th><th>PSNR dB</th><th>luma PSNR</th><th>SSIM</th><th>steps</th>"
            "<th>seconds</th></tr>"
        )
        for name, m in r["methods"].items():
            parts.append(
                f"<tr><td>{esc(named(scene, str(name)))}</td><td>{m['psnr']:.2f}</td><td>{m['luma_psnr']:.2f}</td>"
                f"<td>{m['ssim']:.4f}</td><td>{m['steps']}</td><td>{m['train_seconds']:.1f}</td></tr>"
            )
        parts.append(
            f"</table><p>A blurry view is labelled with its <b>{esc(str(r['pose_label']))}</b>-exposure pose, here and "
            "in every row. PSNR: clipped, rounded to 8 bits, mean over views. Luma PSNR leaves colour errors out.</p>"
        )
        if r.get("plan"):
            parts.append(f"<p>The simulator's plan: {esc(str(r['plan']))}.</p>")
        parts.append(_img(pictures[scene]["curve"], "svg+xml", "PSNR over training seconds"))
        parts.append(_img(pictures[scene]["errors"], "png", "error maps"))
    parts.append(
        "<h2>How this was made</h2><p>" + esc(machine.caption(result["machine"])) + f"; {result['seconds']:.0f} s.</p>"
    )
    parts.append("<ol>" + "".join(f"<li><code>{esc(c)}</code></li>" for c in result["commands"]) + "</ol></html>")
    return "\n".join(parts)
