"""Bytes of other people's spike formats, made the slow and obvious way: a tick is one big integer, bit by bit."""

import numpy as np


def bits_to_bytes(bits, size):
    """The first bit is the lowest bit of the first byte."""
    return int("0" + "".join(str(int(b)) for b in reversed(bits)), 2).to_bytes(size, "little")


def vidar(pixels, row_bits, trailer=1):
    """Raw raster: rows bottom-up, each followed by trailer bits (ones, to be seen if they leak)."""
    out = b""
    for tick in pixels:
        bits = []
        for row in reversed(list(tick)):
            bits += [*row, *[trailer] * (row_bits - len(row))]
        out += bits_to_bytes(bits, (len(bits) + 7) // 8)
    return out


def m1k40(pixels, line=None):
    """Megapixel ticks: rows top first, two blocks of 500 pixels a row, tag = line | channel << 10 in bits 500..511."""
    out = b""
    for tick in pixels:
        for i in range(2000):
            half = tick[i // 2][500 * (i % 2) : 500 * (i % 2) + 500]
            channel = i // 500
            number = 500 if i in (0, 1999) else (line or 1 + i % 499)
            tag = number | channel << 10
            out += bits_to_bytes([*half, *(tag >> k & 1 for k in range(12))], 64)
    return out


def random_pixels(ticks, height, width, seed=0):
    """Spikes at a rate of 0.3, top row first."""
    return (np.random.default_rng(seed).random((ticks, height, width)) < 0.3).astype(np.uint8)
