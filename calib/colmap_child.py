"""COLMAP, in a process of its own: `python -m spikerig.calib.colmap_child JOB.json`; only this imports pycolmap.

Its wheel exports a static zlib (after it is imported first, PNG writing aborts) and ends the process when asked for a
feature type it was built without. So the parent never imports it: a job comes as JSON, a result goes back as JSON and
.npy, and a crash is one clear error in the parent.
"""

from __future__ import annotations

import json
import sys
import time
import zlib  # noqa: F401  the system's zlib must be loaded before pycolmap's
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.calib.smooth import twist_covariance

COVISIBLE = 4  # mapped views that a further instant is matched against


def main(path: str) -> None:
    """Do one job: features, matches, a map of some images, and the others placed in it."""
    import pycolmap

    job = json.loads(Path(path).read_text(encoding="utf-8"))
    root = Path(path).parent
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(job["seed"])
    told: dict[str, Any] = {"version": pycolmap.__version__, "seconds": {}}
    began = time.monotonic()

    def lap(name: str) -> None:
        nonlocal began
        now = time.monotonic()
        told["seconds"][name] = told["seconds"].get(name, 0.0) + now - began
        began = now
        print(json.dumps({"done": name}), flush=True)

    database = root / "database.db"
    _extract(job, root, database, job["map"] + job["place"])
    if job.get("rig"):
        _rig(job, database)
    lap("features")
    _match(job, root, database, _pairs(job))
    lap("matches")
    tries = [_map(job, root, database, k) for k in range(job.get("tries", 1))]
    told["tries"] = [_size(_largest(models)) if models else (0, 0) for models in tries]
    models = max(tries, key=lambda models: _size(_largest(models)) if models else (0, 0))
    told["models"] = sorted((m.num_reg_images() for m in models), reverse=True)
    lap("mapping")
    if models:
        best = _largest(models)
        sparse = root / "sparse"
        sparse.mkdir(exist_ok=True)
        if job["camera"] and job.get("doubt_focal"):
            best.write_text(str(sparse))
            told["focal"] = _focal(sparse)
            lap("focal length")
        if job["camera"] or job.get("rig"):
            _adjust(best)
        told |= _model(best, root)
        told["link"] = _weakest_link(best, bool(job.get("rig")))
        best.write_text(str(sparse))
        lap("adjusting")
        if job["place"]:
            told["placed"] = _place(job, root, database, best)
            lap("localising")
    (root / "result.json").write_text(json.dumps(told), encoding="utf-8")


def _extract(job: dict[str, Any], root: Path, database: Path, names: list[str]) -> None:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = job["threads"]
    options.max_image_size = job.get("max_image_size", -1)
    options.sift.peak_threshold = job["peak_threshold"]
    options.sift.max_num_features = job["max_features"]
    reader = pycolmap.ImageReaderOptions()
    mode = pycolmap.CameraMode.SINGLE
    if job["camera"]:
        reader.camera_model = job["camera"]["model"]
        reader.camera_params = ",".join(repr(float(v)) for v in job["camera"]["params"])
    if job.get("rig"):
        mode = pycolmap.CameraMode.PER_FOLDER
    elif job.get("separate_cameras"):
        mode = pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database,
        root / "images",
        image_names=names,
        camera_mode=mode,
        reader_options=reader,
        extraction_options=options,
    )


def _rig(job: dict[str, Any], database: Path) -> None:
    """Two arms behind one splitter: images of the same name are one frame, their relative pose is fixed."""
    import pycolmap

    config = Path(database).with_name("rig.json")
    config.write_text(json.dumps(job["rig"]), encoding="utf-8")
    opened = pycolmap.Database.open(database)
    pycolmap.apply_rig_config(pycolmap.read_rig_config(config), opened)
    opened.close()


def _match(job: dict[str, Any], root: Path, database: Path, pairs: list[tuple[str, str]]) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = job["threads"]
    matching.sift.max_ratio = job["max_ratio"]
    matching.skip_image_pairs_in_same_frame = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    verification.ransac.max_error = job["max_error_px"]
    options = {"matching_options": matching, "verification_options": verification}
    listed = root / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
    pycolmap.match_image_pairs(database, pairing_options=pairing, **options)


def _pairs(job: dict[str, Any]) -> list[tuple[str, str]]:
    """Pairs of the images to map alone: COLMAP's own pairing would take every image of the database."""
    frame = {name: Path(name).name for name in job["map"]}  # arms of one rig have one name, in two folders
    at = {f: k for k, f in enumerate(sorted(set(frame.values())))}
    reach = job["overlap"]
    near = {0, *range(1, reach + 1), *(2**k for k in range(reach))}  # as COLMAP's sequential one
    names, every = sorted(job["map"]), job["pairs"] == "exhaustive"
    return [
        (a, b) for k, a in enumerate(names) for b in names[k + 1 :] if every or abs(at[frame[a]] - at[frame[b]]) in near
    ]


