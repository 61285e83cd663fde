"""A scene as a torch Dataset: an item a view, with picture, camera, pose, and textures at instants of the exposure."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from spikerig.calib.straight import Straight, straight_of
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import linear_from_srgb, srgb_from_linear
from spikerig.dataset.scene import View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.store import SceneFile, open_scene
from spikerig.dataset.texture import Texture, tfi, tfp, tfp_adaptive
from spikerig.train.trajectory import phases, sub_pose

TEXTURES: dict[str, Callable[[SpikeStream, float, int], Texture]] = {
    "tfp": tfp,
    "tfi": lambda stream, at, _: tfi(stream, at),
    "tfi-causal": lambda stream, at, _: tfi(stream, at, causal=True),
    "tfp-adaptive": lambda stream, at, _: tfp_adaptive(stream, at),
}


class SceneDataset(Dataset[dict[str, Any]]):
    """Views of an RS-3D scene file as tensors; works in DataLoader workers, pickles without an open file.

    Args:
        path: of the scene.
        split: "train", "test" or "all".
        textures: any of tfp, tfi, tfi-causal, tfp-adaptive.
        window: ticks of a TFP window.
        instants: how many of each view's exposure, at (j + 1/2)/n of it.
        encoding: "srgb" for codes in [0, 1], "linear" for light.

    Returns:
        An item is a dict: name; image float32[H,W,3]; valid bool[H,W]; K float32[3,3]; cam_from_world float32[3,4] at
        mid-exposure; at_ns int64[n]; for each texture its light float32[n,H,W] (1.0 = a spike every tick) and, as
        NAME_known, bool[n,H,W]; cam_from_world_at float32[n,3,4] where the view has a trajectory or n is 1.

    Raises:
        UsageError: an unknown split, texture or encoding; a rolling-shutter frame (align the take first).
        DataError: the scene cannot be read.

    Edges:
        A view without spikes has light 0 and nothing known. The file is opened in each process on first use.
    """

    def __init__(
        self,
        path: str | Path,
        split: str = "train",
        textures: Sequence[str] = ("tfp", "tfi"),
        window: int = 32,
        instants: int = 1,
        encoding: str = "srgb",
    ) -> None:
        if split not in ("train", "test", "all") or encoding not in ("srgb", "linear"):
            raise UsageError(
                "no such split or encoding", value=(split, encoding), expected="train test all, srgb linear"
            )
        if strangers := set(textures) - TEXTURES.keys():
            raise UsageError("no such texture", value=sorted(strangers), expected=", ".join(TEXTURES))
        self.path, self.textures, self.window, self.encoding = Path(path), tuple(textures), window, encoding
        self.phases = phases(instants, "midpoints", "mid")
        self._file: SceneFile | None = None
        self._owner = 0
        with open_scene(self.path) as scene:
            self.straight = straight_of(scene) if self.textures else Straight()
            self.names = {"train": scene.train, "test": scene.test, "all": scene.names}[split]

    def __len__(self) -> int:
        return len(self.names)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_file": None, "_owner": 0}

    def _scene(self) -> SceneFile:
        if self._file is None or self._owner != os.getpid():  # a forked worker must not use its parent's handle
            self._file, self._owner = open_scene(self.path), os.getpid()
        return self._file

    def __getitem__(self, index: int) -> dict[str, Any]:
        scene = self._scene()
        view = scene.view(self.names[index])
        codes = view.frame.pixels.astype(np.float32) / view.frame.full
        if (view.frame.transfer, self.encoding) == ("srgb", "linear"):
            codes = linear_from_srgb(codes)
        elif (view.frame.transfer, self.encoding) == ("linear", "srgb"):
            codes = srgb_from_linear(codes)
        at_ns = [view.instant_ns(phase) for phase in self.phases]
        item: dict[str, Any] = {
            "name": view.name,
            "image": torch.from_numpy(np.asarray(codes, np.float32)),
            "valid": torch.from_numpy(np.array(view.valid)),
            "K": torch.tensor(scene.camera.K, dtype=torch.float32),
            "cam_from_world": torch.tensor(view.pose.cam_from_world, dtype=torch.float32),
            "at_ns": torch.tensor(at_ns),
        }
        if view.trajectory is not None or len(self.phases) == 1:
            poses = np.stack([sub_pose(view, phase) for phase in self.phases])
            item["cam_from_world_at"] = torch.tensor(poses, dtype=torch.float32)
        for name in self.textures:
            light, known = self._texture(view, name, at_ns)
            item[name], item[f"{name}_known"] = torch.from_numpy(light), torch.from_numpy(known)
        return item

    def _texture(self, view: View, name: str, at_ns: list[int]) -> tuple[np.ndarray, np.ndarray]:
        if view.spikes is None:
            shape = (len(at_ns), *view.valid.shape)
            return np.zeros(shape, np.float32), np.zeros(shape, bool)
        if view.frame.row_ns:
            raise UsageError(
                "the frame is of a rolling shutter: each row has its own instant",
                value=f"{self.path}: {view.name}, {view.frame.row_ns} ns a row",
                next="align the take first",
            )
        ticks = [view.spikes.tick_at(t) for t in at_ns]
        made = [self.straight.texture(TEXTURES[name](view.spikes, tick, self.window)) for tick in ticks]
        return np.stack([t.light for t in made]), np.stack([t.known for t in made])
