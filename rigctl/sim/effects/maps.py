"""A sensor's own maps, pixel by pixel, from calibration."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts, surplus
from spikerig.rigctl.sim.limits import limits

MOST_PIXELS = 1 << 26
MAPS = {"gain": (True, 100.0), "dark": (True, 1.0), "noise": (False, 0.2)}  # needed; largest value


class Maps(NamedTuple):
    """Per-pixel maps float32[H,W]: relative gain, dark thresholds a tick, sd of the threshold (or None)."""

    gain: Floats
    dark: Floats
    noise: Floats | None


@dataclass(frozen=True, slots=True)
class SensorMap:
    """Gain, dark current and comparator noise of one real sensor.

    The file is a NumPy archive of float32 [H,W]: `gain` (relative, of the light; what threshold and photo response do
    together, mean 1), `dark` (thresholds a tick) and, if known, `noise` (sd of the threshold, of which the kernel takes
    the median). A picture smaller than the maps sees their middle part: rows from (H - h) // 2, columns alike.

    Args:
        file: the archive; in a scene file, its path from there.
    """

    file: str = limits("", unit="a .npz file")

    name: ClassVar[str] = "sensor_map"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "the sensor's own flat fields; RSIR (MM 2023) calibrates the same two maps"
    vanishes: ClassVar[str] = "gain = 1, dark = 0, no noise; or no file"
    cost_ns: ClassVar[float] = 2.0
    excludes: ClassVar[tuple[str, ...]] = ("prnu", "dark_current", "threshold_fpn")

    def placed(self, folder: Path) -> SensorMap:
        """With its file seen from a folder; a DataError where that cannot be used."""
        moved = SensorMap(str(folder / self.file) if self.file else "")
        read_maps(moved.file)
        return moved

    def begin(self, site: Site) -> Hooks:
        """The part of the maps that the picture covers."""
        if not self.file:
            return Hooks(light=lambda block: None)
        gain, dark, noise = cropped(read_maps(self.file), site.height, site.width, self.file)

        def light(block: Floats) -> None:
            block *= gain
            block += dark

        sd = 0.0 if noise is None else float(np.median(noise))
        return Hooks(light=light, pixel={"comparator": (sd, site.key(self.name))} if sd > 0 else {})

    def magnitude(self, facts: Facts) -> Bound:
        """Light x (gain - 1) + dark, over all pairs of light and a sample of the map; noise at both ends."""
        if not self.file:
            return Bound(0.0, 0.0, "no maps")
        gain, dark, noise = cropped(read_maps(self.file), *facts.size, self.file)
        n = max(1, -(-8192 // max(1, facts.light.size)))
        pick = np.random.default_rng(95).integers(0, gain.size, (n, facts.light.size))
        after = facts.light * gain.reshape(-1)[pick] + dark.reshape(-1)[pick]
        moved = after - surplus(after, after + (facts.light_max - facts.light)) - facts.rate
        sd = 0.0 if noise is None else float(np.median(noise))
        start, end = (sd * (np.abs(z) + 2) for z in facts.normal(2)[:, :n])
        spikes = facts.counted(moved * facts.ticks + end - start, moved * facts.margin_ticks + start)
        told = (
            f"gain 1 +- {float(gain.std()):.3g}, dark {float(dark.mean()):.3g} +- {float(dark.std()):.3g}, noise {sd:g}"
        )
        return Bound(spikes, 0.0, f"{told}, x {facts.ticks}")


@lru_cache(maxsize=4)
def read_maps(file: str) -> Maps:
    """The maps of an archive.

    Raises:
        DataError: not there, not such an archive, not finite, out of range, or of different sizes: all faults at once.
    """
    faults: list[str] = []
    found: dict[str, NDArray[np.float32]] = {}
    try:
        with zipfile.ZipFile(Path(file)) as archive:
            for name, (needed, most) in MAPS.items():
                if f"{name}.npy" not in archive.namelist():
                    faults += [f"'{name}' is missing"] if needed else []
                    continue
                try:
                    found[name] = _map(archive, name, most)
                except ValueError as error:
                    faults.append(f"'{name}' {error}")
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        faults.append(getattr(error, "strerror", None) or "not a NumPy archive")
    if len({array.shape for array in found.values()}) > 1:
        faults.append("sizes differ: " + ", ".join(f"{k} {v.shape}" for k, v in found.items()))
    if not faults and not np.isclose(found["gain"].mean(dtype=np.float64), 1, atol=0.02):
        faults.append(f"'gain' is relative, with mean 1; here {found['gain'].mean():.4g}")
    if faults:
        raise DataError(
            "the sensor's maps cannot be used",
            value=f"{file or '(no file)'}: " + "; ".join(faults),
            expected="a .npz of float32 [H,W] arrays gain (mean 1), dark (thresholds a tick) and perhaps noise",
        )
    return Maps(found["gain"], found["dark"], found.get("noise"))


def _map(archive: zipfile.ZipFile, name: str, most: float) -> NDArray[np.float32]:
    """One array, its header checked before anything of its size is allocated; nothing is unpickled."""
    with archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"is of version {version}")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        if dtype != np.float32 or len(shape) != 2 or not 0 < shape[0] * shape[1] <= MOST_PIXELS:
            raise ValueError(f"is {dtype} {shape}")
        n = 4 * shape[0] * shape[1]
        data = file.read(n)
        if len(data) != n:
            raise ValueError(f"ends after {len(data)} of {n} bytes")
        array = np.frombuffer(data, np.float32).reshape(shape, order="F" if fortran else "C")
    if not (np.isfinite(array).all() and array.min() >= 0 and array.max() <= most):
        raise ValueError(f"holds values that are not finite or not in 0 to {most:g}")
    return array


def cropped(maps: Maps, height: int, width: int, file: str) -> Maps:
    """The middle part of maps; a DataError where they are smaller than the picture."""
    h, w = maps.gain.shape
    if h < height or w < width:
        raise DataError(
            "the sensor's maps are smaller than the picture",
            value=f"{file}: {w}x{h}",
            expected=f"at least {width}x{height}",
            next="set camera.width and camera.height to the sensor's",
        )
    y, x = (h - height) // 2, (w - width) // 2
    return Maps(*(None if m is None else m[y : y + height, x : x + width] for m in maps))  # type: ignore[arg-type]
