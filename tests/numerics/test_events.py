"""The event kernel against brute force, closed forms and its hard inputs."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from spikerig import _native
from spikerig.dataset import kernels, oracles
from spikerig.dataset.errors import NumericsError, UsageError

Found = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
LN2 = float(np.log(2.0))


@pytest.fixture(autouse=True)
def restore() -> Iterator[None]:
    isa, threads = _native.isa(), _native.threads()
    yield
    _native.set_isa(isa)
    _native.set_threads(threads)


def case(
    seed: int = 0,
    size: tuple[int, int] = (4, 6),
    knots: int = 5,
    hold: bool = False,
    span: int = 20_000,
    low: float = -2,
) -> tuple[np.ndarray, np.ndarray]:
    """Random light of a few decades at random knots, steady over the last stretch."""
    rng = np.random.default_rng(seed)
    light = (10 ** rng.uniform(low, 0, (knots, *size))).astype(np.float32)
    light[-1] = light[-2]  # nothing happens just at the end, where the oracle is late
    inner = np.sort(rng.choice(np.arange(1, span), knots - 2 + hold, replace=False))
    return light, np.concatenate([[0], inner, [span]]).astype(np.float64)


def thresholds(size: tuple[int, ...], up: float = 0.21, down: float = 0.17) -> tuple[np.ndarray, np.ndarray]:
    return np.full(size, up), np.full(size, down)


def run(light: np.ndarray, at: np.ndarray, up: float = 0.21, down: float = 0.17, **more: Any) -> Found:
    return kernels.events(light, at, thresholds(light.shape[1:], up, down), **({"hold": False, "eps": 0.01} | more))


def ramp(*values: float, step: float = 1000.0, **more: Any) -> tuple[list[int], list[int]]:
    """Times and polarities of one pixel under light of these values at knots `step` ns apart."""
    light = np.array(values, np.float32).reshape(-1, 1, 1)
    at = np.arange(len(values) + bool(more.get("hold"))) * step
    t, _, _, polarity = run(light, at, **more)
    return t.tolist(), polarity.tolist()


def by_pixel(found: Found) -> list[np.ndarray]:
    order = np.lexsort((np.arange(len(found[0])), found[1], found[2]))
    return [column[order] for column in found]


def agree(light: np.ndarray, at: np.ndarray, *, late: float = 1.0, step_ns: float = 1.0, **how: Any) -> int:
    """Assert that the kernel gives the oracle's events, none later than it and none more than `late` ns sooner."""
    how = {"hold": False, "eps": 0.01} | how
    limits = how.pop("limits", thresholds(light.shape[1:]))
    mine, true = kernels.events(light, at, limits, **how), oracles.events(light, at, limits, step_ns=step_ns, **how)
    a, b = by_pixel(mine), by_pixel(true)
    assert len(a[0]) == len(b[0])
    for one, other in zip(a[1:], b[1:], strict=True):
        assert np.array_equal(one, other)
    gap = b[0] - a[0]
    assert gap.min() >= (0 if "tau_ns" not in how else -1)
    assert gap.max() <= late
    order = np.lexsort((mine[1], mine[2], mine[0]))
    assert np.array_equal(order, np.arange(len(order))), "in the order of (t, y, x)"
    return len(gap)


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("tau_ns", [0.0, 100.0, 3000.0])
def test_the_oracles_events(hold: bool, tau_ns: float) -> None:
    light, at = case(hold=hold)
    assert agree(light, at, hold=hold, **({"tau_ns": tau_ns} if tau_ns else {})) > 200


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("refractory_ns", [60, 1000])
def test_the_oracles_events_with_a_refractory_time(hold: bool, refractory_ns: int) -> None:
    """The oracle resets up to a step late, so its references drift: the gap closes to the nanosecond with the step."""
    light, at = case(1, hold=hold, span=4000)
    limits = thresholds(light.shape[1:])
    mine = kernels.events(light, at, limits, hold=hold, eps=0.01, refractory_ns=refractory_ns)
    gaps = []
    for step_ns in (1.0, 0.1):
        true = oracles.events(light, at, limits, hold=hold, eps=0.01, refractory_ns=refractory_ns, step_ns=step_ns)
        a, b = by_pixel(mine), by_pixel(true)
        assert [c.tolist() for c in a[1:]] == [c.tolist() for c in b[1:]]
        gaps.append(np.abs(a[0] - b[0]).mean())
    assert gaps[1] <= min(gaps[0], 1.0), gaps
    assert len(mine[0]) > 30