def _size(model: Any) -> tuple[int, int]:
    """Images of a model, and observations."""
    return model.num_reg_images(), model.compute_num_observations()


def _largest(models: list[Any]) -> Any:
    return max(models, key=_size)


def _adjust(model: Any) -> None:
    """Adjust poses and points once more, with weights of Cauchy: least squares follow the worst features.

    The scale is the median residual of the points, so that the better half counts almost fully.
    """
    import pycolmap

    errors = [p.error for p in model.points3D.values()]
    if len(errors) < 8:
        return
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = max(float(np.median(errors)), 0.01)
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _map(job: dict[str, Any], root: Path, database: Path, attempt: int = 0) -> list[Any]:
    """The models of one attempt; each has a seed of its own, and the odd ones place images by nearer features.

    A map can end in a bent shape that most features fit (seen: 42 degrees off, all views placed, 0.4 px); it holds
    fewer observations than the right one, so that the largest of two attempts is the right one more often.
    """
    import pycolmap

    out = root / f"models{attempt}"
    out.mkdir(exist_ok=True)
    seed = job["seed"] + attempt
    known = bool(job["camera"] or job.get("rig"))
    if job["mapper"] == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.image_names = job["map"]
        options.random_seed = seed
        if known:
            adjust = options.mapper.bundle_adjustment
            adjust.refine_focal_length = adjust.refine_principal_point = adjust.refine_extra_params = False
        return list(pycolmap.global_mapping(database, root / "images", out, options).values())
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = job["map"]
    options.num_threads = options.mapper.num_threads = 1  # two threads give two answers
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_model_size = 3
    options.ba_refine_focal_length = options.ba_refine_extra_params = not known
    options.ba_refine_sensor_from_rig = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = not known
    if known:  # small pictures of known cameras: what is off by more is wrong
        options.mapper.filter_max_reproj_error = job["max_error_px"]
        options.triangulation.merge_max_reproj_error = job["max_error_px"]
        options.triangulation.complete_max_reproj_error = job["max_error_px"]
        options.mapper.init_min_tri_angle = 8.0
        options.mapper.init_min_num_inliers = 40
        if attempt % 2:
            options.mapper.abs_pose_max_error = 3 * job["max_error_px"]
    return list(pycolmap.incremental_mapping(database, root / "images", out, options).values())


def _model(model: Any, root: Path) -> dict[str, Any]:
    """Poses, points and residuals of a model, JSON-ready; points and their residuals as .npy beside."""
    images = {}
    for image in model.images.values():
        if image.has_pose:
            seen = sum(1 for p in image.points2D if p.has_point3D())
            pose = np.asarray(image.cam_from_world().matrix())
            images[image.name] = {"pose": pose.tolist(), "points": seen, "error_px": _residual(model, image)}
    points = list(model.points3D.values())
    np.save(root / "xyz.npy", np.array([p.xyz for p in points], np.float64).reshape(-1, 3))
    np.save(root / "rgb.npy", np.array([p.color for p in points], np.uint8).reshape(-1, 3))
    np.save(root / "error.npy", np.array([p.error for p in points], np.float64))
    cameras = {}
    for key, camera in model.cameras.items():
        cameras[str(key)] = {
            "model": camera.model.name,
            "params": [float(v) for v in camera.params],
            "size": [camera.width, camera.height],
        }
    return {
        "images": images,
        "points": len(points),
        "error_px": float(model.compute_mean_reprojection_error()),
        "track_length": float(model.compute_mean_track_length()),
        "cameras": cameras,
    }


def _residual(model: Any, image: Any) -> float | None:
    """Mean distance in pixels of an image's features from the points they are of; None where it has none."""
    off = []
    for feature in image.points2D:
        if feature.has_point3D():
            at = image.project_point(model.points3D[feature.point3D_id].xyz)
            if at is not None:
                off.append(float(np.linalg.norm(np.asarray(at) - feature.xy)))
    return float(np.mean(off)) if off else None


def _focal(sparse: Path) -> dict[str, float]:
    """The map adjusted once more with a free focal length: its ratio to the one given, and the share of error saved."""
    import pycolmap

    model = pycolmap.Reconstruction(str(sparse))
    before = float(model.compute_mean_reprojection_error())
    given = {}
    for key, camera in model.cameras.items():
        given[key] = float(camera.mean_focal_length())
        if camera.model.name == "PINHOLE":  # one focal length: two of them are free on a circle of views
            stretch = camera.params[1] / camera.params[0]
            if abs(stretch - 1) < 0.01:
                camera.model = pycolmap.CameraModelId.SIMPLE_PINHOLE
                camera.params = [given[key], *camera.params[2:]]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = True
    options.refine_principal_point = options.refine_extra_params = options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    after = float(model.compute_mean_reprojection_error())
    ratios = [float(camera.mean_focal_length()) / given[key] for key, camera in model.cameras.items()]
    return {"ratio": max(ratios, key=lambda r: abs(r - 1)), "saved": 1 - after / max(before, 1e-12)}


