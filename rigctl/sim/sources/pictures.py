"""Pictures as light: linear, finite, not negative; what is not is refused, or mended and counted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.dataset.images import read_linear
from spikerig.rigctl.sim.limits import nearest

MENDING = ("refuse", "zero", "clip")


class Bad(NamedTuple):
    """How many values of a picture were no light."""

    nan: int = 0
    infinite: int = 0
    negative: int = 0

    @property
    def any(self) -> bool:
        """Whether there were some."""
        return sum(self) > 0

    def __str__(self) -> str:
        """The counts that are not zero, in words."""
        words = [f"{n} {'NaN' if key == 'nan' else key}" for key, n in self._asdict().items() if n]
        return ", ".join(words) or "none"


def total(counts: Iterable[Bad]) -> Bad:
    """The sum of counts."""
    return Bad(*(sum(column) for column in zip(Bad(), *counts, strict=True)))


def check_mending(how: str) -> str:
    """`how`, where it is a way to treat bad values; a UsageError where not."""
    if how not in MENDING:
        raise UsageError("no such way with bad values", value=how, expected=nearest(how, MENDING))
    return how


def mend(light: NDArray[np.float32], how: str, where: object = "") -> tuple[NDArray[np.float32], Bad]:
    """Light that can be integrated.

    Args:
        light: float32, any shape; changed in place where it is mended.
        how: `refuse` raises; `zero` puts 0 for NaN, infinite and negative values; `clip` puts 0 for NaN and what is
            below it, and the largest finite value of the picture for plus infinity.
        where: what the light is of, for the message.

    Returns:
        (light, counts of what was bad).

    Raises:
        NumericsError: there is something bad, and `how` is `refuse`.
    """
    with np.errstate(invalid="ignore"):
        good = np.isfinite(light) & (light >= 0)
    if good.all():
        return light, Bad()
    nan, infinite, negative = np.isnan(light), np.isinf(light), light < 0
    bad = Bad(int(nan.sum()), int(infinite.sum()), int((negative & ~infinite).sum()))
    if how == "refuse":
        least = f", the least {light[negative & ~infinite].min():.3g}" if bad.negative else ""
        raise NumericsError("values that are no light", value=f"{where}: {bad} of {light.size}{least}".lstrip(": "))
    most = light[good].max() if how == "clip" and good.any() else np.float32(0)
    light[~good] = 0
    if how == "clip":
        light[infinite & ~negative] = most
    return light, bad


def read_light(
    file: Path, *, background: float | None = None, layer: str = "", how: str = "refuse"
) -> tuple[NDArray[np.float32], Bad]:
    """A picture file as light float32[H,W,3], and how much of it had to be mended.

    Args:
        file: EXR, PNG or JPEG.
        background, layer: as for `read_linear`.
        how: as for `mend`.

    Raises:
        DataError: not a picture, or damaged. NumericsError: bad values, refused.
    """
    light = read_linear(
        file, background=background, nonfinite="keep", layer=layer if file.suffix.lower() == ".exr" else ""
    )
    return mend(light, how)


def as_report(how: str, counts: Iterable[Bad]) -> dict[str, Any]:
    """Counts of all pictures, JSON-ready."""
    told = list(counts)
    return {"how": how, "pictures": sum(bad.any for bad in told), **total(told)._asdict()}
