"""An emulated box, and its driver."""

from spikerig.rigctl.sim.emulate.harpbox import HarpBoxWire
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.serialport import device_errors
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.syncbox import HarpBox

S = 1_000_000_000


def rig(firmware="atxmega", faults=None, host=None, **more):
    host = host or VirtualHost(5 * S)
    wire = HarpBoxWire(
        host, more.pop("clock", Oscillator(ppm=30, name="box")), firmware=firmware, faults=faults, **more
    )
    return host, wire


def box_on(firmware="atxmega", faults=None, **more):
    host, wire = rig(firmware, faults, **more)
    return host, wire, HarpBox(device_errors(wire.port), host, address="emulated", timeout_ns=100_000_000)
