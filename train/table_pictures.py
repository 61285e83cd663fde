"""What people look at of a table: curves.svg (dB over CPU seconds and renders), crops.png (renders beside truth)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import HostError, RigError
from spikerig.train.table_numbers import cells_of

Doc = Mapping[str, Any]
Pixels = NDArray[np.uint8]
CROP = 64  # pixels a side


def _pyplot() -> Any:
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise HostError("plots need matplotlib", next="pip install 'spikerig[plot]'") from error
    matplotlib.rcParams |= {"svg.hashsalt": "table", "svg.fonttype": "none"}  # same numbers, same file; and a small one
    return plt


def curves(doc: Doc) -> bytes:
    """An SVG: held-out dB over CPU seconds of training and over renders; a curve a row (first seed), a line a scene."""
    plt = _pyplot()
    scenes = [s["name"] for s in doc["scenes"]]
    figure, axes = plt.subplots(len(scenes), 2, figsize=(11, 3.6 * len(scenes)), layout="constrained", squeeze=False)
    colours = plt.get_cmap("tab20").colors
    for scene, line in zip(scenes, axes, strict=True):
        for ax, cost in zip(line, ("cpu_seconds", "renders"), strict=True):
            for k, row in enumerate(doc["rows"]):
                for cell in cells_of(doc, row["name"], scene)[:1]:
                    points = [(p[cost], p["psnr"]) for p in cell["history"] if p["psnr"] is not None and p[cost] > 0]
                    style = {"markersize": 2.5, "linewidth": 1, "color": colours[k % 20], "label": row["name"]}
                    ax.plot([x for x, _ in points], [y for _, y in points], "o-", **style)
            ax.set(xscale="log", xlabel=cost.replace("cpu_seconds", "CPU seconds of training"), title=scene)
            ax.grid(True, which="both", alpha=0.2)
        line[0].set_ylabel("held-out PSNR, dB")
        line[1].legend(fontsize=6, ncols=2)
    return _saved(plt, figure, "svg")


def _saved(plt: Any, figure: Any, kind: str) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format=kind, dpi=110, metadata={"Date": None} if kind == "svg" else None)
    plt.close(figure)
    return data.getvalue()


def crops(doc: Doc, folders: Mapping[tuple[str, str], Path]) -> bytes:
    """A PNG: the liveliest square of a held-out view of each scene, the truth first, then every row's render.

    Args:
        doc: the table's numbers.
        folders: (scene, row) -> folder of the first seed's held-out renders, NAME.png.
    """
    plt = _pyplot()
    rows = [r["name"] for r in doc["rows"]]
    columns = len(rows) + 1
    figure, axes = plt.subplots(
        len(doc["scenes"]),
        columns,
        figsize=(1.5 * columns, 1.85 * len(doc["scenes"])),
        layout="constrained",
        squeeze=False,
    )
    for scene, line in zip(doc["scenes"], axes, strict=True):
        name, truth = truth_of(Path(scene["path"]))
        place = liveliest(truth, CROP)
        for ax in line:
            ax.axis("off")
        line[0].imshow(truth[place], interpolation="nearest")
        line[0].set_title(f"{scene['name']}\nsharp truth", fontsize=7)
        for ax, row in zip(line[1:], rows, strict=True):
            render = _render(folders.get((scene["name"], row)), name, truth.shape)
            if render is None:
                ax.set_title(f"{row}\nno render", fontsize=7)
                continue
            ax.imshow(render[place], interpolation="nearest")
            ax.set_title(f"{row}\n{_dB(render, truth):.2f} dB", fontsize=7)
    return _saved(plt, figure, "png")


def _render(folder: Path | None, name: str, shape: Sequence[int]) -> Pixels | None:
    from spikerig.dataset.images import read_image

    if folder is None or not (folder / f"{name}.png").is_file():
        return None
    try:
        render = np.asarray(read_image(folder / f"{name}.png"))
    except RigError:
        return None
    return render if render.shape == tuple(shape) else None


def _dB(render: Pixels, truth: Pixels) -> float:
    error = np.mean((render.astype(float) - truth.astype(float)) ** 2) / 255**2
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def truth_of(path: Path) -> tuple[str, Pixels]:
    """The middle held-out view of a scene and what it should look like: sharp truth, or the frame as stored."""
    from spikerig.dataset.images import srgb8_from_linear
    from spikerig.dataset.store import open_scene

    with open_scene(path) as scene:
        names = scene.test or scene.names
        name = names[len(names) // 2]
        try:
            return name, srgb8_from_linear(np.clip(scene.truth_light(name), 0, 1))
        except RigError:  # no truth, or none of this view
            return name, np.asarray(scene.view(name, spikes=False).frame.pixels8)


def liveliest(picture: Pixels, side: int) -> tuple[slice, slice]:
    """The square of `side` pixels (or all of a smaller picture) with the most gradient energy."""
    gray = picture.astype(float).mean(-1)
    energy = np.zeros_like(gray)
    energy[:-1, :-1] = np.diff(gray, axis=0)[:, :-1] ** 2 + np.diff(gray, axis=1)[:-1] ** 2
    h, w = min(side, gray.shape[0]), min(side, gray.shape[1])
    total = np.pad(energy.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    sums = total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w]
    y, x = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return slice(int(y), int(y) + h), slice(int(x), int(x) + w)
