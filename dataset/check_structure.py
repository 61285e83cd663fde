"""Checks of what is there: the file itself, splits, sizes, pictures, and the pixels of the spike sensor."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.check import Check, Fault, check, fault
from spikerig.dataset.check_look import SceneLook, Undecided, ViewLook

MIN_VALID = 0.5  # share of valid pixels
FLAT_SHARE = 0.2  # of a picture's pixels at full scale, from which on it is over-exposed
FULL_RATE, FULL_SHARE = 0.95, 0.02  # spikes a tick of a pixel that is clipped; share of such pixels
FEW_SPIKES = 4.0  # a view's median spikes a pixel, below which textures are mostly noise
BAD_PIXELS = 1e-3  # share of dead or hot pixels that a good sensor keeps below
MIN_VIEWS = 3  # views over which a pixel's own fault shows through the scene's texture


@check(
    "structure",
    "error",
    "the scene holds no view, or none to train on",
    "capture or build the scene again",
)
def views_to_train_on(scene: SceneLook, _: Mapping[str, object]) -> Iterator[Fault]:
    """There must be a view to train on."""
    if not scene.names:
        yield fault("", "no views")
    elif not scene.train:
        yield fault("", f"all {len(scene.names)} views are held out")


@check(
    "structure",
    "note",
    "no view is held out: nothing can be scored (a warning for a release)",
    "hold views out: `data build --test-every 8`, or `test` of the capture",
    profiles=("scene", "release"),
)
def views_to_test_on(scene: SceneLook, _: Mapping[str, object]) -> Iterator[Fault]:
    """A scene without held-out views cannot be scored."""
    if scene.names and not scene.test:
        yield fault("", f"none of {len(scene.names)} views is held out")


def _spike_size(look: ViewLook) -> tuple[int, int] | None:
    held_out = look.view.split == "test"
    if look.scene.file.has_spikes(look.name):
        return look.survey.width, look.survey.height
    if held_out:
        raise Undecided("held out, without spikes")
    return None


@check(
    "structure",
    "warning",
    "a view to train on has no spikes",
    "record it again, or leave the view out",
    measure=_spike_size,
)
def spikes_are_there(scene: SceneLook, seen: Mapping[str, tuple[int, int] | None]) -> Iterator[Fault]:
    """Views to train on have spikes; a scene of pictures only is noted once."""
    without = [name for name, size in seen.items() if size is None]
    if len(without) == len(seen):
        yield fault("", "no view has spikes: a scene of pictures only", "note")
        return
    for name in without:
        yield fault(name, "no spikes")


@check(
    "structure",
    "error",
    "spikes are not of the camera's size",
    "align the raw recording: `spikerig calib align`",
    measure=_spike_size,
    profiles=("scene", "release"),
)
def spikes_fit_the_camera(scene: SceneLook, seen: Mapping[str, tuple[int, int] | None]) -> Iterator[Fault]:
    """In an aligned scene, the spikes' pixels are the pictures'."""
    want = (scene.camera.width, scene.camera.height)
    for name, size in seen.items():
        if size is not None and size != want:
            yield fault(name, f"spikes of {size[0]}x{size[1]}, pictures of {want[0]}x{want[1]}")


@check(
    "structure",
    "error",
    "a view has no valid pixel; below half of them valid it is a warning",
    "look at the alignment's regions and the overlap of the two arms",
    measure=lambda look: float(look.view.valid.mean()),
)
def pixels_are_valid(scene: SceneLook, seen: Mapping[str, float]) -> Iterator[Fault]:
    """A view needs pixels that both arms see."""
    for name, share in seen.items():
        if share == 0:
            yield fault(name, "no pixel is valid")
        elif share < MIN_VALID:
            yield fault(name, f"only {100 * share:.0f} % of the pixels are valid", "warning")


@dataclass(frozen=True, slots=True)
class Bright:
    """A picture's brightness: its largest value, the spread of its values, the share of pixels at full scale."""

    most: int
    spread: float
    full: float


def _bright(look: ViewLook) -> Bright:
    pixels = look.frame.pixels[look.view.valid]
    if not pixels.size:
        raise Undecided("no valid pixel")
    return Bright(int(pixels.max()), float(np.ptp(pixels)), float((pixels == look.frame.full).all(1).mean()))


@check(
    "structure",
    "error",
    "a picture is black or of one colour; over-exposed (20 % white) is a warning",
    "look at the picture; record it again with a shutter and lamps that fit",
    measure=_bright,
)
def pictures_show_something(scene: SceneLook, seen: Mapping[str, Bright]) -> Iterator[Fault]:
    """A picture that is black, flat or burnt out teaches nothing."""
    for name, bright in seen.items():
        if bright.most == 0:
            yield fault(name, "the picture is black")
        elif bright.spread == 0:
            yield fault(name, f"every pixel of the picture is {bright.most}")
        elif bright.full >= FLAT_SHARE:
            yield fault(name, f"{100 * bright.full:.0f} % of the picture is white", "warning")


def _prints(look: ViewLook) -> tuple[str, str]:
    spikes = ""
    if look.scene.file.has_spikes(look.name) and look.survey.counts.any():
        spikes = hashlib.sha256(look.survey.counts.tobytes() + look.survey.per_tick.tobytes()).hexdigest()
    return hashlib.sha256(np.ascontiguousarray(look.frame.pixels).tobytes()).hexdigest(), spikes


