"""Wire bytes of a spike camera as packed ticks: the picture the right way up, trailers cut."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.m1k40 import unpack_blocks
from spikerig.dataset.vidar_dat import Raster, unpack_rows
from spikerig.dataset.wire import WireProfile

Bits = NDArray[np.uint8]


def ticks_from_wire(data: Bits, profile: WireProfile) -> Bits:
    """Packed ticks of whole ticks of wire bytes.

    Args:
        data: uint8[n * tick_bytes], from the first byte of a tick on.
        profile: how they lie on the wire.

    Returns:
        uint8[n,H,ceil(W/8)], top row first, LSB first, padding bits zero.

    Raises:
        UsageError: not a whole number of ticks.
    """
    ticks, rest = divmod(data.size, profile.tick_bytes)
    if rest:
        raise UsageError("not a whole number of ticks", value=f"{data.size} bytes", expected=f"x {profile.tick_bytes}")
    out = np.empty((ticks, profile.height, (profile.width + 7) // 8), np.uint8)
    if profile.framing == "m1k40":
        unpack_blocks(data.reshape(-1), out)
        return out
    unpack_rows(data.reshape(-1), Raster(profile.height, profile.width, profile.row_bits), out)
    return out if profile.bottom_up else np.ascontiguousarray(out[:, ::-1])
