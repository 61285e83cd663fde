"""`spikerig rig clock serve|status`: the clock-sync service, and what it knows."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.rigctl.host import Host


def clock(
    action: Annotated[str, typer.Argument(help="serve: run the service until a signal. status: ask a running one.")],
    port: Annotated[str | None, typer.Option(help="serve: the box's serial port; else the only one found.")] = None,
    bind: Annotated[str, typer.Option(help="Address of the page, HOST:PORT.")] = "127.0.0.1:8790",
    token_file: Annotated[
        Path | None, typer.Option(help="File with the page's token; needed beyond this computer.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="serve: folder for marks.jsonl and fits.jsonl.")
    ] = None,
    every_s: Annotated[float, typer.Option(help="serve: seconds between bursts of probes.")] = 1.0,
    burst: Annotated[int, typer.Option(help="serve: probes in a burst.")] = 16,
    seconds: Annotated[float, typer.Option(min=0, help="serve: stop by itself after this time; 0: never.")] = 0.0,
    emulate: Annotated[bool, typer.Option("--emulate", help="serve: an emulated box instead of a real one.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Keep the clocks in step in the background, or tell how they are."""
    token = _token(token_file)
    if action == "status":
        told = ask(bind, token)
    elif action == "serve":
        told = serve(_opener(port, emulate), bind, token, out, every_s, burst, seconds)
    else:
        raise UsageError("nothing to do by this name", value=action, expected="serve or status")
    if as_json:
        emit("spikerig.rig.clock/1", told)
    else:
        for line in table(told):
            note(line)


def serve(
    opener_of: Callable[[Any], Callable[[], Any]], bind: str, token: str | None, out: Path | None, every_s: float,
    burst: int, seconds: float,
) -> dict[str, Any]:  # fmt: skip
    """Run the service until SIGTERM, SIGINT or `seconds`; its last status."""
    from spikerig.rigctl.clock_page import Page
    from spikerig.rigctl.clockd import ClockService, Pace
    from spikerig.rigctl.host import RealHost

    host = RealHost()
    service = ClockService(host, opener_of(host), out, Pace(every_s, burst))
    page = Page(bind, service.status, token)
    note(f"clock service on http://{page.host}:{page.port}/status; Ctrl-C ends it")
    until = host.now_ns() + round(seconds * 1e9) if seconds else None
    try:
        with _signals() as wanted:
            service.run(lambda: wanted.is_set() or (until is not None and host.now_ns() >= until))
    finally:
        page.close()
    return service.status()


@contextmanager
def _signals() -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set, while inside."""
    wanted = threading.Event()
    before = {s: signal.signal(s, lambda *_: wanted.set()) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield wanted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _opener(port: str | None, emulate: bool) -> Callable[[Any], Callable[[], Any]]:
    """Given the host, what opens the box."""

    def of(host: Any) -> Callable[[], Any]:
        from spikerig.rigctl.serial_ports import find, serial_opener
        from spikerig.rigctl.syncbox import HarpBox

        if emulate:
            return _emulated(host)
        path = port
        if path is None:
            found, told = find(host)
            if len(found) != 1:
                raise DeviceError(
                    "which clock box?" if found else "no clock box was found",
                    value=", ".join(f.address for f in found) or "; ".join(told) or "no likely serial port",
                    expected="one", next="spikerig rig find; then --port PATH",
                )  # fmt: skip
            path = found[0].address
        return lambda: HarpBox(serial_opener(path), host, address=path)

    return of


def _emulated(host: Host) -> Callable[[], Any]:
    from spikerig.rigctl.sim.emulate.harpbox import HarpBoxWire
    from spikerig.rigctl.sim.emulate.oscillator import Oscillator
    from spikerig.rigctl.sim.emulate.serialport import device_errors
    from spikerig.rigctl.syncbox import HarpBox

    # True time began when the emulation did: an oscillator's past is drawn from its beginning.
    begun = host.now_ns()
    wire = HarpBoxWire(_Since(host, begun), Oscillator(ppm=20.0, walk=1e-8, name="box"), firmware="pico")
    return lambda: HarpBox(device_errors(wire.port), host, address="emulated")


class _Since:
    """A host whose time began at `begun_ns` of another."""

    def __init__(self, host: Host, begun_ns: int) -> None:
        self._begun_ns = begun_ns
        self._host, self.suspended_ns, self.worker, self.aside = host, host.suspended_ns, host.worker, host.aside

    def now_ns(self) -> int:
        """The time since then."""
        return self._host.now_ns() - self._begun_ns

    def sleep_until(self, at_ns: int) -> None:
        """Sleep."""
        self._host.sleep_until(at_ns + self._begun_ns)


def _token(path: Path | None) -> str | None:
    if path is None:
        return None
    try:
        told = path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise HostError("the token cannot be read", value=f"{path}: {error.strerror}") from error
    if len(told) < 16 or any(c.isspace() for c in told):
        raise UsageError("a token is one word of at least 16 characters", value=path,
                         next=f"python -c 'import secrets; print(secrets.token_urlsafe())' > {path}")  # fmt: skip
    return told


def ask(bind: str, token: str | None) -> dict[str, Any]:
    """The status of the service at an address.

    Raises:
        DeviceError: nobody answers there, or no clock service.
        UsageError: it wants a token, or another one.
    """
    import http.client

    from spikerig.rigctl.clock_page import address

    where, number = address(bind)
    try:
        link = http.client.HTTPConnection(where, number, timeout=5)
        link.request("GET", "/status", headers={"Authorization": f"Bearer {token}"} if token else {})
        answer = link.getresponse()
        body = answer.read(1_000_000)
        link.close()
    except (OSError, http.client.HTTPException) as error:
        raise DeviceError(
            "no clock service answers", value=bind, cause=str(error), next="spikerig rig clock serve"
        ) from error
    if answer.status in (401, 403):
        raise UsageError("the clock service wants a token", value=bind, next="--token-file FILE")
    try:
        told = json.loads(body)
        table(told)
    except (ValueError, KeyError, TypeError) as error:
        raise DeviceError("what answers is no clock service", value=bind, cause=str(error)[:200]) from error
    return told


def table(told: dict[str, Any]) -> list[str]:
    """A status for people."""
    lines = [f"running {told['running_s']:.0f} s, suspended {told['suspended_s']:.1f} s"]
    if told["trouble"]:
        lines.append(f"trouble: {told['trouble']}")
    lines.append("clock  state         epoch        offset s           skew ppm    good to us   holds over s   marks")
    for c in told["clocks"]:
        if c["state"] == "searching":
            lines.append(f"{c['clock']:<6} searching")
            continue
        skew = f"{c['skew_ppm']:+.3f} +- {c['skew_sd_ppm']:.3f}"
        lines.append(
            f"{c['clock']:<6} {c['state']:<12} {c['epoch']:>6}  {c['offset_ns'] / 1e9:>+16.6f}  {skew:>18}"
            f"  {c['uncertainty_us']:>12.1f}   {c['hold_over_s']:>12.1f}   {c['marks']:>5}"
        )
    return lines
