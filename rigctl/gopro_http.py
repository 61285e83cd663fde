"""GoPro over HTTP, which a HERO9 speaks only while it is idle: state, settings, media list, downloads that go on.

The opener is an argument: `Wifi` makes real connections, an emulated camera makes its own.
"""

from __future__ import annotations

import http.client
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.dataset.gopro_file import CHAPTER
from spikerig.rigctl.gopro_settings import BY_NUMBER, option_name
from spikerig.rigctl.host import Host

ADDRESS = "10.5.5.9:8080"
FOLDER = re.compile(r"\d{3}GOPRO")
_MOST_JSON = 16 << 20
_CHUNK = 1 << 20
_REFUSED = {  # the camera's "error" in the body of a 403
    1: "the setting is not available as the camera is set now",
    2: "the camera has no such setting",
    3: "the option is not available with the settings before it",
    4: "the setting has no such option",
}


class Dark(DeviceError):
    """The camera does not answer HTTP: it encodes, sleeps, or the network is down."""


Opener = Callable[[float], http.client.HTTPConnection]
"""timeout in seconds -> a connection to the camera that is not yet used."""


@dataclass(frozen=True, slots=True)
class Wifi:
    """Makes real connections to a camera's address."""

    address: str = ADDRESS

    def __call__(self, timeout_s: float) -> http.client.HTTPConnection:
        """A connection, made when it is first used."""
        return http.client.HTTPConnection(self.address, timeout=timeout_s)


@dataclass(frozen=True, slots=True)
class Media:
    """A file on the card: "100GOPRO", "GX010042.MP4", its bytes and when it was made (seconds, the camera's clock)."""

    folder: str
    name: str
    size_bytes: int
    made_s: int

    @property
    def path(self) -> str:
        """Folder and name."""
        return f"{self.folder}/{self.name}"


