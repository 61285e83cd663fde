"""EDI: closed forms with known answers, the threshold found, scenes without what it needs refused."""

from dataclasses import replace

import numpy as np
import pytest

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.events import EventStream, no_events
from spikerig.dataset.images import linear_from_srgb, srgb_from_linear
from spikerig.dataset.store import open_scene, write_scene
from spikerig.dataset.texture import tfp
from spikerig.rigctl.sim.events import EventCamera, simulate_events
from spikerig.train.deblurred import deblurred, frame_light
from spikerig.train.edi import binned_ratio, exposure_ratio, searched, sharpened, sparsity
from spikerig.train.eventview import Thresholds, event_sums, instants, thresholds_of
from spikerig.train.methods import configure
from spikerig.train.metrics import psnr

TWICE = Thresholds(np.log(2), np.log(2), 0.0, "given")


def events(rows, height=1, width=2, span=(0, 1000), clock="rig") -> EventStream:
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    return EventStream(t, x, y, p, height, width, *span, clock)


def test_a_step_of_light_has_its_two_sides():
    """Light 1 for a quarter of the exposure, then 2: the mean is 1.75."""
    stream = events([(300, 1, 0, 1)])
    for at, light in ((200, 1), (299, 1), (300, 2), (599, 2), (600, 2)):
        found = exposure_ratio(stream, (200, 600), at, TWICE)
        np.testing.assert_allclose(found, [[1, light / 1.75]], rtol=1e-12)


def test_what_happened_outside_the_exposure_does_not_count():
    stream = events([(100, 0, 0, 1), (150, 0, 0, 1), (300, 0, 0, -1), (700, 0, 0, 1)])
    found = exposure_ratio(stream, (200, 600), 200, TWICE)
    np.testing.assert_allclose(found, [[1 / (0.25 + 0.75 / 2), 1]], rtol=1e-12)


def test_up_and_down_have_thresholds_of_their_own():
    stream = events([(250, 0, 0, 1), (500, 0, 0, -1)])
    found = exposure_ratio(stream, (0, 1000), 600, Thresholds(np.log(4), np.log(2), 0.0, "given"))
    np.testing.assert_allclose(found[0, 0], 2 / (0.25 * 1 + 0.25 * 4 + 0.5 * 2), rtol=1e-12)


def brute(stream, window, at, thresholds):
    """The double integral, a nanosecond at a time."""
    level = np.zeros((window[1] - window[0], stream.height, stream.width))
    for t, x, y, p in zip(stream.t_ns, stream.x, stream.y, stream.polarity, strict=True):
        if window[0] <= t < window[1]:
            level[t - window[0] :, y, x] += thresholds.up if p > 0 else -thresholds.down
    here = level[min(at, window[1] - 1) - window[0]]
    return 1 / np.exp(level - here).mean(0)


@pytest.mark.parametrize("at", [100, 350, 500, 799, 800])
def test_drawn_events_agree_with_the_integral_taken_ns_by_ns(at):
    rng = np.random.default_rng(at)
    n = 400
    t = np.sort(rng.integers(0, 1000, n))
    stream = EventStream(t, rng.integers(0, 7, n), rng.integers(0, 5, n), rng.choice([-1, 1], n), 5, 7, 0, 1000)
    thresholds = Thresholds(0.3, 0.2, 0.0, "given")
    found = exposure_ratio(stream, (100, 800), at, thresholds)
    np.testing.assert_allclose(found, brute(stream, (100, 800), at, thresholds), rtol=1e-10)


def test_the_binned_form_is_that_of_e2nerf():
    rng = np.random.default_rng(3)
    sums = rng.integers(-6, 7, (4, 3, 5))
    B, c = rng.uniform(0.1, 1, (3, 5)), 0.3
    total, level = np.ones((3, 5)), np.zeros((3, 5))
    for k in range(4):
        level = level + sums[k]
        total = total + np.exp(c * level)
    first = 5 * B / total
    same = Thresholds(c, c, 0.0, "given")
    np.testing.assert_allclose(B * binned_ratio(sums, 0, same), first, rtol=1e-12)
    second = first * np.exp(c * (sums[0] + sums[1]))
    np.testing.assert_allclose(B * binned_ratio(sums, 2, same), second, rtol=1e-12)


