"""Checkerboards and ChArUco boards: what they are, and where a picture shows their corners to a fraction of a pixel."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.saddle import REACH, refine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import srgb_from_linear

Floats = NDArray[np.float64]
SMALL = 800  # pictures narrower than this are doubled before boards are sought: small squares are found then
CLEAR = 1.0  # of the way to the corner of the nearest marker
SMALLEST = 32  # px a side that a picture of a board has at least
LARGEST = 60  # corners a side


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board of squares.

    Args:
        cols, rows: INNER corners, e.g. 9x6 for 10x7 squares.
        square_mm: edge of a square.
        charuco: name of an ArUco dictionary, e.g. "DICT_5X5_100"; empty for a plain checkerboard.
        marker_mm: edge of a ChArUco marker; 0 for a plain checkerboard.
    """

    cols: int
    rows: int
    square_mm: float
    charuco: str = ""
    marker_mm: float = 0.0

    def points(self) -> Floats:
        """float64[N,3] corners in mm about the board's middle, row by row, z = 0."""
        x, y = np.meshgrid(np.arange(self.cols), np.arange(self.rows))
        flat = np.stack([x.ravel() - (self.cols - 1) / 2, y.ravel() - (self.rows - 1) / 2, np.zeros(x.size)], -1)
        return np.asarray(flat, np.float64) * self.square_mm

    @property
    def turns(self) -> tuple[int, ...]:
        """Quarter turns that map the board onto itself: how its corners may be labelled."""
        if self.charuco:
            return (0,)
        return (0, 1, 2, 3) if self.cols == self.rows else (0, 2)

    @property
    def free(self) -> float:
        """How far around a corner nothing but its two edges is to be seen, in squares: markers begin there."""
        bare = 1 - self.marker_mm / self.square_mm if self.charuco else 1.0
        return min(REACH, CLEAR * bare / 2**0.5)

    def relabelled(self, corners: NDArray[Any], turns: int, mirrored: bool = False) -> NDArray[Any]:
        """Corners [N,...] with the labels of a board turned by quarter turns (or first seen in a mirror)."""
        grid = corners.reshape(self.rows, self.cols, *corners.shape[1:])
        grid = grid[:, ::-1] if mirrored else grid
        return np.rot90(grid, turns).reshape(corners.shape)

    def __str__(self) -> str:
        kind = f"ChArUco {self.charuco}" if self.charuco else "checkerboard"
        return f"{self.cols}x{self.rows} inner corners, {self.square_mm:g} mm, {kind}"


@dataclass(frozen=True, slots=True)
class Found:
    """Corners found in a picture.

    Args:
        px: float64[N,2], centres at +0.5; NaN where not seen.
        seen: bool[N].
        method: "sb", "classic" or "charuco".
        mirrored: whether the picture shows the board in a mirror; None where the board cannot tell (a checkerboard).
    """

    px: Floats
    seen: NDArray[np.bool_]
    method: str
    mirrored: bool | None = None


def board_of(pattern: str, square_mm: float, charuco: str = "", marker_mm: float = 0.0) -> Board:
    """A board from a command line.

    Args:
        pattern: "COLSxROWS" inner corners.
        square_mm: edge of a square, > 0.
        charuco, marker_mm: a ChArUco board's dictionary and marker edge (0: three quarters of a square).

    Raises:
        UsageError: not a pattern, not a size, no such dictionary.
    """
    match = re.fullmatch(r"(\d{1,3})[xX×](\d{1,3})", pattern.strip())
    if not match or not all(3 <= int(n) <= LARGEST for n in match.groups()):
        raise UsageError("a pattern is COLSxROWS inner corners", value=pattern, expected="e.g. 9x6, at least 3x3")
    if not (np.isfinite(square_mm) and 1e-3 <= square_mm <= 1e5):
        raise UsageError("the edge of a square is a positive length in mm", value=square_mm, expected="e.g. 24")
    if charuco:
        marker_mm = marker_mm or 0.75 * square_mm
        if not 0 < marker_mm < square_mm:
            raise UsageError("a marker is smaller than its square", value=marker_mm, expected=f"below {square_mm:g} mm")
        _dictionary(charuco)
    elif marker_mm:
        raise UsageError("only a ChArUco board has markers", value=marker_mm, next="give --charuco DICTIONARY too")
    return Board(int(match[1]), int(match[2]), float(square_mm), charuco, float(marker_mm))


def gray8(light: NDArray[Any]) -> NDArray[np.uint8]:
    """Linear light [H,W] as 8-bit gray, encoded like sRGB, its range stretched: what detectors are used to."""
    low, high = np.percentile(light, (0.5, 99.5))
    if not high > low:
        return np.zeros(light.shape, np.uint8)
    return np.rint(srgb_from_linear(np.clip((light - low) / (high - low), 0, 1)) * 255).astype(np.uint8)


