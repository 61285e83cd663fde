"""Scores across worlds: a similarity from training cameras alone, alignment kept apart, nerfbaselines' layout."""

import base64
import hashlib
import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from spikerig.calib.gauge import Similarity, similarity
from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, NumericsError
from spikerig.dataset.images import read_image
from spikerig.dataset.rigid import compose, exp_se3
from spikerig.dataset.scene import Pose
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train import metrics
from spikerig.train.bridge import bridge
from spikerig.train.methods import configure
from spikerig.train.model import SplatModel
from spikerig.train.nerfbaselines import write_results
from spikerig.train.realign import realign, twist_gradient
from spikerig.train.record import open_run
from spikerig.train.run import run_fit
from spikerig.train.score import grade, novel_views

TURN = exp_se3(np.array([0.3, -1.1, 0.4, 0, 0, 0]))[:, :3]
ELSEWHERE = Similarity(2.5, TURN, np.array([1.0, -4.0, 0.5]))
NUDGE = np.array([0.010, -0.012, 0.004, 0.01, 0.0, -0.01])  # under a pixel of 64x40


@pytest.fixture(scope="module")
def oracle(tiny, tmp_path_factory):
    out = tmp_path_factory.mktemp("worlds") / "run"
    run_fit(tiny, configure("oracle", "draft", steps=250, splats=800), out, eval_every=0)
    return out


