"""Still pictures as wire bytes, for tests of framing."""

import numpy as np

from spikerig.rigctl.sim.emulate.spikewire import encode_ticks
from spikerig.rigctl.sim.stream import spike_blocks


def light(height, width, kind, seed=0):
    """float64[H,W] spikes a tick: "texture" (1/f), "object" on black, "flat", "ramp"."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    if kind == "object":
        inside = ((x - width / 2) / (width / 4)) ** 2 + ((y - height / 2) / (height / 4)) ** 2 < 1
        return np.where(inside, 0.2 + 0.1 * np.sin(x / 5) * np.cos(y / 7), 0.0)
    if kind == "flat":
        return np.full((height, width), 0.3)
    if kind == "ramp":
        return 0.1 + 0.4 * y / height + 0.1 * x / width
    fy, fx = np.fft.fftfreq(2 * height)[:, None], np.fft.rfftfreq(2 * width)[None]
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((2 * height, 2 * width))) / (fx**2 + fy**2 + 1e-4) ** 0.75)
    field = field[:height, :width]  # opposite edges do not match
    return 0.05 + 0.5 * (field - field.min()) / np.ptp(field)


def wire_bytes(profile, kind, ticks, seed=0, trailer=0):
    """uint8[ticks * tick_bytes] from a tick's beginning, of pixels that differ by 3 %."""
    rng = np.random.default_rng(seed + 100)
    rate = light(profile.height, profile.width, kind, seed)
    rate = np.clip(rate * (1 + 0.03 * rng.standard_normal(rate.shape)), 0, 1).astype(np.float32)
    blocks = spike_blocks([(0, rate), (ticks, rate)], rng.random(rate.shape) * 0.999, hold=True)
    return encode_ticks(np.concatenate(list(blocks)), profile, trailer)
