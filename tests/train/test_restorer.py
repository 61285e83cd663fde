"""A user's restorer: a small network trained here really sharpens; what is no restorer, or not trusted, is refused."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train import restorer, restorer_child
from spikerig.train.deblurred import frame_light
from spikerig.train.methods import configure
from spikerig.train.metrics import psnr
from spikerig.train.record import open_run, scene_hash
from spikerig.train.restorer import check_restorer, restore
from spikerig.train.run import run_fit
from spikerig.train.score import score_run

TRAINED = 4  # views that the network learns from; the others are held out


class Sharpener(nn.Module):
    """Three convolutions on top of the picture."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 16, (1, 11), padding=(0, 5), padding_mode="replicate"), nn.ReLU(),
            nn.Conv2d(16, 16, (1, 11), padding=(0, 5)), nn.ReLU(), nn.Conv2d(16, 3, (1, 5), padding=(0, 2)),
        )  # fmt: skip

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.layers(x)


class Middle(nn.Module):
    """A network of three pictures and their events: the middle one, a step brighter where events say so."""

    def forward(self, x: torch.Tensor, events: torch.Tensor) -> torch.Tensor:
        return (x[:, 1] + 0.001 * events[:, 1].sum(1, keepdim=True)).clamp(0.0, 1.0)


