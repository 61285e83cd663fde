"""Textures by their definitions, written out as loops here, and what they say where nothing is known."""

import cv2
import numpy as np
import pytest

from spikerig.dataset import kernels, texture
from spikerig.dataset.errors import UsageError
from spikerig.dataset.spikes import SpikeStream, open_spikes


def stream(*trains, ticks=None, lost=()):
    """A stream of one row: pixel i spikes at ticks trains[i]."""
    ticks = ticks or 1 + max((max(t) for t in trains if t), default=0)
    pixels = np.zeros((ticks, 1, len(trains)), np.uint8)
    for i, train in enumerate(trains):
        pixels[list(train), 0, i] = 1
    return SpikeStream(
        np.packbits(pixels, axis=2, bitorder="little"), len(trains), lost=np.array(lost, np.int64).reshape(-1, 2)
    )


@pytest.fixture(scope="module")
def random_stream():
    rng = np.random.default_rng(4)
    pixels = (rng.random((90, 5, 11)) < rng.random((5, 11)) ** 2).astype(np.uint8)
    return SpikeStream.from_pixels(pixels), pixels


@pytest.mark.parametrize("window", [1, 2, 5, 6, 40, 41, 200])
def test_tfp_is_the_count_over_the_part_of_the_window_inside(random_stream, window):
    s, pixels = random_stream
    for at in (0, 0.99, 1, 44, 44.5, 89, 89.999):
        made = texture.tfp(s, at, window)
        inside = [t for t in range(int(at) - window // 2, int(at) - window // 2 + window) if 0 <= t < 90]
        assert np.array_equal(made.light, (pixels[inside].sum(0) / len(inside)).astype(np.float32)), at
        assert made.known.all()


def test_tfp_window_centre_rule():
    assert texture.tfp_window(10, 1) == (10, 11)
    assert texture.tfp_window(10, 5) == (8, 13)  # tick 10 in the middle
    assert texture.tfp_window(10, 4) == (8, 12)  # the start of tick 10 in the middle
    assert texture.tfp_window(10.9, 4) == (8, 12)  # an instant means the tick it lies in


def test_tfp_of_an_empty_window_is_not_known():
    made = texture.tfp(stream((0, 3)), 4, 1)  # T = 4: the window [4, 5) lies outside
    assert not made.known.any()
    assert not made.light.any()


def test_window_sum_is_raw(random_stream):
    s, pixels = random_stream
    assert np.array_equal(texture.window_sum(s, 3, 50), pixels[3:50].sum(0))
    assert texture.window_sum(s, 3, 50).dtype == np.uint32


def by_the_book(train, t, k, causal):
    """TFI of one pixel, from the sorted list of its spikes."""
    before, after = [b for b in train if b < t], [b for b in train if b >= t]
    past, future = (k, 0) if causal else (k // 2 + 1, (k + 1) // 2)
    if len(before) < past or len(after) < future:
        return None
    a, b = before[-past], t if causal else after[future - 1]
    return k / (b - a)


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("k", [1, 2, 3, 4, 7])
def test_tfi_by_the_book(random_stream, k, causal):
    s, pixels = random_stream
    for t in (0, 1, 7, 45, 88, 90):
        made = texture.tfi(s, t, causal=causal, intervals=k)
        for y in range(5):
            for x in range(11):
                expect = by_the_book(pixels[:, y, x].nonzero()[0].tolist(), t, k, causal)
                assert made.known[y, x] == (expect is not None), (t, y, x)
                assert made.light[y, x] == np.float32(expect or 0), (t, y, x)


def test_a_spike_at_the_instant_ends_the_interval():
    s = stream((2, 5, 9), ticks=12)
    assert texture.tfi(s, 5).light[0, 0] == np.float32(1 / 3)  # (2, 5] holds tick 5
    assert texture.tfi(s, 6).light[0, 0] == np.float32(1 / 4)
    assert texture.tfi(s, 5, causal=True).light[0, 0] == np.float32(1 / 3)
    assert texture.tfi(s, 6, causal=True).light[0, 0] == 1.0


def test_tfi_all_is_tfi_at_every_tick(random_stream):
    s, _ = random_stream
    every = kernels.tfi_all(s.bits, s.width)
    for t in range(s.ticks):
        made = texture.tfi(s, t)
        assert np.array_equal(made.known, every[t] > 0)
        assert np.array_equal(made.light[made.known], (1 / every[t][made.known]).astype(np.float32))


def test_dark_and_saturated_pixels_are_finite_and_honest():
    s = stream((), range(50), (10,), ticks=50)
    for made in (texture.tfi(s, 25), texture.tfi(s, 25, causal=True), texture.tfi(s, 25, intervals=3)):
        assert np.isfinite(made.light).all()
        assert not made.known[0, 0]  # no spike: not known, not black
        assert made.known[0, 1]
        assert made.light[0, 1] == 1.0 or made.method == "tfi-causal"
    counted = texture.tfp(s, 25, 41)
    assert counted.known.all()
    assert counted.light[0].tolist() == [0.0, 1.0, np.float32(1 / 41)]


def test_causal_tfi_has_the_bias_its_docstring_states():
    interval = 10
    s = stream(range(0, 200, interval))
    causal = [float(texture.tfi(s, t, causal=True).light[0, 0]) for t in range(50, 150)]
    enclosing = [float(texture.tfi(s, t).light[0, 0]) for t in range(50, 150)]
    assert np.mean(enclosing) == pytest.approx(1 / interval)
    assert np.mean(causal) * interval == pytest.approx(sum(1 / d for d in range(1, interval + 1)), rel=1e-6)
    assert np.mean(causal) * interval == pytest.approx(2.929, abs=1e-3)


def test_lost_ticks_make_textures_unknown_where_they_touch():
    s = stream(range(0, 40, 4), range(0, 40, 13), lost=[(14, 16), (30, 31)], ticks=40)
    assert texture.tfp(s, 10, 8).known.all()  # [6, 14)
    assert not texture.tfp(s, 11, 8).known.any()  # [7, 15)
    assert texture.tfp(s, 20, 8).known.all()  # [16, 24)
    assert texture.tfi(s, 10).known.tolist() == [[True, True]]  # (8, 12], (0, 13]
    assert texture.tfi(s, 13).known.tolist() == [[False, True]]  # (12, 16] holds 14, 15; (0, 13] does not
    assert texture.tfi(s, 13, causal=True).known.tolist() == [[True, True]]
    assert texture.tfi(s, 18, causal=True).known.tolist() == [[True, False]]  # after 16; after 13
    assert texture.tfi(s, 18).light[0].tolist() == [0.25, 0.0]
    adaptive, chosen, known = texture.adaptive_windows(s, 10, (4, 8, 16))
    assert known.all()
    assert chosen.max() == 8  # [2, 18) holds lost ticks
    assert not texture.tfp_adaptive(s, 15, windows=(4, 8)).known.any()
    assert np.isfinite(adaptive).all()


def test_instants_and_arguments_that_make_no_sense():
    s = stream((1, 2, 3))
    for call in (
        lambda: texture.tfp(s, -0.5, 4),
        lambda: texture.tfp(s, 4.5, 4),
        lambda: texture.tfp(s, float("nan"), 4),
        lambda: texture.tfp(s, 1, 0),
        lambda: texture.tfi(s, 1, intervals=0),
        lambda: texture.tfp_adaptive(s, 1, windows=(8, 8)),
        lambda: texture.tfp_adaptive(s, 1, windows=()),
        lambda: texture.tfp_adaptive(s, 1, margin=0),
        lambda: texture.window_sum(s, 2, 5),
    ):
        with pytest.raises(UsageError):
            call()


def test_textures_are_read_only_and_say_what_they_are(random_stream):
    made = texture.tfi(random_stream[0], 30, intervals=3)
    assert made.method == "tfi-3"
    assert made.light.dtype == np.float32
    assert not made.light.flags.writeable
    dark = texture.tfi(stream((), (0, 5)), 3)
    assert np.isnan(dark.with_nan()[0, 0])
    assert dark.with_nan()[0, 1] == np.float32(0.2)


def moving_edge(speed, seed=0):
    """An edge from 0.1 to 0.5 that passes a 48x256 sensor: (stream, light at tick 300, pixels within 8 of the edge)."""
    height, width, ticks = 48, 256, 600
    x = np.arange(width) + 0.5

    def light(tick):
        return 0.1 + 0.4 * np.clip(x - width * 0.4 - speed * (tick - 300) + 0.5, 0, 1)

    knots = np.arange(0, ticks + 1, 2)
    rows = np.array([np.broadcast_to(light(t), (height, width)) for t in knots], np.float32)
    charge = np.random.default_rng(seed).integers(0, 2**32, (height, width), dtype=np.uint32)
    bits, _, _ = kernels.fire(rows, knots, charge, hold=False)
    return SpikeStream(bits, width), np.broadcast_to(light(300), (height, width)), np.abs(x - width * 0.4) < 8


@pytest.mark.parametrize("speed", [0.02, 0.05, 0.1])
def test_adaptive_windows_beat_every_fixed_one(speed):
    s, truth, edge = moving_edge(speed)

    def errors(made):
        square = (made.light - truth) ** 2
        return np.sqrt([square.mean(), square[:, edge].mean(), square[:, ~edge].mean()])

    fixed = np.array([errors(texture.tfp(s, 300, w)) for w in texture.WINDOWS])
    adaptive = errors(texture.tfp_adaptive(s, 300))
    assert np.all(adaptive[0] < 0.8 * fixed[:, 0])  # over all pixels, against every window
    assert adaptive[1] < 1.3 * fixed[:, 1].min()  # at the edge as the best short window
    assert adaptive[2] < 1.3 * fixed[:, 2].min()  # in flat areas as the best long one
    worst = texture.WINDOWS[int(fixed[:, 1].argmin())], texture.WINDOWS[int(fixed[:, 2].argmin())]
    assert worst[0] < worst[1]  # no fixed window does both


def test_adaptive_window_grows_to_the_longest_in_steady_light():
    light = np.broadcast_to(np.linspace(0.003, 0.997, 64, dtype=np.float32), (1, 8, 64))
    for phase in (0, 2**31, 2**32 - 1):  # a sensor that starts in step is no exception
        bits, _, _ = kernels.fire(light, np.array([0, 512]), np.full((8, 64), phase, np.uint32), hold=True)
        for at in (200, 256, 301):
            mean, chosen, _ = texture.adaptive_windows(SpikeStream(bits, 64), at)
            assert np.all(chosen == 256)
            assert np.abs(mean - light[0]).max() < 1 / 256


@pytest.mark.real
def test_reds_sample_has_the_bit_order_and_row_order_of_a_vidar(shared_data):
    truth = cv2.imread(str(shared_data("spike/sim_reds_200.gt.png")), cv2.IMREAD_GRAYSCALE).astype(np.float64)
    with open_spikes(shared_data("spike/sim_reds_200.dat")) as file:
        s = file.read()

    def alike(made):
        return np.corrcoef(made.light.ravel(), truth.ravel())[0, 1]

    assert s.bits.shape == (301, 250, 50)
    assert alike(texture.tfp(s, 150, 41)) >= 0.985
    reversed_bits = np.packbits(np.unpackbits(s.bits, axis=2, bitorder="big"), axis=2, bitorder="little")
    wrong = alike(texture.tfp(SpikeStream(reversed_bits, 400), 150, 41))
    assert 0.9 < wrong < 0.97  # looks fine, is wrong: only the threshold above tells
    assert alike(texture.tfp(SpikeStream(s.bits[:, ::-1], 400), 150, 41)) < 0.2
    assert alike(texture.tfp_adaptive(s, 150, margin=0.75)) >= 0.985


@pytest.mark.real
def test_real_low_light_archive_is_its_plain_mean(shared_data):
    path = shared_data("spike/real_uhsr.npz")
    with np.load(path, allow_pickle=False) as data:
        plain = data["spk"].astype(np.float64).mean(0)
    with open_spikes(path, axes="THW") as file:
        s = file.read()
    assert s.bits.shape == (200, 250, 32)
    assert np.array_equal(texture.tfp(s, 100, 200).light, plain.astype(np.float32))
    assert plain.mean() == pytest.approx(0.031, abs=0.001)
