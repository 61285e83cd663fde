"""The quality of loose pictures: sharpness always; BRISQUE, RankIQA, LPIPS with the user's files; PSNR and SSIM
against references. What was not computed is null, with the reason beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.train import metrics
from spikerig.train.brisque import Brisque
from spikerig.train.judges import Judge
from spikerig.train.sharpness import MEASURES, flat_share, luma, sharpness

Codes = NDArray[np.uint8]
NOT_GIVEN = "not computed: no weights given"
GIF_FACT = "first picture of the GIF"


@dataclass(frozen=True, slots=True, eq=False)
class Judges:
    """The trained judges at hand; None: not given, and then its scores are null."""

    brisque: Brisque | None = None
    rankiqa: Judge | None = None
    lpips: Judge | None = None

    def about(self) -> dict[str, Any]:
        """Each judge's implementation and file hashes, or that it was not computed."""
        return {
            name: NOT_GIVEN if judge is None else judge.about
            for name, judge in (("brisque", self.brisque), ("rankiqa", self.rankiqa), ("lpips", self.lpips))
        }


@dataclass(frozen=True, slots=True, eq=False)
class Loose:
    """A picture from disk: uint8[H,W,3] sRGB codes, and remarks on how they came about."""

    path: Path
    codes: Codes
    remarks: tuple[str, ...]


def read_codes(path: Path, background: str | None = None) -> Loose:
    """A PNG, JPEG, EXR or GIF as 8-bit sRGB codes.

    Args:
        path: of the picture; an EXR is linear light, encoded here; 16 bits are rounded to 8.
        background: black or white, behind transparent pixels (on codes for PNG, on light for EXR).

    Raises:
        DataError, NumericsError: damaged, foreign, NaN.
        UsageError: transparent pixels and no background.
    """
    from spikerig.dataset.images import read_image, srgb_from_linear

    gif = path.suffix.lower() == ".gif"
    pixels, remarks = (_gif(path), [GIF_FACT]) if gif else (read_image(path), [])
    light = pixels.dtype == np.float32
    full = 65535 if pixels.dtype == np.uint16 else 1 if light else 255
    colour = pixels[:, :, :3] if pixels.shape[2] >= 3 else np.repeat(pixels, 3, axis=2)
    if pixels.shape[2] == 4 and (pixels[:, :, 3] < full).any():
        if background is None:
            raise UsageError("the picture is transparent in places", value=path, next="--background black|white")
        alpha = pixels[:, :, 3:] / full
        colour = colour * (1 if light else alpha) + (full if background == "white" else 0) * (1 - alpha)
        remarks.append(f"transparent pixels over {background}")
    if light:
        over, under = float(np.mean(colour > 1)), float(np.mean(colour < 0))
        if over or under:
            remarks.append(f"clipped to 0..1: {over:.2%} above, {under:.2%} below")
        return Loose(path, metrics.rounded(srgb_from_linear(np.clip(colour, 0, 1))), tuple(remarks))
    codes = colour.astype(np.uint8) if colour.dtype == np.uint8 else metrics.rounded(colour / full)
    return Loose(path, codes, tuple(remarks))


def _gif(path: Path) -> NDArray[Any]:
    import cv2

    from spikerig.dataset.exr import check_size, damaged

    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError("the picture cannot be opened", value=f"{path}: {error.strerror}") from error
    if data[:6] not in (b"GIF87a", b"GIF89a") or len(data) < 14:
        raise DataError("not a GIF", value=path)
    check_size(path, int.from_bytes(data[6:8], "little"), int.from_bytes(data[8:10], "little"))
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise damaged(path, str(error)) from error
    if pixels is None:
        raise damaged(path, "its pixels cannot be decoded")
    return np.ascontiguousarray(pixels[:, :, ::-1])


def judge_alone(codes: Codes, judges: Judges) -> tuple[dict[str, Any], list[str]]:
    """What one picture says of itself: sharpness, BRISQUE, RankIQA, each a number or None; and remarks."""
    found, remarks = sharpness(codes)
    row: dict[str, Any] = {**found, "brisque": None, "rankiqa": None}
    if judges.brisque is not None:
        score = judges.brisque(codes)
        row["brisque"] = score.value
        remarks += [f"brisque: {score.remark}"] if score.remark else []
    if judges.rankiqa is not None:
        row["rankiqa"] = _tried("rankiqa", lambda: judges.rankiqa(codes), remarks)  # type: ignore[misc]
    return row, remarks


def compare(codes: Codes, truth: Codes, judges: Judges, ssim: str = "torchmetrics") -> tuple[dict[str, Any], list[str]]:
    """PSNR, SSIM, luma and chroma PSNR, LPIPS of a picture against another of its size, and remarks."""
    remarks: list[str] = []
    row: dict[str, Any] = {
        "psnr": metrics.psnr(codes, truth),
        "ssim": _tried("ssim", lambda: metrics.ssim(codes, truth, ssim), remarks),
        "luma_psnr": metrics.luma_psnr(codes, truth),
        "chroma_psnr": metrics.chroma_psnr(codes, truth),
        "lpips": None,
    }
    if row["psnr"] == float("inf"):
        remarks.append("psnr: infinite, the pictures are equal")
    if judges.lpips is not None:
        row["lpips"] = _tried("lpips", lambda: judges.lpips(codes, truth), remarks)  # type: ignore[misc]
    return row, remarks


