"""The scene file, RS-3D 1.0: one HDF5 file a scene. The schema as one table, and the four things to do with one.

Reading a file is in `store_read`, writing in `store_write`, checking in `store_verify`; docs/format.md is generated
from the table below.
Every dataset and group carries its SHA-256 in the attribute `sha256`; a group's covers its members' too, so the
root's names the whole content. Texts are UTF-8 of fixed length, numbers little endian, JSON is stored as its bytes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import h5py
import numpy as np
from h5py import h5a  # pyright: ignore[reportAttributeAccessIssue]
from numpy.typing import NDArray

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError
from spikerig.dataset.hdf5_guard import (
    ask_child,
    check_attribute,
    hdf5_faults,
    member,
    open_file,
    refuse,
    remember,
    spot,
)
from spikerig.dataset.scene import Finding, Scene, Trajectory
from spikerig.dataset.terminal import note

if TYPE_CHECKING:
    from spikerig.dataset.store_read import SceneFile as SceneFile
    from spikerig.dataset.store_write import SceneWriter as SceneWriter

FORMAT, VERSION, DIGEST = "RS-3D", "1.0", "sha256"
NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,126}")

# path (? = may be absent) | type | shape | what it is.  `@name` is an attribute of the object above it. Letters in a
# shape agree among the members of a group; H and W are the camera's; {view} stands for a view's name.
SCHEMA = r"""
/                                   | group |        | the scene
  @format                           | text  |        | "RS-3D"
  @version                          | text  |        | "1.0"; a newer minor version is read, a newer major one refused
  @status                           | text  |        | "recording", "complete" or "aborted"
  @name                             | text  |        | of the scene
  @light_gain?                      | float |        | texture value (spikes a tick) of RGB white; absent: not known
  @writer?                          | text  |        | program and version that wrote the file
/info                               | u1    | bytes  | free provenance, a JSON object
/calibration?                       | u1    | bytes  | the rig's calibration, a JSON object
/camera                             | group |        | the one camera of all frames and poses
  @width                            | int   |        | W, pixels
  @height                           | int   |        | H, pixels
/camera/K                           | f8    | 3 3    | camera matrix in pixels, for pixel centres at +0.5
/camera/distortion                  | f8    | D      | OpenCV's order: 0, 4, 5 or 8 values
/clock?                             | group |        | the take's map from the spike camera's time to the rig's
  @drift_ppm                        | float |        | growth of the uncertainty outside the knots
/clock/device_ns                    | i8    | K      | the device's own time at the knots
/clock/rig_ns                       | i8    | K      | the rig's time at the same instants
/clock/sigma_ns                     | f8    | K      | standard deviation at the knots
/points?                            | group |        | sparse surface points
  @source                           | text  |        | "sfm", "simulator", "given" or "random"
/points/xyz                         | f8    | N 3    | world positions
/points/rgb                         | u1    | N 3    | sRGB
/views                              | group |        | the views by name: letters, digits, `-`, `_`, `.`
/views/{view}?                      | group |        | one synchronised look
  @split                            | text  |        | "train" or "test"
  @order                            | int   |        | position in the scene, from 0
/views/{view}/pixels                | u1/u2 | H W 3  | the RGB frame, encoded; full scale is the type's largest value
  @transfer                         | text  |        | "srgb" or "linear"
  @start_ns                         | int   |        | start of exposure of sensor row 0
  @exposure_ns                      | int   |        | exposure time
  @row_ns                           | int   |        | read-out time of one sensor row; 0 for a global shutter
  @clock                            | text  |        | name of the clock of start_ns
/views/{view}/spikes?               | u1    | T h b  | packed ticks, top row first, rows padded to bytes, LSB first
  @width                            | int   |        | pixels a row; b = ceil(width / 8), padding bits zero
  @rate_hz?                         | float |        | ticks a second; absent: not known
  @t0_ns                            | int   |        | start of tick 0
  @clock                            | text  |        | name of the clock of t0_ns
