"""The clock service's page: status as JSON and as Prometheus text, on this computer only unless a token guards it."""

from __future__ import annotations

import hmac
import ipaddress
import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from spikerig.dataset.errors import HostError, UsageError

PORT = 8790
METRICS = {
    "uncertainty_us": ("uncertainty_seconds", 1e-6, "What the map to this clock is good to, 95 %"),
    "bias_bound_us": ("bias_bound_seconds", 1e-6, "Half the delay's floor, which no residual shows"),
    "skew_ppm": ("skew_ppm", 1.0, "Its rate against the host's clock"),
    "offset_ns": ("offset_seconds", 1e-9, "Its time minus the host's"),
    "hold_over_s": ("hold_over_seconds", 1.0, "Since the last mark"),
    "marks": ("marks_total", 1.0, "Marks taken"),
    "left_out": ("left_out_total", 1.0, "Groups of marks that were not believed"),
    "steps": ("steps_total", 1.0, "Steps nobody told of"),
    "resets": ("resets_total", 1.0, "Times the clock began anew"),
}


def address(bind: str) -> tuple[str, int]:
    """HOST:PORT in parts; a bare host has the usual port.

    Raises:
        UsageError: it is no address.
    """
    host, colon, port = bind.rpartition(":") if not bind.endswith("]") else (bind, "", "")
    host = (host if colon else bind).strip("[]")
    if not host or (colon and not (port.isdigit() and int(port) < 65536)):
        raise UsageError("not an address to serve on", value=bind, expected="HOST:PORT, e.g. 127.0.0.1:8790")
    return host, int(port) if colon else PORT


def loopback(host: str) -> bool:
    """Whether only this computer can reach it."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def metrics(status: dict[str, Any]) -> str:
    """Prometheus text of a status."""
    lines = ["# HELP spikerig_clock_locked 1 while marks come in", "# TYPE spikerig_clock_locked gauge"]
    clocks = status["clocks"]
    lines += [f'spikerig_clock_locked{{clock="{c["clock"]}"}} {int(c["state"] == "locked")}' for c in clocks]
    for key, (name, unit, what) in METRICS.items():
        rows = [(c["clock"], c[key]) for c in clocks if c.get(key) is not None]
        kind = "counter" if name.endswith("_total") else "gauge"
        lines += [f"# HELP spikerig_clock_{name} {what}", f"# TYPE spikerig_clock_{name} {kind}"]
        lines += [f'spikerig_clock_{name}{{clock="{clock}"}} {value * unit:.12g}' for clock, value in rows]
    return "\n".join(lines) + "\n"


class Page:
    """A small HTTP server in threads of its own: /status, /metrics.

    Args:
        bind: HOST:PORT; port 0 takes a free one.
        status: what to show, called for every request.
        token: asked for as `Authorization: Bearer TOKEN`; needed where others than this computer can reach the page.

    Raises:
        UsageError: an address others can reach, without a token.
        HostError: the address is taken or not ours.
    """

    def __init__(self, bind: str, status: Callable[[], dict[str, Any]], token: str | None = None) -> None:
        host, port = address(bind)
        if not loopback(host) and not token:
            raise UsageError(
                "a page that others can reach needs a token", value=bind, next="give --token-file, or bind 127.0.0.1"
            )
        handler = type("Handler", (_Handler,), {"status": staticmethod(status), "token": token})
        try:
            self._server = _Server((host, port), handler)
        except OSError as error:
            raise HostError(
                "the status page cannot be served", value=bind, cause=error.strerror or str(error),
                next="another --bind; or a service runs here already: spikerig rig clock status",
            ) from error  # fmt: skip
        self.host, self.port = host, int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="clock page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving; may be called twice."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, where: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        import socket

        self.address_family = socket.AF_INET6 if ":" in where[0] else socket.AF_INET
        super().__init__(where, handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that hung up is no news."""


class _Handler(BaseHTTPRequestHandler):
    timeout = 5.0
    server_version, sys_version = "spikerig", ""
    status: Callable[[], dict[str, Any]]
    token: str | None

    def do_GET(self) -> None:
        """Answer."""
        if not self._allowed():
            return
        path = self.path.split("?")[0]
        if path in ("/", "/status"):
            self._answer(200, "application/json", json.dumps(self.status(), allow_nan=False))
        elif path == "/metrics":
            self._answer(200, "text/plain; version=0.0.4", metrics(self.status()))
        else:
            self._answer(404, "text/plain", "/status or /metrics\n")

    def _allowed(self) -> bool:
        told = self.headers.get("Authorization", "")
        if self.token is not None:
            if hmac.compare_digest(told.encode(), f"Bearer {self.token}".encode()):
                return True
            self._answer(401, "text/plain", "a token is needed\n")
            return False
        # Without a token only this computer's own name is heeded: a web page elsewhere cannot point a browser here.
        if loopback(address(self.headers.get("Host") or "localhost")[0]):
            return True
        self._answer(403, "text/plain", "not by this name\n")
        return False

    def _answer(self, code: int, kind: str, text: str) -> None:
        body = text.encode()
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are not the operator's news."""
