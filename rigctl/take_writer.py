"""A take being written: its description, views, log and marks, each line safe once it is told."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.marks import Mark, MarkLog
from spikerig.dataset.rawtake import FORMAT, VERSION, RawTake, TakenView, open_take
from spikerig.dataset.segments import Chunk, scan
from spikerig.dataset.terminal import jsonable
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.segment_writer import sync_folder
from spikerig.rigctl.take_plan import TakePlan


class TakeWriter:
    """Writes a take's folder; use `begin` or `resume`.

    Attributes:
        folder, number: of the take.
        first_chunk, first_epoch: for the recorder: those after what is there.
        views: the last word on each viewpoint, by name.
        last_ns: the newest host time that is written anywhere.
    """

    def __init__(self, folder: Path, document: dict[str, Any], lock: IO[bytes], resumed: bool) -> None:
        self.folder, self.number = folder, int(document["number"])
        self._document, self._lock_file = document, lock
        self._turn = threading.Lock()
        self.first_chunk = self.first_epoch = self.last_ns = 0
        self.views: dict[str, TakenView] = {}
        if resumed:
            self._mend()
        self._log = (folder / "log.jsonl").open("ab")
        self._views = (folder / "views.jsonl").open("ab")
        self.marks = MarkLog(folder / "marks.jsonl", resume=resumed)

    @staticmethod
    def begin(folder: Path, plan: TakePlan, devices: Sequence[DeviceFacts]) -> TakeWriter:
        """Make the folder.

        Raises:
            UsageError: it is there and not empty.
            HostError: it cannot be made.
        """
        if folder.exists() and any(folder.iterdir()):
            again = (folder / "take.json").is_file()
            raise UsageError("a take is there already" if again else "the folder is not empty", value=folder,
                             next="go on with --resume" if again else "give another --out")  # fmt: skip
        document = {
            "format": FORMAT, "version": VERSION, "status": "recording", "number": secrets.randbits(63),
            "plan": plan.as_json(), "devices": [asdict(d) for d in devices], "wire": plan.as_json()["profile"],
        }  # fmt: skip
        try:
            (folder / "rgb").mkdir(parents=True, exist_ok=True)
            (folder / "spikes").mkdir(exist_ok=True)
            lock = _locked(folder)
            writer = TakeWriter(folder, jsonable(document), lock, False)
        except OSError as error:
            raise HostError("the take cannot be written here", value=f"{folder}: {error.strerror}") from error
        writer.status("recording")
        return writer

    @staticmethod
    def resume(folder: Path, plan: TakePlan) -> TakeWriter:
        """Go on with a take: what a crash tore is cut off.

        Raises:
            UsageError: no take, another plan, or another recorder is at work in it.
            DataError: its description is damaged.
        """
        take: RawTake = open_take(folder)
        there, wanted = dict(take.plan), jsonable(plan.as_json())
        changed = sorted(k for k in {*there, *wanted} if there.get(k) != wanted.get(k))
        if changed:
            raise UsageError("the take was begun with another plan", value=f"{folder}: {', '.join(changed)} differ",
                             next="give the plan it was begun with, or another --out")  # fmt: skip
        lock = _locked(folder)
        writer = TakeWriter(folder, dict(take.more), lock, True)
        writer.status("recording")
        return writer

    def status(self, status: str) -> None:
        """Rewrite take.json, whole or not at all."""
        self._document["status"] = status
        path = self.folder / "take.json"
        part = path.with_name("take.json.partial")
        with part.open("w", encoding="utf-8") as file:
            json.dump(jsonable(self._document), file, indent=1, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        sync_folder(self.folder)

    def log(self, told: Mapping[str, Any]) -> None:
        """A line in the log; from any thread."""
        with self._turn:
            if not self._log.closed:
                _line(self._log, told)

    def view(self, view: TakenView) -> None:
        """The last word on a viewpoint, on disk when this returns."""
        self.views[view.name] = view
        _line(self._views, asdict(view))
        os.fsync(self._views.fileno())

    def mark(self, marks: Iterable[Mark]) -> None:
        """Marks of clocks; from any thread, on disk with the next view or at the end."""
        with self._turn:
            self.marks.add(marks)

    def sync(self) -> None:
        """Marks and log are on disk when this returns."""
        with self._turn:
            self.marks.sync()
            os.fsync(self._log.fileno())

    def close(self) -> None:
        """Close all; may be called twice."""
        self.marks.close()
        for file in (self._log, self._views, self._lock_file):
            file.close()

    def _mend(self) -> None:
        """Cut what a crash tore, and find where to go on."""
        spikes = self.folder / "spikes"
        for path in spikes.glob("*.next"):
            path.unlink()
        number = epoch = -1
        segments = sorted(spikes.glob("[0-9]*.seg"))
        for path in segments:
            end = 0
            for found in scan(path, take=self.number, verify=path == segments[-1]):
                if isinstance(found, Chunk):
                    number, epoch = max(number, found.head.number), max(epoch, found.head.epoch)
                    self.last_ns = max(self.last_ns, found.head.last_ns)
                    end = found.offset + found.head.stored
            if path == segments[-1]:
                os.truncate(path, min(end, path.stat().st_size))
        self.first_chunk, self.first_epoch = number + 1, epoch + 1
        for name in ("views.jsonl", "log.jsonl"):
            _cut_torn_line(self.folder / name)
        if (self.folder / "views.jsonl").exists():
            for view in open_take(self.folder).views():
                self.views[view.name] = view
                self.last_ns = max(self.last_ns, view.stop_ns)
                self.first_epoch = max([self.first_epoch, *(e + 1 for e, _, _ in view.spikes)])


def _cut_torn_line(path: Path) -> None:
    if path.exists():
        whole = path.read_bytes()
        os.truncate(path, whole.rfind(b"\n") + 1)


def _line(file: IO[bytes], told: Mapping[str, Any]) -> None:
    file.write(json.dumps(jsonable(dict(told)), allow_nan=False).encode() + b"\n")
    file.flush()


def _locked(folder: Path) -> IO[bytes]:
    file = (folder / ".lock").open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise UsageError("another recorder is at work in this take", value=folder) from error
    return file