@check(
    "structure",
    "error",
    "two views have the same picture, or the same spikes",
    "leave one of them out",
    measure=_prints,
)
def views_differ(scene: SceneLook, seen: Mapping[str, tuple[str, str]]) -> Iterator[Fault]:
    """The same bytes under two names: a copy, or a file that was read twice."""
    for k, what in enumerate(("picture", "spikes")):
        first: dict[str, str] = {}
        for name, prints in seen.items():
            if prints[k] and first.setdefault(prints[k], name) != name:
                yield fault(name, f"the same {what} as {first[prints[k]]}")


@dataclass(frozen=True, slots=True)
class Rates:
    """Spikes a tick of every pixel, float32[H,W], over how many ticks."""

    rate: NDArray[np.float32]
    ticks: int


def _rates(look: ViewLook) -> Rates:
    s = look.survey
    if s.kept == 0:
        raise Undecided("no ticks that were not lost")
    return Rates((s.counts / s.kept).astype(np.float32), s.kept)


def _levels(look: ViewLook) -> tuple[float, float, float]:
    rates = _rates(look)
    clipped = float((rates.rate >= FULL_RATE).mean())
    return float(rates.rate.mean()), clipped, float(np.median(rates.rate)) * rates.ticks


@check(
    "structure",
    "error",
    "a view's spikes are all 0, or every pixel fires in every tick",
    "look at link, power and lens cap of the spike camera; record again",
    measure=_levels,
)
def spikes_are_not_stuck(scene: SceneLook, seen: Mapping[str, tuple[float, float, float]]) -> Iterator[Fault]:
    """A stream of one value is no recording."""
    for name, (mean, _, _) in seen.items():
        if mean == 0:
            yield fault(name, "not one spike")
        elif mean == 1:
            yield fault(name, "every pixel fires in every tick")


@check(
    "structure",
    "warning",
    "over 2 % of the pixels fire in nearly every tick, or the median pixel fires fewer than 4 times",
    "less light, or more of it: the sensor's range is between them",
    measure=_levels,
)
def light_fits_the_sensor(scene: SceneLook, seen: Mapping[str, tuple[float, float, float]]) -> Iterator[Fault]:
    """Clipped pixels have lost their light, dark ones drown in the noise of counting."""
    for name, (mean, clipped, median) in seen.items():
        if mean in (0, 1):
            continue  # stuck: another check's
        if clipped > FULL_SHARE:
            yield fault(name, f"{100 * clipped:.1f} % of the pixels fire in {100 * FULL_RATE:g} % of the ticks or more")
        if median < FEW_SPIKES:
            yield fault(name, f"the median pixel fires {median:.1f} times in the whole view")


@check(
    "structure",
    "warning",
    "over 0.1 % of the spike sensor's pixels never fire in any view where their neighbours do, or fire several "
    "times as often in all of them",
    "mask them, or even textures out with the sensor's maps (`calib photometric`)",
    measure=_rates,
)
def sensor_pixels_work(scene: SceneLook, seen: Mapping[str, Rates]) -> Iterator[Fault]:
    """Dead and hot pixels keep their place while the scene's texture moves on: the mean over views shows them."""
    dead, hot = bad_pixels(list(seen.values()), stride=2 if _bayer(scene) else 1)
    for what, where in (("never fire", dead), ("fire far more often than their neighbours", hot)):
        if where.mean() > BAD_PIXELS:
            y, x = (int(v[0]) for v in np.nonzero(where))
            yield fault("", f"{int(where.sum())} pixels ({100 * where.mean():.2f} %) {what}, the first at x {x}, y {y}")


def bad_pixels(views: Sequence[Rates], stride: int = 1) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which pixels are dead, and which are hot, by all views together.

    Args:
        views: at least MIN_VIEWS, of one size.
        stride: of neighbours that see the same colour; 2 on a Bayer sensor.

    Returns:
        (dead, hot) bool[H,W].

    Raises:
        Undecided: too few views, or of different sizes.
    """
    if len(views) < MIN_VIEWS or len({v.rate.shape for v in views}) > 1:
        raise Undecided(f"it takes {MIN_VIEWS} views of one sensor to tell its pixels from the scene")
    ticks = sum(v.ticks for v in views)
    mean = np.sum([v.rate.astype(np.float64) * v.ticks for v in views], axis=0) / ticks
    around = neighbours(mean, stride)
    usual, most = np.median(around, 0), around.max(0)
    further = np.max([np.median(neighbours(mean, n * stride), 0) for n in (3, 6)], axis=0)  # a dead block has dead rims
    dead = (mean == 0) & (np.maximum(usual, further) * ticks >= 16)
    hot = (mean > 4 * usual + 0.02) & (mean > 1.5 * most)
    return dead, hot | ((mean > 0.98) & (most < 0.5))


def neighbours(picture: NDArray[np.float64], stride: int = 1) -> NDArray[np.float64]:
    """The eight neighbours of every pixel, float64[8,H,W]; beyond the border they are mirrored."""
    height, width = picture.shape
    wide = np.pad(picture, stride, mode="reflect" if min(picture.shape) > stride else "edge")
    steps = [(j, i) for j in (0, 1, 2) for i in (0, 1, 2) if (j, i) != (1, 1)]
    return np.stack([wide[j * stride : j * stride + height, i * stride : i * stride + width] for j, i in steps])


def _bayer(scene: SceneLook) -> bool:
    from spikerig.dataset.bayer import bayer_of

    return bayer_of(scene.info) is not None


STRUCTURE: tuple[Check, ...] = (
    views_to_train_on, views_to_test_on, spikes_are_there, spikes_fit_the_camera, pixels_are_valid,
    pictures_show_something, views_differ, spikes_are_not_stuck, light_fits_the_sensor, sensor_pixels_work,
)  # fmt: skip
