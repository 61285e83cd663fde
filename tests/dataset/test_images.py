"""Pictures: the sRGB curve, PNG and EXR both ways in any memory layout, and files that are damaged or awkward."""

import os
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from spikerig.dataset.bayer import ColourTexture
from spikerig.dataset.errors import DataError, NumericsError, UsageError
from spikerig.dataset.images import (
    linear_from_srgb,
    read_image,
    read_linear,
    srgb8_from_linear,
    srgb_from_linear,
    texture_png,
    write_image,
)
from spikerig.dataset.texture import Texture

RNG = np.random.default_rng(0)


def test_the_srgb_curve_at_published_values() -> None:
    """IEC 61966-2-1: 18% gray is 0.46135612950044, code 128 is 0.21586050011389926 linear; straight below the knee."""
    assert srgb_from_linear(0.18) == pytest.approx(0.46135612950044, abs=1e-13)
    assert linear_from_srgb(128 / 255) == pytest.approx(0.21586050011389926, abs=1e-15)
    assert srgb_from_linear(0.001) == 0.001 * 12.92
    assert srgb_from_linear(np.array([0.0, 1.0])).tolist() == pytest.approx([0, 1], abs=1e-15)
    assert srgb_from_linear(-0.5) == -0.5 * 12.92
    assert srgb_from_linear(4.0) == pytest.approx(1.055 * 4 ** (1 / 2.4) - 0.055)
    assert np.isnan(srgb_from_linear(np.nan))


def test_the_srgb_curve_has_its_inverse_and_keeps_float32() -> None:
    x = np.concatenate([np.linspace(-1, 3, 4001), np.linspace(0.00313, 0.00314, 101)])
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(x)), x, rtol=1e-7, atol=1e-9)
    assert srgb_from_linear(x.astype(np.float32)).dtype == np.float32
    codes = np.arange(256, dtype=np.uint8)
    assert srgb8_from_linear(linear_from_srgb(codes)).tolist() == codes.tolist()
    assert srgb8_from_linear([-3.0, 2.0, np.inf]).tolist() == [0, 255, 255]
    with pytest.raises(NumericsError):
        srgb8_from_linear([0.1, np.nan])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_round_trips_in_rgb_order(tmp_path: Path, dtype: type, channels: int) -> None:
    pixels = RNG.integers(0, np.iinfo(dtype).max, (7, 11, channels), dtype, endpoint=True)
    write_image(tmp_path / "x.png", pixels)
    back = read_image(tmp_path / "x.png")
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, pixels)


def test_png_of_pure_red_is_red(tmp_path: Path) -> None:
    """Written by a few lines of our own, so that a swap in both directions would show."""
    row = b"\0" + bytes([255, 0, 0]) * 2

    def chunk(kind: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")

    head = (2).to_bytes(4, "big") * 2 + bytes([8, 2, 0, 0, 0])
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(row * 2)) + chunk(b"IEND", b"")
    (tmp_path / "red.png").write_bytes(data)
    assert read_image(tmp_path / "red.png").tolist() == [[[255, 0, 0]] * 2] * 2
    np.testing.assert_allclose(read_linear(tmp_path / "red.png")[0, 0], [1, 0, 0])


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": lambda a: a,
    "flipped": lambda a: a[::-1],
    "mirrored": lambda a: a[:, ::-1],
    "BGR": lambda a: a[:, :, ::-1],
    "cropped": lambda a: a[2:-1, 1:-3],
    "transposed": lambda a: a.transpose(1, 0, 2),
    "Fortran": np.asfortranarray,
    "strided": lambda a: a[::2, ::3],
    "float64": lambda a: a.astype(np.float64),
    "half": lambda a: a.astype(np.float16),
    "one channel": lambda a: a[:, :, 1],
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_exr_round_trips_from_any_memory_layout(tmp_path: Path, layout: str) -> None:
    pixels = LAYOUTS[layout](RNG.random((16, 21, 3), np.float32) * 1000 - 3)
    write_image(tmp_path / "x.exr", pixels)
    back = read_image(tmp_path / "x.exr")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, np.atleast_3d(pixels).astype(np.float32))


def exr(path: Path, pixels: np.ndarray, **header: object) -> None:
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    name = {3: "RGB", 4: "RGBA"}.get(pixels.shape[2], "Y")
    OpenEXR.File(about, {name: np.ascontiguousarray(pixels)}).write(str(path))