class Constant(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * 3.0


class Endless(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        k = 0
        while k >= 0:
            k = (k + 1) % 1000
        return x


def pairs(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Blurry and sharp codes [V,H,W,3] of a scene's training views."""
    with open_scene(path) as scene:
        blurry = [srgb_from_linear(frame_light(scene.view(name))) for name in scene.train]
        sharp = [np.clip(srgb_from_linear(scene.truth_light(name)), 0, 1) for name in scene.train]
    return np.stack(blurry).astype(np.float32), np.stack(sharp).astype(np.float32)


@pytest.fixture(scope="module")
def swept(tiny, tmp_path_factory) -> Path:
    """The tiny scene seen by a camera that always sweeps five pixels to the right: a blur that can be learned."""
    with open_scene(tiny) as file:
        scene = file.read()
        views = []
        for view in scene.views:
            if view.split == "train":
                light = np.pad(file.truth_light(view.name), ((0, 0), (2, 2), (0, 0)), mode="edge")
                mean = np.mean([light[:, k : k + 64] for k in range(5)], 0)
                view = replace(
                    view,
                    frame=replace(
                        view.frame, pixels=np.rint(255 * srgb_from_linear(np.clip(mean, 0, 1))).astype(np.uint8)
                    ),
                )
            views.append(view)
    path = tmp_path_factory.mktemp("swept") / "swept.h5"
    write_scene(path, replace(scene, views=tuple(views)))
    return path


@pytest.fixture(scope="module")
def trained(swept, tmp_path_factory) -> Path:
    """TorchScript of a network that learned from the first views."""
    torch.manual_seed(0)
    network = Sharpener()
    x, y = (torch.from_numpy(each[:TRAINED].transpose(0, 3, 1, 2)) for each in pairs(swept))
    x, y = (torch.cat([each, each.flip(2)]) for each in (x, y))
    adam = torch.optim.Adam(network.parameters(), 4e-3)
    for _ in range(400):
        adam.zero_grad()
        loss = (network(x) - y).square().mean()
        loss.backward()
        adam.step()
    path = tmp_path_factory.mktemp("network") / "sharpener.pt"
    torch.jit.script(network.eval()).save(str(path))
    return path


def config(path, method="mpr", **changes):
    return configure(method, "draft", **({"restorer": str(path), "trust": True, "splats": 600, "steps": 15} | changes))


def script(module: nn.Module, path: Path) -> Path:
    torch.jit.script(module).save(str(path))
    return path


def test_a_network_trained_here_sharpens_pictures_it_has_not_seen(swept, trained):
    blurry, sharp = pairs(swept)
    found, about = restore(blurry[TRAINED:], None, config(trained))
    assert found.shape == (2, 40, 64, 3)
    for before, after, truth in zip(blurry[TRAINED:], found, sharp[TRAINED:], strict=True):
        assert psnr(after, truth) > psnr(before, truth) + 2
    assert about["file"] == "sharpener.pt"
    network = torch.jit.load(str(trained))
    with torch.no_grad():
        direct = network(torch.from_numpy(blurry[TRAINED:].transpose(0, 3, 1, 2))).clamp(0, 1).numpy()
    np.testing.assert_allclose(found, direct.transpose(0, 2, 3, 1), atol=2e-6)


def test_a_fit_trains_on_what_it_restored_and_records_the_file(swept, trained, tmp_path):
    longer = {"splats": 800, "steps": 250}
    run_fit(swept, config(trained, **longer), tmp_path / "run", eval_every=0)
    run_fit(swept, configure("plain", "draft", **longer), tmp_path / "plain", eval_every=0)
    with open_scene(swept) as scene:
        sharper, plain = (score_run(open_run(tmp_path / n).model, scene)["blur_view"]["psnr"] for n in ("run", "plain"))
    assert sharper > plain + 0.5
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["deblurred"]["sha256"] == scene_hash(trained)
    assert record["deblurred"]["how"] == "restorer"
    run_fit(swept, config(trained, **longer), tmp_path / "run", resume=True, eval_every=0)  # the same file goes on
    other = script(Sharpener(), tmp_path / "other.pt")
    trained_bytes = trained.read_bytes()
    try:
        trained.write_bytes(other.read_bytes())
        with pytest.raises(DataError, match="not the restorer"):
            run_fit(swept, config(trained, **longer), tmp_path / "run", resume=True, eval_every=0)
    finally:
        trained.write_bytes(trained_bytes)


def test_an_exported_network_gets_neighbours_and_events(tiny, tmp_path):
    """torch.export, three frames, two bins; sizes that are no multiple of 16 are padded and cropped."""
    path = tmp_path / "middle.pt2"
    shapes = torch.zeros(1, 3, 3, 48, 64), torch.zeros(1, 3, 2, 48, 64)
    torch.export.save(torch.export.export(Middle(), shapes), str(path))
    blurry, _ = pairs(tiny)
    sums = np.random.default_rng(0).integers(-9, 10, (len(blurry), 2, 40, 64)).astype(np.float32)
    given = config(path, "d2net", restorer_bins=2, restorer_pad=16)
    found, about = restore(blurry, sums, given)
    expected = np.clip(blurry + 0.001 * sums.sum(1)[..., None], 0, 1)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (about["frames"], about["event_bins"]) == (3, 2)


def test_neighbours_are_the_views_before_and_after():
    assert restorer_child.around(0, 3, 6) == [0, 0, 1]
    assert restorer_child.around(4, 5, 6) == [2, 3, 4, 5, 5]
    assert restorer_child.around(2, 1, 6) == [2]
    made = torch.arange(3.0).reshape(1, 3, 1, 1, 1).expand(1, 3, 3, 2, 2)
    assert restorer_child.picture(made, 3)[0, 0, 0] == 1
    for strange in (made[0], made.expand(2, 3, 3, 2, 2), [made]):
        with pytest.raises((ValueError, TypeError)):
            restorer_child.picture(strange, 3)


def test_without_a_file_or_trust_nothing_runs_and_nothing_stands_in(tiny, trained, tmp_path):
    weights = tmp_path / "weights.bin"
    weights.write_bytes(b"state dict")
    for method in ("mpr", "d2net"):
        for given, kind, match in (
            ({"restorer": ""}, UsageError, "none is shipped"),
            ({"trust": False}, UsageError, "only when you say so"),
            ({"restorer": str(tmp_path / "gone.pt")}, DataError, "no restorer here"),
            ({"restorer": str(weights)}, DataError, "not a network that can run"),
        ):
            out = tmp_path / "run"
            with pytest.raises(kind, match=match):
                run_fit(tiny, config(trained, method, **given), out)
            assert not out.exists()


def test_what_a_restorer_does_wrong_is_told(tiny, trained, tmp_path, monkeypatch):
    blurry, _ = pairs(tiny)
    with pytest.raises(DataError, match="out of range"):
        restore(blurry, None, config(script(Constant(), tmp_path / "constant.pt")))
    with pytest.raises(DataError, match="does not take these pictures") as caught:
        restore(blurry, None, config(trained, restorer_frames=3))
    assert caught.value.cause
    monkeypatch.setattr(restorer, "sys", type("sys", (), {"executable": "/bin/false"}))
    with pytest.raises(DataError, match="does not take"):
        restore(blurry, None, config(trained))


def test_one_that_hangs_is_ended(tiny, tmp_path):
    blurry, _ = pairs(tiny)
    path = script(Endless(), tmp_path / "endless.pt")
    with pytest.raises(DataError, match="took too long"):
        restore(blurry[:1], None, config(path, restorer_limit_s=4.0))


def test_one_that_dies_or_leaves_nothing_is_told(tiny, trained, tmp_path, monkeypatch):
    blurry, _ = pairs(tiny)
    for body, match in (("kill -SEGV $$", "SIGSEGV"), ("exit 0", "left no pictures")):
        fake = tmp_path / "python"
        fake.write_text(f"#!/bin/sh\n{body}\n")
        fake.chmod(0o755)
        monkeypatch.setattr(restorer, "sys", type("sys", (), {"executable": str(fake)}))
        with pytest.raises(DataError) as caught:
            restore(blurry, None, config(trained))
        assert match in f"{caught.value.what} {caught.value.cause}"
    assert sys.executable


@pytest.mark.parametrize(
    ("made", "match"),
    [
        (np.zeros((2, 3, 8, 9), np.float32), "something else"),
        (np.zeros((2, 3, 8, 8), np.float64), "something else"),
        (np.full((2, 3, 8, 8), np.nan, np.float32), "not finite"),
        (np.full((2, 3, 8, 8), 200, np.float32), "out of range"),
        (np.full((2, 3, 8, 8), -0.9, np.float32), "out of range"),
    ],
)
def test_what_is_no_picture_is_refused(made, match):
    with pytest.raises(DataError, match=match):
        restorer._checked(made, (2, 3, 8, 8), Path("x.pt"))
    fine = np.full((2, 3, 8, 8), 1.2, np.float32)
    assert restorer._checked(fine, fine.shape, Path("x.pt")).max() == 1


def test_padding_mirrors_and_does_not_reach_beyond_the_picture():
    picture = np.arange(2 * 3 * 5, dtype=np.float32).reshape(1, 2, 3, 5)
    found = restorer._padded(picture, 4)
    assert found.shape == (1, 2, 4, 8)
    np.testing.assert_array_equal(found[..., :3, :5], picture)
    np.testing.assert_array_equal(found[..., 3, :5], picture[..., 1, :])
    with pytest.raises(UsageError, match="mirrored"):
        restorer._padded(picture, 16)


def test_a_trusted_path_is_told_to_need_no_more(trained):
    assert check_restorer(config(trained)) == trained
