"""The cells of a table as child processes: each measured by the system, kept when finished, gone on with when not.

DIR/cells/NAME/cell.json    what the cell is, by hash; how far it came; its numbers
DIR/cells/NAME/run          its fit (train fit --resume goes on with it)
DIR/cells/NAME/pictures     its held-out renders; NAME/log.txt what its commands told
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.terminal import jsonable, note
from spikerig.train.table import Cell, Plan

CELL = "spikerig.train.table.cell/1"
CELLS, TABLE, LOCK = "cells", "table.json", ".spikerig-table"  # the last is a lock, and says whose folder it is
OUTPUTS = (TABLE, "table.md", "curves.svg", "crops.png")


@dataclass(frozen=True, slots=True)
class Spent:
    """What a child process used, by wait4: seconds, and bytes resident at most; of it and of its own children."""

    what: str
    exit: int
    wall_seconds: float
    cpu_seconds: float
    peak_bytes: int


@dataclass(slots=True)
class Crew:
    """Children at work, so that an interrupt reaches them; `lock` is held by them too, until the last has ended."""

    threads: int
    lock: int
    pids: set[int] = field(default_factory=set)
    guard: threading.Lock = field(default_factory=threading.Lock)
    stopping: bool = False

    def stop(self) -> None:
        """Interrupt every child; no other is started."""
        with self.guard:
            self.stopping = True
            for pid in self.pids:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGINT)


class Stopped(Exception):
    """A cell was left because the table is being interrupted."""


def write_json(path: Path, document: Any) -> None:
    """Replace a JSON file in one step."""
    with whole_file(path, force=True) as part:
        part.write_text(json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_cell(folder: Path) -> dict[str, Any] | None:
    """A cell's record, or None where there is none.

    Raises:
        DataError: it is damaged, or not one.
    """
    path = folder / "cell.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["schema"] != CELL or not isinstance(record["attempts"], list):
            raise ValueError(record["schema"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "a cell of the table is damaged", value=path, cause=repr(error), next=f"rm -r {folder}"
        ) from None
    return record


@contextmanager
def opened(out: Path, plan: Plan, *, resume: bool, force: bool) -> Iterator[int]:
    """Make a table's folder, or look at what it holds; gives the lock that children inherit.

    Raises:
        UsageError: it holds something else, a table that is neither to be gone on with nor replaced, cells of other
            settings, or another run is at work in it.
    """
    if out.exists() and not out.is_dir():
        raise UsageError("the table's folder is a file", value=out)
    ours = (out / LOCK).exists()
    if not ours and out.is_dir() and any(out.iterdir()):
        raise UsageError("the folder holds something that is no table", value=out, next="give another folder with -o")
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise HostError("the table's folder cannot be made", value=f"{out}: {error.strerror}") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            cause = "another table, or fits that one left behind when it was killed; they end by themselves"
            raise UsageError("something is at work in this folder", value=out, cause=cause) from None
        os.set_inheritable(lock, True)
        if ours and not (resume or force):
            raise UsageError(
                "there is a table already", value=out, next="--resume goes on with it, --force replaces it"
            )
        _check_cells(out, plan, resume=resume, force=force)
        yield lock
    finally:
        os.close(lock)


def _check_cells(out: Path, plan: Plan, *, resume: bool, force: bool) -> None:
    if force and not resume:
        shutil.rmtree(out / CELLS, ignore_errors=True)
        for name in OUTPUTS:
            (out / name).unlink(missing_ok=True)
    (out / CELLS).mkdir(exist_ok=True)
    faults = []
    for cell in plan.cells:
        folder = out / CELLS / cell.name
        if (record := read_cell(folder)) is not None and record["sha256"] != cell.sha256:
            if not force:
                faults.append(f"{cell.name}: {', '.join(_differences(record['identity'], cell.identity))}")
            else:
                shutil.rmtree(folder)
    if faults:
        raise UsageError(
            "cells of this table were made with other settings, scenes or code",
            value="\n            ".join(faults),
            next="--resume --force makes these anew and keeps the others; or give another folder with -o",
        )


def _differences(there: Any, wanted: Any) -> list[str]:
    """Names of what differs, inside the config too."""
    names = []
    for key in wanted:
        a, b = there.get(key) if isinstance(there, dict) else None, wanted[key]
        if a == b:
            continue
        if key == "config" and isinstance(a, dict):
            names += [f"{k} {a.get(k)} -> {v}" for k, v in b.items() if a.get(k) != v]
        else:
            names.append({"code": "spikerig's code", "other": "the scene to score on"}.get(key, key))
    return names


def run_all(
    out: Path, plan: Plan, lock: int, *, jobs: int, threads: int, done: Callable[[Cell, dict[str, Any]], None]
) -> dict[str, dict[str, Any]]:
    """Run what is not finished, `jobs` cells at a time; gives the record of every cell by name.

    Args:
        out: folder.
        plan: of the table.
        lock: that children inherit.
        jobs: at a time.
        threads: of each child.
        done: called after each cell, one call at a time.
    """
    crew, told = Crew(threads, lock), threading.Lock()
    records: dict[str, dict[str, Any]] = {}

    def work(cell: Cell) -> None:
        if crew.stopping:
            return
        try:
            record = run_cell(out / CELLS / cell.name, cell, crew, plan.order.nerfbaselines)
        except Stopped:
            return
        with told:
            records[cell.name] = record
            done(cell, record)

    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(work, cell) for cell in plan.cells]
        try:
            for each in waiting:
                each.result()
        except BaseException:
            crew.stop()
            for each in waiting:
                each.cancel()
            raise
    return records


def run_cell(folder: Path, cell: Cell, crew: Crew, nerfbaselines: bool) -> dict[str, Any]:
    """One cell, from where it is: its fit, then its scores. A failure is a result, told in its record.

    Raises:
        Stopped: interrupted; the cell can be gone on with.
    """
    record = read_cell(folder)
    if record is not None and record["status"] == "done" and not _lacks(folder, nerfbaselines):
        return record
    if record is None and folder.exists():  # not a cell: it cannot be told what its run is of
        shutil.rmtree(folder)
    folder.mkdir(exist_ok=True)
    lost = record is not None and record["status"] == "running" and not record.get("fit")
    unmeasured = lost or (record is not None and bool(record.get("unmeasured")))  # what a killed table saw of a fit
    record = record or {"schema": CELL, "sha256": cell.sha256, "identity": dict(cell.identity), "attempts": []}
    kept = {"fit": record["fit"]} if record.get("fit") and (folder / "run/run.json").exists() else {}
    record = {k: record[k] for k in ("schema", "sha256", "identity", "attempts")} | kept
    record |= {"status": "running", "error": None, "unmeasured": unmeasured}
    write_json(folder / "cell.json", record)
    run = ["-o", str(folder / "run"), "--resume", "--threads", str(crew.threads)]
    steps = [] if kept else [("fit", [*cell.fit, *run])]
    steps += [(which, _score_words(folder, which, words, nerfbaselines)) for which, words in cell.scores]
    for what, words in steps:
        document, spent = child(what, [*words, "--json"], folder / "log.txt", crew)
        record["attempts"].append(asdict(spent))
        if crew.stopping:
            write_json(folder / "cell.json", record | {"status": "interrupted"})
            raise Stopped
        if spent.exit != 0:
            record |= {"status": "failed", "error": _failure(what, document, spent.exit)}
            break
        record[what] = _kept(document) | ({"history": _history(folder)} if what == "fit" else {})
        write_json(folder / "cell.json", record)
    else:
        record["status"] = "done"
    write_json(folder / "cell.json", record)
    return record


def _lacks(folder: Path, nerfbaselines: bool) -> bool:
    return not (folder / "pictures").is_dir() or (nerfbaselines and not (folder / "nerfbaselines").is_dir())


def _score_words(folder: Path, which: str, words: Sequence[str], nerfbaselines: bool) -> list[str]:
    more = ["--pictures", str(folder / ("pictures" if which == "own" else f"pictures-{which}")), "--force"]
    if nerfbaselines and which == "own":
        shutil.rmtree(folder / "nerfbaselines", ignore_errors=True)
        more += ["--nerfbaselines", str(folder / "nerfbaselines")]
    return ["train", "score", str(folder / "run"), *words, *more]


def _kept(document: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in document.items() if k not in ("schema", "machine")}


def _history(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "run/history.json").read_text(encoding="utf-8"))


def child(what: str, words: Sequence[str], log: Path, crew: Crew) -> tuple[dict[str, Any], Spent]:
    """Run one command of ours as a child; its JSON, and what it used.

    Raises:
        Stopped: the table is being interrupted.
    """
    env = os.environ | {"SPIKERIG_THREADS": str(crew.threads), "OMP_NUM_THREADS": str(crew.threads)}
    answer = log.with_name(f"{what}.json")
    begin = time.monotonic()
    with answer.open("wb") as stdout, log.open("ab") as stderr:
        with crew.guard:
            if crew.stopping:
                raise Stopped
            process = subprocess.Popen(
                [sys.executable, "-m", "spikerig.dataset", *words],
                stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, env=env, pass_fds=(crew.lock,),
                process_group=0,  # a terminal's Ctrl-C comes to us, and from us once to each of them
            )  # fmt: skip
            crew.pids.add(process.pid)
        try:
            _, status, used = os.wait4(process.pid, 0)
        finally:
            with crew.guard:
                crew.pids.discard(process.pid)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall, cpu = time.monotonic() - begin, used.ru_utime + used.ru_stime
    spent = Spent(what, process.returncode, wall, cpu, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024))
    try:
        document = json.loads(answer.read_text(encoding="utf-8"))
    except ValueError:
        document = {}
    return document if isinstance(document, dict) else {}, spent


def _failure(what: str, document: dict[str, Any], code: int) -> dict[str, Any]:
    """Why a command of a cell failed, in its own words where it had any."""
    told = document.get("error") or {}
    text = str(told.get("what") or f"ended with exit code {code}")
    if code < 0:
        name = signal.Signals(-code).name if -code in {s.value for s in signal.Signals} else f"signal {-code}"
        text = f"killed by {name}" + (", perhaps for want of memory" if -code == signal.SIGKILL else "")
    if told.get("value"):
        text += f" ({told['value']})"
    return {"what": f"{'fit' if what == 'fit' else 'score'}: {text}", "exit_code": code, "next": told.get("next")}


def tell(cell: Cell, record: dict[str, Any], place: tuple[int, int]) -> None:
    """A line for people about a finished cell."""
    head = f"[{place[0]}/{place[1]}] {cell.scene} {cell.row.name} seed {cell.seed}"
    if record["status"] != "done":
        return note(f"{head}: failed: {record['error']['what']}")
    novel = record["own"].get("novel_view") or record["own"].get("blur_view") or {}
    psnr, fit = novel.get("psnr"), record["fit"]
    dB = "no dB" if psnr is None else f"{psnr:.2f} dB"
    return note(f"{head}: {dB}, {fit['steps']} steps, {fit['train_cpu_seconds']:.1f} CPU s of training")
