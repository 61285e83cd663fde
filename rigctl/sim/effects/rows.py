"""416-bit rows: the Vidar's raw dumps carry 16 undocumented bits after each row of pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.dataset.errors import UsageError
from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.draws import stream as draws
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class WideRows:
    """Rows leave the camera wider than the picture; what is in the rest is not documented, so here it is random.

    Only the bytes on the wire change (`wire_bytes`): decoded, the spikes are the same.

    Args:
        trailer_bits: after each row.
    """

    trailer_bits: int = limits(16, 0, 4096, "bits")

    name: ClassVar[str] = "wide_rows"
    stage: ClassVar[Stage] = Stage.WIRE
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "SpikeCV with_head, RSIR RawToSpike(seq, 250, 416)[:, :, :400], Spike-Zoo remove_head"
    vanishes: ClassVar[str] = "always: no bit of a decoded stream changes; trailer_bits = 0 for the bytes"
    cost_ns: ClassVar[float] = 0.0

    def begin(self, site: Site) -> Hooks:
        """Nothing that survives decoding."""
        return Hooks(wire=lambda stream: stream)

    def magnitude(self, facts: Facts) -> Bound:
        """None: the trailer is cut off again."""
        return Bound(0.0, 0.0, "0: cut off by the decoder")


def wire_bytes(stream: SpikeStream, row_bits: int = 416, seed: int = 0) -> bytes:
    """A stream as a camera sends it: a raw raster, rows bottom-up, each with a trailer of random bits.

    Args:
        stream: whole ticks; lost ones cannot be told apart from dark ones here.
        row_bits: of a row on the wire, at least the width.
        seed: of the trailers.

    Returns:
        T * ceil(H * row_bits / 8) bytes; `open_spikes` with that `row_bits` reads the same bits back.

    Raises:
        UsageError: rows narrower than the picture.
    """
    if row_bits < stream.width:
        raise UsageError("rows on the wire must hold the width", value=row_bits, expected=f"at least {stream.width}")
    rng = draws(seed, WideRows.name)
    out: list[bytes] = []
    for first in range(0, stream.ticks, 256):
        ticks = np.unpackbits(stream.bits[first : first + 256, ::-1], axis=2, count=stream.width, bitorder="little")
        trailer = rng.integers(0, 2, (*ticks.shape[:2], row_bits - stream.width), np.uint8)
        rows = np.concatenate([ticks, trailer], axis=2).reshape(len(ticks), -1)
        out.append(np.packbits(rows, axis=1, bitorder="little").tobytes())
    return b"".join(out)
