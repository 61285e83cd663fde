"""Scores and the commands: what is named, what is hashed, what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.images import read_image
from spikerig.dataset.store import open_scene, write_scene


@pytest.fixture(scope="module")
def trained(tiny, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    words = [
        "train",
        "fit",
        str(tiny),
        "-o",
        str(out),
        "--preset",
        "draft",
        "--steps",
        "60",
        "--splats",
        "800",
        "--ply",
    ]
    assert run(words) == 0
    return out


def told(capsys, *words: str, code: int = 0) -> dict:
    assert run([*words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_a_score_names_all_it_depends_on(tiny, trained, tmp_path, capsys):
    found = told(capsys, "train", "score", str(trained), "--pictures", str(tmp_path / "p"))
    assert found["schema"] == "spikerig.train.score/1"
    assert found["pose_label"] == "mid"
    assert found["background"] == [0, 0, 0]
    assert "8 bits" in found["rounding"]
    assert found["ssim_variant"].startswith("torchmetrics")
    assert found["scene_matches"]
    novel, blur = found["novel_view"], found["blur_view"]
    assert found["psnr"] == novel["psnr"] == novel["views"][0]["psnr"]
    assert len(blur["views"]) == 6
    assert blur["psnr"] == pytest.approx(np.mean([v["psnr"] for v in blur["views"]]))
    with open_scene(tiny) as scene:
        name = scene.test[0]
        sharp = np.clip(np.array(read_image(tmp_path / f"p/{name}.png")) / 255.0, 0, 1)
        from spikerig.dataset.images import srgb_from_linear

        truth = np.rint(np.clip(srgb_from_linear(np.clip(scene.truth_light(name), 0, 1)), 0, 1) * 255) / 255
    assert novel["psnr"] == pytest.approx(-10 * np.log10(np.mean((sharp - truth) ** 2)), abs=1e-6)
    again = told(capsys, "train", "score", str(trained))
    assert again["novel_view"]["predictions_sha256"] == novel["predictions_sha256"]
    assert again["novel_view"]["truth_sha256"] == novel["truth_sha256"]


def test_ssim_variants_by_name(trained, capsys):
    values = {v: told(capsys, "train", "score", str(trained), "--ssim", v)["ssim"] for v in ("tf", "inria")}
    assert values["tf"] != values["inria"]
    assert told(capsys, "train", "score", str(trained), "--ssim", "best", code=2)["error"]["type"] == "UsageError"


def test_without_truth_the_stored_frames_are_scored_and_named(tiny, trained, tmp_path, capsys):
    with open_scene(tiny) as file:
        scene = file.read()
    path = tmp_path / "real.h5"
    write_scene(path, replace(scene, truth=None))
    found = told(capsys, "train", "score", str(trained), str(path))
    assert "frames as stored" in found["novel_view"]["against"]
    assert found["blur_view"] is None
    assert not found["scene_matches"]
    write_scene(path, replace(scene, truth=None, views=tuple(v for v in scene.views if v.split == "train")), force=True)
    error = told(capsys, "train", "score", str(trained), str(path), code=4)["error"]
    assert "nothing to score" in error["what"]


def test_render_writes_the_held_out_views(trained, tmp_path, capsys):
    for kind in ("png", "exr"):
        folder = tmp_path / kind
        found = told(capsys, "train", "render", str(trained), "-o", str(folder), "--format", kind)
        picture = read_image(folder / found["pictures"][0])
        assert picture.shape == (40, 64, 3)
        assert picture.dtype == (np.uint8 if kind == "png" else np.float32)
    assert told(capsys, "train", "render", str(trained), "-o", str(tmp_path / "png"), code=2)["error"]["exit_code"] == 2


def test_a_shake_path_becomes_a_scene_again(trained, tmp_path, capsys):
    words = ["--path", "shake", "--format", "exr", "--subframes", "6", "--seed", "3"]
    told(capsys, "train", "render", str(trained), "-o", str(tmp_path / "shaken"), *words)
    told(capsys, "sim", "frames", str(tmp_path / "shaken"), "-o", str(tmp_path / "twin.h5"), "--workers", "1")
    out = str(tmp_path / "again")
    found = told(capsys, "train", "fit", str(tmp_path / "twin.h5"), "--method", "spike-hybrid", "--preset", "draft",
                 "--steps", "30", "--splats", "500", "-o", out)  # fmt: skip
    assert found["psnr"] > 12


def test_usage_faults_are_exit_2(tiny, tmp_path, capsys):
    out = str(tmp_path / "o")
    for words in (
        ["--method", "best"],
        ["--preset", "tiny"],
        ["--set", "warp=9"],
        ["--gray", "green"],
        ["--steps", "5", "--seconds", "5"],
        ["--threads", "0"],
    ):
        error = told(capsys, "train", "fit", str(tiny), "-o", out, *words, code=2)["error"]
        assert error["type"] == "UsageError", words
    assert not (tmp_path / "o").exists()


def test_cuda_without_a_gpu_is_exit_6(tiny, tmp_path, capsys):
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    error = told(capsys, "train", "fit", str(tiny), "-o", str(tmp_path / "o"), "--device", "cuda", code=6)["error"]
    assert error["type"] == "HostError"
