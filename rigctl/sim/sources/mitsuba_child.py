"""The process that runs Mitsuba: a job on stdin, a JSON line a picture on stdout; it may be killed, and may crash.

`python -m spikerig.rigctl.sim.sources.mitsuba_child < job.json`. The job: scene, folder, variant, threads,
memory_bytes, width, height, fov_x_deg, spp, shots; a shot: file, kind ("light" or "depth"), world_from_cam (4x4, our
axes), seed. Pictures that exist are left alone.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.images import write_image

NEAR, FAR = 1e-3, 1e6  # world units


def mitsuba_axes(world_from_cam: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mitsuba's camera-to-world (x left, y up, z ahead) of ours (x right, y down, z ahead), both 4x4."""
    return np.asarray(world_from_cam, np.float64) @ np.diag([-1.0, -1.0, 1.0, 1.0])


def _sensor(mi: Any, job: dict[str, Any], shot: dict[str, Any], sampler: dict[str, Any]) -> Any:
    matrix = mitsuba_axes(np.array(shot["world_from_cam"]))
    return mi.load_dict(
        {
            "type": "perspective", "fov": job["fov_x_deg"], "fov_axis": "x", "near_clip": NEAR, "far_clip": FAR,
            "to_world": mi.ScalarTransform4f(matrix),
            "film": {
                "type": "hdrfilm", "width": job["width"], "height": job["height"], "pixel_format": "rgb",
                "component_format": "float32", "rfilter": {"type": "box"},
            },
            "sampler": sampler,
        }
    )  # fmt: skip


def light(mi: Any, scene: Any, job: dict[str, Any], shot: dict[str, Any]) -> NDArray[np.float32]:
    """Linear light float32[H,W,3] by the scene's own integrator, averaged over each pixel's square."""
    sensor = _sensor(mi, job, shot, {"type": "independent", "sample_count": job["spp"]})
    return np.array(mi.render(scene, sensor=sensor, spp=job["spp"], seed=shot["seed"]), np.float32)[:, :, :3]


def depth(mi: Any, scene: Any, job: dict[str, Any], shot: dict[str, Any]) -> NDArray[np.float32]:
    """Depth along the camera's axis through the pixel centres, float32[H,W]; inf where nothing is."""
    sensor = _sensor(mi, job, shot, {"type": "stratified", "sample_count": 1, "jitter": False})
    found = mi.load_dict({"type": "aov", "aovs": "t:depth,p:position"})
    t, *p = np.moveaxis(np.array(mi.render(scene, sensor=sensor, integrator=found, spp=1), np.float64), 2, 0)
    away = np.array(shot["world_from_cam"])
    z = sum(away[k, 2] * (p[k] - away[k, 3]) for k in range(3))
    return np.where(t > 0, z, np.inf).astype(np.float32)


def main() -> None:
    """Do the job on stdin."""
    job = json.load(sys.stdin)
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if job["memory_bytes"]:
            resource.setrlimit(resource.RLIMIT_AS, (job["memory_bytes"], job["memory_bytes"]))
    except (ImportError, ValueError, OSError):
        pass  # a lower limit is set already
    import mitsuba as mi

    mi.set_variant(job["variant"])
    import drjit as dr

    dr.set_thread_count(job["threads"])
    mi.set_log_level(mi.LogLevel.Error)
    try:
        scene = mi.load_file(job["scene"])
        if not isinstance(scene, mi.Scene):
            raise RuntimeError(f"the file holds a {type(scene).__name__}, not a scene")
        for shot in job["shots"]:
            path = Path(job["folder"]) / shot["file"]
            if not path.exists():
                write_image(path, {"light": light, "depth": depth}[shot["kind"]](mi, scene, job, shot))
            sys.stdout.write(json.dumps({"done": shot["file"]}) + "\n")
            sys.stdout.flush()
    except (RuntimeError, MemoryError, OSError, ValueError) as error:
        sys.stdout.write(json.dumps({"error": str(error) or type(error).__name__}) + "\n")
        sys.exit(4)


if __name__ == "__main__":
    main()
