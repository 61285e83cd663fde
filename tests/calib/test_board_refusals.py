"""`calib board` on bad sessions and hostile folders: each fault by its name, exit 4 or 2, nothing written."""

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from board_faults import CASES, Case, words

from spikerig.dataset import cli
from spikerig.dataset.images import write_image
from spikerig.dataset.spikes import SpikeStream, write_spikes

pytestmark = pytest.mark.usefixtures("remembered")


@pytest.mark.parametrize("case", CASES, ids=[f"{c.code}-{k}" for k, c in enumerate(CASES)])
def test_every_refusal(case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case.shots(tmp_path)
    assert cli.run(words(tmp_path, case)) == 4
    told = json.loads(capsys.readouterr().out)
    assert told["accepted"] is False
    assert case.code in told["reason_codes"]
    assert len(told["reasons"]) == len(told["reason_codes"])
    assert not (tmp_path / "calib.json").exists()
    also = {"bad-corners": {"loose-crop"}, "wrong-pattern": {"too-few-views"}}.get(case.code, set())
    assert set(told["reason_codes"]) - {case.code} <= also
    text = told["reasons"][told["reason_codes"].index(case.code)]
    said = {"wrong-pattern": "9x6", "odd-pairs": "cam_a_04", "duplicates": "cam_a_01 = cam_a_07", "bad-corners": "flat",
            "not-one-rig": "only as" if case.options else "and mirrored"}  # fmt: skip
    assert said.get(case.code, "") in text


def overwrite(*arms: str, by: Callable[[Path], object]) -> Callable[[Path], None]:
    """A spoiler of every file of the arms."""

    def spoil(folder: Path) -> None:
        for arm in arms:
            for path in sorted((folder / arm).iterdir()):
                by(path)

    return spoil


def gray(*shape: int) -> Callable[[Path], None]:
    pixels = np.random.default_rng(1).integers(0, 255, (*shape, 1)).astype(np.uint8)
    return lambda path: write_image(path, pixels, force=True)


def claims_ten_gigapixels(path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(999))) + chunk(b"IEND", b""))


def spikes_of(height: int) -> Callable[[Path], None]:
    def replace(path: Path) -> None:
        path.unlink()
        bits = np.random.default_rng(height).random((64, height + int(path.stem[-1]), 64)) < 0.3
        write_spikes(path.with_suffix(".npz"), SpikeStream.from_pixels(bits, 40_000.0))

    return replace


def ragged(path: Path) -> None:
    path.unlink()
    path.with_suffix(".dat").write_bytes(bytes(12_507))


def fewer_and_nameless(folder: Path) -> None:
    (folder / "b/cam_b_04.png").unlink()
    for k, path in enumerate(sorted((folder / "b").iterdir())):
        path.rename(path.with_name(f"{'pqrst'[k]}.png"))


HOSTILE = [
    ("an empty folder", lambda f: [p.unlink() for p in (f / "a").iterdir()], 2, "no pictures"),
    ("no folder", lambda f: shutil.rmtree(f / "a"), 2, "no such folder"),
    ("text for pictures", overwrite("a", by=lambda p: p.write_text("hello")), 4, "not a picture"),
    ("nothing for pictures", overwrite("b", by=lambda p: p.write_bytes(b"")), 4, "not a picture"),
    ("pictures of one pixel", overwrite("a", "b", by=gray(1, 1)), 4, "1x1 pixels are too few"),
    ("pictures one pixel high", overwrite("b", by=gray(1, 500)), 4, "500x1 pixels are too few"),
    ("a picture that claims 10 gigapixels", overwrite("a", by=claims_ten_gigapixels), 4, "claimed size"),
    ("spike files of several sizes", overwrite("a", by=spikes_of(40)), 4, "differ in size"),
    ("raw spikes of another geometry", overwrite("a", by=ragged), 4, "whole number of ticks"),
    ("an HDF5 file that is none", overwrite("a", by=lambda p: p.rename(p.with_suffix(".h5"))), 4, "cannot be read"),
    ("counts and names that do not match", fewer_and_nameless, 2, "do not pair up"),
    ("black pictures", overwrite("a", "b", by=lambda p: write_image(p, np.zeros((60, 90, 1), np.uint8), force=True)),
     4, "duplicates"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "code", "said"), [h[1:] for h in HOSTILE], ids=[h[0] for h in HOSTILE])
def test_hostile_folders(
    spoil: Callable[[Path], object], code: int, said: str, shots: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    for name in "ab":
        shutil.copytree(shots / name, tmp_path / name)
    spoil(tmp_path)
    assert cli.run(words(tmp_path, Case("", "", lambda f: f))) == code
    out, err = capsys.readouterr()
    assert said in out
    assert "Traceback" not in err
    assert not (tmp_path / "calib.json").exists()


def test_files_without_a_partner_are_named_and_pages_show_what_is_known(
    shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        for path in (shots / name).iterdir():
            shutil.copy(path, tmp_path / name / path.name.replace(f"_{name}_", "_"))
    (tmp_path / "b/cam_04.png").rename(tmp_path / "b/other.png")
    sheet, maps = tmp_path / "sheet.html", tmp_path / "maps.svg"
    line = words(tmp_path, Case("", "", lambda f: f))
    assert cli.run([*line, "--sheet", str(sheet)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["unpaired"] == ["a/cam_04.png", "b/other.png"]
    assert "other.png" in told["warnings"][0]
    page = sheet.read_text(encoding="utf-8")
    assert page.count("<circle") == 2 * 4 * 54 + 3 + 4  # a dot a corner, three rings, a dot a view
    for name in (*told["sd"], "cam_02", "leaving views out"):
        assert name in page
    assert cli.run([*line, "--sheet", str(sheet)]) == 2
    assert cli.run([*line, "--sheet", str(maps), "--force"]) == 0
    assert maps.read_text(encoding="utf-8").startswith("<svg xmlns")
    (tmp_path / "file").write_text("x")
    capsys.readouterr()
    assert cli.run([*line, "--force", "--overlays", str(tmp_path / "file")]) == 2
    assert "folder" in json.loads(capsys.readouterr().out)["error"]["what"]
