"""Scenes on which the plan is checked: small ones, from no light to saturation, from rest to 50 px an exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.effects import EFFECTS
from spikerig.rigctl.sim.limits import nearest
from spikerig.rigctl.sim.spec import SceneSpec, read_scene

# Scenes that say so take much less of an effect than its default: so that there is something to leave out, and
# something not to. What is not listed is at its default there too.
FAINT: Mapping[str, Mapping[str, Any]] = {
    "flicker": {"depth": 0.005},
    "brightness_ramp": {"per_s": 0.0002},
    "splitter": {"share": 0.4995},
    "misalignment": {"rotation_deg": [0.003, -0.003, 0.003]},
    "ghost": {"share": 0.0005},
    "distortion": {"k1": -0.0002},
    "defocus": {"radius_px": 0.05},
    "vignetting": {"power": 0.02},
    "shot_noise": {"threshold_e": 50_000},
    "prnu": {"sd": 0.001},
    "dark_current": {"rate": 0.0001},
    "threshold_fpn": {"sd": 0.001},
    "reset_loss": {"loss": 0.0005},
    "comparator_noise": {"sd": 0.001},
    "hot_pixels": {"share": 0.0001},
    "stuck_pixels": {"dead": 0.0001, "lit": 0.00005},
    "row_noise": {"chance": 1e-5},
    "bit_flips": {"chance": 1e-7},
    "lost_blocks": {"chance": 1e-7},
    "clock_offset": {"offset_us": 5.0},
    "clock_jitter": {"sd_us": 1.0},
    "clock_reset": {"jump_us": 10.0},
    "rolling_shutter": {"readout_ms": 0.1},
    "rgb_noise": {"full_well_e": 1e7, "read_e": 1.0},
    "white_balance": {"gains": [1.001, 1.0, 0.999]},
    "read_noise": {"sd": 0.0003},
    "jpeg": {"quality": 100, "colour": "4:4:4"},
}
# A file is coded in one way or none: a third of the scenes takes each.
CODED = ({"jpeg"}, {"video_codec"}, {"bit_depth"})
LEFT = {"sensor_map"}  # needs a file
PLAIN = {"mirror_flip", "bayer", "response_curve", "video_codec", "bit_depth"}  # not faint, whatever they are set to
MARGIN_MS = 6.4  # of a scene file's default


@dataclass(frozen=True, slots=True)
class Case:
    """One scene of the check.

    Args:
        name: of it.
        words: what is hard or easy about it.
        faint: whether its effects are the faint ones.
        luma: of its walls.
        glow: of a lamp in the picture.
        table: what else differs from the plain one, keys dotted.
    """

    name: str
    words: str
    faint: bool = False
    luma: tuple[float, float] = (0.1, 0.8)
    glow: float = 0.0
    table: Mapping[str, Any] = field(default_factory=dict)


DARK = {"sensor.gain": 0.1, "world.ambient": [0.02] * 3, "world.lamp.power": [0.1] * 3}
NIGHT = {"world.ambient": [0.0] * 3, "world.lamp.power": [0.0] * 3}
BLINDING = {"sensor.gain": 2.0, "world.lamp.power": [60.0] * 3}
AROUND = {"orbit.views": 8, "orbit.arc_deg": 300}
SHORT = {"exposure.exposure_ms": 1.0, "exposure.margin_ticks": 64}

CASES: tuple[Case, ...] = (
    Case("plain", "6 to 11 px of motion, middling light and contrast"),
    Case("plain-faint", "the same", True),
    Case("static", "no motion", table={"shake.path_px": [0, 0]}),
    Case("static-faint", "no motion", True, table={"shake.path_px": [0, 0]}),
    Case("fast", "25 px of motion", table={"shake.path_px": [25, 25]}),
    Case("fastest", "50 px of motion, half the picture's width", True, table={"shake.path_px": [50, 50]}),
    Case("dark", "5 % of the light on 1/4 of the gain", table=DARK),
    Case("bright", "the spike sensor half saturated", True, table={"sensor.gain": 3.0}),
    Case("blinding", "both sensors saturated", table=BLINDING),
    Case("low-contrast", "luma 0.49 to 0.51", True, (0.49, 0.51)),
    Case("high-contrast", "luma 0.01 to 0.99, a lamp in the picture", False, (0.01, 0.99), 30.0),
    Case("one-view", "a single view", True, table={"orbit.views": 1}),
    Case("many-views", "8 views around", table=AROUND),
    Case("short", "1 ms: 40 ticks", table=SHORT),
    Case("long", "20 ms: 800 ticks", True, table={"exposure.exposure_ms": 20.0}),
    Case(
        "paper", "18 samples that hold, no margins", table={"exposure.protocol": "paper", "exposure.exposure_ms": 0.45}
    ),
    Case("from-zero", "every pixel starts empty", True, table={"exposure.phase": "zero"}),
    Case("night", "no light at all", table=NIGHT),
)


def case_named(name: str) -> Case:
    """The case of that name.

    Raises:
        UsageError: there is none.
    """
    names = {case.name: case for case in CASES}
    if name not in names:
        raise UsageError("no such scene in the check", value=name, expected=nearest(name, names))
    return names[name]


def scene_of(case: Case, tolerance: tuple[float, float] = (1.0, 1.0)) -> SceneSpec:
    """A case as a scene with `effects = "auto"`, choosing from all effects there are."""
    return read_scene(table_of(case, tolerance), case.name)


def table_of(case: Case, tolerance: tuple[float, float] = (1.0, 1.0)) -> dict[str, Any]:
    """The same as a scene file's table."""
    ball = {"kind": "sphere", "centre": [0, 0, 0.4], "radius": 0.4, "texture": {"kind": "checker", "size": 0.15}}
    wall = {"kind": "tiles", "size": 0.2, "luma": list(case.luma), "chroma": [0.0, 0.05], "seed": 3}
    room = {"kind": "room", "lo": [-3, -3, 0], "hi": [3, 3, 2.6], "floor": wall, "walls": wall, "ceiling": wall}
    box = {"kind": "box", "centre": [0.8, 0.5, 0.3], "size": [0.4, 0.5, 0.6], "yaw_deg": 20, "texture": wall}
    solids: list[Any] = [room, ball, box]
    if case.glow:
        shine = {"kind": "plain", "a": [1, 1, 1], "emit": case.glow}
        solids.append({"kind": "sphere", "centre": [-0.8, 0.3, 0.5], "radius": 0.15, "texture": shine})
    table: dict[str, Any] = {
        "name": case.name,
        "seed": 1 + CASES.index(case),
        "effects": "auto",
        "tolerance": dict(zip(("spikes", "dn"), tolerance, strict=True)),
        "camera": {"width": 100, "height": 64, "fov_deg": 60},
        "orbit": {"views": 3, "radius": 2.2, "height": 1.1, "target": [0, 0, 0.5], "arc_deg": 100, "test_every": 0},
        "shake": {"path_px": [6, 11]},
        "exposure": {"exposure_ms": 8.0},
        "points": {"count": 50},
        "world": {
            "ambient": [0.5, 0.5, 0.52],
            "lamp": {"position": [-0.6, -0.8, 2.4], "power": [2.2, 2.1, 1.9]},
            "solids": solids,
        },
    }
    for path, value in case.table.items():
        at = table
        *way, last = path.split(".")
        for key in way:
            at = at.setdefault(key, {})
        at[last] = value
    return {**table, "consider": considered(case, table["exposure"])}


def considered(case: Case, exposure: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """All effects that the scene can have at once, as a scene file would list them."""
    files = set().union(*CODED) - CODED[CASES.index(case) % len(CODED)]
    left = LEFT | files | (PLAIN if case.faint else set())
    if exposure.get("phase") == "zero":
        left = left | {"initial_phase"}
    rows = []
    for name in EFFECTS:
        if name in left:
            continue
        row = {"name": name, **(FAINT.get(name, {}) if case.faint else {})}
        if name == "rolling_shutter":  # its rows must lie within the margins
            margin_ms = MARGIN_MS if "margin_ticks" not in exposure else exposure["margin_ticks"] / 40
            row["readout_ms"] = 0.0 if exposure.get("protocol") == "paper" else min(7.0, 1.9 * margin_ms)
            row["readout_ms"] = min(row["readout_ms"], FAINT[name]["readout_ms"]) if case.faint else row["readout_ms"]
        rows.append(row)
    return rows
