"""The clip an emulated GoPro writes: H.264 or H.265 pictures of a scene, and telemetry that tells their true times."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.mp4_boxes import read_movie
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate.gpmf_write import box, item, nest, telemetry_track
from spikerig.rigctl.sim.emulate.oscillator import Oscillator

Pictures = Callable[[int, int, float], NDArray[np.uint8]]
"""(true start of row 0, exposure, time of a row; all ns) -> uint8[H,W,3], the same size each time."""

KEY_FRAME = 15  # frames from one key frame to the next; GoPros write one each half second or so
IMU_HZ = 200.0


@dataclass(frozen=True)
class Recording:
    """One take of an emulated camera.

    Args:
        clock: the camera's oscillator; frames lie on its grid.
        true_ns: true time at which the first frame's row 0 begins its exposure.
        frames: how many are encoded.
        fps: nominal, by the camera's own clock; 120000/1001 for "120".
        exposure_s: of each frame: one for all, or float[frames].
        srot_ms: read-out of the whole picture.
        lead_us: media time (STMP) of the first frame; a real one began at 85.6 ms.
        skipped: frames before which the encoder lost one of the sensor's.
        header: keys of the settings in `moov/udta/GPMF`, over those of a HERO9.
        spare: frame stamps beyond the last frame; a real clip had one.
        seed: of the sensors' noise.
        hevc: H.265 pictures in GX files, else H.264 in GH files.
    """

    clock: Oscillator
    true_ns: int
    frames: int
    fps: Fraction = Fraction(120000, 1001)
    exposure_s: float | Sequence[float] | NDArray[np.float64] = 1 / 480
    srot_ms: float = 7.0
    lead_us: int = 85_608
    skipped: tuple[int, ...] = ()
    header: dict[str, Any] = field(default_factory=dict)
    spare: int = 1
    seed: int = 0
    hevc: bool = False

    @property
    def sensor_numbers(self) -> NDArray[np.int64]:
        """Which of the sensor's frames each encoded one is, int64[frames + spare]."""
        jumps = np.zeros(self.frames + self.spare, np.int64)
        np.add.at(jumps, [k for k in self.skipped if k < len(jumps)], 1)
        return np.arange(len(jumps)) + np.cumsum(jumps)

    @property
    def media_ns(self) -> NDArray[np.int64]:
        """Camera media time of each frame's start."""
        step = NS * self.fps.denominator / self.fps.numerator
        return np.rint(self.lead_us * 1000 + self.sensor_numbers * step).astype(np.int64)

    @property
    def true_starts_ns(self) -> NDArray[np.int64]:
        """True time of each frame's start."""
        begun = int(self.clock.device_from_true(self.true_ns))
        return self.clock.true_from_device(begun + self.media_ns - self.lead_us * 1000)

    @property
    def exposures_s(self) -> NDArray[np.float32]:
        """Exposure of each frame, as the telemetry will tell it."""
        return np.broadcast_to(np.asarray(self.exposure_s, np.float32), (self.frames,))


def hero9_header(**over: Any) -> dict[str, Any]:
    """The settings block of a HERO9 at 1080p120, wide, stabilisation off; keys may be replaced."""
    return {
        "VERS": [8, 2, 0], "FMWR": "HD9.01.01.72.00", "LINF": "LAJ0000000000001", "CASN": "C3441325000001",
        "MINF": "HERO9 Black", "CMOD": 12, "MTYP": 0, "OREN": "U", "DZOM": "N", "PRTN": "Y", "PTWB": "5500K",
        "PTSH": "LOW", "PTCL": "FLAT", "EXPT": "1/480", "PIMX": 400, "PIMN": 400, "PTEV": "0.0", "VFOV": "W",
        "EISE": "N", "EISA": "N/A", "VRES": [1920, 1080], "VFPS": [120000, 1001], "HSGT": "OFF", "BITR": "HIGH",
    } | over  # fmt: skip


