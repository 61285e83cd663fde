"""An emulated HERO9: its states, settings, card and clock. gopro_air.py and gopro_web.py speak to it.

A state machine without threads: whoever touches it brings it up to the time of the host first.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset.clocktime import NS
from spikerig.rigctl.host import Host
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate import gopro_menu as menu
from spikerig.rigctl.sim.emulate.gopro_mp4 import Pictures, Recording, write_clip
from spikerig.rigctl.sim.emulate.oscillator import Oscillator

MS = 1_000_000
POLL_MS = 50  # status 60
_FULL, _FLAT, _HOT = 33, 70, 6  # the statuses that faults change


@dataclass(frozen=True)
class Nature:
    """How this camera behaves when nothing is wrong.

    Args:
        start_ms: command to first frame, mean; each preset differs, and each start by `start_sd_ms`.
        busy_ms, stop_ms, back_ms: how long it is busy after a command, after a stop, and until HTTP is back after that.
        srot_ms: read-out of the sensor.
        bytes_s: what it writes to the card, for the space left.
        chapter_bytes: a new file begins after so many; 4 GB on a real one.
        web_bytes_s: of a download; ten times as fast with turbo.
    """

    model: str = "HERO9 Black"
    firmware: str = "HD9.01.01.72.00"
    serial: str = "C3441325000001"
    ssid: str = "GP25000001"
    start_ms: float = 132.0
    start_sd_ms: float = 15.0
    busy_ms: tuple[float, float] = (20.0, 120.0)
    stop_ms: tuple[float, float] = (400.0, 1500.0)
    back_ms: tuple[float, float] = (100.0, 700.0)
    srot_ms: float = 7.0
    bytes_s: float = 12.5e6
    chapter_bytes: int = 4_000_000_000
    web_bytes_s: float = 4e6


@dataclass(frozen=True)
class Faults:
    """What goes wrong, as data. Times are seconds since the camera was made.

    Args:
        dials_fail: so many first attempts to connect.
        link_lost_s: the Bluetooth link breaks at these times.
        broken_replies: which of the replies of several packets (0 is the first) arrive damaged, and `broken_how`:
            "lost" (a continuation is missing), "repeated" (one comes twice) or "cut" (the last is missing).
        not_ready: so many first questions for hardware info are refused.
        answer_lost: the reply to the n-th shutter command does not come, though it is done.
        never_encodes: the shutter command is accepted, and nothing follows.
        no_card, card_full_s, battery_flat_s, too_hot_s: since when; a recording then ends by itself.
        downloads_break: so many bytes come of each of the first downloads.
        ignores_range: the server sends files from the beginning, whatever was asked.
        dark_hangs: dark HTTP lets connections wait, instead of refusing them.
        protune_refused, protune_ignored: undocumented settings get a no, or a yes without effect.
        forgets: settings that fall back to the factory's when recording starts.
        skipped: frames (of each clip) before which one was lost.
    """

    dials_fail: int = 0
    link_lost_s: tuple[float, ...] = ()
    broken_replies: tuple[int, ...] = ()
    broken_how: str = "lost"
    not_ready: int = 0
    answer_lost: tuple[int, ...] = ()
    never_encodes: bool = False
    no_card: bool = False
    card_full_s: float | None = None
    battery_flat_s: float | None = None
    too_hot_s: float | None = None
    downloads_break: tuple[int, ...] = ()
    ignores_range: bool = False
    dark_hangs: bool = False
    protune_refused: bool = False
    protune_ignored: bool = False
    forgets: tuple[int, ...] = ()
    skipped: tuple[int, ...] = ()


@dataclass
class GoProCamera:
    """The camera.

    Args:
        host: whose time is true time.
        card: folder that stands for the memory card.
        pictures: what it sees.
        clock: its crystal.
        nature, faults, seed: its character.
        truth: what really happened, a dict an event.
    """

    host: Host
    card: Path
    pictures: Pictures
    clock: Oscillator = field(default_factory=Oscillator)
    nature: Nature = field(default_factory=Nature)
    faults: Faults = field(default_factory=Faults)
    seed: int = 0
    truth: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = stream(self.seed, "gopro")
        self.made_ns = self.host.now_ns()
        self.lock = threading.RLock()
        self.settings = dict(menu.FACTORY)
        self.asleep = self.turbo = self.busy = self.encoding = False
        self.changed: list[Callable[[set[int]], None]] = []  # told which statuses changed
        self.first_ns = self.last_ns = 0
        self.dark_until_ns = -1
        self.written = 0.0
        self.clips = max((int(p.name[4:8]) for p in self.card.glob("100GOPRO/G*.MP4")), default=0)
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0
        self._event_ns: int | None = None
        self._unrendered: list[tuple[int, Recording]] = []
        for status, at_s in ((_FULL, self.faults.card_full_s), (_FLAT, self.faults.battery_flat_s),
                             (_HOT, self.faults.too_hot_s)):  # fmt: skip
            if at_s is not None:
                self.at(self.since(at_s), lambda s=status: self._fail(s))

    # ---- time -------------------------------------------------------------------------------------------------------

    def at(self, when_ns: int, what: Callable[[], None]) -> None:
        """Have something happen."""
        self._count += 1
        heapq.heappush(self._due, (int(when_ns), self._count, what))

    def since(self, seconds: float) -> int:
        """Host time so long after the camera was made."""
        return self.made_ns + round(seconds * NS)

    def advance(self) -> None:
        """Let happen what is due by now."""
        with self.lock:
            while self._due and self._due[0][0] <= self.host.now_ns():
                self._event_ns, _, what = heapq.heappop(self._due)
                what()
            self._event_ns = None

    @property
    def now_ns(self) -> int:
        """The time of what happens at the moment, which may be looked at later; else the host's."""
        return self.host.now_ns() if self._event_ns is None else self._event_ns

    @property
    def next_ns(self) -> int | None:
        """When something happens next by itself."""
        return self._due[0][0] if self._due else None

    def _ms(self, span: tuple[float, float]) -> int:
        return round(MS * self.rng.uniform(*span))

    def _now_and(self, delay_ns: int) -> int:
        return self.now_ns + delay_ns

    # ---- what it says of itself -------------------------------------------------------------------------------------

    @property
    def dark(self) -> bool:
        """Whether HTTP is silent: while it encodes (HindSight does too), some moments after, and asleep."""
        return self.asleep or self.encoding or self.hindsight or self.now_ns < self.dark_until_ns

    @property
    def hindsight(self) -> bool:
        """HindSight is on: it encodes all the time and refuses settings."""
        return self.settings[menu.HINDSIGHT] != 4

    @property
    def full(self) -> bool:
        """The card has no space."""
        at = self.faults.card_full_s
        return at is not None and self.now_ns >= self.since(at)

    def statuses(self) -> dict[int, int | str]:
        """Documented statuses by id."""
        now, faults = self.now_ns, self.faults
        hot = faults.too_hot_s is not None and now >= self.since(faults.too_hot_s)
        flat = faults.battery_flat_s is not None and now >= self.since(faults.battery_flat_s)
        seconds = (now - self.first_ns) // NS if self.encoding and now > self.first_ns else 0
        left = 0 if self.full or faults.no_card else max(64e9 - self.written, 0)
        return {
            1: 1, 2: 4 - 4 * flat, 6: int(hot), 8: int(self.busy), 9: 0, 10: int(self.encoding or self.hindsight),
            13: seconds, 17: 1, 30: self.nature.ssid, 33: 2 if faults.no_card else 1 if self.full else 0,
            35: int(left / self.nature.bytes_s / 60), 38: 0, 39: self.clips, 54: int(left / 1024), 60: POLL_MS, 68: 0,
            70: 3 if flat else 87, 82: int(not self.asleep), 85: 0, 88: 0, 89: 12, 96: 0, 97: 0, 113: int(self.turbo),
        }  # fmt: skip

    def _tell(self, *ids: int) -> None:
        for listener in list(self.changed):
            listener(set(ids))

    # ---- what it does -----------------------------------------------------------------------------------------------

    def set(self, number: int, option: int) -> menu.No | None:
        """A setting; None when taken."""
        if self.busy or self.encoding or (self.hindsight and number != menu.HINDSIGHT):
            return menu.No(1)
        if number in menu.UNDOCUMENTED and self.faults.protune_refused:
            return menu.No(2)
        scratch = dict(self.settings)
        said = menu.take(scratch, number, option)
        if said is None and not (number in menu.UNDOCUMENTED and self.faults.protune_ignored):
            self.settings = scratch
            self.busy = True
            self._tell(8)
            self.at(self._now_and(self._ms(self.nature.busy_ms)), self._free)
        return said

    def shutter(self, on: bool) -> bool:
        """Press it; whether it is accepted."""
        if on:
            if self.busy or self.encoding or self.hindsight or self.full or self.faults.no_card:
                return False
            if not self.faults.never_encodes:
                self._begin()
            return True
        if not self.encoding:
            return False
        self._end("shutter", self._now_and(self._ms((20.0, 120.0))))
        return True

    def _begin(self) -> None:
        for number in self.faults.forgets:
            self.settings[number] = menu.FACTORY[number]
        self.busy = True
        fps = menu.rate(self.settings)
        preset = 25.0 * np.sin(float(fps) + self.settings[menu.RESOLUTION])  # each preset has its own lateness
        wait = max(self.nature.start_ms + preset + self.nature.start_sd_ms * self.rng.standard_normal(), 20.0)
        frame_ns = NS / float(fps)
        phase = self.rng.uniform(0, frame_ns)  # the sensor runs free: no command moves it
        self.first_ns = round((np.floor(self._now_and(round(MS * wait)) / frame_ns) + 1) * frame_ns + phase)
        self._fps = fps
        said = self.first_ns + round(MS * self.rng.uniform(-30, 60))
        self.at(max(said, self._now_and(1)), self._encode)
        self._tell(8)

    def _encode(self) -> None:
        self.encoding = True
        self.dark_until_ns = 1 << 62
        self._tell(10)
        self.at(self._now_and(self._ms(self.nature.busy_ms)), self._free)
        self.at(self.first_ns + NS, self._tick)

    def _tick(self) -> None:
        if self.encoding:
            self._tell(13)
            self.at(self._now_and(NS), self._tick)

    def _free(self) -> None:
        if self.busy:
            self.busy = False
            self._tell(8)

    def _fail(self, status: int) -> None:
        if self.encoding:
            self._end({_FULL: "card full", _FLAT: "battery flat", _HOT: "too hot"}[status], self._now_and(0))
        self._tell(status)
        if status == _FLAT:
            self.at(self._now_and(5 * NS), self._sleep)

    def _end(self, why: str, last_ns: int) -> None:
        """End the recording at a true time."""
        self.busy = True
        self._tell(8)
        self.at(last_ns, lambda: self._close_clip(why, last_ns))

    def _close_clip(self, why: str, last_ns: int) -> None:
        if not self.encoding:
            return
        self.encoding = False
        begun, ended = (int(v) for v in self.clock.device_from_true([self.first_ns, last_ns]))
        frames = max(int((ended - begun) * float(self._fps) / NS), 1)
        self.clips += 1
        self.written += (last_ns - self.first_ns) / NS * self.nature.bytes_s
        take = Recording(
            self.clock, self.first_ns, frames, self._fps, self._exposures(frames), self.nature.srot_ms,
            lead_us=round(self.rng.uniform(20_000, 120_000)), skipped=self.faults.skipped,
            header=menu.header(self.settings) | {
                "MINF": self.nature.model, "FMWR": self.nature.firmware, "CASN": self.nature.serial,
            }, seed=self.seed + self.clips, hevc=self.settings[menu.CODEC] == 1,
        )  # fmt: skip
        self._unrendered.append((self.clips, take))
        self.truth.append({
            "device": "rgb", "event": "clip", "number": self.clips, "why": why, "frames": frames,
            "first_true_ns": self.first_ns, "media_ns": take.media_ns[:frames].tolist(),
            "true_ns": take.true_starts_ns[:frames].tolist(), "exposure_s": take.exposures_s.tolist(),
            "srot_ms": self.nature.srot_ms,
        })  # fmt: skip
        self._tell(10)
        done = self._now_and(self._ms(self.nature.stop_ms))
        self.dark_until_ns = done + self._ms(self.nature.back_ms)
        self.at(done, self._free)

    def _exposures(self, frames: int) -> np.ndarray:
        locked = menu.exposure_s(self.settings)
        if locked is not None:
            return np.full(frames, locked)
        most = 0.9 / float(self._fps)  # automatic: drifts with the light
        return np.clip(1 / 900 + 4e-4 * np.sin(np.arange(frames) / 40.0), 1e-4, most)

    def sleep(self) -> None:
        """Go to sleep, unless it records."""
        if not self.encoding:
            self._sleep()

    def _sleep(self) -> None:
        self.asleep = True
        self.turbo = False
        self._tell(82)

    def wake(self) -> None:
        """Awake by a Bluetooth connection; not with an empty battery."""
        self.asleep = False

    def files(self) -> list[Path]:
        """The clips on the card, rendered now if they were not looked at before."""
        with self.lock:
            folder = self.card / "100GOPRO"
            folder.mkdir(parents=True, exist_ok=True)
            while self._unrendered:
                number, take = self._unrendered.pop(0)
                write_clip(folder, number, take, self.pictures, self.nature.chapter_bytes)
            return sorted(folder.glob("G*.MP4"))
