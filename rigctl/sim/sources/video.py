"""Video files as linear light: the stream's transfer, matrix, range and primaries, its true times, its rotation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.exr import check_size
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.primaries import REC709, rec709_from
from spikerig.dataset.pyav import pyav
from spikerig.rigctl.sim.limits import nearest

D65 = (0.3127, 0.3290)
# Codes of ISO/IEC 23091-2 (H.273), as FFmpeg uses them. Absent or 2: not said.
TRANSFERS = {
    1: "bt709", 4: "gamma22", 5: "gamma28", 6: "bt709", 8: "linear", 13: "srgb", 14: "bt709", 15: "bt709", 16: "pq",
    18: "hlg",
}  # fmt: skip
PRIMARIES: dict[int, tuple[float, ...]] = {
    1: REC709,
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *D65),
    6: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *D65),
    7: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *D65),
    9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),
}
MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9}  # matrix coefficients -> what swscale calls them
NAMES = ("bt709", "srgb", "linear", "gamma22", "gamma28", "hlg", "pq")


def linear_from(name: str, codes: ArrayLike) -> NDArray[np.floating]:
    """Linear light of encoded values 0 to 1.

    Args:
        name: bt709 (and BT.601, BT.2020: the camera's curve inverted), srgb, linear, gamma22, gamma28; hlg and pq put
            1.0 at their reference white (75 % signal; 203 cd/m2).
        codes: any shape.

    Source:
        ITU-R BT.709-6 1.2, BT.2100-2 tables 4 and 5, BT.2408 for the reference whites; IEC 61966-2-1.
    """
    x = np.asarray(codes, np.float64)
    if name == "srgb":
        return linear_from_srgb(x)
    if name == "bt709":
        return np.where(x < 4.5 * 0.018, x / 4.5, ((np.maximum(x, 0.081) + 0.099) / 1.099) ** (1 / 0.45))
    if name in ("gamma22", "gamma28"):
        return np.maximum(x, 0) ** (2.2 if name == "gamma22" else 2.8)
    if name == "hlg":
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = np.where(x <= 0.5, x * x / 3, (np.exp((np.maximum(x, 0.5) - c) / a) + b) / 12)
        return scene / ((np.exp((0.75 - c) / a) + b) / 12)
    if name == "pq":
        m = np.maximum(x, 0) ** (32 / 2523)
        return (np.maximum(m - 0.8359375, 0) / (18.8515625 - 18.6875 * m)) ** (8192 / 1305) * (10_000 / 203)
    return x


@dataclass(slots=True)
class Video:
    """An open video.

    Args:
        path: of the file.
        file, container, stream: what is open, PyAV's.
        transfer: of `NAMES`.
        facts: what was found and assumed, JSON-ready; grows while frames are read.
    """

    path: Path
    file: BinaryIO
    container: Any
    stream: Any
    transfer: str
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def seconds(self) -> float | None:
        """How long it claims to be."""
        if self.stream.duration and self.stream.time_base:
            return float(self.stream.duration * self.stream.time_base)
        return self.container.duration / 1e6 if self.container.duration else None

    @property
    def fps(self) -> Fraction | None:
        """Its average (or guessed) frame rate."""
        rate = self.stream.average_rate or self.stream.guessed_rate
        return Fraction(rate) if rate else None

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height, after rotation."""
        ratio = float(self.stream.sample_aspect_ratio or 1) or 1.0
        return 1 / ratio if self.facts.get("rotation_deg", 0) % 180 else ratio

    def frames(self) -> Iterator[tuple[Fraction | None, NDArray[np.float32]]]:
        """(seconds since the first frame, linear Rec.709 float32[H,W,3]) of each, upright; None: the file does not say.

        Raises:
            DataError: a frame is damaged, or the file breaks off.
        """
        av = pyav()
        first: Fraction | None = None
        number, last = 0, Fraction(0)
        try:
            for frame in self.container.decode(self.stream):
                if frame.is_corrupt:
                    raise self._broken(number, float(last), "a frame is damaged")
                at = None if frame.pts is None or frame.time_base is None else frame.pts * Fraction(frame.time_base)
                first = at if first is None else first
                last = at - first if at is not None and first is not None else last
                if frame.interlaced_frame:
                    self.facts["interlaced"] = True
                yield (None if at is None or first is None else at - first), self._light(frame)
                number += 1
        except (av.FFmpegError, OSError, ValueError) as error:
            if isinstance(error, DataError):
                raise
            raise self._broken(number, float(last), str(error)) from error
        promised = self.stream.frames
        if number == 0:
            raise DataError("the video has no frames", value=self.path, cause="an empty or truncated recording")
        if promised and number < 0.98 * promised - 2:
            raise self._broken(number, float(last), f"{promised} frames were promised")

    def _broken(self, number: int, at: float, cause: str) -> DataError:
        return DataError(
            "the video is damaged or breaks off", value=f"{self.path}: after {number} frames, {at:.3f} s", cause=cause,
            next=f"copy it again, or take what is whole with --limit {max(int(at * 10) - 1, 0) / 10:g}",
        )  # fmt: skip

    def _light(self, frame: Any) -> NDArray[np.float32]:
        """Linear light of a decoded frame."""
        check_size(self.path, frame.width, frame.height)
        deep = max(c.bits for c in frame.format.components) > 8
        whole = frame.format.is_rgb or frame.format.name.startswith("yuvj")
        full = frame.color_range == 2 or (frame.color_range != 1 and whole)
        self.facts |= {"full_range": full, "matrix": self._matrix(frame)}
        codes = frame.reformat(
            format="rgb48le" if deep else "rgb24", src_colorspace=self._matrix(frame), dst_color_range=2,
            src_color_range=2 if full else 1, threads=1,
        ).to_ndarray()  # fmt: skip
        light = _curve(self.transfer, deep).take(codes)
        primaries = PRIMARIES.get(int(self.stream.codec_context.color_primaries or 2), REC709)
        if primaries != REC709:
            light = np.maximum(light @ rec709_from(primaries).T.astype(np.float32), 0)  # beyond the gamut: its edge
        turns = round(getattr(frame, "rotation", 0) / 90) % 4
        if turns:
            self.facts["rotation_deg"] = turns * 90
            light = np.rot90(light, turns)
        return np.ascontiguousarray(light)

    def _matrix(self, frame: Any) -> int:
        said = MATRICES.get(int(frame.colorspace))
        return said or (1 if frame.height >= 720 else 5)

    def close(self) -> None:
        """Release the file."""
        self.container.close()
        self.file.close()


def open_video(path: Path, transfer: str = "auto") -> Video:
    """Open a video file's first stream of pictures; nothing else is opened, whatever the file names.

    Args:
        path: of the file.
        transfer: a name of `NAMES`, or "auto": what the stream says; where it does not, srgb for RGB and bt709 else.

    Raises:
        HostError: PyAV is not installed.
        DataError: not a video, no pictures in it, or a transfer that is not handled.
        UsageError: an unknown name.
    """
    if transfer not in ("auto", *NAMES):
        raise UsageError("no such transfer", value=transfer, expected=nearest(transfer, ("auto", *NAMES)))
    av = pyav()
    file = path.open("rb")
    try:
        container = av.open(file, options={"protocol_whitelist": "pipe"})
    except (av.FFmpegError, OSError, ValueError) as error:
        file.close()
        raise DataError("not a video this tool reads", value=path, cause=str(error).split(": '")[0]) from error
    try:
        streams = [s for s in container.streams.video if "attached" not in str(getattr(s, "disposition", "")).lower()]
        if not streams or streams[0].codec_context is None:
            kinds = ", ".join(s.type for s in container.streams) or "nothing"
            raise DataError("no pictures in this video", value=f"{path}: streams of {kinds}")
        stream = streams[0]
        context = stream.codec_context
        check_size(path, context.width, context.height)
        stream.thread_type = "AUTO"
        rgb = context.pix_fmt is None or av.VideoFormat(context.pix_fmt).is_rgb
        said = int(context.color_trc or 2)
        if transfer == "auto" and said not in (0, 2) and said not in TRANSFERS:
            raise DataError(
                "a transfer that is not handled", value=f"{path}: H.273 code {said}",
                next="give --transfer " + " | ".join(NAMES),
            )  # fmt: skip
        named = TRANSFERS.get(said, "srgb" if rgb else "bt709") if transfer == "auto" else transfer
    except BaseException:
        container.close()
        file.close()
        raise
    facts = {
        "codec": context.name, "pixel_format": context.pix_fmt, "transfer": named,
        "transfer_from": "option" if transfer != "auto" else "file" if said in TRANSFERS else "assumed",
        "color_primaries": int(context.color_primaries or 2), "coded_size": [context.width, context.height],
        "pixel_aspect": float(stream.sample_aspect_ratio or 1),
    }  # fmt: skip
    return Video(path, file, container, stream, named, facts)


_CURVES: dict[tuple[str, bool], NDArray[np.float32]] = {}


def _curve(name: str, deep: bool) -> NDArray[np.float32]:
    """The transfer as a table of 256 or 65536 codes."""
    if (name, deep) not in _CURVES:
        _CURVES[name, deep] = linear_from(name, np.linspace(0, 1, 65536 if deep else 256)).astype(np.float32)
    return _CURVES[name, deep]
