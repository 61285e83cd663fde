"""`spikerig train table`: methods side by side on scenes, as in the paper's Table 2, with what each dB costs."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.terminal import emit, note
from spikerig.train.quality_cli import Lpips, Trust

SCHEMA = "spikerig.train.table/1"


def table(
    scenes: Annotated[list[Path], typer.Argument(help="Scene files (.h5).")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the table.")],
    methods: Annotated[
        str,
        typer.Option(help="Rows, comma-separated: METHOD, METHOD@LABEL, or all that need no file of yours."),
    ] = "all",
    label: Annotated[
        str, typer.Option(help="Pose labels of rows that name none, comma-separated: mid, first; a row each.")
    ] = "mid",
    field: Annotated[str, typer.Option(help="Of every row: splat, nerf-fast, nerf.")] = "splat",
    preset: Annotated[str, typer.Option(help="Of every fit.")] = "draft",
    steps: Annotated[int | None, typer.Option(help="Of every fit; the preset's where not given.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Train every fit for so long instead.")] = None,
    seeds: Annotated[str, typer.Option(help="Of every fit, comma-separated.")] = "0",
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="[SCENE:|METHOD:]NAME=VALUE, a setting of fits: of all, of a scene's, of a row's."),
    ] = None,
    extra: Annotated[
        list[str] | None, typer.Option(help="METHOD=WORDS: further words of that row's `train fit`, quoted as one.")
    ] = None,
    score_on: Annotated[
        list[str] | None,
        typer.Option(help="[SCENE=]FILE.h5: score that scene's runs on this one's held-out views too (same world)."),
    ] = None,
    ssim: Annotated[str, typer.Option(help="SSIM variant: torchmetrics, tf, skimage, inria.")] = "torchmetrics",
    lpips: Lpips = None,
    trust: Trust = False,
    jobs: Annotated[int, typer.Option(help="Cells at a time; wall seconds are honest with 1, CPU seconds always.")] = 1,
    threads: Annotated[
        int | None, typer.Option(help="Of all cells together; the machine's cores if not given.")
    ] = None,
    nerfbaselines: Annotated[
        bool, typer.Option("--nerfbaselines", help="Also write every cell's results as nerfbaselines lays them out.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the table there; finished cells stay.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the table there; with --resume, only cells of other settings.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> int:
    """Methods side by side: blur view and novel view, PSNR, SSIM, LPIPS, and what every dB cost.

    Every cell is a `train fit` and a `train score` of its own. Writes table.json, table.md, curves.svg and crops.png.
    Cells that fail are told in the table, and the exit code is 1. The paper's claims are checked and printed below it.
    """
    from spikerig.train.table import Order, plan

    order = Order(
        tuple(scenes), _words(methods), _words(label), field, preset, steps, seconds, _seeds(seeds),
        tuple(setting or ()), _extra(extra or []), _score_on(score_on or [], scenes), ssim, lpips, trust,
        nerfbaselines,
    )  # fmt: skip
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    cores = here if threads is None else threads
    if not 1 <= jobs <= 256 or not 1 <= cores <= 4096:
        raise UsageError("no such number of jobs or threads", value=f"{jobs}, {threads}", expected="1 to 256")
    doc = _make(plan(order), out, jobs, max(1, cores // jobs), resume, force)
    if as_json:
        emit(SCHEMA, doc)
    failed = [c for c in doc["cells"] if c["status"] != "done"]
    for claim in doc["claims"]:
        note(claim["text"])
    note(f"{out / 'table.md'}: {len(doc['cells']) - len(failed)} of {len(doc['cells'])} cells finished")
    return 1 if failed else 0


def _make(laid: Any, out: Path, jobs: int, threads: int, resume: bool, force: bool) -> dict[str, Any]:
    from spikerig.train.claims import claims
    from spikerig.train.table_numbers import document
    from spikerig.train.table_run import TABLE, opened, run_all, tell, write_json

    count = len(laid.cells)
    note(f"{count} cells: {len(laid.scenes)} scenes, {len(laid.rows)} rows, {len(laid.order.seeds)} seeds, to {out}")
    records: dict[str, dict[str, Any]] = {}

    def write(status: str) -> dict[str, Any]:
        doc = document(laid, records, status)
        doc |= {"jobs": jobs, "threads_each": threads, "claims": claims(doc)}
        write_json(out / TABLE, {"schema": SCHEMA, **doc})
        return doc

    def done(cell: Any, record: dict[str, Any]) -> None:
        records[cell.name] = record
        tell(cell, record, (len(records), count))
        write("running")

    with opened(out, laid, resume=resume, force=force) as lock:
        run_all(out, laid, lock, jobs=jobs, threads=threads, done=done)
        doc = write("complete")
        _draw(doc, laid, out)
    return doc


def _draw(doc: dict[str, Any], laid: Any, out: Path) -> None:
    """table.md, and the pictures where matplotlib is there."""
    from spikerig.dataset.outfile import whole_file
    from spikerig.train.table_page import page
    from spikerig.train.table_pictures import crops, curves
    from spikerig.train.table_run import CELLS

    first = laid.order.seeds[0]
    folders = {(c.scene, c.row.name): out / CELLS / c.name / "pictures" for c in laid.cells if c.seed == first}
    made: list[tuple[str, bytes]] = [("table.md", page(doc).encode())]
    try:
        made += [("curves.svg", curves(doc)), ("crops.png", crops(doc, folders))]
    except HostError as error:
        note(f"note: no pictures: {error.what}; {error.next}")
    for name, data in made:
        with whole_file(out / name, force=True) as part:
            part.write_bytes(data)


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in _words(text))
    except ValueError:
        raise UsageError("seeds are whole numbers", value=text, expected="as in 0,1,2") from None


def _extra(texts: list[str]) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for text in texts:
        method, equals, words = text.partition("=")
        try:
            split = tuple(shlex.split(words))
        except ValueError as error:
            raise UsageError("these words cannot be split", value=text, cause=str(error)) from None
        if not equals or not split:
            raise UsageError("further words are METHOD=WORDS", value=text, expected="as in mpr='--set name=value'")
        found[method] = (*found.get(method, ()), *split)
    return found


def _score_on(texts: list[str], scenes: list[Path]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for text in texts:
        scene, equals, file = text.partition("=")
        if not equals and len(scenes) != 1:
            raise UsageError("which scene's runs are to be scored there?", value=text, expected="SCENE=FILE.h5")
        found[scene if equals else scenes[0].stem] = Path(file if equals else text)
    return found