def test_unequal_thresholds() -> None:
    light, at = case(2)
    limits = thresholds(light.shape[1:], 0.5, 0.08)
    agree(light, at, limits=limits)
    polarity = kernels.events(light, at, limits, hold=False, eps=0.01)[3]
    assert (polarity < 0).sum() > 3 * (polarity > 0).sum() > 0


def test_thresholds_of_their_own() -> None:
    light, at = case(3)
    rng = np.random.default_rng(0)
    limits = tuple(rng.uniform(0.1, 0.6, light.shape[1:]) for _ in range(2))
    agree(light, at, limits=limits)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 1), (17, 61), (5, 1023)])
def test_sizes(size: tuple[int, int]) -> None:
    """One pixel, odd sides, and more than one block of 1024 pixels, the last one odd."""
    light, at = case(4, size, knots=3, span=400)
    assert agree(light, at) > size[0] * size[1]


def test_the_same_bits_everywhere() -> None:
    light, at = case(5, (33, 37), knots=7, span=10**7, low=-4)
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 33 * 37, 500), rng.random(500) * 1e7, rng.choice(np.array([-1, 1], np.int8), 500)
    for how in ({}, {"tau_ns": 2e5}, {"refractory_ns": 10_000}, {"noise": noise, "refractory_ns": 500, "tau_ns": 1e4}):
        found = []
        for isa in _native.isas():
            _native.set_isa(isa)
            for threads in (1, 2, 5):
                _native.set_threads(threads)
                found.append(run(light, at, **how))
        assert len(found[0][0]) > 1000
        for other in found[1:]:
            assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_no_light() -> None:
    assert ramp(0, 0, 0) == ([], [])
    assert ramp(0, 0, 0, hold=True, eps=1e-9) == ([], [])


def test_constant_light() -> None:
    for value in (1e-30, 0.3, 1e30):
        assert ramp(value, value, value) == ([], [])
        assert ramp(value, value, value, tau_ns=50.0, refractory_ns=7) == ([], [])


def test_from_nothing_to_white_and_back() -> None:
    """Crossings at eps exp(k threshold), of light that is linear in time: no step, no error but the nanosecond."""
    eps, up, down, step = 1e-3, 0.2, 0.19, 1e6
    t, polarity = ramp(0, 1, 0, 0, eps=eps, up=up, down=down, step=step)
    peak = int(np.log((1 + eps) / eps) / up)
    rise = (eps * np.exp(up * np.arange(1, peak + 1)) - eps) * step
    top = up * peak
    fall = 2 * step - (eps * np.exp(top - down * np.arange(1, int(top / down) + 1)) - eps) * step
    assert polarity == [1] * len(rise) + [-1] * len(fall)
    assert (len(rise), len(fall)) == (34, 35)
    assert np.array_equal(t, np.floor(np.concatenate([rise, fall]) + 0.5))


def test_a_jump_of_a_million() -> None:
    up, down = int(np.log(1e6) / 0.2), int(0.2 * int(np.log(1e6) / 0.2) / 0.21)
    how = {"hold": True, "eps": 1e-12, "up": 0.2, "down": 0.21}
    assert ramp(1e-6, 1, 1e-6, **how) == ([1000] * up + [2000] * down, [1] * up + [-1] * down)
    assert ramp(1e-6, 1, 1e-6, **how, refractory_ns=3) == ([1000, 2000], [1, -1])
    assert (up, down) == (69, 65)


def test_too_many_events_are_refused_soon() -> None:
    """10^12 events would take an hour to count."""
    light = np.ones((2, 100, 1000), np.float32)
    light[1] = 1e6
    start = time.process_time()
    with pytest.raises(NumericsError) as told:
        run(light, np.array([0.0, 1e9]), up=1e-6, down=1e-6, eps=1e-9, most=100_000)
    assert time.process_time() - start < 20
    assert "over 100000" in str(told.value)
    light = light[:, :1, :1]
    n = len(run(light, np.array([0.0, 1e9]), up=0.01, down=0.01)[0])
    assert len(run(light, np.array([0.0, 1e9]), up=0.01, down=0.01, most=n)[0]) == n
    with pytest.raises(NumericsError):
        run(light, np.array([0.0, 1e9]), up=0.01, down=0.01, most=n - 1)


