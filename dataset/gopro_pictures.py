"""Pictures of a GoPro clip, by number or by time; each comes with when its rows were exposed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.gopro_file import GoProClip
from spikerig.dataset.mp4_boxes import damaged, read_movie
from spikerig.dataset.pyav import pyav
from spikerig.dataset.scene import Frame

MAX_PIXELS = 64 << 20
_FAR = 90  # frames: a longer gap is jumped over from the key frame before its end, a shorter one decoded through
_MATRIX = {1: 1, 5: 5, 6: 5, 7: 7, 9: 9}  # H.273 code -> ffmpeg's


def read_pictures(clip: GoProClip, numbers: Iterable[int]) -> Iterator[tuple[int, Frame]]:
    """The frames of these numbers (0 is the first), each once, in increasing order.

    Args:
        clip: as `open_gopro` read it.
        numbers: of frames, e.g. `clip.frames_between(start_ns, end_ns)`.

    Returns:
        (number, Frame) pairs; pixels uint8[H,W,3], uint16 of a video of more than 8 bits; encoded as sRGB, as GoPro's
        own colours are close to it; times on the camera's media time, clock "rgb". Exposure and row time are 0 where
        the camera does not tell them.

    Raises:
        UsageError: a number that the clip does not have.
        HostError: PyAV is not installed.
        DataError: the video is damaged where it is read.

    Cost:
        Each frame asked for is decoded, and those since the key frame before it (docs/hardware/gopro.md, "Cost").
    """
    wanted = np.unique(np.fromiter(numbers, np.int64))
    if len(wanted) and (wanted[0] < 0 or wanted[-1] >= clip.frames):
        raise UsageError("the clip has no such frame", value=int(wanted[-1]), expected=f"0 to {clip.frames - 1}")
    before = 0
    for path, count in zip(clip.paths, clip.chapter_frames, strict=True):
        mine = wanted[(wanted >= before) & (wanted < before + count)] - before
        if len(mine):
            for number, pixels in _decoded(path, mine):
                yield before + number, _frame(clip, before + number, pixels)
        before += count


def _frame(clip: GoProClip, number: int, pixels: NDArray[Any]) -> Frame:
    exposure_ns = 0 if clip.exposure_ns is None else int(clip.exposure_ns[number])
    row_ns = 0 if clip.row_ns is None else round(clip.row_ns)
    return Frame(pixels, "srgb", int(clip.start_ns[number]), exposure_ns, row_ns, "rgb")


def _decoded(path: Path, wanted: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Frames of one file by their number in the order shown."""
    av = pyav()
    track = next(t for t in read_movie(path).tracks if t.handler == "vide" and len(t.sizes))
    grid = np.sort(track.pts) - track.pts.min()
    try:
        with path.open("rb") as file, av.open(file, options={"protocol_whitelist": "pipe"}) as container:
            stream = container.streams.video[0]
            _check_size(path, stream.codec_context.width, stream.codec_context.height)
            stream.thread_type = "AUTO"
            queue, at = [int(n) for n in wanted], -_FAR - 1
            while queue:
                if queue[0] - at > _FAR:
                    container.seek(int(grid[queue[0]]) + (stream.start_time or 0), stream=stream)
                for frame in container.decode(stream):
                    at = _number(path, frame, stream, grid)
                    if frame.is_corrupt:
                        raise damaged(path, f"frame {at} does not decode")
                    if at == queue[0]:
                        yield queue.pop(0), _pixels(path, frame)
                    elif at > queue[0]:
                        raise damaged(path, f"frame {queue[0]} does not decode")
                    if not queue or queue[0] - at > _FAR:
                        break
                else:
                    raise damaged(path, f"frame {queue[0]} does not decode: the video ends at {at}")
    except (av.FFmpegError, OSError, ValueError, StopIteration) as error:
        raise damaged(path, f"the video does not decode: {error}") from error


def _number(path: Path, frame: Any, stream: Any, grid: NDArray[np.int64]) -> int:
    if frame.pts is None:
        raise damaged(path, "a frame without a time")
    at = frame.pts - (stream.start_time or 0)
    n = int(np.clip(np.searchsorted(grid, at), 0, len(grid) - 1))
    if n and abs(int(grid[n - 1]) - at) < abs(int(grid[n]) - at):
        n -= 1
    return n


def _pixels(path: Path, frame: Any) -> NDArray[Any]:
    _check_size(path, frame.width, frame.height)
    deep = max(c.bits for c in frame.format.components) > 8
    full = frame.color_range == 2 or (frame.color_range != 1 and frame.format.name.startswith("yuvj"))
    matrix = _MATRIX.get(int(frame.colorspace), 1 if frame.height >= 720 else 5)
    return frame.reformat(
        format="rgb48le" if deep else "rgb24", src_colorspace=matrix, dst_color_range=2,
        src_color_range=2 if full else 1, threads=1,
    ).to_ndarray()  # fmt: skip


def _check_size(path: Path, width: int, height: int) -> None:
    if not 0 < width * height <= MAX_PIXELS:
        raise DataError("a video of such a size is not read", value=f"{path}: {width} x {height}")
