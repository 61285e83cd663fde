"""Checks that hold the two arms' light against each other: in time, in brightness, and edge by edge."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.agree import edge_agreement
from spikerig.calib.arms import arms_of
from spikerig.calib.lag import LAGS, Lagged, lag_of, lagged
from spikerig.calib.rig import calibration_of
from spikerig.dataset.check import POSED, Check, Fault, Figure, SceneLook, Undecided, ViewLook, check, fault
from spikerig.dataset.errors import RigError

Floats = NDArray[np.float64]
WORST_PX, VIEW_PX = 0.5, 1.0  # edges apart: the median over views, and of one view
LAG_TICKS, LAG_SHARE = 2.0, 0.05  # beyond its uncertainty: a lag to warn of; share of the exposure that is an error
SURE = 3.0  # standard deviations
UNEVEN = 0.15  # of a view's gain from the median view's
GAIN_OFF = 0.3  # of the median gain from the scene's own


def _lagged(look: ViewLook) -> Lagged:
    arms = arms_of(look)
    most = min(arms.reach, round(arms.window / 2))
    if most < LAGS // 2:
        raise Undecided(f"{max(arms.reach, 0)} ticks beside the exposure: nothing to shift it by")
    lags = np.unique(np.rint(np.linspace(-most, most, LAGS)).astype(int))
    textures = [arms.texture(int(k)) for k in lags]
    good = arms.good & np.all([t.known for t in textures], axis=0)
    if good.sum() < 200:
        raise Undecided("too few pixels known in both arms")
    return lagged(lags, [t.light for t in textures], arms.light, good, arms.window)


@check(
    "sync",
    "warning",
    "pictures fit the spikes best a few ticks before or after the time they say they were exposed at (over 5 % of "
    "the exposure: an error); undecided where the scene hardly moves",
    "fit the clocks again; look at start_ns of the frames",
    measure=_lagged,
    profiles=POSED,
)
def frames_are_in_step(scene: SceneLook, seen: Mapping[str, Lagged]) -> Iterator[Fault | Figure]:
    """The exposure's blur, made of spikes, is shifted in time against the blurry picture: it should fit best at 0."""
    found = lag_of(list(seen.values()))
    yield Figure("lag_ticks", found.ticks)
    yield Figure("sd_ticks", found.sd)
    spare = SURE * found.sd
    bound = max(LAG_TICKS, LAG_SHARE * found.window)
    if spare > bound:
        raise Undecided(f"the lag is known to {found.sd:.1f} ticks only")
    if abs(found.ticks) <= LAG_TICKS + spare:
        return
    end = "at least " if found.at_end else ""
    when = "later" if found.ticks > 0 else "earlier"
    said = f"pictures fit spikes of {end}{abs(found.ticks):.1f} ticks {when} (sd {found.sd:.1f})"
    yield fault("", said, "error" if abs(found.ticks) - spare > bound else None)


def _gain(look: ViewLook) -> float:
    arms = arms_of(look)
    texture = arms.texture()
    good = arms.good & texture.known
    gray = arms.light.mean(2)[good]
    if good.sum() < 200 or gray.mean() <= 0:
        raise Undecided("too few pixels known in both arms")
    return float(texture.light[good].mean() / gray.mean())


@check(
    "sync",
    "warning",
    "the ratio of spikes to picture differs by over 15 % between views, or from light_gain by over 30 %",
    "fix shutter, gain and white balance of the camera; look for flicker; measure `calib photometric`",
    measure=_gain,
    profiles=POSED,
)
def brightness_agrees(scene: SceneLook, seen: Mapping[str, float]) -> Iterator[Fault | Figure]:
    """Both arms see one light: their ratio is the rig's, not the view's."""
    usual = float(np.median(list(seen.values())))
    yield Figure("spikes_a_tick_at_white", usual)
    for name, gain in seen.items():
        if abs(gain / usual - 1) > UNEVEN:
            yield fault(name, f"{gain:.3g} spikes a tick at white, the median view has {usual:.3g}")
    if scene.light_gain and abs(usual / scene.light_gain - 1) > GAIN_OFF:
        yield fault("", f"{usual:.3g} spikes a tick at white, light_gain says {scene.light_gain:.3g}")


def _edges(look: ViewLook) -> tuple[float, float]:
    arms = arms_of(look)
    texture = arms.texture()
    found = edge_agreement(texture.light, arms.light.mean(2), look.view.valid & texture.known)
    if not np.isfinite(found.rms_px):
        raise Undecided("no edges by which the arms could be compared")
    return found.rms_px, float(np.nanmedian(np.linalg.norm(found.shift_px, axis=2)))


@check(
    "alignment",
    "error",
    "edges of both arms lie over 0.5 px apart (median of views); a view whose parts mostly are over 1 px apart is "
    "a warning",
    "align again: `calib align`, with --refine; or calibrate again",
    measure=_edges,
    profiles=POSED,
)
def edges_lie_together(scene: SceneLook, seen: Mapping[str, tuple[float, float]]) -> Iterator[Fault | Figure]:
    """Edges of the picture against edges of the spikes' mean over the same exposure, in 4 x 3 parts."""
    median = float(np.median([rms for rms, _ in seen.values()]))
    yield Figure("median_px", median)
    if median > WORST_PX:
        yield fault("", f"edges lie {median:.2f} px apart (median of {len(seen)} views)")
    for name, (_, apart) in seen.items():
        if apart > max(VIEW_PX, 2 * median):
            yield fault(name, f"edges lie {apart:.2f} px apart in most parts of the picture", "warning")


@check(
    "provenance",
    "error",
    "the calibration record in the scene cannot be read, or was changed by hand",
    "align the raw recording again, with the calibration file",
)
def calibration_can_be_read(scene: SceneLook, _: Mapping[str, object]) -> Iterator[Fault | Figure]:
    """The record is whole, and its id is that of its content."""
    if scene.calibration is None:
        raise Undecided("no calibration")
    try:
        calibration_of(scene.calibration)
    except RigError as error:
        yield fault("", f"{error.what}: {str(error.value)[:200]}")


LIGHT: tuple[Check, ...] = (frames_are_in_step, brightness_agrees, edges_lie_together, calibration_can_be_read)