/views/{view}/lost?                 | i8    | L 2    | half-open ranges of lost ticks; there if and only if spikes are
/views/{view}/events?               | group |        | an event camera's look at the same light, in the order of time
  @width                            | int   |        | pixels a row, at most 65536
  @height                           | int   |        | rows, at most 65536
  @t0_ns                            | int   |        | start of the span that was watched
  @t1_ns                            | int   |        | its end, not in it
  @clock                            | text  |        | name of the clock of these times
/views/{view}/events/t_ns           | i8    | N      | times, not decreasing
/views/{view}/events/x              | u2    | N      | columns
/views/{view}/events/y              | u2    | N      | rows, 0 on top
/views/{view}/events/polarity       | i1    | N      | 1 brighter, -1 darker
/views/{view}/sensor_row            | f4    | H W    | row of the RGB sensor each pixel was read at
/views/{view}/valid                 | u1    | H W    | 1 where both arms see, else 0
/views/{view}/pose                  | f8    | 3 4    | cam_from_world of the spike camera, mid-exposure, middle row
/views/{view}/trajectory?           | group |        | poses over the exposure
/views/{view}/trajectory/at_ns      | i8    | K      | times, strictly increasing
/views/{view}/trajectory/poses      | f8    | K 3 4  | cam_from_world at those times
/views/{view}/trajectory/cov?       | f8    | K 6 6  | their covariance
/truth?                             | group |        | what only a simulator knows
  @seed                             | int   |        | of the whole simulation
  @label                            | text  |        | which sub-pose is the truth, e.g. "mid"
/truth/effects                      | u1    | bytes  | effects and their parameters, a JSON object
/truth/clock                        | group |        | the exact map from the device's time to the rig's
  @drift_ppm                        | float |        | growth of the uncertainty outside the knots
/truth/clock/device_ns              | i8    | K      | the device's own time at the knots
/truth/clock/rig_ns                 | i8    | K      | the rig's time at the same instants
/truth/clock/sigma_ns               | f8    | K      | standard deviation at the knots
/truth/views                        | group |        | the truth of the views, by name
/truth/views/{view}?                | group |        | of one view
  @at_ns?                           | int   |        | instant of the light and of the view's pose
/truth/views/{view}/light?          | f4    | H W 3  | sharp linear light, 1.0 = white
/truth/views/{view}/trajectory?     | group |        | the exact path over the exposure
/truth/views/{view}/trajectory/at_ns | i8   | K      | times, strictly increasing
/truth/views/{view}/trajectory/poses | f8   | K 3 4  | cam_from_world at those times
/truth/views/{view}/trajectory/cov? | f8    | K 6 6  | their covariance
"""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the schema: an object ("group" or a dataset), or an attribute ("text", "int", "float").

    A dataset's `dtype` may name several, "u1/u2": of these it has one.
    """

    path: str
    dtype: str
    shape: tuple[str | int, ...]
    about: str
    required: bool
    attrs: Mapping[str, Row]

    @property
    def dtypes(self) -> tuple[np.dtype[Any], ...]:
        """The types a dataset may have."""
        return tuple(np.dtype("<" + kind) for kind in self.dtype.split("/"))


def parse_schema(text: str) -> dict[str, Row]:
    """The rows of a schema table by path, attributes within their objects."""
    rows: dict[str, Row] = {}
    for line in text.strip().splitlines():
        path, dtype, shape, about = (cell.strip() for cell in line.split("|", 3))
        dims = tuple(int(d) if d.isdigit() else d for d in shape.split())
        row = Row(path.rstrip("?"), dtype, dims, about, not path.endswith("?"), {})
        if row.path.startswith("@"):
            cast(dict[str, Row], rows[next(reversed(rows))].attrs)[row.path[1:]] = row
        else:
            rows[row.path] = row
    return rows


