"""What a GoPro says of itself: its statuses, asked no faster than it likes, and waiting for them; keep-alive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError
from spikerig.rigctl import gopro_ble as ble
from spikerig.rigctl.gopro_http import Dark, Web
from spikerig.rigctl.gopro_radio import Radio
from spikerig.rigctl.host import Host

ALIVE_NS = 3 * NS
_DARK_NS, _LONGEST_MS = NS // 2, 5000
_WATCHED = (ble.BUSY, ble.ENCODING, ble.SECONDS, ble.BATTERY, ble.MINUTES_LEFT, ble.KB_LEFT, ble.SD, ble.HOT, ble.COLD)
_CARD = {1: "the card is full", 2: "there is no card", 3: "the card must be formatted", 4: "the card is busy"}


@dataclass
class GoProWatch:
    """The camera's statuses over Bluetooth, or over HTTP where there is none.

    Args:
        host: the clock that waiting goes by.
        web, radio: to the camera.
        patience_s: how long `wait` waits.
        last: the statuses last heard, by id; empty while HTTP is dark.
        recording: HTTP is dark and not spoken to.
    """

    host: Host
    web: Web
    radio: Radio | None
    patience_s: float = 30.0
    last: dict[int, Any] = field(default_factory=dict)
    recording: bool = False
    _alive_ns: int | None = None
    _asked_ns: int | None = None
    _pace_ns: int = 0

    def look(self) -> dict[int, Any]:
        """The watched statuses, at the camera's pace; empty while HTTP is dark and there is no Bluetooth."""
        if self._asked_ns is not None:
            self.host.sleep_until(self._asked_ns + self._pace_ns)
        self._asked_ns = self.host.now_ns()
        if self.radio is not None:
            if not self._pace_ns:
                self._pace_ns = _pace(self.radio.statuses([ble.POLL_MS]).get(ble.POLL_MS))
            self.last = self.radio.statuses(_WATCHED)
            return self.last
        try:
            self.last = self.web.state()[0]
            self._pace_ns = _pace(self.last.get(ble.POLL_MS))
        except Dark:
            self.last, self._pace_ns = {}, _DARK_NS
        return self.last

    def keep_alive(self) -> None:
        """Say that somebody is there, every 3 s; over HTTP not while it records."""
        now = self.host.now_ns()
        if self._alive_ns is not None and now - self._alive_ns < ALIVE_NS:
            return
        self._alive_ns = now
        if self.radio is not None:
            self.radio.keep_alive()
        elif not self.recording:
            try:
                self.web.keep_alive()
            except Dark:
                return  # the next look at the state tells

    def wait(self, what: str, good: Callable[[dict[int, Any]], bool]) -> None:
        """Until the statuses are good; keeps the camera awake meanwhile.

        Raises:
            DeviceError: not within the patience; with what the statuses say of the cause.
        """
        until = self.host.now_ns() + round(self.patience_s * NS)
        while True:
            self.keep_alive()
            now = self.look()
            if good(now):
                return
            if self.host.now_ns() >= until:
                raise DeviceError(
                    "the camera does not get there", value=what, expected=f"within {self.patience_s:g} s",
                    cause=self.trouble() or f"busy {now.get(ble.BUSY)}, encoding {now.get(ble.ENCODING)}",
                    next="look at its screen; HindSight must be off",
                )  # fmt: skip

    def until_idle(self, what: str) -> None:
        """Until it is neither busy nor encoding."""
        self.wait(f"idle ({what})", lambda s: bool(s) and not s.get(ble.BUSY) and not s.get(ble.ENCODING))

    def trouble(self) -> str:
        """What of the last statuses explains a failure; empty where nothing does."""
        now, found = self.last, []
        if (card := now.get(ble.SD)) not in (0, None, -1, 255):
            found.append(_CARD.get(card, f"card state {card}"))
        if now.get(ble.KB_LEFT) == 0 or now.get(ble.MINUTES_LEFT) == 0:
            found.append("no space is left on the card")
        found += ["it is too hot"] if now.get(ble.HOT) else []
        found += ["it is too cold"] if now.get(ble.COLD) else []
        battery = now.get(ble.BATTERY)
        found += [f"its battery is at {battery} %"] if isinstance(battery, int) and battery < 5 else []
        return "; ".join(found)


def _pace(told: Any) -> int:
    """Time between questions from status 60, ns; half a second where the camera does not say."""
    return min(told if isinstance(told, int) and told > 0 else 500, _LONGEST_MS) * 1_000_000
