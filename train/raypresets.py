"""What the presets mean for the two fields of rays; applied after the method's own settings."""

from __future__ import annotations

from typing import Any

RAYS: dict[str, Any] = {"colour_loss": "l2", "fresh_poses": 0, "densify": "off", "opacity_reg": 0.0, "scale_reg": 0.0}

NERF: dict[str, dict[str, Any]] = {
    "draft": {"steps": 1000, "rays": 256, "coarse": 32, "fine": 32, "width": 64},
    "standard": {"steps": 20_000, "rays": 512, "coarse": 64, "fine": 64, "width": 128},
    "full": {"steps": 100_000},
    "paper": {"steps": 200_000},
}
FAST: dict[str, dict[str, Any]] = {
    "draft": {"steps": 3000, "probes": 32, "fine": 8, "table_log2": 16, "finest": 512},
    "standard": {"steps": 10_000, "probes": 48, "fine": 12, "table_log2": 17, "finest": 512},
    "full": {"steps": 30_000, "probes": 64, "fine": 24, "table_log2": 19, "finest": 1024, "grid_levels": 16},
}


def nerf(preset: str) -> dict[str, Any]:
    """The paper's field: 8 x 256 coarse and fine networks, 64 + 128 samples, 1024 rays of one view a step.

    Smaller at `draft` and `standard`; Adam from 5e-4 down to a tenth.
    """
    shape = {"rays": 1024, "coarse": 64, "fine": 128, "width": 256, "lr_net": 5e-4, "lr_end": 0.1}
    return RAYS | {"field": "nerf"} | shape | NERF[preset]


def nerf_fast(preset: str) -> dict[str, Any]:
    """Hash grid, occupancy grid and small networks: 1024 rays of 8 views a step."""
    shape = {
        "rays": 1024, "views_per_step": 8, "coarse": 96, "width": 64, "grid_levels": 12,
        "lr_net": 5e-3, "lr_grid": 2e-2, "lr_end": 0.05,
    }  # fmt: skip
    return RAYS | {"field": "nerf-fast"} | shape | FAST[preset]
