"""`spikerig cost usb`: what one reading thread holds in real time, by rate and by the camera's own memory."""

from __future__ import annotations

import dataclasses
import time
from typing import Annotated, Any

import typer

from spikerig.dataset.machine import caption, describe
from spikerig.dataset.terminal import Progress, emit, note

CASES = (  # profile, MiB of memory in the camera's logic
    ("vidar-400x250-20k", 0.0),
    ("vidar-400x250-20k", 1.0),
    ("vidar-400x250-20k", 16.0),
    ("vidar-400x250-20k-416", 64.0),
    ("vidar-400x250-40k-416", 64.0),
)


def usb(
    seconds: Annotated[float, typer.Option(help="Of each case.")] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Read emulated cameras in real time through pyusb: bytes that came, bytes lost, losses seen, processor time.

    The camera's bytes are copied from a loop, so that the emulation costs little. Rates beyond the FT601 are read over
    an emulated link that could carry them.
    """
    bar = Progress("reading", len(CASES), "cases")
    rows = []
    for name, memory in CASES:
        rows.append(measure(name, memory, seconds))
        bar.step()
    note(caption(describe()))
    if as_json:
        emit("spikerig.cost.usb/1", {"seconds": seconds, "machine": describe(), "cases": rows})
    for r in rows:
        note(
            f"{r['profile']}, {r['memory_mib']:g} MiB: {r['mb_s']:.1f} of {r['need_mb_s']:.0f} MB/s, lost "
            f"{r['lost_bytes']:,} B in {r['losses']} pieces, {r['epochs']} epochs told {r['told_bytes']:,} B, "
            f"{r['cores']:.2f} cores"
        )


def measure(name: str, memory_mib: float, seconds: float) -> dict[str, Any]:
    """One case: the driver against the emulated camera's truth."""
    from spikerig.rigctl.host import RealHost
    from spikerig.rigctl.profiles import PROFILES
    from spikerig.rigctl.sim.emulate.bridge import Bridge
    from spikerig.rigctl.sim.emulate.spike_bench import looped
    from spikerig.rigctl.sim.emulate.spikewire import Loop, SpikeWire
    from spikerig.rigctl.sim.emulate.usb import EmulatedUsb
    from spikerig.rigctl.vidar import VidarSource

    host = RealHost()
    known = PROFILES[name]
    profile = dataclasses.replace(known, link_bytes_s=max(known.link_bytes_s, 1.5 * known.bytes_s))
    wire = SpikeWire(profile, Loop(looped(profile, "noise", 0)), born_ns=host.now_ns() - 123_456_789)
    bridge = Bridge(wire, ram_bytes=int(memory_mib * 2**20))
    source = VidarSource(profile, host, EmulatedUsb(host, [bridge]))
    source.start()
    began, busy, count, told = time.monotonic(), time.process_time(), 0, []
    before = len(bridge.fifo.lost)
    while time.monotonic() - began < seconds:
        block = source.read(200_000_000)
        if block is not None:
            count += len(block.data)
            told += [block.lost_bytes] if block.lost_why else []
    took, busy = time.monotonic() - began, time.process_time() - busy
    lost = [x["stop"] - x["start"] for x in bridge.fifo.lost[before:]]
    source.close()
    return {
        "profile": name, "memory_mib": memory_mib, "need_mb_s": profile.bytes_s / 1e6, "mb_s": count / took / 1e6,
        "bytes": count, "lost_bytes": sum(lost), "losses": len(lost), "epochs": source.epoch + 1,
        "told_bytes": sum(told), "cores": busy / took,
    }  # fmt: skip