def test_a_ramp_of_light_is_found_within_half_a_threshold():
    """Light e^(2 t) over the exposure: log light is off by less than an event everywhere."""
    knots = np.arange(0, 401)
    light = np.exp(2 * knots / 400)[:, None, None].repeat(3, 2).astype(np.float32)
    stream = simulate_events(light, knots, 1e6, EventCamera(threshold_pos=0.02, threshold_neg=0.02, eps=1e-9))
    mean = float(light.mean())
    for at in (0, 100_000, 200_000, 400_000):
        found = exposure_ratio(stream, (0, 400_000), at, Thresholds(0.02, 0.02, 1e-9, "given"))
        np.testing.assert_allclose(np.log(found * mean), 2 * at / 400_000, atol=0.02)


def test_no_events_leave_the_picture_and_a_storm_stays_finite():
    np.testing.assert_array_equal(exposure_ratio(no_events(2, 3, 0, 900), (0, 900), 450, TWICE), np.ones((2, 3)))
    storm = events([(k, 0, 0, 1) for k in range(900)])
    for at in (0, 450, 900):
        found = exposure_ratio(storm, (0, 900), at, Thresholds(5.0, 5.0, 0.0, "given"))
        assert np.isfinite(found).all()
        assert (found > 0).all()
    with pytest.raises(UsageError, match="within an exposure"):
        exposure_ratio(storm, (100, 500), 501, TWICE)


def test_eps_is_part_of_the_light_that_events_see():
    light = np.array([[[0.1, 0.0, 0.4]]], np.float32)
    found = sharpened(light, np.array([[2.0]]), 0.05)
    np.testing.assert_allclose(found, [[[0.25, 0.05, 0.85]]], rtol=1e-6)
    assert sharpened(light, np.array([[0.1]]), 0.05).min() == 0


def test_sparsity_is_least_for_a_sharp_edge():
    step, ramp = np.zeros((9, 40)), np.tile(np.clip((np.arange(40.0) - 15) / 10, 0, 1), (9, 1))
    step[:, 20:] = 1
    ghost = step.copy()
    ghost[:, 17:20], ghost[:, 20:23] = -0.5, 1.5
    assert sparsity(step) < sparsity(ramp)
    assert sparsity(step) < sparsity(ghost)
    assert sparsity(np.ones((4, 4))) == 1


@pytest.mark.parametrize(("form", "least"), [("continuous", 5.0), ("binned", 4.0)])
def test_the_demos_frames_come_out_sharp(tiny, form, least):
    gains = []
    with open_scene(tiny) as scene:
        found = deblurred(scene, configure("edi", "draft", edi_form=form))
        assert found is not None
        assert found.about["thresholds"] == {"up": 0.2, "down": 0.2, "eps": 1e-3, "how": "recorded"}
        for name in scene.train:
            sharp = np.clip(srgb_from_linear(scene.truth_light(name)), 0, 1)
            frame = scene.view(name).frame.pixels / 255
            gains.append(psnr(np.clip(srgb_from_linear(found.light[name]), 0, 1), sharp) - psnr(frame, sharp))
    assert np.mean(gains) > least


def changed(tiny, tmp_path, events=lambda e: e, **of_scene):
    with open_scene(tiny) as file:
        scene = file.read()
    kept = {k: made for k, v in scene.events.items() if (made := events(v)) is not None}
    path = tmp_path / "changed.h5"
    write_scene(path, replace(scene, events=kept, **of_scene), force=True)
    return path