def test_refractory_longer_than_the_exposure() -> None:
    light, at = case(6, knots=9)
    t, x, y, _ = run(light, at, refractory_ns=10**9)
    assert len(set(zip(x, y, strict=True))) == len(t) == 24
    first = by_pixel(run(light, at))
    once = np.unique(first[2] * 6 + first[1], return_index=True)[1]
    assert np.array_equal(by_pixel((t, x, y, y))[0], first[0][once]), "the first event of each"


def test_events_keep_the_refractory_time_apart() -> None:
    """To the nanosecond, rounding included."""
    light, at = case(7, (8, 9), knots=20, span=100_000)
    for refractory in (1, 7, 250):
        t, x, y, _ = by_pixel(run(light, at, refractory_ns=refractory, up=0.01, down=0.01))
        same = (x[1:] == x[:-1]) & (y[1:] == y[:-1])
        gaps = np.diff(t)[same]
        assert gaps.min() == refractory, "a steep ramp fires again at once"


def test_the_reference_after_a_reset_is_the_light_at_its_end() -> None:
    """log2 light rises by 1 every 1000 ns up to knots; threshold 1, held for 1500 ns."""
    light = (1.0, 2.0, 4.0, 8.0, 16.0)
    t, _ = ramp(*light, eps=1e-12, up=LN2 * (1 - 1e-9), down=1.0, refractory_ns=1500)
    # at 1000 an event, free at 2500 where light is 6; 12 is reached at 3500, free after the end
    assert t == [1000, 3500]
    assert ramp(*light, eps=1e-12, up=LN2 * (1 - 1e-9), down=1.0)[0] == [1000, 2000, 3000]


def test_one_knot() -> None:
    assert ramp(0.5) == ([], [])
    assert ramp(0.5, hold=True) == ([], [])
    assert len(run(np.ones((1, 3, 3), np.float32), np.array([5.0]))[0]) == 0


def test_turning_at_a_threshold() -> None:
    """Light from 1 to 2 and back; thresholds of 1 bit, a hair less, a hair more."""
    how = {"eps": 1e-300, "down": LN2}
    assert np.exp(LN2) == 2.0
    assert ramp(1, 2, 1, 1, **how, up=LN2) == ([1000, 2000], [1, -1])
    assert ramp(1, 2, 1, 1, **how, up=LN2 * (1 + 1e-12)) == ([], [])
    below = LN2 * (1 - 1e-9)  # the reference is the level, not the peak: half of it lies a hair below 1
    assert ramp(1, 2, 1, 1, **how, up=below) == ([1000], [1])
    assert ramp(2, 1, 2, 2, **how, up=LN2) == ([1000, 2000], [-1, 1])


def test_a_threshold_at_a_knot() -> None:
    for middle in ([2.0], [2.0, 2.0], [2.0, 2.0, 2.0]):
        t, polarity = ramp(1, *middle, 2.5, eps=1e-300, up=LN2, down=LN2)
        assert (t, polarity) == ([1000], [1])


def test_a_threshold_at_the_end() -> None:
    assert ramp(1, 2, eps=1e-300, up=LN2, down=LN2) == ([], [])
    assert ramp(1, 2, 2, eps=1e-300, up=LN2, down=LN2) == ([1000], [1])


def test_the_ends_of_float32() -> None:
    tiny, huge = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
    for eps in (1e-300, 1e-3, 1e3):
        t, polarity = ramp(tiny, huge, 0, huge, eps=eps, up=1.0, down=1.0)
        assert t == sorted(t)
        assert t[0] >= 0
        assert t[-1] < 3000
        rises = int(np.log((huge + eps) / (tiny + eps)))
        assert polarity[:rises] == [1] * rises
        assert polarity[rises] == -1


def test_the_limits_of_the_photoreceptor() -> None:
    light, at = case(8)
    fast, none = run(light, at, tau_ns=1e-3), run(light, at)
    assert [c.tolist() for c in by_pixel(fast)[1:]] == [c.tolist() for c in by_pixel(none)[1:]]
    assert np.abs(by_pixel(fast)[0] - by_pixel(none)[0]).max() <= 1
    assert len(run(light, at, tau_ns=1e15)[0]) == 0


