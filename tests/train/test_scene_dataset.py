"""The torch Dataset over a scene: what an item holds, in this process, in workers, and after pickling."""

import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hard_store import H, W, full_scene, path, stream
from torch.utils.data import DataLoader

from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.scene import Frame, Scene, Trajectory
from spikerig.dataset.store import write_scene
from spikerig.dataset.texture import tfi, tfp
from spikerig.train.scene_dataset import SceneDataset


def scene() -> Scene:
    """Views with 40 ticks at 40 kHz from 0 ns, exposed over ticks 10 to 30, moving."""
    whole = full_scene()
    moving = path(4, cov=False)
    views = []
    for i, view in enumerate(whole.views):
        frame = Frame(view.frame.pixels, ["srgb", "linear"][i % 2], 250_000, 500_000)
        spikes = None if i == 3 else replace(stream(40, i), t0_ns=0, lost=np.zeros((0, 2), int))
        trajectory = None if i == 1 else Trajectory(250_000 + np.arange(4) * 500_000 // 3, moving.poses)
        views.append(replace(view, frame=frame, spikes=spikes, trajectory=trajectory))
    return replace(whole, views=tuple(views))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_scene(tmp_path / "s.h5", scene())
    return tmp_path / "s.h5"


def test_an_item_holds_the_view_and_its_textures(file: Path) -> None:
    data = SceneDataset(file, textures=("tfp", "tfi"), window=8, instants=2)
    assert len(data) == 3
    item, view = data[2], scene().view("_b")
    assert view.spikes is not None
    assert view.trajectory is not None
    assert item["name"] == "_b"
    np.testing.assert_array_equal(item["image"], view.frame.pixels.astype(np.float32) / 255)
    np.testing.assert_array_equal(item["valid"], view.valid)
    np.testing.assert_array_equal(item["K"], scene().camera.K.astype(np.float32))
    np.testing.assert_array_equal(item["cam_from_world"], view.pose.cam_from_world.astype(np.float32))
    assert item["at_ns"].tolist() == [375_000, 625_000], "at 1/4 and 3/4 of the exposure"
    for k, tick in enumerate((15, 25)):
        for name, want in (("tfp", tfp(view.spikes, tick, 8)), ("tfi", tfi(view.spikes, tick))):
            np.testing.assert_array_equal(item[name][k], want.light)
            np.testing.assert_array_equal(item[f"{name}_known"][k], want.known)
    assert not item["tfi_known"].all()
    assert item["cam_from_world_at"].shape == (2, 3, 4)
    assert not torch.equal(item["cam_from_world_at"][0], item["cam_from_world_at"][1])
    assert "cam_from_world_at" not in data[1], "no trajectory: only mid-exposure is known"


def test_encodings_are_exact(file: Path) -> None:
    for encoding in ("srgb", "linear"):
        data = SceneDataset(file, "all", encoding=encoding)
        for i, view in enumerate(scene().views):
            codes = view.frame.pixels.astype(np.float64) / 255
            linear = linear_from_srgb(codes) if view.frame.transfer == "srgb" else codes
            got = data[i]["image"].double().numpy()
            np.testing.assert_allclose(linear_from_srgb(got) if encoding == "srgb" else got, linear, atol=1e-6)


def test_a_held_out_view_without_spikes_knows_nothing(file: Path) -> None:
    (item,) = list(SceneDataset(file, "test"))
    assert item["name"] == "Z9"
    assert item["tfp"].shape == (1, H, W)
    assert not item["tfp"].any()
    assert not item["tfp_known"].any()


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_give_the_same_items(file: Path, start: str) -> None:
    data = SceneDataset(file, instants=1)
    here = list(data)  # the parent's file is open when the workers start
    loader = DataLoader(data, batch_size=None, num_workers=1, multiprocessing_context=start)
    there = list(loader)
    assert [i["name"] for i in there] == [i["name"] for i in here]
    for a, b in zip(here, there, strict=True):
        assert a.keys() == b.keys()
        assert all(torch.equal(a[k], b[k]) for k in a if k != "name")


def test_another_process_opens_the_file_anew(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = SceneDataset(file)
    opened = data._scene()
    assert data._scene() is opened
    monkeypatch.setattr(os, "getpid", lambda: -1)  # as after a fork
    assert data._scene() is not opened


def test_it_pickles_without_its_open_file_and_collates(file: Path) -> None:
    data = SceneDataset(file)
    first = data[0]
    again = pickle.loads(pickle.dumps(data))
    assert torch.equal(again[0]["tfp"], first["tfp"])
    (batch,) = DataLoader(data, batch_size=3)
    assert batch["image"].shape == (3, H, W, 3)
    assert batch["cam_from_world_at"].shape == (3, 1, 3, 4)


def test_refusals(file: Path, tmp_path: Path) -> None:
    for wrong in ({"split": "val"}, {"textures": ("tfx",)}, {"encoding": "log"}, {"instants": 0}):
        with pytest.raises(UsageError):
            SceneDataset(file, **wrong)
    rolling = scene()
    views = tuple(replace(v, frame=replace(v.frame, row_ns=100)) for v in rolling.views)
    write_scene(tmp_path / "r.h5", replace(rolling, views=views))
    with pytest.raises(UsageError, match="rolling shutter"):
        SceneDataset(tmp_path / "r.h5")[0]
    with pytest.raises(IndexError):
        SceneDataset(file)[3]