def told(capsys, *words, code: int = 0) -> dict:
    assert run([*map(str, words), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def score(capsys, *words, code: int = 0) -> dict:
    return told(capsys, "train", "score", *words, code=code)


def moved(tiny, path, *, held_out=None, train=None, truth=True):
    """The tiny scene in another world; held-out poses nudged by a twist, training poses by one each."""
    with open_scene(tiny) as file:
        scene = file.read()
    rng, views = np.random.default_rng(3), []
    for view in scene.views:
        pose = view.pose.cam_from_world
        if held_out is not None and view.split == "test":
            pose = compose(exp_se3(held_out), pose)
        if train is not None and view.split == "train":
            pose = compose(exp_se3(rng.normal(0, train, 6)), pose)
        pose = ELSEWHERE.poses(pose[None])[0]
        views.append(replace(view, pose=Pose(pose), trajectory=None))
    light = replace(scene.truth, trajectories={}, at_ns={}) if truth else None
    write_scene(path, replace(scene, views=tuple(views), truth=light, points=None))
    return path


def test_another_world_is_brought_over_and_gives_the_same_scores(tiny, oracle, tmp_path, capsys):
    here = score(capsys, oracle, "--align-steps", "0")
    there = score(capsys, oracle, moved(tiny, tmp_path / "there.h5"), "--align-steps", "0")
    assert here["worlds"]["same_world"]
    assert not there["worlds"]["same_world"]
    assert there["worlds"]["fitted_on"] == "training cameras only"
    assert there["worlds"]["training_cameras"] == 6
    assert there["worlds"]["scale"] == pytest.approx(1 / 2.5)
    assert there["novel_view"]["psnr"] == pytest.approx(here["novel_view"]["psnr"], abs=1e-3)
    assert there["blur_view"]["psnr"] == pytest.approx(here["blur_view"]["psnr"], abs=0.3)
    assert here["novel_view_aligned"] is None


def test_held_out_cameras_take_no_part_in_the_similarity(tiny, oracle, tmp_path, capsys):
    exact = score(capsys, oracle, moved(tiny, tmp_path / "a.h5"), "--align-steps", "0")
    nudged = score(capsys, oracle, moved(tiny, tmp_path / "b.h5", held_out=10 * NUDGE), "--align-steps", "0")
    assert nudged["worlds"] == exact["worlds"]
    assert nudged["psnr"] < exact["psnr"] - 3


def test_raw_and_aligned_scores_are_both_there_and_apart(tiny, oracle, tmp_path, capsys):
    exact = score(capsys, oracle, "--align-steps", "0")
    path = moved(tiny, tmp_path / "nudged.h5", held_out=NUDGE)
    found = score(capsys, oracle, path)
    raw, aligned = found["novel_view"], found["novel_view_aligned"]
    assert found["psnr"] == raw["psnr"]
    assert raw["psnr"] < exact["psnr"] - 1
    assert aligned["psnr"] > exact["psnr"] - 0.1
    assert aligned["views"][0]["moved_px"] > 0.3
    assert "not comparable" in aligned["how"]
    assert raw["predictions_sha256"] != aligned["predictions_sha256"]
    assert score(capsys, oracle, path, "--align-steps", "0")["novel_view"] == raw


def test_estimates_in_the_same_file_meet_its_true_held_out_poses(tiny, tmp_path, capsys):
    """As `calib poses --write` leaves it: estimated training poses, and a truth that knows the real ones."""
    with open_scene(tiny) as file:
        scene = file.read()
    views = []
    for v in scene.views:
        pose = v.pose.cam_from_world  # a held-out pose as stored may be anything: the truth knows better
        off = compose(exp_se3(20 * NUDGE), pose) if v.split == "test" else ELSEWHERE.poses(pose[None])[0]
        views.append(replace(v, pose=Pose(off), trajectory=None))
    rgb_points = replace(scene.points, xyz=ELSEWHERE.points(scene.points.xyz))
    written = replace(scene, views=tuple(views), points=rgb_points, info={**scene.info, "poses": {"versions": {}}})
    write_scene(tmp_path / "estimated.h5", written)
    run_fit(
        tmp_path / "estimated.h5", configure("oracle", "draft", steps=120, splats=800), tmp_path / "r", eval_every=0
    )
    found = score(capsys, tmp_path / "r")
    assert not found["worlds"]["same_world"]
    assert found["worlds"]["scale"] == pytest.approx(2.5)
    assert found["worlds"]["apart_deg_median"] < 1e-3
    assert found["novel_view_aligned"] is not None
    assert found["novel_view"]["psnr"] > 17
    assert abs(found["novel_view"]["psnr"] - found["blur_view"]["psnr"]) < 5


def cameras(n: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {str(k): exp_se3(np.concatenate([rng.normal(0, 1, 3), rng.normal(0, 2, 3)])) for k in range(n)}


def test_bridge_refuses_what_cannot_be_fitted():
    many = cameras(5)
    far = dict(zip(many, ELSEWHERE.poses(np.stack(list(many.values()))), strict=True))
    assert bridge(many, many, estimated=True).to_run is None
    assert bridge(many, far, estimated=False).to_run.scale == pytest.approx(2.5)
    assert bridge({"x": many["0"]}, many, estimated=False).cameras == 0
    with pytest.raises(DataError, match="no training view"):
        bridge({"x": many["0"]}, many, estimated=True)
    with pytest.raises(DataError, match="too few"):
        bridge({k: many[k] for k in "01"}, far, estimated=True)
    still = dict.fromkeys("0123", many["0"])
    with pytest.raises(DataError):
        bridge(still, far, estimated=True)


def test_bridge_is_fitted_to_every_camera():
    many = cameras(6)
    rng = np.random.default_rng(2)
    rough = {k: compose(exp_se3(rng.normal(0, 0.02, 6)), p) for k, p in many.items()}
    found = bridge(many, rough | {"more": many["0"]}, estimated=True)
    whole = similarity(np.stack([many[k] for k in sorted(many)]), np.stack([rough[k] for k in sorted(many)]))
    assert found.cameras == 6
    assert found.to_run is not None
    assert np.array_equal(found.to_run.t, whole.t)


def test_small_differences_of_exact_poses_are_told_not_fitted():
    many = cameras(5)
    near = {k: compose(exp_se3(np.full(6, 1e-4)), p) for k, p in many.items()}
    found = bridge(many, near, estimated=False)
    assert found.to_run is None
    assert found.deg == pytest.approx(np.degrees(1e-4 * np.sqrt(3)), rel=1e-3)
    assert bridge(many, near, estimated=True).to_run is not None


def test_twist_gradient_is_the_derivative():
    rng = np.random.default_rng(1)
    pose, weights = exp_se3(rng.normal(0, 1, 6)), rng.normal(0, 1, (3, 4))

    def loss(twist):
        return float(np.sum(weights * np.sin(compose(exp_se3(twist), pose))))

    analytic = twist_gradient(pose, weights * np.cos(pose))
    h = 1e-6
    for k in range(6):
        e = np.eye(6)[k] * h
        assert (loss(e) - loss(-e)) / (2 * h) == pytest.approx(analytic[k], rel=1e-7, abs=1e-8)


def test_alignment_finds_a_camera_and_never_ends_worse(tiny, oracle):
    model = open_run(oracle).model
    with open_scene(tiny) as scene:
        pose = novel_views(scene)[0][0].pose
    picture = np.rint(np.clip(model.picture(pose), 0, 1) * 255).astype(np.uint8)
    found = realign(model, compose(exp_se3(2 * NUDGE), pose), picture, 80)
    assert found.after < found.before / 50
    assert np.linalg.norm(found.pose[:, :3] - pose[:, :3]) < np.linalg.norm(NUDGE[:3])
    there = realign(model, pose, picture, 3)
    assert there.after <= there.before
    blank = realign(model, pose, np.zeros_like(picture), 2)
    assert blank.after <= blank.before
    away = compose(exp_se3(np.array([0, np.pi, 0, 0, 0, 0.0])), pose)  # sees nothing: no gradient, and so no move
    assert np.allclose(realign(model, away, picture, 5).pose, away, atol=1e-5)


def test_alignment_of_a_broken_model_is_told(tiny, oracle):
    opened = open_run(oracle).model
    with open_scene(tiny) as scene:
        exam = novel_views(scene)[0][0]

    class Broken(SplatModel):
        def draw(self, pose, background=None, sh_degree=None):
            drawn = super().draw(pose, background, sh_degree)
            return replace(drawn, image=drawn.image * float("nan"))

    broken = Broken(opened.splats, opened.gauge, opened.camera, opened.config)
    with pytest.raises(NumericsError, match="not finite"):
        realign(broken, exam.pose, exam.picture, 2)


def test_a_scene_without_truth_is_measured_without_a_reference_too(tiny, oracle, tmp_path, capsys):
    found = score(capsys, oracle, moved(tiny, tmp_path / "real.h5", truth=False), "--align-steps", "0")
    assert found["quality"]["of"] == "renders of the held-out views"
    assert 0 < found["quality"]["mean"]["crete_blur"]["mean"] < 1
    assert found["quality"]["judges"]["brisque"].startswith("not computed")
    assert found["lpips"] is None
    assert score(capsys, oracle)["quality"] is None
    with open_scene(tiny) as file:
        scene = file.read()
    train_only = replace(scene, truth=None, views=tuple(v for v in scene.views if v.split == "train"))
    write_scene(tmp_path / "none.h5", train_only)
    score(capsys, oracle, tmp_path / "none.h5", code=4)
    alone = score(capsys, oracle, tmp_path / "none.h5", "--quality")
    assert alone["novel_view"] is alone["blur_view"] is None
    assert len(alone["quality"]["views"]) == 6


def test_cameras_that_a_run_moved_are_its_world_and_damaged_ones_are_told(tiny, oracle, tmp_path, capsys):
    import shutil

    copy = tmp_path / "run"
    shutil.copytree(oracle, copy)
    record = json.loads((copy / "run.json").read_text())
    with open_scene(tiny) as scene:
        record["cameras"] = {
            n: compose(exp_se3(NUDGE / 10), scene.view(n, spikes=False).pose.cam_from_world).tolist()
            for n in scene.train
        }
    (copy / "run.json").write_text(json.dumps(record))
    assert not score(capsys, copy, "--align-steps", "2")["worlds"]["same_world"]
    for bad in ({"a": [1, 2]}, [1], {"a": [None] * 12}, {"a": [float("nan")] * 12}):
        (copy / "run.json").write_text(json.dumps(record | {"cameras": bad}))
        assert "cameras" in score(capsys, copy, code=4)["error"]["what"]


def test_results_are_laid_out_as_nerfbaselines_reads_them(tiny, oracle, tmp_path, capsys):
    out = tmp_path / "nb"
    found = score(capsys, oracle, "--nerfbaselines", out, "--ssim", "tf")
    results = json.loads((out / "results.json").read_text())
    assert found["nerfbaselines"] == str(out / "results.json")
    names = sorted(p.name for p in (out / "predictions/color").iterdir())
    for key, kind in (("predictions_sha256", "color"), ("ground_truth_sha256", "gt-color")):
        data = b"".join((out / "predictions" / kind / n).read_bytes() for n in names)
        assert results[key] == hashlib.sha256(data).hexdigest()
    raw = {k: struct.unpack(f"<{len(names)}f", base64.b64decode(v)) for k, v in results["metrics_raw"].items()}
    assert set(raw) == {"psnr", "ssim", "mae", "mse"}
    assert raw["psnr"] == pytest.approx([v["psnr"] for v in found["novel_view"]["views"]], rel=1e-6)
    assert raw["ssim"] == pytest.approx([v["ssim"] for v in found["novel_view"]["views"]], rel=1e-6)
    pair = [read_image(out / "predictions" / kind / names[0]) / 255 for kind in ("color", "gt-color")]
    assert raw["mse"][0] == pytest.approx(np.mean((pair[0] - pair[1]) ** 2), rel=1e-6)
    assert results["metrics"]["psnr"] == round(float(np.mean([v["psnr"] for v in found["novel_view"]["views"]])), 5)
    assert results["nb_info"]["method"] == "spikerig-splat-oracle"
    assert results["render_dataset_metadata"]["scene"] == "tiny"
    assert json.loads((out / "predictions/info.json").read_text())["evaluation_protocol"] == "default"
    assert score(capsys, oracle, "--nerfbaselines", out, code=2)["error"]["type"] == "UsageError"


def test_predictions_are_in_the_order_of_their_files(tmp_path):
    """a-1.png sorts before a.png, though "a" sorts before "a-1"."""
    rng = np.random.default_rng(0)
    made = {n: rng.integers(0, 256, (2, 12, 12, 3), np.uint8) for n in ("b", "a", "a-1")}
    about = {"method": "m", "dataset": "d", "scene": "s", "steps": 1, "seconds": None, "config": {}, "background": None,
             "checkpoint_sha256": None}  # fmt: skip
    out = write_results(tmp_path, [(n, *pair) for n, pair in made.items()], about, None)
    results = json.loads(out.read_text())
    psnr = struct.unpack("<3f", base64.b64decode(results["metrics_raw"]["psnr"]))
    assert psnr == pytest.approx([metrics.psnr(*made[n]) for n in ("a-1", "a", "b")], rel=1e-6)
    data = b"".join((tmp_path / "predictions/color" / f"{n}.png").read_bytes() for n in ("a-1", "a", "b"))
    assert results["predictions_sha256"] == hashlib.sha256(data).hexdigest()


def test_equal_pictures_are_graded(tiny, oracle):
    model = open_run(oracle).model
    with open_scene(tiny) as scene:
        exam = novel_views(scene)[0][0]
    same = replace(exam, picture=np.rint(np.clip(model.picture(exam.pose), 0, 1) * 255).astype(np.uint8))
    found = grade(model, [same])
    assert found["psnr"] == float("inf")
    assert "equal" in found["views"][0]["remarks"][0]


def test_poses_of_a_transforms_file_are_given_not_estimated(tiny, oracle, tmp_path, capsys):
    """Held-out pictures alone, whose poses came with them, are scored in their own world."""
    with open_scene(tiny) as file:
        scene = file.read()
    views = tuple(view for view in scene.views if view.split == "test")
    mine = {
        kind: {v.name: record[v.name] for v in views if v.name in record}
        for kind in ("light", "trajectories", "at_ns")
        if (record := getattr(scene.truth, kind)) is not None
    }
    alone = replace(scene, views=views, events={}, truth=replace(scene.truth, **mine))
    write_scene(tmp_path / "estimated.h5", replace(alone, info={"poses": {"accepted": True}}))
    assert "no training view" in score(capsys, oracle, tmp_path / "estimated.h5", code=4)["error"]["what"]
    write_scene(tmp_path / "given.h5", replace(alone, info={"poses": "transforms_val.json"}))
    found = score(capsys, oracle, tmp_path / "given.h5")
    assert found["novel_view_aligned"] is None
    assert found["psnr"] == score(capsys, oracle)["psnr"]
