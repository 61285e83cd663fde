"""Hard inputs of the clocks: what devices, links and operators do to marks, each with the bound that must hold."""

from dataclasses import replace

import numpy as np

from spikerig.dataset.clocktime import NS
from spikerig.dataset.marks import Probe, Sight
from spikerig.rigctl.sim.emulate.clockworld import FULL_SPEED, HIGH_SPEED, World

SECONDS = 120


class Ramped(World):
    """A world in which the box begins to warm by so many ppm/min at half time; the others stay as they are."""

    def __init__(self, seed, ppm_per_min):
        super().__init__(seed, ramp_ppm_per_min=0.0)
        self.ppm_per_min = ppm_per_min

    def at(self, clock, true_ns):
        """See World; a quadratic more from half time on."""
        shown = super().at(clock, true_ns)
        since = np.maximum(np.asarray(true_ns, np.int64) - SECONDS // 2 * NS, 0) / NS
        warm = 0.5 * self.ppm_per_min * 1e-6 / 60 * since**2 * NS if clock == "box" else 0.0
        return shown + np.rint(warm).astype(np.int64)


def stepped(marks, at_box_ns, by_ns):
    """The box's clock jumps, and nobody tells."""
    return [
        replace(m, device_ns=m.device_ns + by_ns) if isinstance(m, Probe) and m.device_ns >= at_box_ns else m
        for m in marks
    ]


def garbled(marks, share, seed=0):
    """Stamps of which some are bad by anything between a microsecond and an hour, either way."""
    rng = np.random.default_rng(seed)

    def bad(m):
        return replace(m, device_ns=m.device_ns + int(rng.choice([-1, 1]) * 10 ** rng.uniform(3, 12.5)))

    return [bad(m) if rng.random() < share else m for m in marks]


def burst(marks, first, last, by_ns, clock="box"):
    """Marks of some seconds that all say the same wrong thing."""
    start = min(m.device_ns for m in marks if m.clock == clock)

    def inside(m):
        return m.clock == clock and first <= (m.device_ns - start) / NS < last

    return [replace(m, device_ns=m.device_ns + by_ns) if inside(m) else m for m in marks]


def slow(marks, first, last, by_ns):
    """A host too busy to read: answers of some seconds come late."""
    start = marks[0].received_ns
    return [
        replace(m, received_ns=m.received_ns + by_ns) if first <= (m.received_ns - start) / NS < last else m
        for m in marks
    ]


def worlds():
    """Marks by name: (world, marks, the clock to judge, bound of the error in us)."""
    cases = {}

    def case(name, world, marks, clock="host", bound_us=100.0):
        cases[name] = (world, marks, clock, bound_us)

    w = World(11)
    probes = w.probes(SECONDS)
    spike = w.sights("spike", SECONDS, 10)
    case("nothing wrong", w, probes)
    case("1 in 5 stamps garbled by 1 us to an hour", w, garbled(probes, 0.2))
    case("every mark twice", w, [m for m in probes for _ in range(2)])
    case("marks in random order", w, [probes[k] for k in np.random.default_rng(0).permutation(len(probes))])
    case("4 of 5 marks missing", w, probes[::5], bound_us=120.0)
    case("no marks for half a minute", w, [m for m in probes if not 40 < (m.sent_ns - probes[0].sent_ns) / NS < 70])
    case("the box 3 ms ahead for 5 s", w, burst(probes, 50, 55, 3_000_000))
    case("answers 20 ms late for 20 s", w, slow(probes, 50, 70, 20_000_000), bound_us=120.0)
    far = slow([replace(p, sent_ns=p.sent_ns - 1_000_000) for p in probes], 0, 1e9, 3_000_000)
    case("a slow link: floors of 3 ms and 1 ms", w, far, bound_us=1100.0)
    case("half a millisecond of stalls in every second message", w, _stalled(w), bound_us=150.0)
    for ppm in (-1.0, 1.0, 5.0):
        warm = Ramped(12, ppm)
        case(f"warming by {ppm:+g} ppm/min from half time", warm, warm.probes(SECONDS))
        case(f"the same, sights of the spike camera, {ppm:+g}", warm,
             warm.probes(SECONDS) + warm.sights("spike", SECONDS, 10), "spike", 25.0)  # fmt: skip
    case(
        "sights 0.4 ms off (4 steps misread) for 5 s", w, probes + burst(spike, 50, 55, 400_000, "spike"), "spike", 25.0
    )
    case("1 in 5 sights misread by whole steps", w, probes + _misread(spike), "spike", 25.0)
    case("sights of rising edges only", w, probes + [s for s in spike if s.rising], "spike", 700.0)
    return cases


def _stalled(world):
    from spikerig.rigctl.sim.emulate.clockworld import Link

    half = Link(replace(HIGH_SPEED.out, stall=0.5, stall_ms=0.5), replace(FULL_SPEED.back, stall=0.5, stall_ms=0.5))
    return world.probes(SECONDS, half)


def _misread(sights):
    rng = np.random.default_rng(1)
    steps = np.where(rng.random(len(sights)) < 0.2, rng.integers(-40, 41, len(sights)), 0) * 100_000
    return [replace(s, panel_ns=s.panel_ns + int(k)) for s, k in zip(sights, steps, strict=True)]


def lone_marks():
    """So few marks that little can be known, and that must be said."""
    return {
        "one probe": [Probe("box", 0, 0, 10**18, 200_000)],
        "two probes at one instant": [Probe("box", 0, 0, 10**18, 200_000), Probe("box", 0, 0, 10**18, 200_001)],
        "two probes an hour apart": [
            Probe("box", 0, 0, 10**18, 200_000),
            Probe("box", 0, 3600 * NS, 10**18 + 3600 * NS, 3600 * NS + 200_000),
        ],
        "a probe that took no time": [Probe("box", 0, 5, 10**18, 5)],
        "one sight": [Sight("spike", 0, 5, 10**18, 1000.0, True, 0)],
    }


T = "numerics/test_clock.py::"
ROWS = [
    ("12 cells, gaps of 0.01 s to 100 s", "clock_track", "states and covariances to 1e-6 of longdouble least squares",
     T + "test_the_smoother_is_least_squares"),
    ("1 in 10 marks 30 deviations off, all the same way", "track", "each named; the map as without them to 0.5 us",
     T + "test_marks_far_off_are_named_and_change_nothing"),
    ("offsets near 2^62 ns, Unix times, 10 years apart", "clock_track, ClockModel",
     "to 2 ns where the same at 0 is", T + "test_the_origin_of_time_does_not_matter"),
    *[(name, "fit_rig", f"error below {bound:g} us at every instant",
       T + "test_marks_that_went_wrong") for name, (_, _, _, bound) in worlds().items()],
    ("a step of 0.5 ms, 20 ms, 1 s, -20 ms of the box that nobody tells", "fit_rig",
     "found, to one mark; rig time goes on over it, good to what is claimed", T + "test_a_step_is_found_and_bridged"),
    ("a step below the delay's own bound", "fit_rig", "not found, and within the claim",
     T + "test_a_step_smaller_than_the_bound_stays_within_it"),
    ("one mark, two at one instant, an hour apart, no delay", "fit_rig", "finite; sigma grows by what is not known",
     T + "test_lone_marks_promise_little"),
    ("a counter of 32 bits: wraps, several at once, duplicates, at the edge", "unwrap", "exact integers",
     T + "test_counters_are_unwrapped"),
    ("pulses missing, doubled, strays, a clock off by 900 ppm", "number_pulses", "every number right or left out",
     T + "test_pulses_get_their_numbers"),
    ("collinear, one, equal and 1e5 points", "lower_hull", "the hull by brute force",
     T + "test_the_hull_is_below_everything"),
    ("bounds of one-way stamps: latency 1 us to 4 ms", "hull_floor", "truth within [hull - bound, hull]",
     T + "test_the_floor_stays_within_its_bound"),
    ("answers before questions, no marks, NaN", "gate, track, hull_floor", "refused by name",
     T + "test_nonsense_is_refused"),
    ("6 hours of marks, one every 10 s", "track", "p99 below 25 us", T + "test_six_hours"),
    ("an LED that repeats within what the stamps leave open", "frame_sights", "refused, with both numbers",
     "calib/test_led.py::test_a_clip_that_may_have_seen_two_beats_is_refused"),
    ("a light without a beat", "frame_sights", "told by its pattern, median within 40 us",
     "calib/test_led.py::test_a_light_without_a_beat_is_told_by_its_pattern"),
    ("an LED on in the last two frames of a clip only", "read_frames", "no edge off by more than 200 us",
     "calib/test_panel_read.py::test_an_led_that_comes_on_as_the_clip_ends_makes_no_false_time"),
    ("no clock box: a plain LED, its period 2.5 % off, its place unknown", "led_sights", "frames to spikes 100 us p99",
     "rigctl/test_ingest_led.py::test_an_led_ties_every_frame_to_the_spikes"),
]  # fmt: skip
