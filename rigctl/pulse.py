"""The take's pulse: a thread that asks the clock box, keeps the RGB camera awake and notes the stream's progress."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError
from spikerig.dataset.marks import Mark, Probe, Reset
from spikerig.rigctl.devices import FrameSource, SyncBox
from spikerig.rigctl.host import Host
from spikerig.rigctl.recorder import Recorder

STEP_NS = NS // 20
POLL_NS = NS
KEPT = 1000  # probes that the live residual looks at: a minute's
GOLDEN_NS = 618_034  # of a millisecond: probes must not keep step with the bus's frames


class Pulse:
    """Runs beside the record loop until closed.

    Args:
        host: the clock.
        box: asked every `probe_ns`; None without.
        rgb: polled every second while `rgb_free` is not held; None without.
        recorder: whose stream is marked.
        mark: takes marks; event: takes what went wrong.

    Attributes:
        rgb_state: what the RGB camera last told.
        rgb_free: held by whoever talks to the RGB camera.
    """

    def __init__(
        self,
        host: Host,
        box: SyncBox | None,
        rgb: FrameSource | None,
        recorder: Recorder,
        probe_ns: int,
        mark: Callable[[list[Mark]], None],
        event: Callable[[Mapping[str, Any]], None],
    ) -> None:
        self.host, self.box, self.rgb, self.recorder = host, box, rgb, recorder
        self.probe_ns, self._mark, self._event = probe_ns, mark, event
        self.rgb_state: Mapping[str, Any] = {}
        self.rgb_free = threading.Lock()
        self._probes: deque[Probe] = deque(maxlen=KEPT)
        self._epoch: dict[str, int] = {}
        self._sick: dict[str, str] = {}
        self._stop = False
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """End; may be called twice."""
        self._stop = True
        if self._thread.is_alive():
            with self.host.aside():
                self._thread.join()

    def hold_rgb(self) -> None:
        """Wait until nobody talks to the RGB camera; `rgb_free.release()` gives it back."""
        while not self.rgb_free.acquire(blocking=False):
            self.host.sleep_until(self.host.now_ns() + STEP_NS // 10)

    def residual_us(self) -> float | None:
        """Rms distance of the quickest probes from a line, microseconds; None before four of an epoch.

        It is not the accuracy: half of the path's asymmetry hides in it.
        """
        probes = [p for p in list(self._probes) if p.sent_ns is not None and p.epoch == self._probes[-1].epoch]
        if len(probes) < 4:
            return None
        trips = np.array([p.received_ns - (p.sent_ns or 0) for p in probes])
        quick = [probes[k] for k in np.argsort(trips)[: max(4, len(probes) // 4)]]
        mid = np.array([(p.received_ns + (p.sent_ns or 0)) / 2 - quick[0].received_ns for p in quick])
        told = np.array([float(p.device_ns - quick[0].device_ns) for p in quick])
        rest = told - np.polyval(np.polyfit(mid, told - mid, 1), mid) - mid
        return float(np.sqrt(np.mean(rest**2))) / 1e3

    def _run(self) -> None:
        with self.host.worker("pulse"):
            self._ready.set()
            next_probe = next_poll = self.host.now_ns()
            asked = 0
            while not self._stop:
                now = self.host.now_ns()
                self._mark(list(self._stream_marks()))
                if self.box is not None and now >= next_probe:
                    self._try("clock box", self._ask_box)
                    asked += 1
                    next_probe = now + self.probe_ns + asked * GOLDEN_NS % 1_000_000
                if self.rgb is not None and now >= next_poll and self.rgb_free.acquire(blocking=False):
                    try:
                        self._try("rgb camera", self._poll)
                    finally:
                        self.rgb_free.release()
                    next_poll = now + POLL_NS
                due = now + STEP_NS if self.box is None else min(now + STEP_NS, next_probe)
                self.host.sleep_until(max(due, self.host.now_ns() + 1))
            self._mark(list(self._stream_marks()))

    def _try(self, what: str, step: Callable[[], None]) -> None:
        """A device that fails is told once, and again when it is well."""
        try:
            step()
        except DeviceError as error:
            if self._sick.get(what) != error.what:
                self._tell("device", f"{what}: {error.what}: {error.value}")
            self._sick[what] = error.what
            reopen = getattr(self.box, "reopen", None)
            if what == "clock box" and reopen is not None and "no answer" not in error.what:
                try:
                    reopen(0)
                except DeviceError:
                    pass  # told above; the next round tries again
        else:
            if self._sick.pop(what, None):
                self._tell("device", f"{what}: it is back")

    def _ask_box(self) -> None:
        if self.box is None:
            return
        probe = self.box.probe()
        self._probes.append(probe)
        self._mark([*self._reset("box", probe.epoch), probe, *self.box.heard()])

    def _poll(self) -> None:
        if self.rgb is not None:
            self.rgb_state = dict(self.rgb.poll())

    def _stream_marks(self) -> list[Mark]:
        marks: list[Mark] = []
        for epoch, byte_end, after_ns in self.recorder.progress():
            marks += self._reset("spike", epoch)
            marks.append(Probe("spike", epoch, None, self.recorder.device_ns(byte_end), after_ns))
        return marks

    def _reset(self, clock: str, epoch: int) -> list[Mark]:
        before = self._epoch.get(clock)
        self._epoch[clock] = epoch
        return [] if before in (None, epoch) else [Reset(clock, epoch, self.host.now_ns(), "a new epoch")]

    def _tell(self, kind: str, words: str) -> None:
        self._event({"host_ns": self.host.now_ns(), "kind": kind, "words": words})
