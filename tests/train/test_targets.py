"""What a step is given: instants, textures in display units, masks, ratio targets, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError
from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.scene import Scene
from spikerig.dataset.store import open_scene, write_scene
from spikerig.dataset.texture import Texture
from spikerig.train.gauge import Gauge
from spikerig.train.methods import configure
from spikerig.train.metrics import psnr
from spikerig.train.spikelight import average_texture, spike_tick, windowed_tfi
from spikerig.train.targets import Targets, load_targets

UNIT = Gauge((0.0, 0.0, 0.0), 1.0)


def targets(path, method: str, **changes) -> Targets:
    with open_scene(path) as scene:
        return load_targets(scene, configure(method, "draft", **changes), UNIT)


def changed(tiny, tmp_path, **changes):
    """The tiny scene with its first view (or the scene itself) changed; returns the new file."""
    with open_scene(tiny) as file:
        scene: Scene = file.read()
    of_scene = {k: changes.pop(k) for k in ("clock", "light_gain", "truth", "info") if k in changes}
    views = (replace(scene.views[0], **changes), *scene.views[1:]) if changes else scene.views
    write_scene(tmp_path / "changed.h5", replace(scene, views=views, **of_scene))
    return tmp_path / "changed.h5"


def test_the_calibrated_converter_is_that_of_the_simulator(tiny):
    gray = targets(tiny, "spikenerf").gray
    assert gray is not None
    assert gray.white == pytest.approx(0.4)
    assert np.array(gray.weights) == pytest.approx([0.299, 0.587, 0.114], abs=0.02)
    assert gray.bias == pytest.approx(0.002 / 0.4, abs=0.003)


def test_a_tfs_target_is_the_sharp_gray_of_its_instant(tiny):
    found = targets(tiny, "spikenerf", textures="tfi-window")
    with open_scene(tiny) as scene:
        for view in found.views:
            (texture, weight), *more = view.instants[0.5].textures
            assert not more
            assert float(weight.sum()) == pytest.approx(1)
            gray = scene.truth_light(view.name) @ np.array([0.299, 0.587, 0.114])
            error = np.abs(texture.numpy() - srgb_from_linear(np.clip(gray, 0, 1)))
            assert np.median(error) < 0.025


def test_ratio_targets_are_sharper_than_the_frame_and_instants_differ(tiny):
    found = targets(tiny, "spike-ratio")
    assert found.ratio == pytest.approx((0.1, 0.3, 0.5, 0.7, 0.9))
    gains = []
    with open_scene(tiny) as scene:
        for view in found.views:
            sharp = np.clip(srgb_from_linear(scene.truth_light(view.name)), 0, 1)
            made = view.instants[0.5].ratio.float().numpy()
            gains.append(psnr(made, sharp) - psnr(view.frame.numpy(), sharp))
            assert not torch.equal(view.instants[0.1].ratio, view.instants[0.9].ratio)
    assert np.mean(gains) > 2


def test_the_oracle_sees_the_truth_at_its_own_instant(tiny):
    found = targets(tiny, "oracle")
    with open_scene(tiny) as scene:
        name = found.views[0].name
        assert found.views[0].frame.numpy() == pytest.approx(
            srgb_from_linear(np.clip(scene.truth_light(name), 0, 1)), abs=1e-6
        )
        assert found.views[0].instants[0.5].pose.numpy() == pytest.approx(
            scene.view(name).pose.cam_from_world, abs=1e-6
        )


def test_unknown_and_invalid_pixels_carry_no_weight(tiny, tmp_path):
    with open_scene(tiny) as scene:
        view = scene.view(scene.train[0])
    bits = np.array(view.spikes.bits)
    bits[:, 3:5] = 0  # two rows that never fire
    valid = np.array(view.valid)
    valid[:, :7] = False
    found = targets(changed(tiny, tmp_path, spikes=replace(view.spikes, bits=bits), valid=valid), "spikenerf",
                    textures="tfi").views[0]  # fmt: skip
    weight = found.instants[0.5].textures[0][1]
    assert not weight[3:5].any()
    assert not weight[:, :7].any()
    assert weight[10:, 10:].any()
    assert found.valid is not None


def test_spikes_on_another_clock_are_mapped_or_refused(tiny, tmp_path):
    with open_scene(tiny) as scene:
        view = scene.view(scene.train[0])
        middle = view.instant_ns(0.5)
        expected = spike_tick(view, middle, None)
    foreign = replace(view, spikes=replace(view.spikes, clock="vidar", t0_ns=view.spikes.t0_ns + 777_000))
    clock = ClockModel(np.array([777_000]), np.array([0]), np.zeros(1))
    assert spike_tick(foreign, middle, clock) == pytest.approx(expected)
    with pytest.raises(DataError, match="different clocks"):
        spike_tick(foreign, middle, None)


def test_a_windowed_tfi_of_steady_light_is_that_light():
    from spikerig.dataset.spikes import SpikeStream

    rates = np.array([0.9, 0.4, 0.11, 0.03])
    total = np.arange(1, 321)[:, None] * rates
    on = np.floor(total) > np.floor(total - rates)
    stream = SpikeStream(np.packbits(np.repeat(on[:, None], 2, 1), axis=2, bitorder="little"), 4, 40000.0)
    found = windowed_tfi(stream, 160, 24)
    assert found.known.all()
    assert found.light[0] == pytest.approx(rates, rel=0.12)


def test_what_a_method_lacks_is_told(tiny, tmp_path):
    with pytest.raises(DataError, match="no spikes"):
        targets(changed(tiny, tmp_path, spikes=None), "spikenerf")
    assert len(targets(tmp_path / "changed.h5", "plain").views) == 6


def test_no_trajectory_no_truth_no_training_views(tiny, tmp_path):
    path = changed(tiny, tmp_path, trajectory=None)
    with pytest.raises(DataError, match="no trajectory"):
        targets(path, "average")
    targets(path, "spikenerf")
    with pytest.raises(DataError, match="no trajectory"):
        targets(path, "plain", pose_label="first")
    with open_scene(tiny) as file:
        scene = file.read()
    write_scene(path, replace(scene, truth=None), force=True)
    with pytest.raises(DataError, match="sharp truth"):
        targets(path, "oracle")
    held_out = tuple(v for v in scene.views if v.split == "test")
    write_scene(path, replace(scene, truth=None, events={}, views=held_out), force=True)
    with pytest.raises(DataError, match="no training views"):
        targets(path, "plain")


def test_spikes_that_end_before_the_exposure_are_told(tiny, tmp_path):
    with open_scene(tiny) as scene:
        spikes = scene.view(scene.train[0]).spikes
    short = changed(tiny, tmp_path, spikes=replace(spikes, bits=spikes.bits[:200]))
    with pytest.raises(DataError, match="cover"):
        targets(short, "spikenerf")


def test_a_rolling_shutter_is_remarked(tiny, tmp_path):
    with open_scene(tiny) as scene:
        frame = scene.view(scene.train[0]).frame
    rolling = replace(frame, row_ns=100, start_ns=frame.start_ns - 100 * 20)
    assert "rolling" in targets(changed(tiny, tmp_path, frame=rolling), "plain").remarks[0]


def test_the_average_texture_is_over_those_that_know():
    one = Texture(np.array([[0.2, 0.4, 0.0]], np.float32), np.array([[True, True, False]]), 3.0, "tfp")
    two = Texture(np.array([[0.4, 0.0, 0.0]], np.float32), np.array([[True, False, False]]), 3.0, "tfi")
    light, known = average_texture([one, two])
    np.testing.assert_allclose(light, [[0.3, 0.4, 0.0]], rtol=1e-6)
    assert known.tolist() == [[True, True, False]]