def write_clip(folder: Path, number: int, take: Recording, pictures: Pictures, chapter_bytes: int) -> list[Path]:
    """Write a clip as chapters GH01nnnn.MP4, GH02nnnn.MP4, ...; a chapter ends at a key frame once it is full.

    Raises:
        HostError: PyAV is not installed, or the disk refuses.
    """
    paths: list[Path] = []
    first = 0
    while first < take.frames:
        path = folder / f"G{'X' if take.hevc else 'H'}{len(paths) + 1:02d}{number:04d}.MP4"
        count = _encode(path, take, first, pictures, chapter_bytes)
        last = first + count >= take.frames
        _add_telemetry(path, take, first, count + (take.spare if last else 0), count)
        paths.append(path)
        first += count
    return paths


def _encode(path: Path, take: Recording, first: int, pictures: Pictures, most_bytes: int) -> int:
    """Encode frames from `first` on into a plain MP4; how many fitted."""
    try:
        import av
    except ImportError as error:
        raise HostError("the emulated camera needs PyAV", next='pip install "spikerig[video]"') from error
    starts, exposures = take.true_starts_ns, take.exposures_s
    bytes_ = done = height = 0
    tuning = {"preset": "ultrafast", "crf": "16", "bf": "0", "g": str(KEY_FRAME)}
    if take.hevc:
        tuning["x265-params"] = f"bframes=0:scenecut=0:keyint={KEY_FRAME}:pools=none:frame-threads=1:log-level=none"
    else:
        tuning["x264-params"] = "scenecut=0"
    scale = {"video_track_timescale": str(take.fps.numerator)}
    with av.open(str(path), "w", format="mp4", options=scale) as container:
        video: Any = container.add_stream("libx265" if take.hevc else "libx264", rate=take.fps, options=tuning)
        video.codec_context.thread_count = 1  # the same bits on every run
        video.codec_context.time_base = 1 / take.fps
        for k in range(first, take.frames):
            if done and done % KEY_FRAME == 0 and bytes_ >= most_bytes:
                break
            exposure_ns = round(float(exposures[k]) * NS)
            if not done:
                height, width = pictures(int(starts[k]), exposure_ns, 0.0).shape[:2]
                if width % 2 or height % 2:
                    raise UsageError("a camera's picture has even sides", value=f"{width} x {height}")
                video.width, video.height, video.pix_fmt = width, height, "yuvj420p"
            pixels = pictures(int(starts[k]), exposure_ns, take.srot_ms * 1e6 / height)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24").reformat(
                format="yuvj420p", dst_colorspace=1 if height >= 720 else 5, dst_color_range=2, threads=1
            )
            frame.pts, frame.time_base = done, 1 / take.fps
            for packet in video.encode(frame):
                bytes_ += packet.size
                container.mux(packet)
            done += 1
        container.mux(video.encode())
    return done


def _add_telemetry(path: Path, take: Recording, first: int, stamped: int, frames: int) -> None:
    """Put payloads behind the pictures, and their track and the settings into moov."""
    raw = path.read_bytes()
    at = raw.rfind(b"moov") - 4
    if read_movie(path).size_bytes != len(raw) or int.from_bytes(raw[at : at + 4], "big") != len(raw) - at:
        raise HostError("this PyAV lays out MP4 files in a way the emulator does not know", value=path)
    per = round(float(take.fps))
    payloads = [
        _payload(take, k, min(k + per, first + stamped), first + frames) for k in range(first, first + stamped, per)
    ]  # fmt: skip
    lasts = [round(1000 * min(per, first + frames - k) / float(take.fps)) for k in range(first, first + stamped, per)]
    offsets = (at + np.cumsum([0, *map(len, payloads[:-1])])).tolist()
    moov = raw[at + 8 :]
    scale = int.from_bytes(raw[raw.find(b"mvhd", at) + 16 :][:4], "big")
    track = telemetry_track(2, [len(p) for p in payloads], offsets, [max(n, 1) for n in lasts], scale)
    user = box("udta", box("FIRM", str(take_header(take)["FMWR"]).encode()), box("GPMF", _settings(take), bytes(64)))
    cut = moov.find(b"udta") - 4  # ffmpeg's own, the last of its boxes
    moov = moov[:cut] if cut >= 0 else moov
    part = path.with_suffix(".part")
    head = box("ftyp", b"mp41", bytes.fromhex("20131018"), b"mp41")  # as GoPro's; ffmpeg's is longer
    start = raw.find(b"mdat") - 4
    head += box("free", bytes(start - len(head) - 8))
    media = box("mdat", raw[start + 8 : at], *payloads)  # one of them, as GoPro writes and its own reader wants
    part.write_bytes(head + media + box("moov", moov, user, track))
    os.replace(part, path)


