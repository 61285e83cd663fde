"""Hard inputs of the simulator, and small worlds to cast."""

from typing import Any

import numpy as np

from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.spec import SceneSpec, read_scene


def small_table(**changes: Any) -> dict[str, Any]:
    """A scene of four views that takes a fraction of a second, as its TOML would be read; dotted keys change it."""
    table: dict[str, Any] = {
        "name": "small",
        "seed": 5,
        "effects": ["shot_noise", "dark_current", "threshold_fpn", "read_noise"],
        "camera": {"width": 29, "height": 18, "fov_deg": 60},
        "orbit": {"views": 4, "radius": 2.0, "height": 1.0, "target": [0, 0, 0.4], "arc_deg": 60, "test": [2]},
        "exposure": {"exposure_ms": 1.0, "sub_poses": 5, "margin_ticks": 16},
        "shake": {"path_px": [3, 5]},
        "points": {"count": 100},
        "world": {
            "lamp": {"position": [-0.6, -0.8, 2.4], "power": [2.0, 1.9, 1.8]},
            "solids": [
                {
                    "kind": "room",
                    "lo": [-3, -3, 0],
                    "hi": [3, 3, 2.6],
                    "floor": {"kind": "tiles"},
                    "walls": {"kind": "noise"},
                },
                {"kind": "sphere", "centre": [0, 0, 0.4], "radius": 0.4, "texture": {"kind": "checker", "size": 0.2}},
                {"kind": "box", "centre": [0.7, 0.6, 0.3], "size": [0.4, 0.5, 0.6], "yaw_deg": 20},
                {"kind": "rect", "centre": [-0.7, 0.7, 0.5], "right": [0.3, 0, 0.1], "up": [-0.1, 0, 0.3]},
            ],
        },
    }
    for path, value in changes.items():
        at = table
        *way, last = path.split("__")
        for key in way:
            at = at.setdefault(key, {})
        at[last] = value
    return table


def small(**changes: Any) -> SceneSpec:
    """The scene of `small_table`."""
    return read_scene(small_table(**changes))


def steady(value: float | np.ndarray, ticks: int, height: int = 3, width: int = 5) -> Light:
    """White light that holds, over `ticks` of exposure without margins."""
    rgb = np.empty((1, height, width, 3), np.float32)
    rgb[...] = np.reshape(value, (*np.shape(value), 1)) if np.ndim(value) else value
    return Light(rgb, np.array([0, ticks]), (0, ticks), 40_000.0)


def hdr_light(height: int = 8, width: int = 8) -> Light:
    """Light of 1e6 to 1 in one frame."""
    values = np.logspace(-6, 0, height * width).reshape(height, width).astype(np.float32)
    return steady(values, 4000, height, width)


NUMERICS = "numerics/test_sim.py::"
ROWS = [
    ("no light at all", "simulate", "no spike, nothing left, a black frame", NUMERICS + "test_no_light"),
    (
        "light exactly at the threshold",
        "integrate",
        "a spike every tick, nothing clipped",
        NUMERICS + "test_at_the_threshold",
    ),
    (
        "light of two thresholds a tick and more",
        "integrate",
        "a spike every tick, the excess counted exactly",
        NUMERICS + "test_charge_is_conserved",
    ),
    (
        "saturation by a lamp in the picture",
        "simulate",
        "one spike a tick, the frame clipped to 255, charge conserved",
        NUMERICS + "test_saturation",
    ),
    (
        "2,000,000 ticks of dim light",
        "integrate",
        "counts equal the closed form: no drift",
        NUMERICS + "test_two_million_dim_ticks",
    ),
    (
        "integer photons",
        "integrate",
        "the closed form and the paper's step form, bit for bit",
        NUMERICS + "test_integer_photons_step_by_step",
    ),
    (
        "odd sizes (width not a multiple of 8, one pixel)",
        "simulate",
        "shapes as asked, padding bits zero",
        NUMERICS + "test_odd_sizes",
    ),
    (
        "T = 0 and T = 1",
        "integrate",
        "no ticks: the charge unchanged; one tick: one decision",
        NUMERICS + "test_no_tick_and_one_tick",
    ),
    (
        "HDR 1e6:1 in one frame",
        "simulate",
        "counts within one spike of light x ticks everywhere",
        NUMERICS + "test_hdr",
    ),
    (
        "50 px of motion an exposure",
        "shake_path",
        "the length asked for to 1e-6, finite light",
        NUMERICS + "test_fast_motion",
    ),
    ("NaN, infinite or negative light", "simulate", "NumericsError", NUMERICS + "test_light_that_is_not_light"),
    (
        "rays along an axis, through an edge, from a wall",
        "Stage.picture",
        "finite light, no hole",
        NUMERICS + "test_rays_along_axes",
    ),
    (
        "few electrons a tick",
        "shot_noise",
        "the Poisson distribution's mean and variance",
        NUMERICS + "test_shot_noise_is_poisson",
    ),
    (
        "unknown keys, units out of range, contradictions",
        "load_scene_toml",
        "all faults at once, the nearest name",
        "rigctl/test_spec.py::test_all_faults_at_once",
    ),
    ("duplicate effects", "load_scene_toml", "UsageError", "rigctl/test_spec.py::test_effects_that_do_not_go_together"),
    (
        "pictures with NaN, infinite or negative values",
        "sim frames",
        "one DataError that lists them all",
        "rigctl/test_frames.py::test_pictures_that_cannot_be_used",
    ),
]