def window(x0: int, y0: int, x1: int, y1: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def test_exr_is_read_on_its_display_window(tmp_path: Path) -> None:
    pixels = RNG.random((4, 6, 3), np.float32)
    exr(tmp_path / "x.exr", pixels, dataWindow=window(0, 0, 5, 3), displayWindow=window(-1, 1, 3, 5))
    back = read_image(tmp_path / "x.exr")
    assert back.shape == (5, 5, 3)
    np.testing.assert_array_equal(back[:3, 1:], pixels[1:, :4])
    assert not back[3:].any()
    assert not back[:, 0].any()
    exr(tmp_path / "y.exr", pixels, dataWindow=window(0, 0, 5, 3), displayWindow=window(6, 0, 9, 3))
    with pytest.raises(DataError, match="outside its display window"):
        read_image(tmp_path / "y.exr")


def test_exr_with_nan_or_infinities_is_refused_unless_kept(tmp_path: Path) -> None:
    pixels = np.ones((3, 4, 3), np.float32)
    pixels[0, 0, 0], pixels[1, 1, 1] = np.nan, -np.inf
    exr(tmp_path / "x.exr", pixels)
    with pytest.raises(NumericsError, match="NaN or infinite") as told:
        read_image(tmp_path / "x.exr")
    assert "2 of 36" in str(told.value)
    np.testing.assert_array_equal(read_image(tmp_path / "x.exr", nonfinite="keep"), pixels)


def test_alpha_needs_a_background_and_is_laid_over_it(tmp_path: Path) -> None:
    codes = np.array([[[200, 100, 0, 255], [200, 100, 0, 51], [9, 9, 9, 0]]], np.uint8)
    write_image(tmp_path / "x.png", codes)
    with pytest.raises(UsageError, match="alpha"):
        read_linear(tmp_path / "x.png")
    over_white = read_linear(tmp_path / "x.png", background=1.0)
    shown = np.array([[200, 100, 0], [0.2 * 200 + 0.8 * 255, 0.2 * 100 + 0.8 * 255, 0.8 * 255], [255, 255, 255]]) / 255
    np.testing.assert_allclose(over_white[0], linear_from_srgb(shown), atol=1e-6)
    exr(tmp_path / "x.exr", np.array([[[0.5, 0.25, 0, 0.5]]], np.float32))
    np.testing.assert_allclose(read_linear(tmp_path / "x.exr", background=1.0)[0, 0], [1.0, 0.75, 0.5])


@pytest.mark.parametrize("kind", ["png", "jpg", "exr", "tall.exr"])
def test_a_truncated_picture_is_one_data_error(tmp_path: Path, kind: str) -> None:
    """At every tenth of the file; OpenEXR itself opens such a file "successfully"."""
    path = tmp_path / f"x.{kind}"
    pixels = RNG.integers(0, 256, (64, 48, 3), np.uint8)
    if kind == "jpg":
        import cv2

        path.write_bytes(cv2.imencode(".jpg", pixels)[1].tobytes())
    else:
        write_image(path, pixels.astype(np.float32) if "exr" in kind else pixels)
    whole = path.read_bytes()
    assert read_image(path).shape == (64, 48, 3)
    for part in range(10):
        path.write_bytes(whole[: len(whole) * part // 10])
        with pytest.raises(DataError):
            read_image(path)
    path.write_bytes(whole[:-1])
    with pytest.raises(DataError, match="damaged"):
        read_image(path)


def test_a_corrupt_png_is_found_by_its_checksums(tmp_path: Path) -> None:
    path = tmp_path / "x.png"
    write_image(path, RNG.integers(0, 256, (32, 32, 3), np.uint8))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match="damaged") as told:
        read_image(path)
    assert "corrupt at byte" in told.value.cause, "found before any decoder saw it"


def test_claimed_sizes_are_checked_before_anything_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "x.png"
    write_image(path, np.zeros((4, 4), np.uint8))
    data = bytearray(path.read_bytes())
    data[16:24] = (100_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    path.write_bytes(data)
    with pytest.raises(DataError, match="size is refused"):
        read_image(path)
    path = tmp_path / "x.exr"
    exr(path, np.zeros((4, 4, 3), np.float32))
    path.write_bytes(path.read_bytes().replace(np.array([0, 0, 3, 3], "<i4").tobytes(), b"\0" * 8 + b"\0\0\0\x40" * 2))
    with pytest.raises(DataError):
        read_image(path)


@pytest.mark.parametrize("content", [b"", b"\x89PNG", b"hello, world", b"\x76\x2f\x31\x01", b"\xff\xd8\xff\xd9"])
def test_what_is_no_picture_is_a_data_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(DataError):
        read_image(tmp_path / "x.png")


def test_missing_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.png"):
        with pytest.raises(DataError, match="not a file"):
            read_image(path)


def test_writing_refuses_what_would_lose_something(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="fit its numbers"):
        write_image(tmp_path / "x.png", np.zeros((4, 4, 3)))
    with pytest.raises(UsageError, match="fit its numbers"):
        write_image(tmp_path / "x.exr", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(UsageError):
        write_image(tmp_path / "x.png", np.zeros((4, 4, 2), np.uint8))
    write_image(tmp_path / "x.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(UsageError, match="exists already"):
        write_image(tmp_path / "x.png", np.ones((4, 4), np.uint8))
    assert not read_image(tmp_path / "x.png").any()
    write_image(tmp_path / "x.png", np.ones((4, 4), np.uint8), force=True)
    assert read_image(tmp_path / "x.png").all()
    assert os.listdir(tmp_path) == ["x.png"]


def test_the_png_of_a_texture_in_colour(tmp_path: Path) -> None:
    light = np.random.default_rng(0).random((5, 6, 3)).astype(np.float32)
    known = np.ones((5, 6, 3), bool)
    texture_png(tmp_path / "a.png", ColourTexture(light, known, 3, "tfp"), 0.8)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), srgb8_from_linear(np.float32(0.8) * light))
    known[2, 3, 1] = False
    texture_png(tmp_path / "b.png", ColourTexture(light * known, known, 3, "tfp"), 0.8)
    np.testing.assert_array_equal(read_image(tmp_path / "b.png")[:, :, 3] == 255, known.all(2))


def test_the_png_of_a_texture(tmp_path: Path) -> None:
    light = np.linspace(0, 0.5, 100, dtype=np.float32).reshape(10, 10)
    gain = texture_png(tmp_path / "a.png", Texture(light, np.ones((10, 10), bool), 3, "tfp"), 2.0)
    assert gain == 2.0
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 0], srgb8_from_linear(2 * light))
    known = light > 0.1
    gain = texture_png(tmp_path / "b.png", Texture(light * known, known, 3, "tfi"))
    assert gain == pytest.approx(1 / np.percentile(light[known], 99))
    shown = read_image(tmp_path / "b.png")
    np.testing.assert_array_equal(shown[:, :, 3] == 255, known)
    nothing = Texture(np.zeros((2, 2)), np.zeros((2, 2), bool), 0, "tfi")
    assert texture_png(tmp_path / "c.png", nothing) == 1.0
