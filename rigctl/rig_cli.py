"""The rig's own verbs: find its devices, and probe what a spike camera sends."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, DeviceError, RigError, UsageError
from spikerig.dataset.terminal import emit, note
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.host import RealHost

Emulate = Annotated[str, typer.Option(help="An emulated rig in place of the real one: a file (TOML) or `demo`.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
Found = tuple[list[DeviceFacts], list[str]]


def find(emulate: Emulate = "", as_json: Json = False) -> None:
    """Look for the rig's devices: spike camera, RGB camera, clock box; each is found or the reason told.

    Exit codes: 0 all kinds found, 1 some are missing.
    """
    told: dict[str, dict[str, Any]] = {}
    with bench_of(emulate) as bench:
        for kind, search in FINDERS.items():
            told[kind] = _ask(search, bench)
    missing = [kind for kind, found in told.items() if not found["devices"]]
    if as_json:
        emit("spikerig.rig.find/1", {"emulated": bool(emulate), "kinds": told, "missing": missing})
    for kind, found in told.items():
        for d in found["devices"]:
            note(f"{kind:>5}: {d['model']}, serial {d['serial'] or '(none)'}, {d['address']}, firmware {d['firmware']}")
        for reason in found["reasons"]:
            note(f"{kind:>5}: {'-' if found['devices'] else 'none'} ({reason})")
    if missing:
        raise typer.Exit(1)


def _ask(search: Callable[[Any], Found], bench: Any) -> dict[str, Any]:
    """What one kind's search brought; a kind that cannot be searched must not hide the others."""
    try:
        facts, failed = search(bench)
    except RigError as error:
        facts, failed = [], [str(error).replace("\n", ";")]
    devices = [
        {"model": f.model, "serial": f.serial, "firmware": f.firmware, "address": f.address, **f.more} for f in facts
    ]
    return {"devices": devices, "reasons": failed or ([] if facts else ["none answered"])}


def probe(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Where the raw bytes are dumped.")] = None,
    file: Annotated[Path | None, typer.Option(help="Look at a dump in place of a camera.")] = None,
    emulate: Emulate = "",
    profile: Annotated[str, typer.Option(help="Wire profile for the USB ids: a name or a TOML file.")] = "",
    serial: Annotated[str, typer.Option(help="Of the camera, or its address as `rig find` tells it.")] = "",
    megabytes: Annotated[float, typer.Option("--megabytes", help="How much to look at.")] = 16.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing dump.")] = False,
    as_json: Json = False,
) -> None:
    """Take raw bytes from a spike camera (or a dump) and tell what wire they are of: row width, tags, phase, rate.

    Exit codes: 0 one hypothesis convinces, 1 none does.
    """
    from spikerig.dataset.outfile import refuse_existing, whole_file
    from spikerig.rigctl.probe import examine
    from spikerig.rigctl.profiles import DEFAULT, PROFILES, profile_named

    if file is not None and (emulate or out is not None):
        raise UsageError("a dump is looked at where it is", value=file, next="give --file alone")
    if not 0.1 <= megabytes <= 1024:
        raise UsageError("between 0.1 and 1024 MB can be looked at", value=megabytes)
    size = int(megabytes * 1e6)
    with bench_of(emulate) as bench:
        chosen = profile_named(profile) if profile else bench.profile if bench else PROFILES[DEFAULT]
        if file is not None:
            data, bytes_s = _from_file(file, size), None
        else:
            if out is not None:
                refuse_existing(out, force)
            data, bytes_s = _from_camera(bench, chosen, serial, size)
    if out is not None:
        with whole_file(out, force=force) as part:
            part.write_bytes(data.tobytes())
    seen = examine(data, [chosen, *PROFILES.values()], bytes_s)
    best = seen.convincing
    document = {
        "bytes": seen.bytes, "ones": seen.ones, "bytes_s": bytes_s, "row_bits": seen.row_bits,
        "row_stands_out": seen.row_stands_out, "convincing": best.profile.name if best else None,
        "hypotheses": [h.as_json() for h in seen.hypotheses], "out": None if out is None else str(out),
    }  # fmt: skip
    if as_json:
        emit("spikerig.rig.probe/1", document)
    for h in seen.hypotheses:
        rate = f", {h.rate_hz:,.1f} ticks/s" if h.rate_hz else ""
        gain = "too few bytes" if h.gain is None else f"gain {h.gain:,.0f} nats"
        phase = f"tick begins at byte {h.phase} ({h.phase_confidence:.2f})"
        note(f"{h.confidence:6.3f}  {h.profile.name}: {gain}, {phase}, trailer {h.trailer}{rate}")
    rows = f"{seen.row_bits} bits" if seen.row_bits else "no length stands out"
    note(f"rows: {rows}; {100 * seen.ones:.1f} % of {seen.bytes:,} bytes' bits are set")
    if best is None:
        note("no hypothesis convinces: show the camera a bright, textured, still scene; or give --profile FILE.toml")
        raise typer.Exit(1)