def _tried(name: str, judge: Callable[[], float], remarks: list[str]) -> float | None:
    try:
        return judge()
    except UsageError as error:  # too small for it
        remarks.append(f"{name}: {error.what}")
        return None


def measure(
    paths: Sequence[Path],
    judges: Judges,
    *,
    reference: Path | None = None,
    ssim: str = "torchmetrics",
    background: str | None = None,
) -> dict[str, Any]:
    """Measure loose pictures.

    Args:
        paths: of the pictures.
        judges: trained ones at hand.
        reference: folder with a picture of the same stem for each.
        ssim: variant, by name.
        background: see `read_codes`.

    Returns:
        A JSON-ready record: a row a picture with the hash of its file, means, and what each number is.

    Raises:
        RigError: pictures that cannot be read or do not fit together, all of them at once.
    """
    if ssim not in metrics.SSIM_VARIANTS:
        raise UsageError("no such SSIM", value=ssim, expected=", ".join(metrics.SSIM_VARIANTS))
    if background not in (None, "black", "white"):
        raise UsageError("no such background", value=background, expected="black or white")
    pairs = _all(paths, lambda path: (path, None if reference is None else partner(path, reference)))
    rows = _all(pairs, lambda pair: _row(pair[0], pair[1], judges, ssim, background))
    return {
        "pictures": rows,
        "mean": means(rows),
        "judges": judges.about(),
        "measures": {name: about for name, (about, _) in MEASURES.items()},
        "reference": None if reference is None else str(reference),
        "ssim_variant": f"{ssim}: {metrics.SSIM_VARIANTS[ssim][0]}",
        "rounding": metrics.ROUNDING,
    }


def partner(path: Path, folder: Path) -> Path:
    """The picture of the same stem in a folder; exactly one."""
    from spikerig.dataset.images import SUFFIXES

    if not folder.is_dir():
        raise UsageError("the references are not a folder", value=folder)
    found = sorted(p for p in folder.iterdir() if p.stem == path.stem and p.suffix.lower() in (*SUFFIXES, ".gif"))
    if len(found) != 1:
        raise UsageError(f"{len(found)} references of this stem", value=f"{path.stem} in {folder}", expected="one")
    return found[0]


def _row(path: Path, other: Path | None, judges: Judges, ssim: str, background: str | None) -> dict[str, Any]:
    from spikerig.train.record import scene_hash

    picture = read_codes(path, background)
    truth = None if other is None else read_codes(other, background)
    if truth is not None and truth.codes.shape != picture.codes.shape:
        sizes = [f"{x.codes.shape[1]}x{x.codes.shape[0]}" for x in (picture, truth)]
        raise UsageError("a picture and its reference have different sizes", value=f"{path}: {' and '.join(sizes)}")
    plane = luma(picture.codes)
    alone, remarks = judge_alone(picture.codes, judges)
    row: dict[str, Any] = {
        "file": str(path),
        "sha256": scene_hash(path),
        "width": picture.codes.shape[1],
        "height": picture.codes.shape[0],
        "luma_mean": float(plane.mean()),
        "flat_share": (share := flat_share(plane)),
        "flat": share >= 1,
        **alone,
    }
    remarks = [*picture.remarks, *remarks]
    if truth is not None and other is not None:
        against, more = compare(picture.codes, truth.codes, judges, ssim)
        row |= {"reference": str(other), "reference_sha256": scene_hash(other), **against}
        remarks += [*(f"reference: {r}" for r in truth.remarks), *more]
    return row | {"remarks": remarks}


def _all(items: Sequence[Any], work: Callable[[Any], Any]) -> list[Any]:
    """The work on every item, or one error that tells every fault."""
    done, faults = [], []
    for item in items:
        try:
            done.append(work(item))
        except RigError as error:
            faults.append(error)
    if not faults:
        return done
    if len(faults) == 1:
        raise faults[0]
    kinds = {type(f) for f in faults}
    kind = kinds.pop() if len(kinds) == 1 else DataError
    told = "\n            ".join(f"{f.what}: {f.value}" for f in faults[:20])
    more = f"\n            and {len(faults) - 20} more" if len(faults) > 20 else ""
    nexts = list(dict.fromkeys(f.next for f in faults if f.next))
    raise kind(f"{len(faults)} of {len(items)} pictures cannot be measured", value=told + more, next="; ".join(nexts))


def means(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean of each number over the pictures that have one, and over how many; infinite values are left out."""
    names = [*MEASURES, "brisque", "rankiqa", "psnr", "ssim", "luma_psnr", "chroma_psnr", "lpips"]
    out: dict[str, Any] = {}
    for name in names:
        values = [r[name] for r in rows if r.get(name) is not None and np.isfinite(r[name])]
        if values:
            out[name] = {"mean": float(np.mean(values)), "pictures": len(values)}
    return out
