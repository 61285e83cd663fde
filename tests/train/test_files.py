"""Checkpoints and .ply files: exact round trips, and clear refusals of damaged ones."""

import numpy as np
import pytest
import torch

from spikerig.dataset.errors import DataError, UsageError
from spikerig.train import checkpoint
from spikerig.train.gauge import Gauge
from spikerig.train.ply import export_ply, import_ply
from spikerig.train.record import open_run
from spikerig.train.splat import Splats


def splats(degree: int = 1, n: int = 17) -> Splats:
    rng = np.random.default_rng(degree)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, (degree + 1) ** 2, 3))
    return Splats(*(torch.from_numpy(rng.standard_normal(s).astype(np.float32)) for s in shapes))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_in_any_gauge(tmp_path, degree):
    gauge = Gauge((3.0, -2.0, 0.5), 0.25)
    before = splats(degree)
    export_ply(tmp_path / "s.ply", before, gauge)
    after = import_ply(tmp_path / "s.ply", gauge)
    for name, tensor in before.tensors().items():
        assert torch.allclose(after.tensors()[name], tensor, atol=1e-6), name


def test_ply_is_the_standard_layout_in_world_units(tmp_path):
    one = splats(1, n=2)
    export_ply(tmp_path / "s.ply", one, Gauge((10.0, 0.0, 0.0), 2.0))
    head, body = (tmp_path / "s.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:18] == [f"f_rest_{k}" for k in range(9)]
    assert names[18:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    row = dict(zip(names, np.frombuffer(body, "<f4").reshape(2, -1)[0], strict=True))
    assert row["x"] == pytest.approx(one.means[0, 0].item() / 2 + 10)
    assert row["scale_1"] == pytest.approx(one.log_scales[0, 1].item() - np.log(2), abs=1e-6)
    assert row["f_rest_1"] == one.sh[0, 2, 0].item()  # red's second coefficient: channel by channel
    assert row["f_rest_3"] == one.sh[0, 1, 1].item()  # green's first


def test_an_existing_ply_is_kept(tmp_path):
    (tmp_path / "s.ply").write_text("mine")
    with pytest.raises(UsageError, match="exists"):
        export_ply(tmp_path / "s.ply", splats(), Gauge((0.0, 0.0, 0.0), 1.0))
    assert (tmp_path / "s.ply").read_text() == "mine"


@pytest.mark.parametrize("spoil", ["cut", "long", "text", "nan", "names", "count", "missing"])
def test_a_damaged_ply_is_told(tmp_path, spoil):
    path = tmp_path / "s.ply"
    export_ply(path, splats(), Gauge((0.0, 0.0, 0.0), 1.0))
    data = path.read_bytes()
    changed = {
        "cut": data[:-3],
        "long": data + b"xx",
        "text": b"hello",
        "nan": data[:-4] + b"\xff\xff\xff\x7f",
        "names": data.replace(b"opacity", b"opaqueX"),
        "count": data.replace(b"vertex 17", b"vertex 99999999999"),
    }
    if spoil == "missing":
        path.unlink()
    else:
        path.write_bytes(changed[spoil])
    with pytest.raises(DataError):
        import_ply(path, Gauge((0.0, 0.0, 0.0), 1.0))


def test_checkpoint_round_trip_and_refusals(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, splats().tensors(), {"step": 3, "bad": float("nan")})
    tensors, record = checkpoint.load(path)
    assert torch.equal(tensors["sh"], splats().sh)
    assert (record["step"], record["bad"]) == (3, None)
    assert not list(tmp_path.glob("*.partial"))
    data = path.read_bytes()
    for damage in (data[:50], data[:-7], b"\xff" * 64, b""):
        path.write_bytes(damage)
        with pytest.raises(DataError, match="checkpoint"):
            checkpoint.load(path)
    path.unlink()
    with pytest.raises(DataError, match="no checkpoint"):
        checkpoint.load(path)


def test_a_safetensors_file_of_others_is_not_a_checkpoint(tmp_path):
    from safetensors.torch import save_file

    save_file({"weight": torch.zeros(3)}, tmp_path / "c.safetensors")
    with pytest.raises(DataError, match="not a checkpoint of spikerig"):
        checkpoint.load(tmp_path / "c.safetensors")


def test_a_folder_without_a_run_is_told(tmp_path):
    with pytest.raises(DataError, match="no run here"):
        open_run(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(DataError, match="cannot be read"):
        open_run(tmp_path)
