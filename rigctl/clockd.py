"""The clock-sync service: asks the clock box all the time, keeps every mark, and knows each clock's map at any time."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spikerig.calib.clock_watch import ClockWatch
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.dataset.marks import Mark, MarkLog, Probe, Reset
from spikerig.dataset.terminal import jsonable
from spikerig.rigctl.devices import SyncBox
from spikerig.rigctl.host import Host

SCHEMA = "spikerig.rig.clock/1"
SLICE_NS = NS // 10  # a signal is heeded within this
GOLDEN_NS = 618_034  # of a millisecond: bursts must not keep step with the bus's frames
KEPT_NS = 2_000_000  # a box that is back this close to where it should be kept its time
SUSPEND_NS = 1_000_000  # less than this is the two clocks' own noise


@dataclass(frozen=True, slots=True)
class Pace:
    """How often the box is asked.

    Args:
        every_s: between bursts.
        burst: probes in one.
        apart_ms: between the probes of a burst.
        sync_s: between pushes of the marks to the disk: a crash loses no older ones.
        fit_s: between lines of fits.
        patience_s: longest pause between tries to open a box that is gone.
    """

    every_s: float = 1.0
    burst: int = 16
    apart_ms: float = 7.0
    sync_s: float = 5.0
    fit_s: float = 30.0
    patience_s: float = 5.0

    def __post_init__(self) -> None:
        if not (0 < self.every_s < 3600 and 1 <= self.burst <= 1000 and 0 <= self.apart_ms <= 1000 and self.sync_s > 0):
            raise UsageError("a pace of probes is out of range", value=self)


class ClockService:
    """Keeps the clocks.

    Args:
        host: the clock that stamps.
        opener: opens the box; called again after it was lost. Epochs go on counting over all that were opened.
        folder: for marks.jsonl (raw) and fits.jsonl (what was thought at the time); None keeps nothing.
        pace: how often to ask.
        stamp_ns: step of the box's stamps.

    Edges:
        A box that is gone leaves the maps in hold-over; it is looked for until it is back. A suspend of the host is
        told by the system's clocks and becomes a `Reset` of "host".
    """

    def __init__(
        self, host: Host, opener: Callable[[], SyncBox], folder: Path | None = None, pace: Pace | None = None,
        stamp_ns: int = 32_000,
    ) -> None:  # fmt: skip
        self._host, self._opener, self._pace = host, opener, pace or Pace()
        self._watches: dict[str, ClockWatch] = {"box": ClockWatch("box", stamp_ns)}
        self._lock = threading.Lock()  # over the watches and the log: the loop, feeders and askers share them
        self._box: SyncBox | None = None
        self._epochs: dict[int, int] = {}  # ours by the driver's, of the box that is open
        self._next_epoch = 0
        self._begun_ns, self._suspended = host.now_ns(), host.suspended_ns()
        self._host_epoch, self._pause_ns, self._again_ns = 0, NS // 10, 0
        self._synced_ns = self._fitted_ns = self._begun_ns
        self._trouble = "not opened yet"
        self._log: MarkLog | None = None
        self._fits: Path | None = None
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                self._log = MarkLog(folder / "marks.jsonl")
            except OSError as error:
                raise HostError("marks cannot be kept here", value=f"{folder}: {error.strerror}") from error
            self._fits = folder / "fits.jsonl"

    def run(self, stop: Callable[[], bool]) -> None:
        """Turn until `stop()`; then close the box and the files. Call in a worker thread of the host, or the only one.

        Raises:
            HostError: the marks cannot be written (disk full).
        """
        due = self._host.now_ns()
        try:
            while not stop():
                now = self._host.now_ns()
                if now >= due:
                    self.turn(stop)
                    due = max(due + round(self._pace.every_s * NS), self._host.now_ns())
                self._host.sleep_until(min(due, self._host.now_ns() + SLICE_NS))
        except OSError as error:
            raise HostError("the clock service cannot write its marks", value=error.strerror or str(error)) from error
        finally:
            self.close()

    def turn(self, stop: Callable[[], bool] = lambda: False) -> None:
        """One round: look for a suspend, ask a burst, take it in, keep the files."""
        self._suspend()
        probes = self._burst(stop)
        self._suspend()  # one that fell into the burst: its probes are on both sides of it
        with self._lock:
            if probes:
                self._watches["box"].add([p for p in probes if p.sent_ns is not None])
            self._keep()

    def feed(self, marks: Iterable[Probe]) -> None:
        """Stamps of another device (the spike camera's arrivals): kept, and watched as that clock's."""
        groups: dict[str, list[Probe]] = {}
        for mark in marks:
            groups.setdefault(mark.clock, []).append(mark)
        with self._lock:
            for clock, group in groups.items():
                self._watches.setdefault(clock, ClockWatch(clock)).add(group)
                self._store(group)

    def status(self) -> dict[str, Any]:
        """What is known now; from any thread."""
        now = self._host.now_ns()
        with self._lock:
            clocks = [watch.told(now) for watch in self._watches.values()]
            return jsonable({
                "host_ns": now, "running_s": (now - self._begun_ns) / 1e9, "trouble": self._trouble,
                "suspended_s": self._suspended / 1e9, "host_epoch": self._host_epoch, "clocks": clocks,
            })  # fmt: skip

    def box_at(self, host_ns: int) -> tuple[int, float]:
        """The box's time at a host time, and what it is good to (ns).

        Raises:
            DeviceError: the box was never heard.
        """
        with self._lock:
            if self._watches["box"].last_ns is None:
                raise DeviceError("the clock box was never heard", cause=self._trouble, next="spikerig rig find")
            return self._watches["box"].at(host_ns)

    def close(self) -> None:
        """Close the box and the files; may be called twice."""
        with self._lock:
            if self._log is not None:
                self._write_fits()
                self._log.close()
                self._log = None
        self._drop("stopped")

    # ---- one turn's parts

    def _burst(self, stop: Callable[[], bool]) -> list[Probe]:
        box = self._box or self._open()
        if box is None:
            return []
        found: list[Probe] = []
        missed = 0
        try:
            for k in range(self._pace.burst):
                if stop():
                    break
                try:
                    found.append(self._epoch(box.probe()))
                    missed = 0
                except DeviceError:
                    missed += 1
                    if missed >= 3:
                        raise  # not a damaged answer: the box is gone
                pause = round(self._pace.apart_ms * 1e6) + (k * GOLDEN_NS) % 1_000_000
                self._host.sleep_until(self._host.now_ns() + pause)
            found += [self._epoch(p) for p in box.heard()]
        except DeviceError as error:
            self._drop(str(error.what))
        with self._lock:
            self._told_epochs(found)
            self._store(found)
        return found

    def _epoch(self, probe: Probe) -> Probe:
        """The probe with its epoch counted over all boxes opened.

        A driver begins an epoch where it cannot know better: after an unplug, and when the host was suspended. A box
        that is still where it should be goes on in its old one.
        """
        self._suspend()
        if probe.epoch not in self._epochs:
            watch = self._watches["box"]
            epoch = self._next_epoch
            if watch.last_ns is not None:
                told, good = watch.at(probe.received_ns)
                if abs(probe.device_ns - told) <= max(KEPT_NS, 3 * good):
                    epoch = watch.epoch
            self._epochs[probe.epoch] = epoch
            self._next_epoch = max(self._next_epoch, epoch + 1)
        return replace(probe, epoch=self._epochs[probe.epoch])

    def _told_epochs(self, probes: list[Probe]) -> None:
        """A `Reset` for every epoch of the box that is new, before its marks."""
        known = self._watches["box"].epoch
        for probe in probes:
            if known >= 0 and probe.epoch > known:
                self._store([Reset("box", probe.epoch, probe.received_ns, "its clock began anew")])
            known = max(known, probe.epoch)

    def _open(self) -> SyncBox | None:
        if self._host.now_ns() < self._again_ns:
            return None
        try:
            self._box = self._opener()
        except (DeviceError, HostError) as error:
            self._trouble = error.what
            self._again_ns = self._host.now_ns() + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, round(self._pace.patience_s * NS))
            return None
        self._epochs, self._pause_ns, self._trouble = {}, NS // 10, ""
        return self._box

    def _drop(self, why: str) -> None:
        box, self._box, self._trouble = self._box, None, why
        if box is not None:
            box.close()

    def _suspend(self) -> None:
        slept = self._host.suspended_ns()
        if slept - self._suspended < SUSPEND_NS:
            return
        by, self._suspended = slept - self._suspended, slept
        self._host_epoch += 1
        now = self._host.now_ns()
        with self._lock:
            self._store([Reset("host", self._host_epoch, now, f"suspended for {by / 1e9:.3f} s")])
            for watch in self._watches.values():
                watch.jumped(by)

    def _store(self, marks: Iterable[Mark]) -> None:
        if self._log is not None:
            self._log.add(marks)

    def _keep(self) -> None:
        now = self._host.now_ns()
        if self._log is None:
            return
        if now - self._fitted_ns >= self._pace.fit_s * NS:
            self._fitted_ns = now
            self._write_fits()
        if now - self._synced_ns >= self._pace.sync_s * NS:
            self._synced_ns = now
            self._log.sync()

    def _write_fits(self) -> None:
        if self._fits is None:
            return
        now = self._host.now_ns()
        line: Mapping[str, Any] = {"host_ns": now, "clocks": [w.told(now) for w in self._watches.values()]}
        with self._fits.open("a", encoding="utf-8") as file:
            file.write(json.dumps(jsonable(line), allow_nan=False) + "\n")