ROWS: Mapping[str, Row] = parse_schema(SCHEMA)


def row_of(path: str | None) -> Row | None:
    """The schema's row of an object in a file, None if it has none: `/views/v007/pose` -> `/views/{view}/pose`."""
    return ROWS.get(re.sub(r"^(/truth)?/views/[^/]+", lambda m: (m[1] or "") + "/views/{view}", path or ""))


def schema_markdown() -> str:
    """The schema as a Markdown table, for docs/format.md."""
    lines = ["| path | type | shape | what it is |", "|---|---|---|---|"]
    for row in ROWS.values():
        for one in (row, *row.attrs.values()):
            name = f"`{one.path}`" if one is row else f"&emsp;`{one.path}`"
            shape = " ".join(str(n) for n in one.shape)
            lines.append(
                f"| {name}{'' if one.required else ' (may be absent)'} | {one.dtype} | {shape} | {one.about} |"
            )
    return "\n".join(lines) + "\n"


def read_attr(thing: h5py.Group | h5py.Dataset, name: str) -> Any:
    """An attribute of the schema as str, int or float; None where an optional one is absent.

    Raises:
        DataError: it is missing, or not of its kind.
    """
    row = cast(Row, row_of(thing.name)).attrs[name]
    if not h5a.exists(thing.id, name.encode()):
        if row.required:
            raise refuse(spot(thing), f"the attribute {name} is missing")
        return None
    check_attribute(thing, h5a.open(thing.id, name.encode()))
    value: Any = thing.attrs[name]
    kind = "text" if isinstance(value, bytes | str) else "int" if isinstance(value, np.integer) else "float"
    if kind != row.dtype:
        raise refuse(spot(thing), f"the attribute {name} is {value!r}, where {row.dtype} belongs")
    if kind == "text":
        return value.decode() if isinstance(value, bytes) else str(value)
    return int(value) if kind == "int" else float(value)


def stored_digest(thing: h5py.Group | h5py.Dataset) -> str:
    """The digest an object carries, "" if none."""
    value: Any = thing.attrs.get(DIGEST, b"")
    return value.decode() if isinstance(value, bytes) else str(value)


def group_at(parent: h5py.Group, name: str) -> h5py.Group:
    """A member that must be a group."""
    found = member(parent, name)
    if not isinstance(found, h5py.Group):
        raise refuse(spot(found), "a dataset where a group belongs")
    return found


