"""OpenEXR beyond plain RGB: layers, views, parts, sample types, chroma, primaries, depth, awkward files."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from spikerig.dataset import exr
from spikerig.dataset.errors import DataError, NumericsError, RigError, UsageError
from spikerig.dataset.exr import read_exr, read_exr_depth
from spikerig.dataset.images import image_head, read_image, read_linear, srgb_from_linear
from spikerig.dataset.primaries import REC709, rec709_from, rgb_from_luma_chroma, xyz_from_rgb

RNG = np.random.default_rng(0)
DATA = Path(os.environ.get("SPIKERIG_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def save(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    OpenEXR.File(HEADER | header, {k: np.ascontiguousarray(v) for k, v in channels.items()}).write(str(path))
    return path


def planes(n: int, height: int = 5, width: int = 7) -> list[np.ndarray]:
    return [RNG.random((height, width), np.float32) for _ in range(n)]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_every_sample_type(tmp_path: Path, dtype: type) -> None:
    pixels = (RNG.random((5, 7, 3)) * 60000).astype(dtype)
    back = read_exr(save(tmp_path / "x.exr", {"RGB": pixels}))
    np.testing.assert_array_equal(back, pixels.astype(np.float32))
    assert back.flags.c_contiguous


def test_sample_types_may_differ_between_channels(tmp_path: Path) -> None:
    r, g, b = planes(3)
    path = save(tmp_path / "x.exr", {"R": r.astype(np.float16), "G": g, "B": (b * 9).astype(np.uint32)})
    back = read_exr(path)
    np.testing.assert_array_equal(back[:, :, 0], r.astype(np.float16))
    np.testing.assert_array_equal(back[:, :, 1], g)
    np.testing.assert_array_equal(back[:, :, 2], (b * 9).astype(np.uint32))


def test_layers_are_chosen_by_name(tmp_path: Path) -> None:
    p = planes(7)
    channels = dict(zip(["R", "G", "B", "glow.R", "glow.G", "glow.B", "Z"], p, strict=True))
    path = save(tmp_path / "x.exr", channels)
    np.testing.assert_array_equal(read_exr(path), np.dstack(p[:3]))
    np.testing.assert_array_equal(read_exr(path, "glow"), np.dstack(p[3:6]))
    np.testing.assert_array_equal(read_exr(path, "glow.G"), p[4][:, :, None])
    np.testing.assert_array_equal(read_exr(path, "Z")[:, :, 0], p[6])
    with pytest.raises(UsageError, match="no such layer") as told:
        read_exr(path, "Glow")
    assert "glow (B, G, R)" in str(told.value)


def test_blenders_combined_is_the_picture(tmp_path: Path) -> None:
    p = planes(8)
    names = [f"View Layer.{n}" for n in ("Diffuse.R", "Diffuse.G", "Diffuse.B")] + ["View Layer.Depth.Z"]
    names += [f"View Layer.Combined.{c}" for c in "RGBA"]
    path = save(tmp_path / "x.exr", dict(zip(names, p, strict=True)))
    np.testing.assert_array_equal(read_exr(path), np.dstack(p[4:]))
    np.testing.assert_array_equal(read_exr_depth(path), p[3])
    two = save(tmp_path / "y.exr", dict(zip([f"{a}.{c}" for a in "ab" for c in "RGB"], p[:6], strict=True)))
    with pytest.raises(DataError, match="several pictures"):
        read_exr(two)


def test_a_vector_is_neither_gray_nor_depth(tmp_path: Path) -> None:
    """Blender 5 writes a part for each pass, with bare channel names."""
    n, rgb, z = planes(3), planes(3), planes(1)[0]
    passes = {
        "Normal": dict(zip("XYZ", n, strict=True)),
        "Glossy": dict(zip("RGB", planes(3), strict=True)),
        "Combined": dict(zip("RGB", rgb, strict=True)),
        "Depth": {"Z": z},
    }
    kind = OpenEXR.scanlineimage
    parts = [OpenEXR.Part({"type": kind}, channels, f"View Layer.{name}") for name, channels in passes.items()]
    OpenEXR.File(parts).write(str(tmp_path / "x.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "x.exr"), np.dstack(rgb))
    np.testing.assert_array_equal(read_exr_depth(tmp_path / "x.exr"), z)
    with pytest.raises(DataError, match="no RGB"):
        read_exr(save(tmp_path / "n.exr", dict(zip("XYZ", n, strict=True))))


def test_parts_and_views(tmp_path: Path) -> None:
    def part(name: str, view: str, channels: dict[str, np.ndarray]) -> Any:
        return OpenEXR.Part({"type": OpenEXR.scanlineimage, "view": view}, channels, name)

    left, right, z = RNG.random((4, 6, 3), np.float32), RNG.random((4, 6, 3), np.float32), planes(1, 4, 6)[0]
    parts = [
        part("depth.left", "left", {"Z": z}),
        part("rgb.left", "left", {"RGB": left}),
        part("rgb.right", "right", {"RGB": right}),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "x.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "x.exr"), left)
    for name in ("right", "rgb.right"):
        np.testing.assert_array_equal(read_exr(tmp_path / "x.exr", name), right)
    np.testing.assert_array_equal(read_exr_depth(tmp_path / "x.exr"), z)
    multi = dict(zip(["R", "G", "B", "right.R", "right.G", "right.B"], planes(6), strict=True))
    path = save(tmp_path / "y.exr", multi, multiView=["left", "right"])
    np.testing.assert_array_equal(read_exr(path, "right")[:, :, 2], multi["right.B"])
    np.testing.assert_array_equal(read_exr(path, "left"), read_exr(path))


def test_tiles_and_gray_with_alpha(tmp_path: Path) -> None:
    p = planes(3, 40, 33)
    tiles = {"tiles": OpenEXR.TileDescription(), "type": OpenEXR.tiledimage}
    path = save(tmp_path / "x.exr", dict(zip("RGB", p, strict=True)), **tiles)
    np.testing.assert_array_equal(read_exr(path), np.dstack(p))
    path = save(tmp_path / "y.exr", {"Y": p[0], "A": p[1]})
    np.testing.assert_array_equal(read_exr(path), np.dstack([p[0]] * 3 + [p[1]]))
    assert image_head(path) == (33, 40, True)


def test_depth_where_nothing_is(tmp_path: Path) -> None:
    z = np.array([[1.5, 65504, 2]], np.float16)
    np.testing.assert_array_equal(read_exr_depth(save(tmp_path / "h.exr", {"V": z})), [[1.5, np.inf, 2]])
    z = np.array([[1.5, 65504, 1e10]], np.float32)
    np.testing.assert_array_equal(read_exr_depth(save(tmp_path / "f.exr", {"Q": z})), [[1.5, 65504, np.inf]])
    equal = save(tmp_path / "e.exr", {"RGB": np.dstack([z] * 3)})
    np.testing.assert_array_equal(read_exr_depth(equal), [[1.5, 65504, np.inf]])
    with pytest.raises(DataError, match="no depth"):
        read_exr_depth(save(tmp_path / "n.exr", {"RGB": np.dstack(planes(3))}))


def test_published_primaries() -> None:
    """Rec.709 to XYZ as IEC 61966-2-1 prints it; ACES AP0's neutral becomes white."""
    published = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    np.testing.assert_allclose(xyz_from_rgb(REC709), published, atol=6e-5)
    np.testing.assert_allclose(rec709_from(REC709), np.eye(3), atol=1e-12)
    ap0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
    np.testing.assert_allclose(rec709_from(ap0, ap0[6:]) @ np.ones(3), np.ones(3), atol=1e-9)
    assert rec709_from(ap0)[2].sum() < 0.95, "kept as it is, a D60 white is yellowish under D65"
    for bad in (np.zeros(8), (0.3, 0.3) * 4, np.full(8, np.nan), np.ones(6)):
        with pytest.raises(DataError, match="span no colours"):
            xyz_from_rgb(tuple(bad))
    with pytest.raises(DataError, match="no colour"):
        rec709_from(REC709, (0.3, 0.0))