def take_header(take: Recording) -> dict[str, Any]:
    """The settings that a recording's file will tell."""
    fps = [take.fps.numerator, take.fps.denominator]
    return hero9_header(VFPS=fps, SROT=float(take.srot_ms)) | take.header


def _settings(take: Recording) -> bytes:
    told = [item("DVID", "L", 1), item("DVNM", "c", "Global Settings")]
    for key, value in take_header(take).items():
        if isinstance(value, str):
            told.append(item(key, "c", value))
        elif isinstance(value, float):
            told.append(item(key, "f", value))
        else:
            kind = "L" if np.max(value) > 255 or key in ("PIMX", "PIMN") else "B"
            told.append(item(key, kind, np.atleast_2d(value) if key in ("VRES", "VFPS") else value))
    return nest("DEVC", *told)


def _payload(take: Recording, first: int, end: int, encoded: int) -> bytes:
    """The telemetry of frames [first, end), of which those from `encoded` on are stamps only."""
    media_us = take.media_ns // 1000
    rows = np.minimum(np.arange(first, end), take.frames - 1)
    jumps = np.diff(take.sensor_numbers, prepend=-1)[first:end] - 1
    stamp, total = int(media_us[first]), end
    step_us = 1e6 / float(take.fps)
    until = int(media_us[end]) if end < len(media_us) else int(media_us[end - 1] + step_us)
    t0, t1 = (int(np.ceil((t - take.lead_us) * IMU_HZ / 1e6)) for t in (stamp, until))
    t0, t1 = max(t0, 0), max(t1, t0 + 1, 1)
    noise = stream(take.seed, f"imu {first}")
    n = t1 - t0
    accel = np.rint(417 * (np.array([9.81, 0.0, 0.0]) + 0.02 * noise.standard_normal((n, 3))))
    gyro = np.rint(939 * 0.002 * noise.standard_normal((n, 3)))
    imu_us = int(take.lead_us + t0 * 1e6 / IMU_HZ)
    level = np.tile([32767, 0, 0, 0], (end - first, 1))
    return nest(
        "DEVC",
        item("DVID", "L", 1),
        item("DVNM", "c", "HERO9 Black"),
        _stream("ACCL", "s", accel, imu_us, t1, "Accelerometer", 417, "m/s\xb2", item("TMPC", "f", 38.5)),
        _stream("GYRO", "s", gyro, imu_us, t1, "Gyroscope", 939, "rad/s", item("TMPC", "f", 38.5)),
        _stream("SHUT", "f", take.exposures_s[rows], stamp, total, "Exposure time (shutter speed)", unit="s"),
        _stream("ISOE", "S", np.full(end - first, int(take_header(take)["PIMX"])), stamp, total, "Sensor ISO"),
        _stream("CORI", "s", level, stamp, total, "CameraOrientation", 32767),
        _stream("MSKP", "b", jumps, stamp, total, "Main video frame skips"),
        _stream("LSKP", "b", 0 * jumps, stamp, total, "Low res video frame skips"),
    )


def _stream(
    key: str, kind: str, values: NDArray[Any], stamp_us: int, total: int, name: str, scale: int = 0, unit: str = "",
    *more: bytes,
) -> bytes:  # fmt: skip
    told = [item("STMP", "J", stamp_us), item("TSMP", "L", total), item("STNM", "c", name)]
    told += [item("SIUN", "c", unit)] if unit else []
    told += [item("SCAL", "s", scale)] if scale else []
    return nest("STRM", *told, *more, item(key, kind, values))
