"""Emulated time, oscillators and latencies: what every emulated device stands on."""

import threading

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.virtual import VirtualHost

S = 1_000_000_000


def run(host, jobs):
    told, threads, gate = [], [], threading.Barrier(len(jobs))

    def work(name, period, until):
        with host.worker(name):
            gate.wait()
            while host.now_ns() + period <= until:
                host.sleep_until(host.now_ns() + period)
                told.append((host.now_ns(), name))

    for job in jobs:
        threads.append(threading.Thread(target=work, args=job))
        threads[-1].start()
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()
    return told


def test_workers_take_turns_in_the_order_of_time():
    jobs = [("a", 3, 30), ("b", 5, 30), ("c", 7, 30)]
    told = run(VirtualHost(), jobs)
    due = sorted((k * period, name) for name, period, until in jobs for k in range(1, until // period + 1))
    assert told == due  # ties by name
    assert told == run(VirtualHost(), jobs)


def test_alone_sleeping_sets_the_time_and_never_back():
    host = VirtualHost(7)
    host.sleep_until(300 * S)
    host.sleep_until(5)
    assert host.now_ns() == 300 * S


def test_a_worker_aside_holds_nothing_up():
    host, done = VirtualHost(), threading.Event()

    def waits():
        with host.worker("waits"), host.aside():
            assert done.wait(10)

    other = threading.Thread(target=waits)
    other.start()
    with host.worker("runs"):
        host.sleep_until(9)
    assert host.now_ns() == 9
    done.set()
    other.join(10)
    assert not other.is_alive()


def test_a_name_is_one_workers():
    host = VirtualHost()
    with host.worker("a"), pytest.raises(UsageError), host.worker("a"):
        pass


def test_an_oscillator_is_its_formula_without_wander():
    clock = Oscillator(offset_ns=5 * S, ppm=50, ramp_ppm_per_min=1)
    at = np.array([0, 60 * S, 300 * S])
    seconds = at / S
    expected = 5 * S + at + (50e-6 * seconds + 0.5 * (1e-6 / 60) * seconds**2) * S
    # the ramp is a staircase of 0.1 s: half a stair of phase at most
    assert np.abs(clock.device_from_true(at) - expected).max() <= 0.5 * (1e-6 / 60) * 0.1 * 300 * S + 1


def test_wander_has_its_spread_and_does_not_depend_on_how_far_one_looks():
    ends = [Oscillator(walk=1e-8, seed=seed).device_from_true(100 * S) - 100 * S for seed in range(60)]
    # the integral of a random walk: sigma = walk * T^1.5 / sqrt(3)
    assert np.std(ends) == pytest.approx(1e-8 * 100**1.5 / np.sqrt(3) * S, rel=0.3)
    near, far = Oscillator(walk=1e-8, seed=3), Oscillator(walk=1e-8, seed=3)
    near.device_from_true(1 * S)
    assert near.device_from_true(500 * S) == far.device_from_true(500 * S)


@pytest.mark.parametrize("ppm", [-1000, -50, 0, 50, 1000])
def test_there_and_back_is_a_nanosecond(ppm):
    clock = Oscillator(offset_ns=-123456789, ppm=ppm, ramp_ppm_per_min=1, walk=1e-8)
    at = np.arange(0, 400 * S, 1_700_000_003)
    assert np.abs(clock.true_from_device(clock.device_from_true(at)) - at).max() <= 1


def test_latency_has_its_floor_mean_and_grain():
    rng = np.random.default_rng(0)
    plain = Latency(60, 40)
    late = np.array([plain.arrives_ns(1000, rng) - 1000 for _ in range(4000)])
    assert late.min() >= 60_000
    assert late.mean() == pytest.approx(100_000, rel=0.05)
    assert all(Latency(60, 40, grain_us=125).arrives_ns(k, rng) % 125_000 == 0 for k in range(0, 10**6, 9999))
    with pytest.raises(UsageError):
        Latency(float("nan"))
