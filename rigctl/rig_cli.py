"""The rig's own verbs: find its devices, and probe what a spike camera sends."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, DeviceError, RigError, UsageError
from spikerig.dataset.terminal import emit, note
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.host import RealHost

Emulate = Annotated[Path | None, typer.Option(help="A file of emulated devices in place of the real ones (TOML).")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
Found = tuple[list[DeviceFacts], list[str]]


def find(emulate: Emulate = None, as_json: Json = False) -> None:
    """Look for the rig's devices: spike camera, RGB camera, clock box; each is found or the reason told.

    Exit codes: 0 all kinds found, 1 some are missing.
    """
    bench = None if emulate is None else read_bench(emulate)
    told: dict[str, dict[str, Any]] = {}
    for kind, search in FINDERS.items():
        try:
            facts, failed = search(bench)
        except RigError as error:  # one kind that cannot be searched must not hide the others
            facts, failed = [], [str(error).replace("\n", ";")]
        devices = [
            {"model": f.model, "serial": f.serial, "firmware": f.firmware, "address": f.address, **f.more}
            for f in facts
        ]
        told[kind] = {"devices": devices, "reasons": failed or ([] if facts else ["none answered"])}
    missing = [kind for kind, found in told.items() if not found["devices"]]
    if as_json:
        emit("spikerig.rig.find/1", {"emulated": emulate is not None, "kinds": told, "missing": missing})
    for kind, found in told.items():
        for d in found["devices"]:
            note(f"{kind:>5}: {d['model']}, serial {d['serial'] or '(none)'}, {d['address']}, firmware {d['firmware']}")
        for reason in found["reasons"]:
            note(f"{kind:>5}: {'-' if found['devices'] else 'none'} ({reason})")
    if missing:
        raise typer.Exit(1)


def probe(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Where the raw bytes are dumped.")] = None,
    file: Annotated[Path | None, typer.Option(help="Look at a dump in place of a camera.")] = None,
    emulate: Emulate = None,
    profile: Annotated[str, typer.Option(help="Wire profile for the USB ids: a name or a TOML file.")] = "",
    serial: Annotated[str, typer.Option(help="Of the camera, or its address as `rig find` tells it.")] = "",
    megabytes: Annotated[float, typer.Option("--megabytes", help="How much to look at.")] = 16.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing dump.")] = False,
    as_json: Json = False,
) -> None:
    """Take raw bytes from a spike camera (or a dump) and tell what wire they are of: row width, tags, phase, rate.

    Exit codes: 0 one hypothesis convinces, 1 none does.
    """
    from spikerig.rigctl.probe import examine
    from spikerig.rigctl.profiles import DEFAULT, PROFILES, profile_named

    if (file is not None) + (emulate is not None) > 1 or (file is not None and out is not None):
        raise UsageError("a dump is looked at where it is", value=file, next="give --file alone")
    if not 0.1 <= megabytes <= 1024:
        raise UsageError("between 0.1 and 1024 MB can be looked at", value=megabytes)
    bench = None if emulate is None else read_bench(emulate)
    chosen = profile_named(profile) if profile else bench.profile if bench else PROFILES[DEFAULT]
    size = int(megabytes * 1e6)
    if file is not None:
        data, bytes_s = _from_file(file, size), None
    else:
        data, bytes_s = _from_camera(bench, chosen, serial, size)
        if out is not None:
            from spikerig.dataset.outfile import whole_file

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


class Bench:
    """Emulated transports in place of the machine's."""

    def __init__(self, table: dict[str, Any], where: str) -> None:
        from spikerig.rigctl.sim.emulate.spike_bench import bridge_of
        from spikerig.rigctl.sim.emulate.usb import EmulatedUsb
        from spikerig.rigctl.sim.emulate.virtual import VirtualHost

        self.host = VirtualHost()
        bridges = [bridge_of(table["spike"], where=where)] if "spike" in table else []
        self.usb = EmulatedUsb(self.host, bridges)
        self.profile = bridges[0].wire.profile if bridges else None


def read_bench(path: Path) -> Any:
    """The emulated devices of a file.

    Raises:
        UsageError, DataError: there is no such file, or it is no TOML, or an entry is wrong.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError("the file of emulated devices cannot be read", value=f"{path}: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataError("the file of emulated devices is no TOML", value=path, cause=str(error)) from error
    return Bench(table, str(path))


def _spike(bench: Any) -> Found:
    from spikerig.rigctl.vidar import find as search

    return search(RealHost(), None) if bench is None else search(bench.host, bench.usb)


# kind -> what looks for its devices: (bench or None) -> (found, a line for each that failed)
FINDERS: dict[str, Callable[[Any], Found]] = {"spike": _spike}
