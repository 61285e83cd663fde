"""How sure a rig is: of each parameter, and of where the crop lies, by the residuals and by leaving views out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.bundle import Fit, turn
from spikerig.calib.crop import grid, rgb_px_from_spike_px, spike_px_from_rgb_px
from spikerig.calib.evidence import jackknife_cov
from spikerig.calib.lens import COEFFICIENTS, stored
from spikerig.calib.parity import inverse
from spikerig.calib.rig import RigCalibration
from spikerig.dataset.scene import Camera, Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Certainty:
    """Uncertainties of a joint fit.

    Args:
        names: of the shared parameters, e.g. "spike.fx_px".
        sd, jackknife: standard deviation of each by the residuals and by leaving views out; `sd` of the baseline too.
        left_out: float64[V,P] of `names`: the parameters without each view; NaN for views not used.
        crop_sd_px: standard deviation of the crop over the spike picture, float64[4,5] (down, across): the larger of
            that by the residuals and that by leaving views out.
        crop_left_out_px: float64[V], how far the crop moves without that view, at most.
    """

    names: tuple[str, ...]
    sd: Mapping[str, float]
    jackknife: Mapping[str, float]
    left_out: Floats
    crop_sd_px: Floats
    crop_left_out_px: Floats

    @property
    def worst_crop_px(self) -> float:
        """The crop's standard deviation where it is largest; infinite where nothing is known."""
        return float(np.nanmax(self.crop_sd_px)) if np.isfinite(self.crop_sd_px).any() else float("inf")


def certainty(record: RigCalibration, fit: Fit, alone: tuple[Fit, Fit], held: bool, left_out: Floats) -> Certainty:
    """Uncertainties of a rig.

    Args:
        record: of the fit.
        fit: the joint fit.
        alone: each arm's own fit, for lenses that were held.
        held: whether they were.
        left_out: float64[V,P], `parameters` without each view.
    """
    names, at = parameters(fit, fit)
    cov = _covariance(fit, alone, held, names)
    sd = {n: float(np.sqrt(max(cov[k, k], 0))) for k, n in enumerate(names)}
    used = np.isfinite(left_out).all(axis=1)
    rows = left_out[used]
    scatter = np.sqrt(np.diag(jackknife_cov(rows))) if len(rows) > 1 else np.full(len(names), np.nan)
    here = grid(record.spike.width, record.spike.height, 5, 4)
    rgb = rgb_px_from_spike_px(record, here)

    def crop(values: Floats) -> Floats:
        return spike_px_from_rgb_px(_with(record, fit, values), rgb)

    steps = np.clip(1e-3 * np.sqrt(np.maximum(np.diag(cov), 0)), 1e-9, 1e-3 * np.maximum(np.abs(at), 1e-2))
    slopes = np.stack([
        (crop(at + h * e) - crop(at - h * e)) / (2 * h) for h, e in zip(steps, np.eye(len(at)), strict=True)
    ], -1)  # fmt: skip
    spread = np.einsum("...ip,pq,...iq->...", slopes, cov, slopes)
    moved = np.full(len(left_out), np.nan)
    if len(rows) > 1:
        crops = np.stack([crop(values) for values in rows]) - here
        moved[used] = np.nanmax(np.linalg.norm(crops, axis=-1), axis=(1, 2), initial=0)
        off = crops - crops.mean(0)
        spread = np.fmax(spread, (off**2).sum((0, -1)) * (len(rows) - 1) / len(rows))
    unit = fit.step[:, 3] / max(float(np.linalg.norm(fit.step[:, 3])), 1e-300)
    sd["baseline_mm"] = float(np.sqrt(max(unit @ cov[-3:, -3:] @ unit, 0)))
    jackknife = dict(zip(names, scatter.tolist(), strict=True))
    return Certainty(names, sd, jackknife, left_out, np.sqrt(spread), moved)


def parameters(fit: Fit, near: Fit) -> tuple[tuple[str, ...], Floats]:
    """Names and values of all shared parameters; the step's turn in radians, away from that of `near`."""
    names: list[str] = []
    values: list[float] = []
    for arm, (K, c) in zip(("spike", "rgb"), fit.lenses, strict=True):
        names += [f"{arm}.{n}_px" for n in ("fx", "fy", "cx", "cy")] + [f"{arm}.{n}" for n in COEFFICIENTS[: len(c)]]
        values += [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *c]
    R = fit.step[:, :3] @ near.step[:, :3].T
    names += ["turn_x_rad", "turn_y_rad", "turn_z_rad", "shift_x_mm", "shift_y_mm", "shift_z_mm"]
    values += [*(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2), *fit.step[:, 3]]
    return tuple(names), np.array(values)


def _covariance(fit: Fit, alone: tuple[Fit, Fit], held: bool, names: tuple[str, ...]) -> Floats:
    """Covariance float64[P,P] in the order of `names`; of held lenses that of each arm alone."""
    cov, place = np.zeros((len(names), len(names))), {n: k for k, n in enumerate(names)}

    def put(part: Fit, own: Mapping[str, str]) -> None:
        at = [place[own[n]] for n in part.names]
        cov[np.ix_(at, at)] = part.cov

    lens = {f"{n}{k}": f"{arm}.{n}_px" for k, arm in enumerate(("spike", "rgb")) for n in ("fx", "fy", "cx", "cy")}
    lens |= {f"{n}_{k}": f"{arm}.{n}" for k, arm in enumerate(("spike", "rgb")) for n in COEFFICIENTS}
    step = {f"turn_{a}": f"turn_{a}_rad" for a in "xyz"} | {f"shift_{a}": f"shift_{a}_mm" for a in "xyz"}
    if held:
        put(alone[0], lens)
        put(alone[1], _second(lens))
    put(fit, {**lens, **step})
    return cov


def _second(lens: Mapping[str, str]) -> dict[str, str]:
    """Names of a lens fitted alone (camera 0) -> those of the RGB arm."""
    return {n[:-1] + "0": v for n, v in lens.items() if v.startswith("rgb.")}


def _with(record: RigCalibration, fit: Fit, values: Floats) -> RigCalibration:
    """The record with other parameters: lenses, the step's turn and shift."""
    made: dict[str, Any] = {}
    at = 0
    for arm, (K, c) in zip(("spike", "rgb"), fit.lenses, strict=True):
        fx, fy, cx, cy = values[at : at + 4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        camera = record.camera(arm)  # type: ignore[arg-type]
        made[arm] = replace(camera, K=K, distortion=stored(values[at + 4 : at + 4 + len(c)]))
        at += 4 + len(c)
    step = np.concatenate([turn(values[at : at + 3]) @ fit.step[:, :3], values[at + 3 :, None]], 1)
    return replace(record, spike_from_rgb=Pose(inverse(step)), **made)


def rounded(record: RigCalibration) -> RigCalibration:
    """The record without the last digits, which differ from run to run (sums take the order that memory suggests)."""

    def camera(c: Camera) -> Camera:
        return replace(c, K=c.K.round(6), distortion=c.distortion.round(9))

    M = record.spike_from_rgb.cam_from_world
    step = np.concatenate([M[:, :3].round(9), M[:, 3:].round(5)], 1) + 0.0  # no negative zeros
    return replace(
        record,
        spike=camera(record.spike),
        rgb=camera(record.rgb),
        spike_from_rgb=Pose(step),
        depth_mm=(round(record.depth_mm[0], 3), round(record.depth_mm[1], 3)),
        residual_px=round(record.residual_px, 6),
        sd={name: float(f"{value:.3g}") for name, value in record.sd.items()},
    )
