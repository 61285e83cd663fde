"""The GoPro HERO9 as the rig's RGB camera: settled, started and stopped over Bluetooth, its files fetched over WiFi.

Without Bluetooth (`radio=None`) a person presses the button: the start is seen by HTTP going dark, the stop by its
coming back. Either way the true times of frames come from the clip and the LED panel, never from the command.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError, RigError, UsageError
from spikerig.rigctl import gopro_ble as ble
from spikerig.rigctl.devices import Clip, DeviceFacts
from spikerig.rigctl.gopro_http import ADDRESS, Dark, Media, Web, Wifi
from spikerig.rigctl.gopro_radio import BleLink, Radio
from spikerig.rigctl.gopro_settle import settle
from spikerig.rigctl.gopro_watch import GoProWatch
from spikerig.rigctl.host import Host

_WAKING = 5  # s that a camera may take to wake


class GoProSource:
    """A HERO9 behind `FrameSource`.

    Args:
        host: the clock that waiting goes by.
        web: HTTP to it.
        radio: Bluetooth to it; None: a person presses the button.
        say: tells that person what to do.
        patience_s: how long the camera, or the person, may take for a start or a stop.
        facts: as `identify` told them; asked for where not given.

    Raises:
        DeviceError: it does not answer.
    """

    def __init__(
        self, host: Host, web: Web, radio: Radio | None = None, *, say: Callable[[str], None] = lambda text: None,
        patience_s: float = 30.0, facts: DeviceFacts | None = None,
    ) -> None:  # fmt: skip
        self.host, self.web, self.radio, self.say = host, web, radio, say
        self.facts = facts or identify(host, web, radio)
        self._watch = GoProWatch(host, web, radio, patience_s)
        self._started: tuple[int, int] | None = None
        self._before: set[str] = set()
        self._turbo = False

    def settle(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Bring the camera to the rig's settings, changed by `settings`; see `gopro_settle.settle`."""
        return settle(self._watch, settings)

    def poll(self) -> dict[str, Any]:
        """Keep the connection alive and tell the state; never asks faster than the camera wants to be asked.

        Returns:
            busy, encoding, seconds, battery_percent, minutes_left, card_kb, card_state, hot, cold; `dark`: nothing is
            known (no Bluetooth, and it records: the others are None); `trouble`: what is wrong, in words;
            `ended_early`: a recording that was started runs no more.
        """
        self._watch.keep_alive()
        told = self._watch.look()
        ended = self._started is not None and bool(told) and not told.get(ble.ENCODING)
        return ble.known(told) | {"dark": not told, "trouble": self._watch.trouble(), "ended_early": ended}

    def start(self) -> None:
        """Start a recording and return when the camera says that it encodes ("accepted" is not enough).

        Raises:
            DeviceError: it refuses, or accepts and does not encode; with what its statuses say of the cause.
        """
        if self._started is not None:
            raise UsageError("a recording runs already", next="stop it first")
        self._watch.until_idle("start")
        self._before = {m.path for m in self._media()}
        if self.radio is None:
            self.say("Press the camera's shutter button: start recording.")
            self._started = self._edge("start", lambda s: not s or bool(s.get(ble.ENCODING)))
            self._watch.recording = True
            return
        before = self.host.now_ns()
        self._shutter(1)
        self._watch.wait("encoding after the start", lambda s: bool(s.get(ble.ENCODING)))
        self._started = (before, self.host.now_ns())

    def stop(self) -> Clip:
        """Stop and return when the camera is idle again; the clip just made.

        Raises:
            DeviceError: it does not become idle, or no new clip is on the card.
        """
        if self._started is None:
            raise UsageError("no recording runs", next="start one first")
        begun = self._started
        if self.radio is None:
            self.say("Press the camera's shutter button: stop recording.")
            ended = self._edge("stop", lambda s: bool(s) and not s.get(ble.ENCODING))
            self._watch.recording = False
        else:
            before = self.host.now_ns()
            self._shutter(0)
            self._watch.wait("the end of encoding", lambda s: not s.get(ble.ENCODING))
            ended = (before, self.host.now_ns())
        self._started = None
        self._watch.until_idle("stop")
        made = [m for m in self._media() if m.path not in self._before]
        if not made:
            raise DeviceError(
                "no new clip is on the card", cause=self._watch.trouble() or "it recorded elsewhere, or not"
            )
        first = made[0]
        whole = [m for m in made if m.name[4:8] == first.name[4:8]]
        return Clip(first.path, sum(m.size_bytes for m in whole), begun, ended)

    def _shutter(self, on: int) -> None:
        """Press the shutter; where the answer is lost the state decides, it is not pressed twice."""
        radio = self.radio
        if radio is None:
            raise UsageError("there is no Bluetooth to press the shutter with")
        try:
            radio.do(ble.SHUTTER, bytes([on]), again=False)
        except DeviceError as error:
            self._watch.look()
            if bool(self._watch.last.get(ble.ENCODING)) != bool(on) and not self._watch.last.get(ble.BUSY):
                raise DeviceError(
                    "the camera does not " + ("start" if on else "stop"), value=error.value,
                    cause=self._watch.trouble() or error.cause or error.what, next=error.next,
                ) from error  # fmt: skip

    def _edge(self, what: str, good: Callable[[dict[int, Any]], bool]) -> tuple[int, int]:
        """Host times between which HTTP went dark, or came back."""
        last = self.host.now_ns()
        until = last + round(max(self._watch.patience_s, 60.0) * NS)
        while True:
            before = self.host.now_ns()
            if good(self._watch.look()):
                return last, self.host.now_ns()
            last = before
            if before >= until:
                raise DeviceError(f"nobody pressed {what}", expected="within a minute", next="press it and try again")

    def _media(self) -> list[Media]:
        """The media list; the camera's server comes back some moments after encoding."""
        until = self.host.now_ns() + round(self._watch.patience_s * NS)
        while True:
            try:
                return self.web.media()
            except Dark:
                if self.host.now_ns() >= until:
                    raise
                self._watch.keep_alive()
                self.host.sleep_until(self.host.now_ns() + NS // 2)

    def fetch(self, clip: Clip, folder: Path) -> list[Path]:
        """Bring a clip's chapters; a broken download goes on, also in a later program.

        Raises:
            DeviceError: the card does not have it, or not in that size any more.
        """
        self._watch.until_idle("download")
        name = clip.name.rpartition("/")[2]
        directory = clip.name.rpartition("/")[0]
        parts = [
            m for m in self._media() if m.folder == directory and m.name[:2] == name[:2] and m.name[4:] == name[4:]
        ]
        if sum(m.size_bytes for m in parts) != clip.size_bytes:
            raise DeviceError(
                "the clip on the card is not the one that was recorded", value=clip.name,
                expected=f"{clip.size_bytes} bytes in all", cause=f"it holds {len(parts)} such files: formatted?",
            )  # fmt: skip
        self.web.turbo(True)
        self._turbo = True
        try:
            return [self.web.download(m, folder / m.name) for m in parts]
        finally:
            self._calm()

    def _calm(self) -> None:
        if self._turbo:
            self._turbo = False
            try:
                self.web.turbo(False)
            except DeviceError:
                return  # it ends by itself after some minutes

    def sleep(self) -> None:
        """Put the camera to sleep; connecting over Bluetooth wakes it."""
        if self.radio is None:
            self.web.sleep()
            return
        self.radio.do(ble.SLEEP, again=False)
        self.radio.close()

    def wake(self) -> None:
        """Wake it, and wait until it is ready."""
        if self.radio is None:
            raise UsageError("only Bluetooth wakes the camera", next="press its mode button")
        self.radio.connect()
        self._watch.until_idle("wake")

    def close(self) -> None:
        """Stop a recording that runs, and give the camera back; may be called twice, and after errors."""
        if self._started is not None and self.radio is not None:
            self._started = None
            try:
                self._shutter(0)
            except DeviceError:
                pass  # it is gone; it stops when its card or battery does
        self._calm()
        if self.radio is not None:
            self.radio.close()


def open_gopro(
    host: Host, *, link: str = "ble", name: str = "", address: str = ADDRESS,
    say: Callable[[str], None] = lambda text: None,
) -> GoProSource:  # fmt: skip
    """A real camera.

    Args:
        host: the clock that waiting goes by.
        link: "ble": controlled over Bluetooth; "hand": a person presses the button.
        name: part of its Bluetooth name; empty: the first one heard.
        address: of its server.
        say: tells the person what to do.

    Raises:
        UsageError: no such link.
        DeviceError: it does not answer.
        HostError: bleak is not installed.
    """
    if link not in ("ble", "hand"):
        raise UsageError("no such link to a GoPro", value=link, expected="ble or hand")
    radio = Radio(lambda: _bleak_link(name), host) if link == "ble" else None
    return GoProSource(host, Web(Wifi(address), host), radio, say=say)


def find(host: Host, web: Web | None = None, radio: Radio | None = None) -> tuple[list[DeviceFacts], list[str]]:
    """Look for a camera: over Bluetooth, and where that brings none over WiFi.

    Args:
        host: the clock that waiting goes by.
        web, radio: to it; None: this machine's, one try.

    Returns:
        The camera found, and a line for each way that did not lead to it, with the reason.
    """
    web = web or Web(Wifi(), host)
    radio = radio or Radio(lambda: _bleak_link(""), host, tries=1)
    reasons: list[str] = []
    for way, over in (("Bluetooth", radio), ("WiFi", None)):
        try:
            return [identify(host, web, over)], reasons
        except RigError as error:
            reasons.append(f"GoPro over {way}: {error.what}" + (f" ({error.cause})" if error.cause else ""))
        finally:
            radio.close()
    return [], reasons


def identify(host: Host, web: Web, radio: Radio | None) -> DeviceFacts:
    """The camera that answers: over Bluetooth with model, serial and firmware; over HTTP only that it is there.

    Raises:
        DeviceError: it does not answer.
    """
    address = getattr(web.opener, "address", "")
    if radio is None:
        more = {"link": "hand", "http_version": web.version()}
        ssid = web.state()[0].get(ble.AP_SSID)
        return DeviceFacts("rgb", "GoPro", str(ssid or ""), "", address, more)
    told = ble.hardware(_patiently(host, radio))
    radio.do(ble.AP, b"\x01")  # its network, for the files
    more = {"link": "ble", "ssid": told.get("ssid", "")}
    return DeviceFacts("rgb", told.get("model", ""), told.get("serial", ""), told.get("firmware", ""), address, more)


def _bleak_link(name: str) -> BleLink:
    from spikerig.rigctl.gopro_bleak import BleakLink

    return BleakLink(name)


def _patiently(host: Host, radio: Radio) -> bytes:
    """Hardware info; a camera that just woke says for some seconds that it is not ready."""
    for n in range(_WAKING):
        try:
            return radio.do(ble.HARDWARE)
        except DeviceError:
            if n == _WAKING - 1:
                raise
            host.sleep_until(host.now_ns() + NS)
    raise DeviceError("the camera does not wake")
