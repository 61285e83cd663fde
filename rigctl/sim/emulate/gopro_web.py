"""HTTP to an emulated HERO9: its server's bytes, in the same process on emulated time, or on a local socket."""

from __future__ import annotations

import http.client
import io
import json
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs, urlsplit

from spikerig.dataset.clocktime import NS
from spikerig.rigctl.sim.emulate.gopro_camera import GoProCamera

_WORDS = {200: "OK", 206: "Partial Content", 400: "Bad Request", 403: "Forbidden", 404: "Not Found",
          416: "Range Not Satisfiable", 500: "Internal Server Error"}  # fmt: skip
_PIECE = 1 << 18


@dataclass
class WebServer:
    """The camera's server: requests as bytes in, replies as bytes out, in pieces as they come.

    Args:
        camera: whose it is.
        downloads: how many were asked for so far.
    """

    camera: GoProCamera
    downloads: int = 0

    def reply(self, request: bytes) -> Iterator[bytes]:
        """The bytes of the reply; a ConnectionResetError where a download breaks off."""
        lines = request.decode("latin-1").split("\r\n")
        words = lines[0].split(" ")
        if len(words) != 3 or words[0] != "GET":
            yield _whole(400, {})
            return
        heads = dict(line.lower().split(": ", 1) for line in lines[1:] if ": " in line)
        where = urlsplit(words[1])
        if where.path.startswith("/videos/DCIM/"):
            yield from self._file(where.path.removeprefix("/videos/DCIM/"), heads.get("range", ""))
            return
        with self.camera.lock:
            status, body = self._answer(where.path, {k: v[-1] for k, v in parse_qs(where.query).items()})
        yield _whole(status, body)

    def _answer(self, path: str, query: dict[str, str]) -> tuple[int, Any]:
        camera = self.camera
        if path == "/gopro/version":
            return 200, {"version": "2.0"}
        if path == "/gopro/camera/state":
            return 200, {"status": _keyed(camera.statuses()), "settings": _keyed(camera.settings)}
        if path == "/gopro/camera/keep_alive":
            return 200, {}
        if path == "/gopro/media/list":
            return 200, {"id": "1554375628411872255", "media": [{"d": "100GOPRO", "fs": self._files()}]}
        if path == "/gopro/media/turbo_transfer":
            camera.turbo = query.get("p") == "1"
            return 200, {}
        if path == "/gopro/camera/setting" and list(query) == ["setting", "option"]:  # the order counts
            return self._set(query["setting"], query["option"], documented=True)
        if path.startswith("/gp/gpControl/setting/") and path.count("/") == 5:
            return self._set(*path.split("/")[-2:], documented=False)
        if path == "/gp/gpControl/command/system/sleep":
            camera.sleep()
            return 200, {}
        if path.startswith("/gopro/camera/shutter/") or path.startswith("/gp/gpControl/command/shutter"):
            return 500, {"version": "6.00", "path_info": "command/shutter", "error_code": -3,
                         "error_msg": "500 Internal Server Error", "function": "gpcontrol_cgi_handler"}  # fmt: skip
        return 404, {}

    def _files(self) -> list[dict[str, str]]:
        found = [{"n": "GOPR0001.JPG", "cre": "1", "mod": "1", "s": "77"}]  # there may be pictures too
        for path in self.camera.files():
            found.append({"n": path.name, "cre": "1700000000", "mod": "1700000000", "s": str(path.stat().st_size),
                          "ls": "-1", "glrv": "817767"})  # fmt: skip
        return found

    def _set(self, number: str, option: str, *, documented: bool) -> tuple[int, Any]:
        if not (number.isdigit() and option.isdigit()):
            return 400, {}
        said = self.camera.set(int(number), int(option))
        if said is None:
            return 200, {}
        told = {"error": said.error, "setting_id": int(number), "option_id": int(option)}
        return 403, told | ({"supported_options": list(said.supported)} if said.error in (3, 4) else {})

    def _file(self, name: str, wanted: str) -> Iterator[bytes]:
        camera = self.camera
        with camera.lock:
            path = {f"100GOPRO/{p.name}": p for p in camera.files()}.get(name)
        if path is None:
            yield _whole(404, {})
            return
        size = path.stat().st_size
        first = 0
        if wanted.startswith("bytes=") and not camera.faults.ignores_range:
            begin = wanted.removeprefix("bytes=").split("-")[0]
            first = int(begin) if begin.isdigit() else 0
            if first >= size:
                yield _whole(416, {})
                return
        part = f"Content-Range: bytes {first}-{size - 1}/{size}\r\n" if first else ""
        yield _head(206 if first else 200, "video/mp4", size - first, part)
        breaks = camera.faults.downloads_break[self.downloads : self.downloads + 1]
        self.downloads += 1
        left = breaks[0] if breaks else size
        rate = camera.nature.web_bytes_s * (10 if camera.turbo else 1)
        with path.open("rb") as file:
            file.seek(first)
            while data := file.read(min(_PIECE, left)):
                camera.host.sleep_until(camera.host.now_ns() + round(len(data) / rate * NS))
                left -= len(data)
                yield data
        if breaks and first + breaks[0] < size:
            raise ConnectionResetError(104, "the camera's network went away")