def test_luminance_chroma_by_its_definition() -> None:
    """Against the sums of ImfRgbaYca.cpp written out pixel by pixel, on an odd size."""
    height, width = 9, 11
    y = RNG.random((height, width)) + 0.5
    ry, by = (RNG.random((5, 6)) * 0.2 - 0.1 for _ in range(2))
    taps = [0.002128, -0.007540, 0.019597, -0.043159, 0.087929, -0.186077, 0.627123]
    taps += taps[::-1]

    def along(values: np.ndarray, size: int) -> np.ndarray:
        def at(k: int) -> Any:
            return values[min(max(k, 0), len(values) - 1)]

        rows = []
        for i in range(size):
            rows.append(at(i // 2) if i % 2 == 0 else sum(w * at(i // 2 - 6 + k) for k, w in enumerate(taps)))
        return np.array(rows)

    full_r, full_b = (along(along(c, height).T, width).T for c in (ry, by))
    r, b = (full_r + 1) * y, (full_b + 1) * y
    wr, wg, wb = xyz_from_rgb(REC709)[1]
    expected = np.dstack([r, (y - r * wr - b * wb) / wg, b])
    assert expected.min() > 0.1, "nothing here is saturated"
    np.testing.assert_allclose(rgb_from_luma_chroma(y, ry, by, REC709), expected, atol=2e-6)
    gray = rgb_from_luma_chroma(y, 0 * ry, 0 * by, REC709)
    np.testing.assert_array_equal(gray, np.repeat(y.astype(np.float32)[:, :, None], 3, 2))


def test_wild_colours_of_chroma_are_tamed_and_keep_their_luminance() -> None:
    y, ry = np.full((8, 8), 0.5), np.zeros((4, 4))
    ry[2, 2] = 3.7  # green far below zero at pixel (4, 4)
    rgb = rgb_from_luma_chroma(y, ry, np.zeros((4, 4)), REC709)
    assert rgb[4, 4].min() >= 0
    weights = xyz_from_rgb(REC709)[1]
    np.testing.assert_allclose((rgb @ weights)[4, 4], 0.5, rtol=1e-5)


def test_a_channel_of_fewer_samples_is_no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """The binding cannot write such a file; the collection has only whole luminance-chroma ones."""
    window = (np.array([0, 0]), np.array([5, 3]))
    header = {"dataWindow": window, "displayWindow": window}
    channels = {"Y": np.ones((4, 6), np.float32), "RY": np.zeros((2, 3), np.float32)}
    monkeypatch.setattr(exr, "_read_parts", lambda path: [exr.Part(header, channels)])
    with pytest.raises(DataError, match="no RGB"):
        read_exr(Path("x.exr"))
    with pytest.raises(DataError, match="fewer pixels"):
        read_exr(Path("x.exr"), "RY")
    channels["BY"] = np.zeros((4, 6), np.float32)
    with pytest.raises(DataError, match="no RGB"):
        read_exr(Path("x.exr"))


def test_a_damaged_file_says_nothing_on_stdout(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The binding prints; a JSON document shall be alone there."""
    path = save(tmp_path / "x.exr", {"RGB": RNG.random((64, 64, 3), np.float32)})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match="damaged") as told:
        read_exr(path)
    assert capfd.readouterr().out == ""
    assert "1 of 1 parts cannot be read" in told.value.cause
    assert "Exception raised reading" in told.value.cause


def test_claims_that_no_file_of_that_size_can_hold(tmp_path: Path) -> None:
    path = save(tmp_path / "x.exr", {"RGB": np.zeros((4, 4, 3), np.float32)})
    whole = path.read_bytes()
    claim = np.array([0, 0, 9999, 9999], "<i4").tobytes()
    path.write_bytes(whole.replace(np.array([0, 0, 3, 3], "<i4").tobytes(), claim))
    with pytest.raises(DataError, match="claimed size is refused") as told:
        read_exr(path)
    assert "1200000000 bytes" in str(told.value)


def test_tiles_larger_than_any_picture(tmp_path: Path) -> None:
    tiles = {"tiles": OpenEXR.TileDescription(), "type": OpenEXR.tiledimage}
    path = save(tmp_path / "x.exr", dict(zip("RGB", planes(3, 40, 33), strict=True)), **tiles)
    data = path.read_bytes()
    at = data.index(b"tiles\0tiledesc\0") + len(b"tiles\0tiledesc\0") + 4
    path.write_bytes(data[: at + 4] + np.array([1 << 24], "<u4").tobytes() + data[at + 8 :])
    with pytest.raises(DataError, match="claimed size is refused"):
        read_exr(path)


def test_bytes_that_are_wrong(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Any byte of any header or pixel may be wrong: a picture comes, or one of our errors."""
    window = (np.array([1, 2], np.int32), np.array([7, 6], np.int32))
    header = {"chromaticities": (0.7, 0.3, 0.2, 0.8, 0.1, 0.05, 0.31, 0.33), "adoptedNeutral": np.float32([0.3, 0.3])}
    path = save(tmp_path / "x.exr", {"RGBA": RNG.random((5, 7, 4), np.float32)}, dataWindow=window, **header)
    data, refused = path.read_bytes(), 0
    for k in range(400):
        wrong = bytearray(data)
        for at in RNG.integers(0, len(data), 1 + k % 4):
            wrong[at] = RNG.integers(0, 256)
        path.write_bytes(wrong)
        try:
            assert read_exr(path).ndim == 3
        except DataError:
            refused += 1
    assert 50 < refused < 400
    assert capfd.readouterr().out == ""


def test_layers_are_for_exr_only(tmp_path: Path) -> None:
    from spikerig.dataset.images import write_image

    write_image(tmp_path / "x.png", np.zeros((3, 4), np.uint8))
    with pytest.raises(UsageError, match="only an EXR"):
        read_image(tmp_path / "x.png", layer="glow")


# ---- the collection of awkward files ---------------------------------------------------------------------------------

REFUSED = {  # what the shared EXR files end in, where it is not a picture
    "DisplayWindow/t09.exr": (DataError, "outside its display window"),
    "DisplayWindow/t10.exr": (DataError, "outside its display window"),
    "DisplayWindow/t11.exr": (DataError, "outside its display window"),
    "DisplayWindow/t12.exr": (DataError, "outside its display window"),
    "TestImages/AllHalfValues.exr": (NumericsError, "NaN or infinite"),
    "TestImages/BrightRingsNanInf.exr": (NumericsError, "NaN or infinite"),
    "TestImages/WideFloatRange.exr": (DataError, "no RGB"),  # a lone channel G
    "v2/LowResLeftView/Trunks.exr": (DataError, "deep pixels"),
}
FILES = sorted(str(p.relative_to(DATA / "exr")) for p in (DATA / "exr").rglob("*.exr"))


@pytest.mark.real
@pytest.mark.parametrize("name", FILES or ["ScanLines/Cannon.exr"])
def test_awkward_exr_files_are_read_or_refused(name: str, shared_data: Callable[[str], Path]) -> None:
    path = shared_data(f"exr/{name}")
    if name in REFUSED:
        kind, says = REFUSED[name]
        with pytest.raises(kind, match=says) as told:
            read_image(path)
        assert isinstance(told.value, RigError)
        assert path.name in str(told.value)
        json.dumps(told.value.as_json())
        return
    pixels = read_image(path)
    header = OpenEXR.File(str(path), header_only=True).parts[0].header
    (x0, y0), (x1, y1) = header["displayWindow"]
    assert pixels.shape[:2] == (y1 - y0 + 1, x1 - x0 + 1)
    assert pixels.dtype == np.float32
    assert pixels.flags.c_contiguous
    assert np.isfinite(pixels).all()
    assert pixels.any()


@pytest.mark.real
def test_the_whole_collection_is_here(shared_data: Callable[[str], Path]) -> None:
    shared_data("exr")
    assert len(FILES) == 47
    assert set(REFUSED) <= set(FILES)


@pytest.mark.real
def test_one_picture_in_four_encodings(shared_data: Callable[[str], Path]) -> None:
    """The same photograph as RGB and as luminance-chroma, of Rec.709 and of XYZ primaries."""
    root = shared_data("exr/Chromaticities")
    plain = read_image(root / "Rec709.exr")
    np.testing.assert_allclose(read_image(root / "XYZ.exr"), plain, atol=6e-3)  # half floats, up to 6.9
    for name in ("Rec709_YC", "XYZ_YC"):
        codes = [srgb_from_linear(np.clip(x, 0, 1)) for x in (plain, read_image(root / f"{name}.exr"))]
        assert 10 * np.log10(1 / np.mean((codes[0] - codes[1]) ** 2)) > 36, "chroma at half the samples, no more lost"


@pytest.mark.real
@pytest.mark.parametrize("number", [2, 3, 4, 5, 6, 7, 8, 13, 14, 15, 16])
def test_one_picture_on_many_windows(number: int, shared_data: Callable[[str], Path]) -> None:
    """t01 to t16 hold the same 400x300 pixels under other data and display windows."""
    root = shared_data("exr/DisplayWindow")
    whole = read_image(root / "t01.exr")
    header = OpenEXR.File(str(root / f"t{number:02d}.exr"), header_only=True).parts[0].header
    (ax, ay), (cx, cy) = header["dataWindow"][0].tolist(), header["displayWindow"][0].tolist()
    seen = read_image(root / f"t{number:02d}.exr")
    expected = np.zeros_like(seen)
    for y in range(len(seen)):
        row = y + cy - ay
        if 0 <= row < 300:
            columns = np.arange(seen.shape[1]) + cx - ax
            inside = (columns >= 0) & (columns < 400)
            expected[y, inside] = whole[row, columns[inside]]
    np.testing.assert_array_equal(seen, expected)


@pytest.mark.real
def test_views_and_lone_channels_of_the_collection(shared_data: Callable[[str], Path]) -> None:
    fog = shared_data("exr/MultiView/Fog.exr")
    np.testing.assert_array_equal(read_image(fog), read_image(fog, layer="left"))
    assert not np.array_equal(read_image(fog), read_image(fog, layer="right"))
    lone = shared_data("exr/TestImages/WideFloatRange.exr")
    assert read_image(lone, layer="G", nonfinite="keep").max() > 1e38
    rings = shared_data("exr/TestImages/BrightRingsNanInf.exr")
    kept = read_linear(rings, nonfinite="keep")
    assert (np.isnan(kept).any(), np.isinf(kept).any()) == (True, True)