def test_a_photoreceptor_under_a_jump_is_an_exponential() -> None:
    """Light 1 to 5 at 1000 ns, tau 200: level 1 exp(0.2 k) at 1000 - 200 log((5 - level) / 4)."""
    t, _ = ramp(1, 5, hold=True, eps=1e-300, up=0.2, down=0.2, tau_ns=200.0, step=1e4)
    levels = np.exp(0.2 * np.arange(1, 9))
    assert np.array_equal(t, np.floor(1e4 - 200 * np.log((5 - levels) / 4) + 0.5))


def test_a_photoreceptor_that_turns_within_a_segment() -> None:
    """Its light rises on after the light has turned: the peak is met, then the way down."""
    light, at = case(9, (3, 5), knots=20, span=2000)
    assert agree(light, at, tau_ns=150.0, step_ns=0.5) > 50
    light = np.array([1, 9, 1, 1], np.float32).reshape(-1, 1, 1)
    assert agree(light, np.array([0.0, 500.0, 1000.0, 9000.0]), tau_ns=400.0, step_ns=0.25) > 10


@pytest.mark.parametrize("bad", [-1e-9, np.nan, np.inf])
def test_light_that_is_none(bad: float) -> None:
    light, at = case()
    light[2, 1, 3] = bad
    with pytest.raises(NumericsError, match="finite and not negative"):
        run(light, at)


def test_noise_resets_and_is_lost_in_reset() -> None:
    def noise(*rows: tuple[float, int]) -> dict[str, Any]:
        when, sign = zip(*rows, strict=True)
        return {"noise": (np.zeros(len(rows), np.int64), np.array(when), np.array(sign, np.int8))}

    still = (0.5, 0.5, 0.5)
    assert ramp(*still, **noise((700, 1), (30, -1))) == ([30, 700], [-1, 1]), "in any order"
    assert ramp(*still, **noise((30, -1), (30, 1))) == ([30, 30], [-1, 1])
    assert ramp(*still, **noise((30, -1), (99, 1), (130, 1)), refractory_ns=100) == ([30, 130], [-1, 1])
    assert ramp(*still, **noise((1000, 1), (1999.6, 1))) == ([1000], [1]), "2000 is the end"
    # 1 to 3 in 1000 ns, threshold 1 bit: 2 at 500; a noise event at 250 (light 1.5) moves the next level to 3
    more = {"eps": 1e-300, "up": LN2, "down": LN2}
    assert ramp(1, 3, 3, **more)[0] == [500]
    assert ramp(1, 3, 3, **more, **noise((250, 1)))[0] == [250, 1000]


def test_noise_among_the_oracles_events() -> None:
    light, at = case(10, (3, 4), span=6000)
    rng = np.random.default_rng(2)
    noise = rng.integers(0, 12, 40), rng.random(40) * 6e3, rng.choice(np.array([-1, 1], np.int8), 40)
    limits = thresholds((3, 4))
    mine = kernels.events(light, at, limits, hold=False, eps=0.01, noise=noise)
    true = oracles.events(light, at, limits, hold=False, eps=0.01, noise=noise, step_ns=0.25)
    a, b = by_pixel(mine), by_pixel(true)
    assert [c.tolist() for c in a[1:]] == [c.tolist() for c in b[1:]]
    assert np.abs(a[0] - b[0]).max() <= 5


@pytest.mark.parametrize(
    "wrong",
    [
        {"up": 0.0}, {"down": -0.2}, {"up": np.nan}, {"eps": 0.0}, {"eps": np.nan}, {"refractory_ns": -1},
        {"tau_ns": -1.0}, {"tau_ns": np.inf}, {"at": np.array([0.0, 1.0])}, {"hold": True},
        {"at": np.array([0.0, 2, 1, 3, 4])},
        {"at": np.array([0.0, 1, 2, 3, np.inf])}, {"noise": (np.array([24]), np.zeros(1), np.ones(1, np.int8))},
        {"noise": (np.array([-1]), np.zeros(1), np.ones(1, np.int8))},
        {"noise": (np.array([0]), np.full(1, np.nan), np.ones(1, np.int8))},
    ],
)  # fmt: skip
def test_numbers_that_do_not_fit(wrong: dict[str, Any]) -> None:
    light, at = case()
    with pytest.raises(UsageError):
        run(light, wrong.pop("at", at), **wrong)
