"""The flat config: presets, methods, settings by name, and the readings of w."""

from dataclasses import replace

import pytest

from spikerig.dataset.errors import UsageError
from spikerig.train.config import FitConfig, effective_weight, from_json, parse_setting
from spikerig.train.methods import FIELDS, METHODS, configure


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("field", "preset"), [(field, p) for field, (_, presets) in FIELDS.items() for p in presets])
def test_every_method_goes_with_every_preset_of_every_field_and_survives_json(method, field, preset):
    config = configure(method, preset, field, steps=7)
    assert (config.method, config.preset, config.field, config.steps) == (method, preset, field, 7)
    assert from_json(config.as_json()) == config


def test_the_papers_preset_is_the_papers():
    config = configure("spikenerf", "paper", "nerf")
    assert (config.steps, config.rays, config.coarse, config.fine, config.width) == (200_000, 1024, 64, 128, 256)


@pytest.mark.parametrize(
    ("field", "preset", "changes", "told"),
    [
        ("splat", "paper", {}, "no such preset"),
        ("nerf-fast", "paper", {}, "no such preset"),
        ("cubes", "draft", {}, "no such field"),
        ("nerf", "draft", {"splats": 5}, "splats"),
        ("nerf", "draft", {"table_log2": 14}, "table_log2"),
        ("splat", "draft", {"rays": 64}, "rays"),
        ("nerf-fast", "draft", {"colour_loss": "l1ssim"}, "SSIM"),
        ("nerf-fast", "draft", {"fresh_poses": 1}, "fresh_poses"),
        ("nerf-fast", "draft", {"rays": 4, "views_per_step": 8}, "views_per_step"),
        ("nerf-fast", "draft", {"occupancy": 4096}, "occupancy"),
    ],
)
def test_what_a_field_cannot_do_is_refused(field, preset, changes, told):
    with pytest.raises(UsageError) as caught:
        configure("plain", preset, field, **changes)
    assert told in str(caught.value)


def test_all_faults_are_told_at_once():
    with pytest.raises(UsageError) as caught:
        FitConfig(gray="green", steps=0, lr_end=2.0, ratio_min=2.0)
    for part in ("gray is 'green'", "steps must", "lr_end must", "ratio_min"):
        assert part in str(caught.value)


def test_settings_by_name():
    assert parse_setting("antialias=true") == ("antialias", True)
    assert parse_setting("lr_means=1e-3") == ("lr_means", 1e-3)
    assert parse_setting("textures=tfp") == ("textures", "tfp")
    for wrong in ("lr_means", "nothing=1", "steps=many", "antialias=perhaps"):
        with pytest.raises(UsageError):
            parse_setting(wrong)
    with pytest.raises(UsageError) as caught:
        from_json({"steps": 3, "warp": 9})
    assert caught.value.value == "warp"


def test_the_readings_of_w_differ_by_what_the_equation_leaves_open():
    pixels = 400 * 250
    assert effective_weight(1e-4, "mean", pixels) == 1e-4
    assert effective_weight(1e-4, "sum-batch", pixels) == pytest.approx(0.1024)
    assert effective_weight(1e-4, "sum-image", pixels) == pytest.approx(10)
    assert effective_weight(1e-4, "u8", pixels) == pytest.approx(6.5, abs=0.01)


def test_what_a_method_needs():
    needs = {m: (configure(m).needs_spikes, configure(m).needs_trajectory) for m in METHODS}
    assert needs["plain"] == (False, False)
    assert needs["average"] == (False, True)
    assert needs["spikenerf"] == (True, False)
    assert needs["spike-ratio"] == (True, True)
    assert needs["oracle"] == (False, False)
    assert replace(configure("plain"), pose_label="first").needs_trajectory
