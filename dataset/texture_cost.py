"""`spikerig cost texture` and `spikerig cost page`: texture estimators against known light, error over seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from spikerig.dataset import cost
from spikerig.dataset.cost import Setting
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import emit, note

WINDOWS = (4, 8, 16, 32, 64, 128, 256, 512)
TICKS, AT = 1024, 512


def static_ramp(seed: int = 0) -> tuple[Any, NDArray[np.float64]]:
    """A still ramp from 0.01 to 0.99 spikes a tick, random start phases: (stream, light[250,400])."""
    light = np.broadcast_to(np.linspace(0.01, 0.99, 400), (250, 400))
    return _stream(np.repeat(light[None], 2, 0), np.array([0, TICKS]), seed), light


def moving_grating(seed: int = 0, pixels_per_tick: float = 0.05, period_px: float = 20.0) -> tuple[Any, NDArray]:
    """A sine grating that slides (16 px in an exposure of 320 ticks): (stream, light[250,400] at tick 512)."""
    knots = np.arange(0, TICKS + 1, 4)
    x = np.arange(400) + 0.5
    wave = 0.3 + 0.2 * np.sin(2 * np.pi * (x[None] - pixels_per_tick * knots[:, None]) / period_px)
    light = np.repeat(wave[:, None, :], 250, 1)
    return _stream(light, knots, seed), light[AT // 4]


def _stream(light: NDArray, knots: NDArray[np.int64], seed: int) -> Any:
    from spikerig.dataset.kernels import fire
    from spikerig.dataset.spikes import SpikeStream

    charge = np.random.default_rng(seed).integers(0, 2**32, light.shape[1:], dtype=np.uint32)
    bits, _, _ = fire(light.astype(np.float32), knots.astype(np.int64), charge, hold=False)
    return SpikeStream(bits, light.shape[2], 40000.0)


def settings(seed: int = 0) -> list[Setting]:
    """Every estimator over both scenes; the error is the RMS over all pixels, an unknown pixel counting as dark."""
    from spikerig.dataset.texture import tfi, tfp, tfp_adaptive

    found: list[Setting] = []
    for scene, (stream, light) in (("static", static_ramp(seed)), ("moving", moving_grating(seed))):

        def error(texture: Any, light: NDArray = light) -> float:
            return float(np.sqrt(np.mean((texture.light - light) ** 2)))

        for window in WINDOWS:
            found.append(Setting(f"TFP, {scene}", window, lambda s=stream, w=window: tfp(s, AT, w), error))
        for k in (1, 2, 4, 8, 16):
            found.append(Setting(f"TFI, {scene}", k, lambda s=stream, k=k: tfi(s, AT, intervals=k), error))
        found.append(Setting(f"TFI causal, {scene}", 1, lambda s=stream: tfi(s, AT, causal=True), error))
        found.append(Setting(f"TFP adaptive, {scene}", "auto", lambda s=stream: tfp_adaptive(s, AT), error))
    return found


def texture(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for NAME.json and NAME.svg.")] = None,
    repeats: Annotated[int, typer.Option(help="Timed runs of each setting.")] = 5,
    seed: Annotated[int, typer.Option(help="Start phases of the pixels.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep TFP windows and TFI intervals on still and moving light: error against truth over seconds."""
    finish(
        "texture",
        lambda: cost.sweep(
            "texture",
            "Textures of 400x250 spikes, one core a kernel",
            settings(seed),
            knob="window or intervals",
            error_unit="RMS light, 1 = a spike every tick",
            reference="the simulated light at the same instant",
            repeats=repeats,
        ),
        out,
        force,
        as_json,
    )


def finish(name: str, run: Any, out: Path | None, force: bool, as_json: bool) -> None:
    """Run a sweep and report it; `out` is checked before the work begins."""
    from dataclasses import asdict

    if out is not None and (out / f"{name}.json").exists() and not force:
        raise UsageError("an earlier result is there", value=out / f"{name}.json", next="add --force to replace it")
    done = run()
    if out is not None:
        note(f"wrote {cost.save(done, out)}")
    if as_json:
        emit("spikerig.cost/1", asdict(done))
    else:
        note(cost.table(done))


def page(
    folder: Annotated[Path, typer.Argument(help="Folder of saved sweeps.")] = Path("docs/cost"),
    out: Annotated[Path, typer.Option("-o", "--out", help="The page to write.")] = Path("docs/cost.md"),
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Write the cost page from saved sweeps; the page is generated, so it is replaced."""
    if not folder.is_dir():
        raise UsageError("no folder of sweeps", value=folder, next="spikerig cost texture -o docs/cost")
    text = cost.page(folder)
    out.write_text(text, encoding="utf-8")
    if as_json:
        emit("spikerig.cost.page/1", {"page": str(out), "sweeps": [p.stem for p in sorted(folder.glob("*.json"))]})
    else:
        note(f"wrote {out}")
