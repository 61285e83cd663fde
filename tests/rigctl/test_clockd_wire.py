"""The clock service while box and cable misbehave: each fault on the emulated serial wire, with its own bound."""

import numpy as np
import pytest
from clock_bench import Bench, S

from spikerig.calib.clock import fit_rig
from spikerig.dataset.marks import Probe, read_marks
from spikerig.rigctl import harp
from spikerig.rigctl.sim.emulate.harpbox import BoxFaults
from spikerig.rigctl.sim.emulate.latency import Latency

FIRMWARES = ("atxmega", "pico")


def watched(bench, first_s, last_s):
    """(error, claim) in us, every two seconds."""
    told = []
    for until in range(first_s, last_s, 2):
        bench.turns(until)
        told.append(bench.off_us())
    return np.array(told).T


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_either_firmware_is_followed(firmware):
    bench = Bench(wire={"firmware": firmware})
    off, claim = watched(bench, 20, 60)
    assert (off <= np.minimum(claim, 600 if firmware == "atxmega" else 100)).all()  # an ATxmega's slots are 1 ms
    assert (bench.box["state"], bench.box["epoch"]) == ("locked", 0)


@pytest.mark.parametrize("by_ns", [700_000_000, -3 * S])
def test_a_step_that_nobody_tells_is_an_epoch_and_known_again_at_once(by_ns):
    bench = Bench(faults=BoxFaults(steps=((40 * S, by_ns),)))
    bench.turns(38)
    assert bench.box["epoch"] == 0
    off, claim = watched(bench, 44, 80)
    assert (bench.box["epoch"], bench.box["state"]) == (1, "locked")
    assert (off <= np.minimum(claim, 200)).all()


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_seconds_that_roll_over_begin_no_epoch(firmware, tmp_path):
    bench = Bench(tmp_path, wire={"start_second": harp.ROLL_S - 30, "firmware": firmware})
    off, claim = watched(bench, 20, 60)
    assert (off <= np.minimum(claim, 600 if firmware == "atxmega" else 100)).all()
    assert (bench.box["epoch"], bench.box["resets"], bench.box["steps"]) == (0, 0, 0)
    bench.service.close()
    stamps = [m.device_ns for m in read_marks(tmp_path / "marks.jsonl") if isinstance(m, Probe)]
    assert min(stamps) < harp.ROLL_S * S < max(stamps)


def test_a_burst_of_late_answers_does_not_pull_the_map(tmp_path):
    bench = Bench(tmp_path)
    bench.turns(40)
    quick, bench.wire._to_host = bench.wire._to_host, Latency(20_000, 3_000)
    during = watched(bench, 42, 52)
    bench.wire._to_host = quick
    after = watched(bench, 54, 70)
    for off, claim in (during, after):
        assert (off <= np.minimum(claim, 150)).all()
    assert (bench.box["epoch"], bench.box["steps"]) == (0, 0)
    bench.service.close()
    marks = list(read_marks(tmp_path / "marks.jsonl"))
    late = [m for m in marks if isinstance(m, Probe) and m.sent_ns and m.received_ns - m.sent_ns > 20_000_000]
    assert len(late) > 60  # they came, and stand in the raw marks
    at = np.arange(10, 68) * S
    clocks = fit_rig(marks)
    true = bench.wire.box_ns(at) - clocks.origin_ns
    assert np.abs(clocks.fit("host").model.rig_from_device(at) - true).max() <= 120_000


@pytest.mark.parametrize("ramp", [-1.0, 1.0, 5.0])
def test_a_warming_crystal_is_followed(ramp):
    bench = Bench(ramp=ramp)
    off, claim = watched(bench, 20, 150)
    assert (off <= 100).all()
    assert (off <= claim).mean() >= 0.95


def test_answers_lost_damaged_and_doubled_one_time_in_three():
    bench = Bench(faults=BoxFaults(corrupt=0.15, lose=0.1, twice=0.1))
    off, claim = watched(bench, 20, 80)
    assert (off <= np.minimum(claim, 150)).all()
    assert bench.box["epoch"] == 0
    assert {t["what"] for t in bench.wire.truth} >= {"corrupt", "lost"}
