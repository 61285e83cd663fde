"""Video codec: what H.264 or HEVC leave of a picture at a bit rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.pyav import pyav
from spikerig.rigctl.sim.arms import in_views
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.effects.jpeg import coding_loss
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

WORST = 51  # the coarsest quantiser
LEAST = 64  # px along an edge: smaller pictures are padded, encoders refuse them
SOFTEN = np.array([1.0, 2.0, 1.0]) / 4


@dataclass(frozen=True, slots=True)
class VideoCodec:
    """The picture is one of a video's: it is predicted from the one before it, and coded with its share of the rate.

    A view has one picture, so its neighbour is stood in for by the same picture softened (1 2 1 along both axes): what
    moves with the camera is predicted, fine detail and noise are not. The two are encoded, first and second picture
    of a group of `group`, with the finest constant quantiser whose mean size over the group keeps to the rate; the
    second comes back. Pixels are 8 bits 4:2:0, as cameras write; more than 8 bits are coded as 10.

    Args:
        codec: h264 (libx264) or hevc (libx265).
        mbit_s: bit rate of the whole camera picture.
        fps: pictures a second.
        full_px: pixels of the camera's whole picture: the simulated one gets its share by area. 0: it is the whole.
        group: pictures from one that stands alone to the next.
    """

    codec: str = limits("hevc", unit="codec", choices=("h264", "hevc"))
    mbit_s: float = limits(60.0, 1e-3, 1e6, "Mbit a second")
    fps: float = limits(119.88, 1e-3, 1e6, "pictures a second")
    full_px: int = limits(1920 * 1080, 0, 10**9, "px")
    group: int = limits(30, 1, 1000, "pictures")

    name: ClassVar[str] = "video_codec"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "ITU-T H.264 and H.265 through PyAV; no published rate of a HERO9 at 1080p120 was found"
    vanishes: ClassVar[str] = "left out; a rate so high that the quantiser is finest leaves the loss of 4:2:0"
    cost_ns: ClassVar[float] = 3700.0

    def begin(self, site: Site) -> Hooks:
        """The same for every view.

        Raises:
            HostError: PyAV is not installed.
        """
        pyav()
        return Hooks(coded=self.through)

    def bits_for(self, pixels: NDArray[Any]) -> float:
        """Bits a picture of this size may take in the mean."""
        share = pixels.shape[0] * pixels.shape[1] / self.full_px if self.full_px else 1.0
        return self.mbit_s * 1e6 / self.fps * share

    def through(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Pixels [H,W,3] as they come out of the video."""
        return self.encoded(pixels)[0]

    def encoded(self, pixels: NDArray[Any]) -> tuple[NDArray[Any], float]:
        """Pixels as they come out of the video, and the bits that a picture of its group takes in the mean."""
        pair = (_padded(_softened(pixels)), _padded(pixels))
        allowed = self.bits_for(pixels)
        lo, hi = 1, WORST  # finest quantiser that may do, coarsest that must
        best = None
        while lo < hi or best is None:
            mid = (lo + hi) // 2
            coded, sizes = _coded(self.codec, pair, mid)
            bits = 8 * (sizes[0] + (self.group - 1) * sizes[1]) / self.group
            if bits <= allowed or mid == WORST:
                hi, best = mid, (coded, bits)
            else:
                lo = mid + 1
        height, width = pixels.shape[:2]
        return np.ascontiguousarray(best[0][:height, :width]), best[1]

    def magnitude(self, facts: Facts) -> Bound:
        """What the surveyed views lose."""
        share = self.mbit_s * 1e6 / self.fps / (self.full_px or facts.size[0] * facts.size[1])
        words = f"{self.codec} at {share:.3g} bits a pixel; {in_views(facts)}"
        return Bound(0.0, coding_loss(facts, self.through), words)


def _softened(pixels: NDArray[Any]) -> NDArray[Any]:
    wide = np.pad(pixels.astype(np.float32), [(1, 1), (1, 1), (0, 0)], mode="edge")
    rows = SOFTEN[0] * wide[:-2] + SOFTEN[1] * wide[1:-1] + SOFTEN[2] * wide[2:]
    soft = SOFTEN[0] * rows[:, :-2] + SOFTEN[1] * rows[:, 1:-1] + SOFTEN[2] * rows[:, 2:]
    return np.rint(soft).astype(pixels.dtype)


def _padded(pixels: NDArray[Any]) -> NDArray[Any]:
    """Even sizes of at least 64, by repeating the edge."""
    more = [(0, max(LEAST, n + n % 2) - n) for n in pixels.shape[:2]]
    return np.pad(pixels, [*more, (0, 0)], mode="edge")


def _coded(codec: str, pair: tuple[NDArray[Any], NDArray[Any]], qp: int) -> tuple[NDArray[Any], list[int]]:
    """The second of two pictures after coding with a quantiser, and the bytes of both."""
    av = pyav()
    deep = pair[0].dtype == np.uint16
    kind, inside = ("rgb48le", "yuv420p10le") if deep else ("rgb24", "yuv420p")
    encoder = av.CodecContext.create("libx264" if codec == "h264" else "libx265", "w")
    encoder.height, encoder.width = pair[0].shape[:2]
    encoder.pix_fmt, encoder.framerate, encoder.time_base = inside, 30, _fraction(1, 30)
    # One thread for all of it, the same bits on every run: threads that convert slices of a picture spill over the rows
    # of others where the width is not a multiple of 16.
    encoder.thread_count = 1
    if codec == "h264":
        encoder.options = {"preset": "veryfast", "qp": str(qp), "bf": "0", "x264-params": "scenecut=0:keyint=1000"}
    else:
        tuned = f"qp={qp}:bframes=0:scenecut=0:keyint=1000:pools=none:frame-threads=1:log-level=none"
        encoder.options = {"preset": "veryfast", "x265-params": tuned}
    decoder = av.CodecContext.create(codec, "r")
    decoder.thread_count = 1
    packets = []
    for k, pixels in enumerate(pair):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=kind).reformat(format=inside, threads=1)
        frame.pts = k
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    frames = [frame for packet in packets for frame in decoder.decode(packet)] + decoder.decode(None)
    return frames[-1].to_ndarray(format=kind, threads=1), [packet.size for packet in packets]


def _fraction(a: int, b: int) -> Any:
    from fractions import Fraction

    return Fraction(a, b)
