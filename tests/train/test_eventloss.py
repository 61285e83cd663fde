"""E2NeRF's event loss: known answers, the published code, gradients, batches of pixels, refusals."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train.eventloss import EVENTS, lin_log, log_light, pair_loss
from spikerig.train.field import Step
from spikerig.train.fit import Task, new_state, view_loss
from spikerig.train.gauge import Gauge
from spikerig.train.losses import linear_from_srgb
from spikerig.train.methods import configure
from spikerig.train.run import prepare, run_fit
from spikerig.train.targets import load_targets, views_of_step

UNIT = Gauge((0.0, 0.0, 0.0), 1.0)


def one(value) -> torch.Tensor:
    return torch.tensor([[value]], dtype=torch.float64)


def loss(change, events, up=0.3, down=0.2, shift=0.5, hinge=0.0) -> float:
    return float(pair_loss(one(change), one(float(events)), one(up), one(down), one(1.0), shift=shift, hinge=hinge))


def test_known_answers_of_one_pixel():
    assert loss(0.3 * 4.5, 4) == pytest.approx(0)
    assert loss(-0.2 * 2.5, -2) == pytest.approx(0)
    assert loss(0.3 * 3, 4) == pytest.approx(1.5**2)
    assert loss(-0.2 * 4, -2) == pytest.approx(1.5**2)
    assert loss(0.3 * 4, 4, shift=0.0) == pytest.approx(0)


def test_pixels_without_events_cost_only_with_the_hinge():
    assert loss(5.0, 0) == 0
    assert loss(0.29, 0, hinge=2.0) == 0
    assert loss(-0.19, 0, hinge=2.0) == 0
    assert loss(0.6, 0, hinge=2.0) == pytest.approx(2 * 1)
    assert loss(-0.6, 0, hinge=2.0) == pytest.approx(2 * 2**2)
    assert loss(0.3 * 4.5, 4, hinge=2.0) == pytest.approx(0)


def test_lin_log_is_a_line_then_a_log_and_joins():
    at = torch.tensor([0.0, 10.0, 20.0, 20.0 + 1e-9, 255.0], dtype=torch.float64)
    expected = [0, math.log(20) / 2, math.log(20), math.log(20), math.log(255)]
    np.testing.assert_allclose(lin_log(at), expected, atol=1e-9)
    assert torch.isfinite(lin_log(torch.tensor([-3.0, 0.0]))).all()


@pytest.mark.parametrize("change", [-0.7, -0.05, 0.1, 0.9])
@pytest.mark.parametrize("events", [-2.0, 0.0, 3.0])
def test_gradients_on_both_sides_of_the_kinks(change, events):
    at = torch.tensor([[change]], dtype=torch.float64, requires_grad=True)
    fixed = (one(events), one(0.3), one(0.2), one(1.0))
    assert torch.autograd.gradcheck(lambda c: pair_loss(c, *fixed, shift=0.5, hinge=1.5), at)


@pytest.mark.parametrize("kind", ["linear", "encoded"])
def test_gradients_of_what_an_event_camera_sees(kind):
    picture = torch.tensor([[[0.02, 0.03, 0.05], [0.4, 0.6, 0.2]]], dtype=torch.float64, requires_grad=True)
    eps = torch.tensor(1e-3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda p: log_light(p, eps, kind), picture)
    black = torch.full((1, 1, 3), -0.01, requires_grad=True)
    (grad,) = torch.autograd.grad(log_light(black, eps.float(), kind).sum(), black)
    assert torch.isfinite(grad).all()


def test_linear_light_plus_eps_is_what_the_simulator_takes_the_log_of():
    picture = torch.full((1, 1, 3), 0.5)
    light = float(linear_from_srgb(torch.tensor(0.5)))
    assert float(log_light(picture, torch.tensor(0.02), "linear")) == pytest.approx(math.log(light + 0.02), rel=1e-6)


def published(all_rgb, event_data) -> float:
    """event_loss_call of E2NeRF, of every pixel: all_rgb [5,P,3] codes, event_data [4,P]."""
    gray = np.array([0.299, 0.587, 0.114])

    def log(rgb):
        x = rgb @ gray * 255
        return np.where(x <= 20, x * math.log(20) / 20, np.log(np.maximum(x, 1e-9)))

    losses = []
    for start, end in combinations(range(5), 2):
        change = log(all_rgb[end]) - log(all_rgb[start])
        current = sum(event_data[k] for k in range(start, end))
        pos, neg = current > 0, current < 0
        up = np.mean((change / 0.3 * pos - (current + 0.5) * pos) ** 2)
        down = np.mean((change / 0.2 * neg - (current - 0.5) * neg) ** 2)
        losses.append(up + down)
    return float(np.mean(losses))


def tiny_task(tiny, method="e2-5x", field="splat", **changes) -> tuple[Task, object]:
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, configure(method, "draft", field, **({"steps": 10} | changes)))
        return task, scene.points


def pictures_of(task, seed=0) -> dict[float, torch.Tensor]:
    rng = np.random.default_rng(seed)
    return {p: torch.from_numpy(rng.uniform(0, 1, (40, 64, 3)).astype(np.float32)) for p in task.targets.colour}


STEP = Step(0, 0.0, (0.0, 0.0, 0.0), np.random.default_rng(0))


def test_the_published_setting_is_the_published_loss(tiny):
    task, _ = tiny_task(tiny, event_light="encoded", average_domain="encoded", event_pos=0.3, event_neg=0.2)
    assert task.targets.colour == (0.0, 0.25, 0.5, 0.75, 1.0)
    view, drawn = task.targets.views[2], pictures_of(task)
    (found,) = EVENTS.loss(None, task, view, drawn, STEP)
    with open_scene(tiny) as scene:
        frame = scene.view(view.name).frame
        edges = frame.start_ns + np.arange(5) * frame.exposure_ns // 4
        sums = scene.events(view.name).bins(edges).reshape(4, -1)
    rgb = np.stack([drawn[p].numpy().reshape(-1, 3) for p in task.targets.colour])
    assert float(found) == pytest.approx(0.001 * published(rgb, sums), rel=1e-4)


def test_pictures_that_fit_the_events_cost_next_to_nothing(tiny):
    """Truth at the ends of the bins, unlike the mid-exposure picture at all of them."""
    task, _ = tiny_task(tiny, event_weight=1.0, event_shift=0.0)
    view = task.targets.views[0]
    up, _, eps = view.beside["thresholds"][0, 0].tolist()
    start = np.full((40, 64), 0.2)
    levels = np.concatenate([np.zeros((40, 64, 1)), np.cumsum(view.beside["events"].numpy(), -1)], -1)
    light = (start + eps)[..., None] * np.exp(up * levels) - eps
    code = torch.from_numpy(np.where(light <= 0.0031308, light * 12.92, 1.055 * light.clip(1e-9) ** (1 / 2.4) - 0.055))
    drawn = {p: code[..., k, None].expand(-1, -1, 3).float() for k, p in enumerate(task.targets.colour)}
    (found,) = EVENTS.loss(None, task, view, drawn, STEP)
    (flat,) = EVENTS.loss(None, task, view, dict.fromkeys(drawn, drawn[0.5]), STEP)
    assert float(found) < 1e-3
    assert float(flat) > 1


def test_pixels_that_are_not_valid_do_not_count(tiny):
    task, _ = tiny_task(tiny)
    view, drawn = task.targets.views[0], pictures_of(task)
    half = torch.zeros(40, 64, dtype=torch.bool)
    half[:, :20] = True
    (found,) = EVENTS.loss(None, task, replace(view, valid=half), drawn, STEP)
    left = replace(view, beside={n: t[:, :20] for n, t in view.beside.items()})
    (expected,) = EVENTS.loss(None, task, left, {p: d[:, :20] for p, d in drawn.items()}, STEP)
    assert float(found) == pytest.approx(float(expected), rel=1e-5)


def test_a_batch_of_all_pixels_is_the_picture(tiny):
    task, _ = tiny_task(tiny, field="nerf-fast", rays=64 * 40, views_per_step=1)
    batch = task.field.look(task.targets, task.camera, task.config, 3, np.random.default_rng(1))
    whole = views_of_step(task.targets, task.config.seed, 3)[0]
    drawn = pictures_of(task)
    taken = {p: d.reshape(-1, 3)[batch.pixels][:, None] for p, d in drawn.items()}
    count = np.bincount(batch.pixels.numpy(), minlength=64 * 40).reshape(40, 64)
    (found,) = EVENTS.loss(None, task, batch, taken, STEP)
    expected = 0.0
    for k in range(0, count.max()):  # a pixel that was drawn n times counts n times
        mask = torch.from_numpy(count > k)
        (some,) = EVENTS.loss(None, task, replace(whole, valid=mask), drawn, STEP)
        expected += float(some) * int(mask.sum()) / count.sum()
    assert float(found) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("domain", ["linear", "encoded"])
def test_the_exposed_picture_is_the_average_of_its_domain(tiny, domain):
    task, points = tiny_task(tiny, event_weight=0.0, average_domain=domain, colour_loss="l2")
    state = new_state(points, task)
    view = task.targets.views[0]
    with torch.no_grad():
        found = float(view_loss(state, task, view, STEP))
        model = task.model(state)
        drawn = [task.field.draw(model, view, view.instants[p].pose, STEP)[0] for p in task.targets.colour]
        if domain == "encoded":
            mean = torch.stack(drawn).mean(0)
        else:
            light = torch.stack([linear_from_srgb(d) for d in drawn]).mean(0)
            mean = torch.where(light <= 0.0031308, light * 12.92, 1.055 * light.clamp(min=1e-9) ** (1 / 2.4) - 0.055)
    assert found == pytest.approx(float((mean - view.frame).square().mean()), rel=1e-4)


def test_events_make_e2nerf_sharper(tiny, tmp_path):
    found = [
        run_fit(tiny, configure("e2-2x", "draft", splats=800, steps=200, event_weight=w), tmp_path / str(w),
                eval_every=0)["psnr"]
        for w in (0.0, 0.001)
    ]  # fmt: skip
    assert found[1] > found[0] + 0.3


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"poses_per_view": 1}, "two sub-poses"),
        ({"instants_rule": "midpoints"}, "endpoints"),
        ({"fresh_poses": 1}, "fresh_poses"),
        ({"event_pos": 0.3}, "both or not"),
        ({"event_weight": -1.0}, "event_weight"),
        ({"average_domain": "encoded", "fresh_poses": 2}, "linear light"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, match):
    with pytest.raises(UsageError) as caught:
        configure("e2-5x", "draft", **changes)
    assert match in str(caught.value)


def test_scenes_without_events_or_thresholds_are_refused(tiny, tmp_path):
    with open_scene(tiny) as file:
        scene = file.read()
    write_scene(tmp_path / "unknown.h5", replace(scene, info={}))
    write_scene(tmp_path / "none.h5", replace(scene, events={}))
    for name, match in (("unknown", "at which thresholds"), ("none", "have none")):
        with open_scene(tmp_path / f"{name}.h5") as changed, pytest.raises(DataError, match=match) as caught:
            load_targets(changed, configure("e2-5x", "draft"), UNIT)
        assert caught.value.next
    with open_scene(tmp_path / "unknown.h5") as changed:
        found = load_targets(changed, configure("e2-5x", "draft", event_pos=0.25, event_neg=0.2), UNIT)
    assert found.views[0].beside["thresholds"][3, 4].tolist() == pytest.approx([0.25, 0.2, 0.0])
