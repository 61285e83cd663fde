"""An emulated Vidar whose bytes say their own number, so that a test sees every gap."""

import numpy as np

from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.profiles import PROFILES
from spikerig.rigctl.sim.emulate.bridge import Bridge, UsbFault
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.spikewire import SpikeWire
from spikerig.rigctl.sim.emulate.usb import EmulatedUsb
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.vidar import VidarSource

S, MS = 1_000_000_000, 1_000_000
K20 = PROFILES["vidar-400x250-20k"]
MID = WireProfile("mid-128x80", 128, 80, 128, 20_000.0)  # 25.6 MB/s
SMALL = WireProfile("small-64x40", 64, 40, 64, 20_000.0)


class Numbered:
    """Every 4-byte word of the stream is its own number; transfers come and go in whole words."""

    def copy(self, start, out):
        assert start % 4 == 0
        assert len(out) % 4 == 0
        out.view(np.uint32)[:] = np.arange(start // 4, (start + len(out)) // 4, dtype=np.uint32)


def camera(profile=MID, source=None, *, faults=(), ppm=30.0, born_s=1.23456, host=None, **more):
    """(host, bus, bridge): a camera whose faults are (kind, at_s, and what else)."""
    host = host or VirtualHost()
    clock = Oscillator(ppm=ppm, walk=1e-8, seed=5)
    wire = SpikeWire(profile, source or Numbered(), clock, born_ns=host.now_ns() - round(born_s * S))
    bridge = Bridge(wire, faults=[UsbFault(**f) for f in faults], **more)
    return host, EmulatedUsb(host, [bridge]), bridge


def opened(profile=MID, **more):
    """(host, bus, bridge, a driver that streams)."""
    host, bus, bridge = camera(profile, **more)
    source = VidarSource(profile, host, bus)
    source.start()
    return host, bus, bridge, source


def record(host, source, until_s, pauses=(), wait_ns=100 * MS):
    """Blocks until then, with copies of their bytes; `pauses` are (at_s, for_s) in which nobody reads."""
    blocks, waiting = [], sorted(pauses)
    while host.now_ns() < until_s * S:
        if waiting and host.now_ns() >= waiting[0][0] * S:
            host.sleep_until(host.now_ns() + round(waiting.pop(0)[1] * S))
        block = source.read(wait_ns)
        if block is not None:
            blocks.append((block, block.data.copy()))
    return blocks


def gaps(blocks, tail=0):
    """(gaps inside what an epoch holds for sure, gaps in suspect ends, gaps between epochs), in bytes each.

    The suspect end of an epoch is what the next one says of it, or `tail` of the last one.
    """
    inside, suspect, between = [], [], []
    epochs = {}
    for block, data in blocks:
        epochs.setdefault(block.epoch, []).append((block, data))
    last = None
    for number, (_, parts) in enumerate(sorted(epochs.items())):
        later = [b for e, rest in sorted(epochs.items())[number + 1 : number + 2] for b, _ in rest[:1]]
        assert [b.byte_index for b, _ in parts] == list(np.cumsum([0, *(len(d) for _, d in parts[:-1])]))
        words = np.concatenate([d for _, d in parts]).view(np.uint32).astype(np.int64)
        doubt = later[0].suspect_bytes if later else tail
        sure = len(words) - doubt // 4
        for at in np.flatnonzero(np.diff(words) != 1):
            (inside if at + 1 < sure else suspect).append(int(words[at + 1] - words[at] - 1) * 4)
        if last is not None:
            between.append(int(words[0] - last - 1) * 4)
        last = int(words[-1])
    return inside, suspect, between
