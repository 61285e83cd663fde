"""Render any .blend as the folder of shaken sub-frames that `spikerig sim frames` reads.

    blender -b SCENE.blend -P render_rs3d.py -- --out FOLDER [--views 200] [--subframes 18] [--dry-run] ...
    spikerig sim frames FOLDER -o scene.h5

Each training view is an exposure: sub-frames of a camera that shakes, in linear light (OpenEXR), the one at the label
with its depth. Each test view is one sharp picture. Views stand on a hemisphere around the scene, or where NeRF's
transforms_*.json say. Frames that exist are not rendered again: start it again after a break. Needs nothing but Blender
(2.93 or later) and the NumPy that comes with it; everything that does not need Blender can be imported without it.
"""

import argparse
import json
import math
import os
import sys
from pathlib import Path

import numpy as np

WAVES = np.array([0.5, 1.0, 1.7])  # of the shake, turns an exposure
LOOKS = 65  # instants at which a path's length is measured


def arguments(argv):
    """The script's options: what follows `--` on Blender's command line."""
    parser = argparse.ArgumentParser(prog="blender -b SCENE.blend -P render_rs3d.py --", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--views", type=int, default=200, help="viewpoints on the hemisphere")
    parser.add_argument("--test", type=int, default=None, help="how many of them are for testing (half)")
    parser.add_argument("--poses-train", type=Path, help="NeRF's transforms_train.json, in place of the hemisphere")
    parser.add_argument("--poses-test", type=Path, help="NeRF's transforms_test.json (the first --test of it)")
    parser.add_argument("--protocol", choices=("paper", "rig"), default="paper", help="18 slots that hold, or 8 ms")
    parser.add_argument("--subframes", type=int, default=None, help="of an exposure (18; rig: 17)")
    parser.add_argument("--shake-px", type=float, nargs=2, default=(6.0, 11.0), help="path of the picture's centre")
    parser.add_argument("--translation", type=float, default=0.2, help="share of the path that moves, not turns")
    parser.add_argument("--size", type=int, nargs=2, help="width and height (the file's)")
    parser.add_argument("--samples", type=int, help="of Cycles or Eevee a pixel (the file's)")
    parser.add_argument("--target", type=float, nargs=3, default=(0.0, 0.0, 0.0), help="what the hemisphere is around")
    parser.add_argument("--radius", type=float, help="of the hemisphere (the camera's distance)")
    parser.add_argument("--background", type=float, default=1.0, help="linear gray behind a transparent film")
    parser.add_argument("--seed", type=int, default=0, help="of viewpoints, shake and render noise")
    parser.add_argument("--dry-run", action="store_true", help="write transforms.json and capture.toml, render nothing")
    args = parser.parse_args(argv)
    args.subframes = args.subframes or (18 if args.protocol == "paper" else 17)
    if args.views < 1 or args.subframes < 2 or not 0 <= args.shake_px[0] <= args.shake_px[1]:
        parser.error("--views is at least 1, --subframes at least 2, --shake-px from low to high")
    return args


# ---- poses: OpenGL camera-to-world, 4x4 (x right, y up, z back), as Blender has them -------------------------------


def looking_at(eye, target):
    """The pose of a camera at `eye` that looks at `target`, the world's z up in its picture."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return pose


def hemisphere(count, radius, target, seed):
    """`count` poses evenly drawn on the upper hemisphere, not within ten degrees of the horizon or the pole."""
    rng = np.random.default_rng(seed)
    height = rng.uniform(math.sin(math.radians(10)), math.sin(math.radians(80)), count)
    angle = rng.uniform(0, 2 * math.pi, count)
    flat = np.sqrt(1 - height**2)
    eyes = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], 1) * radius + np.asarray(target)
    return [looking_at(eye, np.asarray(target, float)) for eye in eyes]


def poses_of(path):
    """The poses of a NeRF transforms file, in order."""
    frames = json.loads(path.read_text())["frames"]
    return [np.array(frame["transform_matrix"], float) for frame in frames]


def turned(vector):
    """The rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def shaken(base, phases, length_px, focal_px, depth, translation, rng):
    """The poses at phases of the exposure (0 to 1) of a hand that shakes; at phase 0.5 it is `base`.

    Three waves of rotation and translation with random phases, scaled so that a point straight ahead at `depth` draws
    a path of `length_px` pixels over the exposure.
    """
    turning, moving = 1 - translation, translation * depth
    size = np.array([turning, turning, 0.3 * turning, moving, moving, 0.3 * moving])
    waves = rng.normal(size=(3, 6)) / np.array([[1.0], [2.0], [4.0]]) * size
    start = rng.uniform(0, 2 * math.pi, (3, 6))

    def offsets(at, scale):
        turns = 2 * math.pi * WAVES[:, None] * np.reshape(at, (-1, 1, 1))
        middle = math.pi * WAVES[:, None]
        return scale * (waves * (np.sin(turns + start) - np.sin(middle + start))).sum(1)

    def poses(at, scale):
        out = []
        for offset in offsets(at, scale):
            move = np.eye(4)
            move[:3, :3], move[:3, 3] = turned(offset[:3]), offset[3:]
            out.append(base @ move)
        return np.stack(out)

    def length(scale):
        ahead = base @ np.array([0, 0, -depth, 1.0])
        seen = np.stack([np.linalg.inv(pose) @ ahead for pose in poses(np.linspace(0, 1, LOOKS), scale)])
        pixels = focal_px * seen[:, :2] / -seen[:, 2:3]
        return float(np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum())

    scale = 1e-4
    for _ in range(8):  # nearly linear in the scale
        scale *= length_px / max(length(scale), 1e-12)
    return poses(phases, scale)


# ---- the layout ----------------------------------------------------------------------------------------------------


def phases_of(protocol, subframes):
    """When sub-frames are cast: in the middle of their slots (paper), or from start to end of the exposure (rig)."""
    k = np.arange(subframes)
    return (k + 0.5) / subframes if protocol == "paper" else k / (subframes - 1)


def layout(args, focal_px, width, height, depth):
    """transforms.json of the whole folder: every view, every sub-frame, its file and its pose."""
    if args.poses_train:
        train = poses_of(args.poses_train)
        test = poses_of(args.poses_test)[: args.test] if args.poses_test else []
    else:
        held = args.views // 2 if args.test is None else args.test
        every = hemisphere(args.views, args.radius or depth, args.target, args.seed)
        train, test = every[: args.views - held], every[args.views - held :]
    phases, views = phases_of(args.protocol, args.subframes), []
    label = int(np.argmin(np.round(np.abs(phases - 0.5), 9)))
    for number, base in enumerate(train):
        name, rng = f"r_{number:03d}", np.random.default_rng([args.seed, number])
        away = float(np.linalg.norm(base[:3, 3] - np.asarray(args.target)))
        path = shaken(base, phases, rng.uniform(*args.shake_px), focal_px, away, args.translation, rng)
        frames = [{"file": f"{name}/{k:02d}.exr", "transform_matrix": p.tolist()} for k, p in enumerate(path)]
        views.append({"name": name, "split": "train", "depth": frames[label]["file"], "frames": frames})
    for number, base in enumerate(test):
        name = f"t_{number:03d}"
        frames = [{"file": f"{name}/00.exr", "transform_matrix": base.tolist()}]
        views.append({"name": name, "split": "test", "frames": frames})
    return {"fl_x": focal_px, "w": width, "h": height, "background": args.background, "views": views}


def capture_toml(args):
    """The settings beside it: the protocol; `spikerig sim frames` takes any other with --settings."""
    return f'seed = {args.seed}\n\n[exposure]\nprotocol = "{args.protocol}"\n'


def to_render(document, out):
    """(number, file, pose, whether depth is wanted too) of every frame that is not there yet."""
    rows = [(frame, frame["file"] == view.get("depth")) for view in document["views"] for frame in view["frames"]]
    return [
        (number, frame["file"], frame["transform_matrix"], layers)
        for number, (frame, layers) in enumerate(rows)
        if not (out / frame["file"]).exists()
    ]


def write_plan(document, settings, out):
    """Write transforms.json and capture.toml; a folder begun with other poses is left alone."""
    out.mkdir(parents=True, exist_ok=True)
    text, plan = json.dumps(document, indent=1) + "\n", out / "transforms.json"
    if plan.exists() and plan.read_text() != text:
        sys.exit(f"{plan} was made with other settings: give them again, or another --out")
    plan.write_text(text)
    (out / "capture.toml").write_text(settings)


def focal_of(lens_mm, sensor_width_mm, sensor_height_mm, fit, width, height):
    """Focal length in pixels of Blender's camera: its sensor lies along the longer side, or along the one it names."""
    if fit == "VERTICAL":
        return lens_mm / sensor_height_mm * height
    return lens_mm / sensor_width_mm * (width if fit == "HORIZONTAL" else max(width, height))


# ---- Blender -------------------------------------------------------------------------------------------------------


def prepare(scene, camera, args):
    """Make the scene render what the layout says: no blur of its own, no lens shift, no compositor."""
    render = scene.render
    if camera.data.type != "PERSP":
        sys.exit(f"the camera '{camera.name}' is {camera.data.type}: a perspective camera is needed")
    if args.size:
        render.resolution_x, render.resolution_y = args.size
        render.resolution_percentage = 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.use_motion_blur = render.use_compositing = render.use_sequencer = render.use_border = False
    render.use_file_extension = False
    camera.data.shift_x = camera.data.shift_y = 0.0
    camera.data.dof.use_dof = False
    camera.parent = None
    camera.constraints.clear()
    camera.animation_data_clear()
    scene.view_layers[0].use_pass_z = True
    if args.samples and hasattr(scene, "cycles"):
        scene.cycles.samples = args.samples
    if args.samples and hasattr(scene, "eevee"):
        scene.eevee.taa_render_samples = args.samples
    factor = render.resolution_percentage / 100
    return int(render.resolution_x * factor), int(render.resolution_y * factor)


def save_as(settings, layers, transparent):
    """Linear float EXR; with all layers (Combined and Depth) or the picture alone."""
    if hasattr(settings, "media_type"):  # Blender 5
        settings.media_type = "MULTI_LAYER_IMAGE" if layers else "IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER" if layers else "OPEN_EXR"
    settings.color_depth = "32"
    settings.exr_codec = "ZIP"
    if not layers:
        settings.color_mode = "RGBA" if transparent else "RGB"


def main(argv):
    """Lay the folder out and render what it lacks."""
    import bpy
    from mathutils import Matrix

    args = arguments(argv)
    scene = bpy.context.scene
    camera = scene.camera
    if camera is None:
        sys.exit("the scene has no camera")
    depth = float(np.linalg.norm(np.array(camera.matrix_world, float)[:3, 3] - np.asarray(args.target)))
    width, height = prepare(scene, camera, args)
    lens = camera.data
    focal = focal_of(lens.lens, lens.sensor_width, lens.sensor_height, lens.sensor_fit, width, height)
    document = layout(args, focal, width, height, depth)
    write_plan(document, capture_toml(args), args.out)
    left = to_render(document, args.out)
    total = sum(len(view["frames"]) for view in document["views"])
    print(f"{args.out}: {len(document['views'])} views, {len(left)} of {total} frames to render")
    if args.dry_run:
        return
    for done, (number, file, matrix, layers) in enumerate(left):
        target = args.out / file
        part = target.with_suffix(".part.exr")
        target.parent.mkdir(exist_ok=True)
        camera.matrix_world = Matrix(matrix)
        save_as(scene.render.image_settings, layers, scene.render.film_transparent)
        if hasattr(scene, "cycles"):
            scene.cycles.seed = (args.seed + number) % 2**31
        scene.render.filepath = str(part)
        bpy.ops.render.render(write_still=True)
        os.replace(part, target)  # so that a file is whole, or not there
        print(f"{done + 1}/{len(left)} {file}", flush=True)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