def find(light: NDArray[Any], board: Board) -> Found | None:
    """The board's corners in a picture, None where it is not (wholly) seen.

    Args:
        light: [H,W] linear light.
        board: which.

    Returns:
        A Found. A checkerboard is seen wholly or not at all; a ChArUco board may be seen in part (6 corners or more).

    Edges:
        Small pictures are sought at double size. Corners keep OpenCV's order, which is one of the board's `turns`.

    Cost:
        0.2 s for 400x250, 0.7 s for 1920x1080; twice that where there is no board.

    Source:
        Duda and Frese 2018 (findChessboardCornersSB); the classic detector as the fallback; then `saddle.refine`.
    """
    gray = gray8(light)
    found = _find_charuco(gray, board) if board.charuco else _find_plain(gray, board)
    if found is None:
        return None
    return replace(found, px=refine(light, found.px, found.seen, board.cols, board.rows, board.free))


def _find_plain(gray: NDArray[np.uint8], board: Board) -> Found | None:
    import cv2

    size = (board.cols, board.rows)
    everything = np.ones(board.cols * board.rows, bool)
    scales = (2, 1) if gray.shape[1] < SMALL else (1,)
    for more in (0, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE):
        for scale in scales[: 1 if more else None]:
            large = gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
            ok, corners = cv2.findChessboardCornersSB(large, size, flags=cv2.CALIB_CB_ACCURACY | more)
            if ok:
                return Found(ours(corners) / scale, everything, "sb")
    ok, corners = cv2.findChessboardCorners(gray, size)
    return Found(ours(corners), everything, "classic") if ok else None


def ours(corners: NDArray[Any]) -> Floats:
    """OpenCV's corners, (N,1,2) in 4.x and (N,2) in 5, centres at 0: as float64[N,2], centres at +0.5."""
    return np.asarray(corners, np.float64).reshape(-1, 2) + 0.5


def seen_size(light: NDArray[Any]) -> tuple[int, int] | None:
    """How many inner corners (cols, rows) of whatever checkerboard is in a picture; None where there is none."""
    import cv2

    gray = gray8(light)
    if gray.shape[1] < SMALL:
        gray = cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    ok, _, labels = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), cv2.CALIB_CB_LARGER)
    return (int(labels.shape[1]), int(labels.shape[0])) if ok and labels is not None else None


def _dictionary(name: str) -> Any:
    import cv2

    number = getattr(cv2.aruco, name, None) if re.fullmatch(r"DICT_[A-Za-z0-9_]+", name) else None
    if not isinstance(number, int):
        known = sorted(n for n in dir(cv2.aruco) if re.fullmatch(r"DICT_\dX\d_\d+", n))
        raise UsageError("no such ArUco dictionary", value=name, expected=", ".join(known))
    return cv2.aruco.getPredefinedDictionary(number)


def _find_charuco(gray: NDArray[np.uint8], board: Board) -> Found | None:
    """Markers do not read in a mirror: the picture is tried both ways, and the better one says how it was seen.

    Boards with an even number of rows of squares are sought with OpenCV's old pattern too (before 4.6), if need be.
    """
    import cv2

    scale = 2 if gray.shape[1] < SMALL else 1
    large = (
        gray if scale == 1 else np.asarray(cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), np.uint8)
    )
    for old in (False, True) if board.rows % 2 else (False,):
        found = _find_pattern(large, board, old)
        if found is not None:
            return replace(found, px=found.px / scale)
    return None


def _find_pattern(gray: NDArray[Any], board: Board, old: bool) -> Found | None:
    import cv2

    made = cv2.aruco.CharucoBoard(
        (board.cols + 1, board.rows + 1), board.square_mm, board.marker_mm, _dictionary(board.charuco)
    )
    made.setLegacyPattern(old)
    # Where the library has its corners, in squares: its origin and direction have changed between versions.
    at = np.asarray(made.getChessboardCorners(), np.float64)[:, :2] / board.square_mm
    cell = np.rint(at - at.min(0)).astype(int)
    label = cell[:, 1] * board.cols + cell[:, 0]
    detector = cv2.aruco.CharucoDetector(made)
    best: Found | None = None
    for mirrored in (False, True):
        corners, ids, _, _ = detector.detectBoard(np.ascontiguousarray(gray[:, ::-1]) if mirrored else gray)
        if ids is None or len(ids) < 6 or (best is not None and len(ids) <= best.seen.sum()):
            continue
        px = np.full((len(label), 2), np.nan)
        px[label[np.asarray(ids).ravel()]] = ours(corners)
        if mirrored:
            px[:, 0] = gray.shape[1] - px[:, 0]
        best = Found(px, np.isfinite(px[:, 0]), "charuco", mirrored)
    return best