def _place(job: dict[str, Any], root: Path, database: Path, model: Any) -> dict[str, Any]:
    """Further instants: matched against the map's nearest images of other views, then solved one by one."""
    import pycolmap

    mapped = {i.name: i for i in model.images.values() if i.has_pose}
    near = _neighbours(model, mapped)
    own = job["own"]
    pairs = [(name, other) for name in job["place"] for other in near.get(own[name], [])]
    _match(job, root, database, pairs)
    opened = pycolmap.Database.open(database)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = 2 * job["max_error_px"]
    options.ransac.random_seed = job["seed"]
    placed = {}
    for name in job["place"]:
        image: Any = opened.read_image_with_name(name)
        keys = np.asarray(opened.read_keypoints(image.image_id), np.float64)[:, :2]
        found: dict[tuple[int, int], None] = {}
        for other in near.get(own[name], []):
            there = mapped[other]
            geometry = opened.read_two_view_geometry(image.image_id, there.image_id)
            for a, b in np.asarray(geometry.inlier_matches).reshape(-1, 2):
                point = there.points2D[int(b)]
                if point.has_point3D():
                    found[int(a), int(point.point3D_id)] = None
        rows = list(found)
        if len(rows) < 8:
            continue
        xy = keys[[a for a, _ in rows]]
        xyz = np.array([model.points3D[p].xyz for _, p in rows])
        camera = model.cameras[image.camera_id]
        solved = pycolmap.estimate_and_refine_absolute_pose(
            xy, xyz, camera, estimation_options=options, return_covariance=True
        )
        if solved is None or solved["num_inliers"] < 8:
            continue
        pose = np.asarray(solved["cam_from_world"].matrix())
        good = np.asarray(solved["inlier_mask"], bool)
        off = camera.img_from_cam(xyz[good] @ pose[:, :3].T + pose[:, 3]) - xy[good]
        variance = float(np.sum(off**2)) / max(2 * int(good.sum()) - 6, 1)  # COLMAP's covariance is for one of 1 px^2
        placed[name] = {
            "pose": pose.tolist(),
            "inliers": int(solved["num_inliers"]),
            "cov": (variance * twist_covariance(np.asarray(solved["covariance"]), pose)).tolist(),
        }
    opened.close()
    return placed


def _weakest_link(model: Any, rigged: bool) -> dict[str, Any]:
    """How few points hold two parts of a map together, and which views are the smaller part.

    The views (the arms of a rig are one view) are joined by the strongest links: points that both see, and a third view
    too, for two views alone say nothing of their distance against the others'. The weakest link that is needed is the
    one along which a map bends.
    """
    view = {i.name: Path(i.name).name if rigged else i.name for i in model.images.values() if i.has_pose}
    seen: dict[str, set[int]] = {name: set() for name in view.values()}
    for key, point in model.points3D.items():
        names = {view[name] for e in point.track.elements if (name := model.images[e.image_id].name) in view}
        if len(names) > 2:
            for name in names:
                seen[name].add(key)
    found = weakest_link(seen)
    return found | {"views": [min(n for n, v in view.items() if v == name) for name in found["views"]]}


def weakest_link(seen: dict[str, set[int]]) -> dict[str, Any]:
    """The weakest edge of the strongest tree over views that see points: {"points", "views" of the smaller part}."""
    names = sorted(seen)
    best = {n: (len(seen[n] & seen[names[0]]), names[0]) for n in names[1:]}
    edges: list[tuple[int, str, str]] = []
    while best:
        name = max(best, key=lambda n: (best[n][0], n))
        count, other = best.pop(name)
        edges.append((count, name, other))
        for n in best:
            best[n] = max(best[n], (len(seen[n] & seen[name]), name))
    if not edges:
        return {"points": 0, "views": names}
    weak = min(edges)
    part = {weak[1]}
    while more := {n for _, a, b in edges if (a, b) != weak[1:] for n in (a, b) if {a, b} & part} - part:
        part |= more
    return {"points": weak[0], "views": sorted(min(part, set(names) - part, key=len))}


def _neighbours(model: Any, mapped: dict[str, Any]) -> dict[str, list[str]]:
    """The images that see most of the same points, for each image."""
    seen = {n: {p.point3D_id for p in i.points2D if p.has_point3D()} for n, i in mapped.items()}
    near = {}
    for name, points in seen.items():
        shared = sorted(((len(points & seen[o]), o) for o in seen if o != name), reverse=True)
        near[name] = [o for n, o in shared[:COVISIBLE] if n > 0]
    return near


if __name__ == "__main__":
    main(sys.argv[1])
