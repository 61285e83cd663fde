"""`spikerig train quality`: loose pictures measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.train.quality import Judges

BrisqueModel = Annotated[Path | None, typer.Option(help="BRISQUE's SVM for OpenCV (brisque_model_live.yml).")]
BrisqueRange = Annotated[Path | None, typer.Option(help="The ranges of its features (brisque_range_live.yml).")]
RankIqa = Annotated[Path | None, typer.Option("--rankiqa", help="RankIQA's weights: safetensors or TorchScript.")]
Lpips = Annotated[Path | None, typer.Option("--lpips", help="LPIPS's weights: safetensors or TorchScript.")]
Trust = Annotated[bool, typer.Option("--trust", help="Let TorchScript files run; they are programs.")]


def quality(
    images: Annotated[list[Path], typer.Argument(help="Pictures: PNG, JPEG, EXR, GIF.")],
    reference: Annotated[Path | None, typer.Option(help="Folder of references, matched by stem.")] = None,
    ssim: Annotated[str, typer.Option(help="SSIM variant: torchmetrics, tf, skimage, inria.")] = "torchmetrics",
    brisque_model: BrisqueModel = None,
    brisque_range: BrisqueRange = None,
    rankiqa: RankIqa = None,
    lpips: Lpips = None,
    trust: Trust = False,
    background: Annotated[str | None, typer.Option(help="Behind transparent pixels: black or white.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Measure pictures: sharpness without weights; BRISQUE, RankIQA and LPIPS with yours; PSNR and SSIM to references.

    What was not computed is null in the JSON, and the reason is beside it. Nothing stands in for missing weights.
    """
    from spikerig.train.quality import measure

    judges = judges_of(brisque_model, brisque_range, rankiqa, lpips, trust)
    if lpips is not None and reference is None:
        raise UsageError("LPIPS compares with a reference", value=lpips, next="--reference DIR")
    result = measure(images, judges, reference=reference, ssim=ssim, background=background)
    for row in result["pictures"]:
        note(_line(row))
    for name, why in result["judges"].items():
        if isinstance(why, str):
            note(f"{name}: {why}")
    if as_json:
        emit("spikerig.train.quality/1", result)


def judges_of(model: Path | None, ranges: Path | None, rankiqa: Path | None, lpips: Path | None, trust: bool) -> Judges:
    """The judges that the options give.

    Raises:
        UsageError: half a BRISQUE, or TorchScript without --trust.
        DataError: files that are not what they should be.
    """
    from spikerig.train.brisque import open_brisque
    from spikerig.train.judges import open_lpips, open_rankiqa
    from spikerig.train.quality import Judges

    if (model is None) != (ranges is None):
        raise UsageError("BRISQUE needs its model and its ranges", next="--brisque-model YML --brisque-range YML")
    return Judges(
        None if model is None or ranges is None else open_brisque(model, ranges),
        None if rankiqa is None else open_rankiqa(rankiqa, trust=trust),
        None if lpips is None else open_lpips(lpips, trust=trust),
    )


def _line(row: dict[str, Any]) -> str:
    parts = [f"{row['file']}: {row['width']}x{row['height']}"]
    for name, label in (
        ("crete_blur", "blur"), ("tenengrad", "tenengrad"), ("laplacian_over_noise", "laplacian/noise"),
        ("brisque", "BRISQUE"), ("rankiqa", "RankIQA"), ("psnr", "PSNR"), ("ssim", "SSIM"), ("lpips", "LPIPS"),
    ):  # fmt: skip
        if row.get(name) is not None:
            parts.append(f"{label} {row[name]:.4g}")
    return ", ".join(parts) + "".join(f"\n  {remark}" for remark in row["remarks"])