def _from_file(file: Path, size: int) -> Any:
    import numpy as np

    try:
        with file.open("rb") as stream:
            data = np.frombuffer(stream.read(size), np.uint8)
    except OSError as error:
        raise UsageError("the dump cannot be read", value=f"{file}: {error.strerror}") from error
    if not len(data):
        raise DataError("the dump is empty", value=file)
    return data


def _from_camera(bench: Any, profile: Any, serial: str, size: int) -> tuple[Any, float | None]:
    """A gapless stretch of bytes, and the bytes a second that were measured around it."""
    import numpy as np

    from spikerig.rigctl.vidar import VidarSource

    host = bench.host if bench else RealHost()
    source = VidarSource(profile, host, bench.usb if bench else None, serial=serial, patience_ns=10 * NS)
    try:
        source.start()
        kept: list[Any] = []
        epoch, have, end = 0, 0, host.now_ns() + 30 * NS
        while have < size or source.measured_rate() is None:
            block = source.read(NS // 2)
            if host.now_ns() > end:
                break
            if block is None:
                continue
            if block.epoch != epoch and have < size:
                kept, have, epoch = [], 0, block.epoch
            if have < size:
                kept.append(block.data.copy())
                have += len(block.data)
        rate = source.measured_rate()
    finally:
        source.close()
    data = np.concatenate(kept)[:size] if kept else np.zeros(0, np.uint8)
    if not len(data):
        raise DeviceError("no bytes came", value=f"{source.facts.serial} at {source.facts.address}")
    return data, rate.bytes_s if rate else None


@contextmanager
def bench_of(emulate: str) -> Iterator[Any]:
    """The transports of an emulated rig, by its file or its name; None: this machine's own.

    Raises:
        UsageError: there is no such file, or an entry is wrong.
    """
    if not emulate:
        yield None
        return
    from spikerig.rigctl.sim.emulate.rig import load_rig_spec, transports_of

    bench = transports_of(load_rig_spec(emulate))
    try:
        yield bench
    finally:
        shutil.rmtree(bench.card, ignore_errors=True)


def _spike(bench: Any) -> Found:
    from spikerig.rigctl.vidar import find as search

    return search(RealHost()) if bench is None else search(bench.host, bench.usb, (bench.profile,))


def _rgb(bench: Any) -> Found:
    from spikerig.rigctl.gopro import find as search

    return search(RealHost()) if bench is None else search(bench.host, bench.web, bench.radio)


def _sync(bench: Any) -> Found:
    from spikerig.rigctl.serial_ports import find as search

    return search(RealHost()) if bench is None else search(bench.host, bench.ports, bench.opener_of)


# kind -> what looks for its devices: (bench or None) -> (found, a line for each that failed)
FINDERS: dict[str, Callable[[Any], Found]] = {"spike": _spike, "rgb": _rgb, "sync": _sync}