@dataclass
class Web:
    """Requests to one camera, one connection each.

    Args:
        opener: makes connections.
        host: the clock that waiting goes by.
        timeout_s: of a request that is not a download.
    """

    opener: Opener
    host: Host
    timeout_s: float = 3.0

    def get(self, path: str, query: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """A GET whose reply is JSON.

        Raises:
            Dark: no connection, or no answer in time.
            DeviceError: an answer other than 200, or no JSON.
        """
        where = path + ("?" + urlencode(query) if query else "")
        connection = self.opener(self.timeout_s)
        try:
            connection.request("GET", where)
            reply = connection.getresponse()
            body = reply.read(_MOST_JSON + 1)
        except (OSError, http.client.HTTPException) as error:
            raise _dark(where, error) from error
        finally:
            connection.close()
        try:
            told = json.loads(body) if body.strip() and len(body) <= _MOST_JSON else {}
        except (ValueError, RecursionError):
            told = None
        if reply.status != 200:
            raise refusal(where, reply.status, told)
        if not isinstance(told, dict):
            raise DeviceError("the camera's answer is no JSON object", value=f"{where}: {body[:80]!r}")
        return told

    def version(self) -> str:
        """Of the HTTP interface; a HERO9 says 2.0."""
        return str(self.get("/gopro/version").get("version", ""))

    def state(self) -> tuple[dict[int, Any], dict[int, Any]]:
        """(statuses, settings) by id."""
        told = self.get("/gopro/camera/state")
        try:
            return tuple({int(k): v for k, v in told[part].items()} for part in ("status", "settings"))  # type: ignore[return-value]
        except (KeyError, ValueError, AttributeError) as error:
            raise DeviceError("the camera's state is not what it should be", value=str(told)[:80]) from error

    def keep_alive(self) -> None:
        """Say that somebody is there."""
        self.get("/gopro/camera/keep_alive")

    def set(self, number: int, option: int) -> None:
        """Set a setting; the names are the order in which GoPro wants them.

        Raises:
            DeviceError: refused (403), with what would be taken.
        """
        self.get("/gopro/camera/setting", {"setting": number, "option": option})

    def set_undocumented(self, number: int, option: int) -> None:
        """Set a setting that GoPro does not document, by the address of older cameras."""
        self.get(f"/gp/gpControl/setting/{number}/{option}")

    def sleep(self) -> None:
        """Put the camera to sleep; only Bluetooth wakes it."""
        self.get("/gp/gpControl/command/system/sleep")

    def turbo(self, on: bool) -> None:
        """Turbo transfer: faster downloads; the camera shows it and does nothing else meanwhile."""
        self.get("/gopro/media/turbo_transfer", {"p": int(on)})

    def media(self) -> list[Media]:
        """The clips on the card, by folder and name. Other files are left out.

        Raises:
            DeviceError: a name that is no GoPro's (it could be a path), or numbers that are none.
        """
        found = []
        try:
            for folder in self.get("/gopro/media/list").get("media", []):
                if not FOLDER.fullmatch(folder["d"]):
                    continue
                for file in folder["fs"]:
                    if CHAPTER.fullmatch(file["n"]):  # sizes and times are text on a HERO9
                        found.append(Media(folder["d"], file["n"], int(file["s"]), int(file.get("cre", 0))))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DeviceError("the camera's media list is not what it should be", cause=repr(error)) from error
        return sorted(found, key=lambda m: m.path)

    def download(self, media: Media, target: Path, tries: int = 4) -> Path:
        """Bring a file; goes on where an earlier try, or an earlier program, stopped.

        Args:
            media: as `media` listed it; its size is what must arrive.
            target: where it goes; a `.part` file lies beside it until it is whole.

        Raises:
            UsageError: the target exists and has another size.
            DeviceError: it broke off `tries` times without bringing a byte, or is not what was listed.
            HostError: the disk refuses.
        """
        if target.exists():
            if target.stat().st_size == media.size_bytes:
                return target
            raise UsageError("a file of another size lies there", value=target, next="move it away")
        part, idle = target.with_name(f".{target.name}.{media.size_bytes}.part"), 0
        try:
            while (have := part.stat().st_size if part.exists() else 0) < media.size_bytes or not part.exists():
                if idle == tries:
                    raise DeviceError(
                        "the download breaks off again and again", value=f"{media.path}: {have} of {media.size_bytes}",
                        next="give the same command again: it goes on from there",
                    )  # fmt: skip
                self._piece(media, part, have)
                gained = part.exists() and part.stat().st_size > have
                idle = 0 if gained else idle + 1
                if not gained:
                    self.host.sleep_until(self.host.now_ns() + 500_000_000 * idle)
            os.replace(part, target)
        except OSError as error:
            raise HostError("the clip cannot be written", value=f"{target}: {error.strerror or error}") from error
        return target

    def _piece(self, media: Media, part: Path, have: int) -> None:
        """One connection's worth of a download; a break is no error here."""
        connection = self.opener(max(self.timeout_s, 10.0))
        try:
            reply = _asked(connection, f"/videos/DCIM/{media.path}", have)
            if reply.status not in (200, 206):
                raise refusal(media.path, reply.status, None)
            start, total = _span(reply, have)
            if total != media.size_bytes:
                raise DeviceError("the file on the card changed", value=f"{media.path}: {total} bytes",
                                  expected=f"{media.size_bytes}")  # fmt: skip
            with part.open("r+b" if start else "wb") as file:
                file.seek(start)
                file.truncate()
                left = media.size_bytes - start
                while left > 0 and (data := _some(reply, min(left, _CHUNK))):
                    file.write(data)
                    left -= len(data)
        except _Broken:
            return
        finally:
            connection.close()


class _Broken(Exception):
    """A connection broke; the bytes before it are good."""


def _asked(connection: http.client.HTTPConnection, where: str, have: int) -> http.client.HTTPResponse:
    try:
        connection.request("GET", where, headers={"Range": f"bytes={have}-"} if have else {})
        return connection.getresponse()
    except (OSError, http.client.HTTPException) as error:
        raise _Broken from error


def _some(reply: http.client.HTTPResponse, most: int) -> bytes:
    try:
        return reply.read1(most)
    except (OSError, http.client.HTTPException) as error:
        raise _Broken from error


def _span(reply: http.client.HTTPResponse, have: int) -> tuple[int, int]:
    """(first byte, whole size) of a reply: 206 goes on, 200 begins again."""
    if reply.status == 200:
        length = reply.getheader("Content-Length") or ""
        return 0, int(length) if length.isascii() and length.isdigit() else -1
    match = re.fullmatch(r"bytes (\d+)-(\d+)/(\d+)", reply.getheader("Content-Range") or "")
    if match is None or int(match[1]) != have:
        raise DeviceError("the camera sends another part than was asked for", value=reply.getheader("Content-Range"),
                          expected=f"from byte {have}")  # fmt: skip
    return have, int(match[3])


def refusal(where: str, status: int, told: Any) -> DeviceError:
    """The error for an answer other than 200: of a 403 with what the camera would take."""
    told = told if isinstance(told, dict) else {}
    code, number, offered = told.get("error"), told.get("setting_id"), told.get("supported_options")
    if status == 403 and isinstance(code, int) and isinstance(number, int):
        name = BY_NUMBER[number].name if number in BY_NUMBER else f"setting {number}"
        names = [option_name(number, o) for o in offered if isinstance(o, int)] if isinstance(offered, list) else []
        return DeviceError(
            "the camera refuses a setting", value=f"{name} = {told.get('option_id')}", expected=", ".join(names),
            cause=_REFUSED.get(code, f"error {code}"),
            next="set in order: anti-flicker, lens, resolution, fps, stabilisation",
        )  # fmt: skip
    cause = str(told.get("error_msg", "")) or {404: "it has no such address", 500: "it does not do this by HTTP"}.get(
        status, ""
    )
    return DeviceError("the camera refuses a request", value=f"{where}: HTTP {status}", cause=cause,
                       next="control goes by Bluetooth on a HERO9")  # fmt: skip


def _dark(where: str, error: Exception) -> Dark:
    return Dark(
        "the camera does not answer over WiFi", value=where, cause=f"{type(error).__name__}: {error}",
        next="it is silent while it records or sleeps; join its network, see docs/hardware/gopro.md",
    )  # fmt: skip