def _keyed(told: dict[int, Any]) -> dict[str, Any]:
    return {str(k): v for k, v in told.items()}


def _whole(status: int, body: Any) -> bytes:
    text = json.dumps(body).encode()
    return _head(status, "application/json", len(text)) + text


def _head(status: int, kind: str, length: int, more: str = "") -> bytes:
    return (
        f"HTTP/1.1 {status} {_WORDS[status]}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n{more}"
        "Connection: close\r\n\r\n"
    ).encode()


# ---- in the same process --------------------------------------------------------------------------------------------


@dataclass
class AirWifi:
    """Makes connections to an emulated camera, on the host's time; `Opener`."""

    server: WebServer
    address: str = "10.5.5.9:8080"

    def __call__(self, timeout_s: float) -> http.client.HTTPConnection:
        """A connection that is not yet used."""
        return _Connection(self.server, timeout_s)


class _Connection(http.client.HTTPConnection):
    """http.client's connection over a pipe instead of a socket: all bytes are those of a real one."""

    def __init__(self, server: WebServer, timeout_s: float) -> None:
        super().__init__("10.5.5.9", 8080, timeout=timeout_s)
        self._server, self._patience_s = server, timeout_s

    def connect(self) -> None:
        """Connect; a dark camera refuses at once, or lets it wait."""
        camera = self._server.camera
        camera.host.sleep_until(camera.host.now_ns() + 3_000_000)
        camera.advance()
        if camera.dark:
            if camera.faults.dark_hangs:
                camera.host.sleep_until(camera.host.now_ns() + round(self._patience_s * NS))
                raise TimeoutError("timed out")
            raise ConnectionRefusedError(111, "Connection refused")
        self.sock = _Pipe(self._server)  # type: ignore[assignment]


class _Pipe:
    """What http.client asks of a socket."""

    def __init__(self, server: WebServer) -> None:
        self._server, self._sent = server, b""

    def sendall(self, data: bytes) -> None:
        self._sent += bytes(data)

    def makefile(self, mode: str) -> io.BufferedReader:
        return io.BufferedReader(_Pieces(self._server.reply(self._sent)), 1 << 16)

    def close(self) -> None:
        self._sent = b""


class _Pieces(io.RawIOBase):
    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces, self._rest = pieces, b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._rest:
            piece = next(self._pieces, None)
            if piece is None:
                return 0
            self._rest = piece
        n = min(len(buffer), len(self._rest))
        buffer[:n], self._rest = self._rest[:n], self._rest[n:]
        return n


# ---- on a real socket -----------------------------------------------------------------------------------------------


@contextmanager
def serve(server: WebServer) -> Iterator[str]:
    """Serve on 127.0.0.1 while inside; yields "address:port". A dark camera hangs up without a word."""

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            request = b""
            while not request.endswith(b"\r\n\r\n") and (line := self.rfile.readline(1 << 16)):
                request += line
            server.camera.advance()
            if server.camera.dark:
                return
            try:
                for piece in server.reply(request):
                    self.wfile.write(piece)
            except ConnectionError:
                return

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True
        allow_reuse_address = True

    with Server(("127.0.0.1", 0), Handler) as listening:
        thread = threading.Thread(target=listening.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            yield f"127.0.0.1:{listening.server_address[1]}"
        finally:
            listening.shutdown()
            thread.join()
