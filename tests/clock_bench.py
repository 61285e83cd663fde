"""The clock service on an emulated box, through the real driver."""

from spikerig.rigctl.clockd import ClockService, Pace
from spikerig.rigctl.sim.emulate.harpbox import HarpBoxWire
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.serialport import device_errors
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.syncbox import HarpBox

S = 1_000_000_000


class Outliving:
    """What a device calls time: it goes on while the host is suspended."""

    def __init__(self, host):
        self.host = host

    def now_ns(self):
        return self.host.now_ns() + self.host.suspended_ns()

    def sleep_until(self, at_ns):
        self.host.sleep_until(at_ns - self.host.suspended_ns())


class Bench:
    """`wire` is what else the box's emulator is told; `ramp` of its crystal in ppm a minute; `pace` of the service."""

    def __init__(self, folder=None, faults=None, seed=0, *, ramp=1, wire=None, **pace):
        self.host = VirtualHost()
        clock = Oscillator(ppm=35, ramp_ppm_per_min=ramp, walk=1e-8, seed=seed, name="box")
        told = {"firmware": "pico", "start_second": 1_700_000_000, **(wire or {})}
        self.wire = HarpBoxWire(
            Outliving(self.host), clock, faults=faults, seed=seed, to_box=Latency(60, 40, 0, 0.02, 5),
            to_host=Latency(140, 40, 125, 0.02, 5), **told,
        )  # fmt: skip
        self.opened = 0
        self.service = ClockService(self.host, self.open, folder, Pace(**{"burst": 8, **pace}))

    def open(self):
        self.opened += 1
        return HarpBox(device_errors(self.wire.port), self.host, address="emulated", timeout_ns=50_000_000)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.service.close()

    def run(self, until_s):
        self.service.run(lambda: self.host.now_ns() >= until_s * S)

    def turns(self, until_s):
        """As `run`, but it stays open."""
        while self.host.now_ns() < until_s * S:
            due = self.host.now_ns() + S
            self.service.turn()
            self.host.sleep_until(due)

    def off_us(self):
        now = self.host.now_ns()
        told, good = self.service.box_at(now)
        return abs(told - int(self.wire.box_ns(now + self.host.suspended_ns()))) / 1e3, good / 1e3

    @property
    def box(self):
        return next(c for c in self.service.status()["clocks"] if c["clock"] == "box")
