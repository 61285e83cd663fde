"""An emulated spike camera from a table of a rig's file (`[spike]` of `--emulate SPEC.toml`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.profiles import DEFAULT, profile_named, profile_of
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate.bridge import Bridge, read_faults
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.spikewire import BitsAt, Loop, SpikeWire, Ticks, encode_ticks
from spikerig.rigctl.sim.stream import spike_blocks

_KEYS = {
    "profile", "serial", "ram_bytes", "link_bytes_s", "rate_hz", "ppm", "ramp_ppm_per_min", "walk", "born_s",
    "turn", "faults", "seed", "picture", "trailer", "overflow_error",
}  # fmt: skip
_LOOP_TICKS = 256


def bridge_of(table: Mapping[str, Any], start_ns: int = 0, bits: BitsAt | None = None, where: str = "") -> Bridge:
    """A spike camera on its bridge.

    Args:
        table: profile (a name or a table), serial, ram_bytes, link_bytes_s, rate_hz (the true one), ppm,
            ramp_ppm_per_min, walk (of its oscillator), born_s (before `start_ns`; by default a moment in the middle of
            a tick), turn (a table of `Latency`), faults (tables of `UsbFault`, seconds from `start_ns`), seed, picture
            ("texture" or "noise", looped, where no `bits` are given), trailer, overflow_error.
        start_ns: true time at which the emulation starts.
        bits: what the camera sees: (t0, t1) -> packed ticks, counted from its birth.
        where: for messages.

    Raises:
        UsageError: a key or a value is wrong.
    """
    if not set(table) <= _KEYS:
        raise UsageError("the emulated spike camera has unknown keys", value=f"{where}: {sorted(set(table) - _KEYS)}",
                         expected=", ".join(sorted(_KEYS)))  # fmt: skip
    told = table.get("profile", DEFAULT)
    profile = profile_of(told, where) if isinstance(told, Mapping) else profile_named(str(told))
    seed = int(table.get("seed", 0))
    rate = float(table.get("rate_hz", profile.rate_hz))
    age = float(table.get("born_s", 1 + stream(seed, "vidar phase").random() / rate * 1000))
    drift = {k: float(table[k]) for k in ("ppm", "ramp_ppm_per_min", "walk") if k in table}
    clock = Oscillator(offset_ns=-start_ns, seed=seed, name="vidar", **drift) if drift else None
    trailer = int(table.get("trailer", 0))
    if bits is not None:
        source: Loop | Ticks = Ticks(bits, profile, trailer)
    else:
        source = Loop(looped(profile, str(table.get("picture", "texture")), seed, trailer))
    wire = SpikeWire(profile, source, clock, born_ns=start_ns - round(age * NS), rate_hz=rate)
    faults = [{**f, "at_s": float(f.get("at_s", 0.0)) + start_ns / NS} for f in table.get("faults", ())]
    plain = {k: table[k] for k in ("serial", "ram_bytes", "link_bytes_s", "overflow_error") if k in table}
    turn = Latency(**table["turn"]) if "turn" in table else None
    return Bridge(wire, faults=read_faults(faults), turn=turn, seed=seed, **plain)


def looped(profile: WireProfile, picture: str, seed: int, trailer: int = 0) -> NDArray[np.uint8]:
    """Wire bytes of 256 ticks of a still picture, for a `Loop`."""
    rng = stream(seed, "vidar picture")
    h, w = profile.height, profile.width
    if picture == "noise":
        return rng.integers(0, 256, profile.tick_bytes * _LOOP_TICKS, dtype=np.uint8)
    if picture != "texture":
        raise UsageError("no such looped picture", value=picture, expected="texture or noise")
    fy, fx = np.fft.fftfreq(2 * h)[:, None], np.fft.rfftfreq(2 * w)[None]
    smooth = np.fft.rfft2(rng.standard_normal((2 * h, 2 * w))) / (fy**2 + fx**2 + 1e-4) ** 0.75
    field = np.fft.irfft2(smooth, (2 * h, 2 * w))[:h, :w]  # a corner: opposite edges do not match
    light = (0.05 + 0.5 * (field - field.min()) / np.ptp(field)).astype(np.float32)
    ends = [(0, light), (_LOOP_TICKS, light)]
    blocks = list(spike_blocks(ends, rng.random((h, w)) * 0.999, hold=True, block_ticks=_LOOP_TICKS))
    return encode_ticks(np.concatenate(blocks), profile, trailer)
