"""The process a restorer runs in: `python -m spikerig.train.restorer_child FILE FOLDER FRAMES DEVICE`.

Reads codes.npy (and sums.npy) of the folder, writes out.npy: float32[V,3,H,W], a picture a view.
"""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch


def network_of(path: Path, device: str) -> Any:
    """A TorchScript or torch.export file as something to call."""
    with zipfile.ZipFile(path) as archive:
        script = any("/code/" in name for name in archive.namelist())
    if script:
        return torch.jit.load(str(path), map_location=device).eval()
    return torch.export.load(str(path)).module().to(device)


def around(number: int, frames: int, count: int) -> list[int]:
    """The views before and after one, and itself in the middle; at an end the last is repeated."""
    half = frames // 2
    return [min(max(k, 0), count - 1) for k in range(number - half, number + half + 1)]


def picture(out: Any, frames: int) -> np.ndarray:
    """[3,H,W] of what a network gave: [1,3,H,W], or the middle one of [1,T,3,H,W]; never of a list."""
    if isinstance(out, list | tuple):
        raise TypeError("a list of pictures; wrap the network so that it returns the one that counts")
    out = out.detach().cpu().float()
    if out.ndim == 5 and out.shape[1] == frames:
        out = out[:, frames // 2]
    if out.ndim != 4 or len(out) != 1:
        raise ValueError(f"gives {list(out.shape)}, not [1,3,H,W] or [1,T,3,H,W]")
    return out[0].numpy()


def main(file: str, folder: str, frames: int, device: str) -> None:
    """Restore all pictures; torch on one thread, so that the bits do not depend on their number."""
    torch.set_num_threads(1)
    network, at = network_of(Path(file), device), Path(folder)
    codes = torch.from_numpy(np.load(at / "codes.npy", allow_pickle=False))
    sums = torch.from_numpy(np.load(at / "sums.npy", allow_pickle=False)) if (at / "sums.npy").exists() else None
    made = []
    with torch.no_grad():
        for number in range(len(codes)):
            which = around(number, frames, len(codes))
            inputs = [each[which][None] if frames > 1 else each[which] for each in (codes, sums) if each is not None]
            made.append(picture(network(*(x.to(device) for x in inputs)), frames))
    np.save(at / "out.npy", np.stack(made), allow_pickle=False)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4])