def read_array(parent: h5py.Group, name: str, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
    """The numbers of a dataset of the schema, of a given shape if one is given."""
    found = dataset_at(parent, name)
    if shape is not None and found.shape != shape:
        raise refuse(spot(found), f"shape {found.shape}, where {shape} belongs")
    return found[()]


def dataset_at(parent: h5py.Group, name: str) -> h5py.Dataset:
    """A member that must be a dataset of the type and shape that its row of the schema says."""
    found = member(parent, name)
    if not isinstance(found, h5py.Dataset):
        raise refuse(spot(found), "a group where a dataset belongs")
    check_shape(found)
    return found


def check_shape(found: h5py.Dataset) -> None:
    """Refuse a dataset that is not of the type and shape of its row."""
    row = row_of(found.name)
    if row is None or found.dtype not in row.dtypes or len(found.shape) != len(row.shape):
        raise refuse(spot(found), f"{found.dtype} of shape {found.shape}: not what the schema says")
    if any(isinstance(want, int) and want != n for want, n in zip(row.shape, found.shape, strict=True)):
        raise refuse(spot(found), f"shape {found.shape}, where the schema says {row.shape}")


def read_json(parent: h5py.Group, name: str) -> dict[str, Any]:
    """A JSON object stored as its UTF-8 bytes."""
    try:
        value = json.loads(read_array(parent, name).tobytes())
    except (ValueError, RecursionError) as error:
        raise refuse(spot(parent, name), f"not JSON: {error}") from error
    if not isinstance(value, dict):
        raise refuse(spot(parent, name), "not a JSON object")
    return value


def has(parent: h5py.Group, name: str) -> bool:
    """Whether a group has a member of that name."""
    return parent.id.links.exists(name.encode())


def read_clock(group: h5py.Group) -> ClockModel:
    """A clock model as it was written."""
    device, rig, sigma = (read_array(group, name) for name in ("device_ns", "rig_ns", "sigma_ns"))
    return ClockModel(device, rig, sigma, read_attr(group, "drift_ppm"))


def read_trajectory(group: h5py.Group) -> Trajectory:
    """A trajectory as it was written."""
    times = read_array(group, "at_ns")
    cov = read_array(group, "cov", (len(times), 6, 6)) if has(group, "cov") else None
    return Trajectory(times, read_array(group, "poses", (len(times), 3, 4)), cov)


def open_scene(path: str | Path, *, partial: bool = False) -> SceneFile:
    """Open a scene file for reading, lazily.

    Args:
        path: of the file; the first time it is seen, a child process looks at it first (see `hdf5_guard`).
        partial: also open one whose writer did not finish, with the views that are whole.

    Raises:
        DataError: damaged, hostile, not RS-3D, of a newer major version, or not finished.
        UsageError: there is no such file.

    Cost:
        40 views: see docs/format.md; 0.3 s more the first time a file is seen.
    """
    from spikerig.dataset.store_read import SceneFile

    file = open_file(path)
    try:
        with hdf5_faults(path):
            check_version(file)
            return SceneFile(file, Path(path), partial)
    except BaseException:
        file.close()
        raise


def check_version(file: h5py.File) -> None:
    """Refuse a file that is not RS-3D, or whose major version is newer than this reader's; note a newer minor one."""
    if not h5a.exists(file.id, b"format") or read_attr(file, "format") != FORMAT:
        raise DataError("not an RS-3D scene", value=file.filename, cause="an HDF5 file of another kind")
    found = read_attr(file, "version")
    match = re.fullmatch(r"(\d{1,4})\.(\d{1,4})", found)
    if not match:
        raise refuse(file.filename, f"version {found!r}")
    major, minor = (int(n) for n in VERSION.split("."))
    if int(match[1]) != major:
        raise DataError(
            "this scene is of a version that this reader does not know",
            value=f"{file.filename}: RS-3D {found}",
            expected=f"RS-3D {major}.x (this reader knows {VERSION})",
            next="pip install --upgrade spikerig",
        )
    if int(match[2]) > minor:
        note(f"{file.filename}: RS-3D {found} is newer than this reader ({VERSION}); what it added is not read")


def write_scene(path: str | Path, scene: Scene, *, force: bool = False) -> None:
    """Write a scene whole: it appears at `path` complete, or not at all.

    Args:
        path: of the file, usually .h5.
        scene: in memory; `store_write.SceneWriter` takes one view at a time.
        force: replace an existing file.

    Raises:
        UsageError: the file exists, or a name or number cannot be stored.
    """
    from spikerig.dataset.store_write import write

    write(path, scene, force)


def verify_scene(path: str | Path) -> list[Finding]:
    """Check a scene file against the schema and all its checksums, in a child process.

    Returns:
        What is wrong, nothing if all is well.

    Raises:
        DataError: it cannot be read at all: damaged, hostile, not RS-3D, of a newer major version.
        UsageError: there is no such file.

    Cost: reads the whole file once.
    """
    found = ask_child("verify", path)
    remember(path)  # the child walked and read it all
    return [Finding(**one) for one in found]


if __name__ == "__main__":
    print(schema_markdown(), end="")


def __getattr__(name: str) -> Any:
    if name in ("SceneFile", "SceneWriter"):  # they import this module's table, so they are found late
        from importlib import import_module

        return getattr(import_module(f"spikerig.dataset.store_{'read' if name == 'SceneFile' else 'write'}"), name)
    raise AttributeError(name)
