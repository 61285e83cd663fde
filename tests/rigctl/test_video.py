"""Videos as light: transfer, matrix, range, depth, rotation, true times; and files that are damaged or none."""

import builtins
from collections.abc import Callable
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.rigctl.sim.sources.moving import Look, fitted, open_moving
from spikerig.rigctl.sim.sources.video import linear_from, open_video

RED = np.array([0.8, 0.3, 0.1])  # encoded
LUMA = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 9: (0.2627, 0.0593)}


def planes(rgb: np.ndarray, matrix: int, full: bool, bits: int) -> list[int]:
    """Y'CbCr codes of an encoded colour, by the definition of its matrix (BT.709, BT.601, BT.2020)."""
    kr, kb = LUMA[matrix]
    r, g, b = rgb
    y = kr * r + (1 - kr - kb) * g + kb * b
    chroma = [(b - y) / 2 / (1 - kb), (r - y) / 2 / (1 - kr)]
    top, m = (1 << bits) - 1, 1 << (bits - 8)
    if full:
        return [round(y * top), *(round(c * top + 128 * m) for c in chroma)]
    return [round((16 + 219 * y) * m), *(round((128 + 224 * c) * m) for c in chroma)]


def plain(rgb: np.ndarray, fmt: str, matrix: int, full: bool, bits: int, size: tuple[int, int] = (32, 16)) -> Any:
    frame = av.VideoFrame(*size, fmt)
    kind = np.uint8 if bits == 8 else np.uint16
    for plane, code in zip(frame.planes, planes(rgb, matrix, full, bits), strict=True):
        plane.update(np.full(plane.buffer_size // np.dtype(kind).itemsize, code, kind).tobytes())
    return frame


def write(path: Path, frames: list[Any], pts: list[int] | None = None, **context: Any) -> Path:
    """A lossless FFV1 video of frames, a tick of its clock a millisecond."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream("ffv1", rate=1000)
        stream.width, stream.height = frames[0].width, frames[0].height
        stream.pix_fmt = frames[0].format.name
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        turn = context.pop("rotation", None)
        if turn is not None:
            stream.set_display_rotation(turn)
        for key, value in context.items():
            setattr(stream.codec_context, key, value)
        for k, frame in enumerate(frames):
            frame.pts, frame.time_base = (pts[k] if pts else 40 * k), Fraction(1, 1000)
            frame.color_range = context.get("color_range", frame.color_range)
            frame.colorspace = context.get("colorspace", frame.colorspace)
            for packet in stream.encode(frame):
                out.mux(packet)
        for packet in stream.encode():
            out.mux(packet)
    return path


def gray(value: int, size: tuple[int, int] = (32, 16)) -> Any:
    pixels = np.full((size[1], size[0], 3), value, np.uint8)
    return av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="bgr0")


@pytest.mark.parametrize(
    ("name", "code", "light"),
    [
        ("bt709", 0.045, 0.01),
        ("bt709", 0.5, 0.259589),
        ("srgb", 0.5, 0.214041),
        ("gamma22", 0.5, 0.5**2.2),
        ("gamma28", 0.5, 0.5**2.8),
        ("hlg", 0.5, 1 / 12 / 0.264963),  # half signal is a twelfth of the peak
        ("hlg", 1.0, 1 / 0.264963),
        ("pq", 0.508078, 100 / 203),  # 100 cd/m2
        ("pq", 1.0, 10_000 / 203),
        ("linear", 0.3, 0.3),
    ],
)
def test_transfers_at_published_values(name: str, code: float, light: float) -> None:
    assert linear_from(name, [code])[0] == pytest.approx(light, rel=2e-4)
    curve = linear_from(name, np.linspace(0, 1, 1001))
    assert curve[0] == pytest.approx(0, abs=1e-6)
    assert np.all(np.diff(curve) >= 0)


@pytest.mark.parametrize(
    ("fmt", "matrix", "full", "bits"),
    [
        ("yuv420p", 1, False, 8),
        ("yuv420p", 5, False, 8),
        ("yuv444p", 1, True, 8),
        ("yuv422p10le", 1, False, 10),
        ("yuv420p10le", 5, True, 10),
        ("yuv420p10le", 9, False, 10),
    ],
)
def test_matrix_range_and_depth(tmp_path: Path, fmt: str, matrix: int, full: bool, bits: int) -> None:
    about = {"colorspace": matrix, "color_range": 2 if full else 1, "color_trc": 13, "color_primaries": 1}
    frame = plain(RED, fmt, matrix, full, bits)
    video = open_video(write(tmp_path / "x.mkv", [frame], **about))
    light = next(video.frames())[1]
    video.close()
    assert (video.facts["transfer"], video.facts["transfer_from"]) == ("srgb", "file")
    assert (video.facts["full_range"], video.facts["matrix"]) == (full, matrix)
    codes = 255 * (1.055 * light[8, 16].astype(np.float64) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(codes, 255 * RED, atol=2.6 if bits == 8 else 1.2)
    wrong = 255 * np.array([0.8, 0.3, 0.1]) - codes
    assert np.abs(wrong).max() < 5, "another matrix or range would be off by ten and more"


def test_what_the_stream_does_not_say_is_assumed_and_told(tmp_path: Path) -> None:
    yuv = open_video(write(tmp_path / "y.mkv", [plain(RED, "yuv420p", 5, False, 8)]))
    rgb = open_video(write(tmp_path / "r.mkv", [gray(188)]))
    assert (yuv.facts["transfer"], yuv.facts["transfer_from"]) == ("bt709", "assumed")
    assert (rgb.facts["transfer"], rgb.facts["transfer_from"]) == ("srgb", "assumed")
    assert next(rgb.frames())[1][3, 4] == pytest.approx(0.5029, abs=1e-3)
    told = open_video(tmp_path / "y.mkv", "linear")
    assert (told.facts["transfer"], told.facts["transfer_from"]) == ("linear", "option")
    with pytest.raises(UsageError, match="no such transfer"):
        open_video(tmp_path / "y.mkv", "rec709")
    for video in (yuv, rgb, told):
        video.close()


def test_wide_primaries_become_rec709(tmp_path: Path) -> None:
    """BT.2020's red is redder than Rec.709's: more than 1 in red, and what lies beyond the gamut goes to its edge."""
    frame = plain(np.array([0.75, 0.75, 0.75]), "yuv420p10le", 9, False, 10)
    about = {"colorspace": 9, "color_range": 1, "color_primaries": 9, "color_trc": 8}
    video = open_video(write(tmp_path / "w.mkv", [frame], **about))
    np.testing.assert_allclose(next(video.frames())[1][5, 5], [0.75] * 3, atol=3e-3)
    video.close()
    frame = plain(np.array([0.5, 0.0, 0.0]), "yuv444p10le", 9, False, 10)
    video = open_video(write(tmp_path / "v.mkv", [frame], **about))
    light = next(video.frames())[1][5, 5]
    assert light[0] == pytest.approx(0.5 * 1.6605, rel=0.01)  # BT.2087, table 1
    assert light[1] == light[2] == 0
    video.close()


@pytest.mark.parametrize(("turn", "corner"), [(0, (0, 0)), (90, (-1, 0)), (180, (-1, -1)), (-90, (0, -1))])
def test_rotation_is_undone(tmp_path: Path, turn: int, corner: tuple[int, int]) -> None:
    """A white top left corner; the display matrix turns the picture counter-clockwise."""
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:4, :4] = 255
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="bgr0")
    video = open_video(write(tmp_path / "r.mkv", [frame], rotation=turn))
    light = next(video.frames())[1]
    video.close()
    assert light.shape[:2] == ((32, 16) if turn % 180 else (16, 32))
    assert light[corner].min() > 0.9
    assert light.sum() == pytest.approx(48, rel=0.01)


def test_true_times_of_a_variable_frame_rate(tmp_path: Path) -> None:
    pts = [100, 110, 150, 151, 400]
    path = write(tmp_path / "v.mkv", [gray(40 * k) for k in range(5)], pts)
    moving = open_moving(path, Look(size=None))
    times = [when for when, _ in moving.pictures]
    assert times == [Fraction(t - 100, 1000) for t in pts]
    assert moving.last == Fraction(249, 1000)
    assert moving.facts["times"] == "file"
    again = open_moving(path, Look(fps=200, size=None))
    assert [when for when, _ in again.pictures] == [Fraction(k, 200) for k in range(5)]
    assert again.facts["times"] == "frame rate"
    for source in (moving, again):
        source.close()


def test_frames_that_do_not_go_on_in_time_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from spikerig.rigctl.sim.sources import video as module

    path = write(tmp_path / "v.mkv", [gray(9)] * 2)
    light = np.zeros((16, 32, 3), np.float32)
    told = [(Fraction(t), light) for t in (0, 1, 1, 0, 2)]
    monkeypatch.setattr(module.Video, "frames", lambda self: iter(told))
    with closing(open_moving(path)) as moving:
        assert [when for when, _ in moving.pictures] == [0, 1, 2]
    assert (moving.facts["pictures"], moving.facts["skipped"]) == (3, 2)
    grown = [told[0], (Fraction(1), np.zeros((8, 32, 3), np.float32))]
    monkeypatch.setattr(module.Video, "frames", lambda self: iter(grown))
    with closing(open_moving(path)) as moving, pytest.raises(DataError, match="changes its size"):
        list(moving.pictures)


def test_area_filter_and_crop() -> None:
    light = np.random.default_rng(0).random((12, 20, 3), np.float32)
    np.testing.assert_allclose(fitted(light, (10, 6)), light.reshape(6, 2, 10, 2, 3).mean((1, 3)), rtol=1e-5)
    middle = fitted(light, (6, 6))
    np.testing.assert_allclose(middle, light[:, 4:16].reshape(6, 2, 6, 2, 3).mean((1, 3)), rtol=1e-5)
    assert fitted(light, None) is light
    assert fitted(light, (20, 12)) is light
    ramp = np.repeat(np.linspace(0, 1, 20, dtype=np.float32)[None, :, None], 12, 0).repeat(3, 2)
    grown = fitted(ramp, (40, 24))
    assert grown.shape == (24, 40, 3)
    assert (grown.min(), grown.max()) == (0, 1)
    wide = fitted(light, (20, 6), aspect=2.0)  # 20 pixels twice as wide as high: 40x12
    np.testing.assert_allclose(wide, light.reshape(6, 2, 20, 3).mean(1), rtol=1e-5)


def test_videos_that_are_none(tmp_path: Path) -> None:
    for name, data in {"empty": b"", "text": b"hello " * 99, "list": b"#EXTM3U\n#EXTINF:5,\nx.mkv\n"}.items():
        (tmp_path / f"{name}.mp4").write_bytes(data)
        with pytest.raises(DataError, match="not a video"):
            open_video(tmp_path / f"{name}.mp4")
    with av.open(str(tmp_path / "sound.flac"), "w") as out:
        stream = out.add_stream("flac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        for packet in [*stream.encode(sound), *stream.encode()]:
            out.mux(packet)
    with pytest.raises(DataError, match="no pictures in this video") as told:
        open_video(tmp_path / "sound.flac")
    assert "audio" in str(told.value)


def test_a_list_cannot_make_it_open_another_file(tmp_path: Path) -> None:
    """Play lists and concat files name other files; none is opened."""
    inner = write(tmp_path / "secret.mkv", [gray(99)])
    (tmp_path / "a.m3u8").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{inner}\n#EXT-X-ENDLIST\n")
    (tmp_path / "b.ffconcat").write_text(f"ffconcat version 1.0\nfile '{inner}'\n")
    for name in ("a.m3u8", "b.ffconcat"):
        with pytest.raises(DataError, match="not a video"):
            open_video(tmp_path / name)


def test_truncated_and_corrupt_videos(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(20)]
    with av.open(str(tmp_path / "x.mp4"), "w", options={"movflags": "faststart"}) as out:
        stream = out.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, "yuv420p", 4_000_000
        for picture in pictures:
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                out.mux(packet)
        for packet in stream.encode():
            out.mux(packet)
    whole = (tmp_path / "x.mp4").read_bytes()
    video = open_video(tmp_path / "x.mp4")
    assert len(list(video.frames())) == 20
    video.close()
    late = 0
    for part in range(1, 20):
        (tmp_path / "y.mp4").write_bytes(whole[: len(whole) * part // 20])
        try:
            video = open_video(tmp_path / "y.mp4")
        except DataError:
            continue
        late += 1
        with pytest.raises(DataError, match=r"breaks off|no frames"):
            list(video.frames())
        video.close()
    assert late > 5, "most open, and are found out while they are read"
    for k in range(30):  # any byte may be wrong: frames come, or a DataError does
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 1 + 20 * (k % 3)):
            data[at] ^= int(rng.integers(1, 256))
        (tmp_path / "z.mp4").write_bytes(data)
        try:
            video = open_video(tmp_path / "z.mp4")
        except DataError:
            continue
        try:
            for _, light in video.frames():
                assert np.isfinite(light).all()
        except DataError:
            pass
        video.close()


def test_a_stream_that_ends_before_its_promise(tmp_path: Path) -> None:
    """The decoder may end without a word: the number of frames that the file promised tells."""
    with closing(open_video(write(tmp_path / "v.mkv", [gray(9)] * 10))) as video:
        video.stream = SimpleNamespace(frames=40, codec_context=video.stream.codec_context)
        container = video.container
        video.container = SimpleNamespace(decode=lambda _: container.decode(video=0), close=container.close)
        with pytest.raises(DataError, match="breaks off") as told:
            list(video.frames())
    assert "after 10 frames, 0.360 s" in str(told.value)
    assert "40 frames were promised" in told.value.cause
    assert "--limit 0.2" in told.value.next


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "x.mkv", [gray(9)])
    real = builtins.__import__

    def missing(name: str, *rest: Any, **more: Any) -> Any:
        if name == "av":
            raise ImportError("No module named 'av'")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(HostError, match="PyAV") as told:
        open_video(path)
    assert told.value.exit_code == 6
    assert 'pip install "spikerig[video]"' in str(told.value)


@pytest.mark.real
def test_a_gopro_video(shared_data: Callable[[str], Path]) -> None:
    moving = open_moving(shared_data("gopro/max-heromode.mp4"))
    times, first = [], None
    for when, light in moving.pictures:
        first = light if first is None else first
        times.append(when)
    moving.close()
    assert len(times) == 315
    assert set(np.diff(times)) == {Fraction(1001, 30000)}
    assert first is not None
    assert first.shape == (250, 400, 3)
    assert 0.1 < first.mean() < 0.6
    assert (moving.facts["transfer"], moving.facts["transfer_from"], moving.facts["full_range"]) == (
        "bt709",
        "file",
        True,
    )
