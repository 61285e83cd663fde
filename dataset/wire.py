"""How a spike camera's bytes lie on the wire: geometry, framing, rate, link; and how sure each of these is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from spikerig.dataset.errors import UsageError

Sure = Literal["verified", "documented", "assumed"]
Framing = Literal["none", "m1k40"]


@dataclass(frozen=True, slots=True)
class WireProfile:
    """One mode of one camera.

    Args:
        name: e.g. "vidar-400x250-20k".
        width, height: pixels.
        row_bits: bits of a row on the wire, at least `width`; the rest is a trailer of unknown meaning.
        rate_hz: nominal ticks a second; the measured rate is what counts.
        framing: "none": ticks follow each other bare; "m1k40": 64-byte blocks with line and channel tags.
        bottom_up: rows come from the bottom of the picture up.
        vendor, product: USB identity.
        packet_bytes: of a transfer, a multiple of the endpoint's 1024.
        link_bytes_s: what the link can carry, sustained.
        sure: for each field above, whether it was seen on hardware ("verified"), stands in a vendor's document or code
            ("documented"), or is our guess ("assumed"). A field without an entry is "assumed".
    """

    name: str
    width: int
    height: int
    row_bits: int
    rate_hz: float
    framing: Framing = "none"
    bottom_up: bool = True
    vendor: int = 0x0403
    product: int = 0x601F
    packet_bytes: int = 262_144
    link_bytes_s: float = 360e6
    sure: Mapping[str, Sure] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (0 < self.width <= self.row_bits and self.height > 0 and self.rate_hz > 0 and self.row_bits % 8 == 0):
            raise UsageError(
                "a wire profile needs positive sizes, whole bytes a row, and row_bits >= width", value=self
            )
        if self.packet_bytes < 1024 or self.packet_bytes % 1024:
            raise UsageError("a packet is a multiple of 1024 bytes", value=self.packet_bytes)

    @property
    def tick_bytes(self) -> int:
        """Bytes of one tick on the wire."""
        return 128_000 if self.framing == "m1k40" else self.row_bits // 8 * self.height

    @property
    def bytes_s(self) -> float:
        """Nominal bytes a second."""
        return self.tick_bytes * self.rate_hz