def test_a_threshold_that_nobody_knows_is_found(tiny, tmp_path):
    with open_scene(changed(tiny, tmp_path, info={})) as scene:
        config = configure("edi", "draft")
        assert thresholds_of(scene, config) is None
        found = searched(scene, config, lambda n: frame_light(scene.view(n)))
        assert found.up == found.down == pytest.approx(0.2, rel=0.4)
        assert found.how == "searched"
        given = thresholds_of(scene, configure("edi", "draft", event_pos=0.3, event_neg=0.25))
        assert given == Thresholds(0.3, 0.25, 0.0, "given")


def test_scenes_that_do_not_fit_are_refused(tiny, tmp_path):
    def refused(match, **changes):
        with open_scene(changed(tiny, tmp_path, **changes)) as scene, pytest.raises(DataError, match=match):
            deblurred(scene, configure("edi", "draft"))

    refused("have none", events=lambda e: None)
    refused("make no sense", info={"events": {"threshold_pos": -1, "threshold_neg": 0.2, "eps": 0.001}})
    refused("make no sense", info={"events": {"threshold_pos": float("1e300"), "threshold_neg": "x"}})
    refused("different clocks", events=lambda e: replace(e, clock="other"))
    refused("do not cover", events=lambda e: e.slice(e.t0_ns, (e.t0_ns + e.t1_ns) // 2))
    refused("no event threshold", events=lambda e: no_events(40, 64, e.t0_ns, e.t1_ns), info={})


def test_events_and_spikes_saw_the_same_light(tiny):
    """Where the events say that light changed by three thresholds or more, spikes changed the same way."""
    agree = []
    with open_scene(tiny) as scene:
        for name in scene.train:
            view = scene.view(name)
            begin, end = (view.instant_ns(p) for p in (0.0, 1.0))
            change = scene.events(name, begin, end).accumulate()
            first, last = (tfp(view.spikes, view.spikes.tick_at(t), 64).light for t in (begin, end))
            far = np.abs(change) >= 3
            agree.append(np.mean((np.sign(change) == np.sign(last - first))[far]))
    assert np.mean(agree) > 0.95


def test_mid_exposure_must_be_the_end_of_a_bin(tiny):
    with open_scene(tiny) as scene:
        with pytest.raises(UsageError, match="even edi_bins"):
            deblurred(scene, configure("edi", "draft", edi_form="binned", edi_bins=5))
        assert deblurred(scene, configure("edi", "draft", edi_form="binned", edi_bins=5, pose_label="first"))


def test_events_on_another_clock_are_mapped(tiny, tmp_path):
    late = 5_000_000
    clock = ClockModel(np.array([late]), np.array([0]), np.zeros(1))

    def moved(e):
        return replace(e, t_ns=e.t_ns + late, t0_ns=e.t0_ns + late, t1_ns=e.t1_ns + late, clock="device")

    with open_scene(tiny) as scene, open_scene(changed(tiny, tmp_path, events=moved, clock=clock)) as other:
        name = scene.train[0]
        np.testing.assert_array_equal(event_sums(scene, scene.view(name), 4), event_sums(other, other.view(name), 4))


def test_bins_share_the_exposure_and_nothing_else(tiny):
    with open_scene(tiny) as scene:
        view = scene.view(scene.train[0])
        stream = scene.events(view.name)
        begin, end = instants(scene, view, (0.0, 1.0), stream)
        assert (begin, end) == (view.frame.start_ns, view.frame.start_ns + view.frame.exposure_ns)
        sums = event_sums(scene, view, 4)
        np.testing.assert_array_equal(sums.sum(0), stream.accumulate(begin, end))
        quarter = begin + (end - begin) // 4
        np.testing.assert_array_equal(sums[0], stream.accumulate(begin, quarter))


def test_frames_are_decoded_by_their_transfer(tiny):
    with open_scene(tiny) as scene:
        view = scene.view(scene.train[0])
    np.testing.assert_allclose(frame_light(view), linear_from_srgb(view.frame.pixels / 255), rtol=1e-6)
    straight = replace(view, frame=replace(view.frame, transfer="linear"))
    np.testing.assert_allclose(frame_light(straight), view.frame.pixels / 255, rtol=1e-6)
