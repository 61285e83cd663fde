"""How a picture is held against float64: tight where rounding cannot flip a threshold, counted where it can."""

from dataclasses import dataclass

import torch
from hard_raster import BACKGROUND, HEIGHT, POSE, WIDTH, K

from spikerig.train import oracles
from spikerig.train.splat import Splats

EPSILON = 2.0**-24  # rounding of a float32


@dataclass(frozen=True)
class Truth:
    """The float64 picture of a scene, which pixels a rounding may flip, and by how much the others may be off."""

    image: torch.Tensor  # [H,W,3]
    alpha: torch.Tensor  # [H,W]
    band: torch.Tensor  # [H,W] bool: a threshold (1/255, 0.99, 1.1e-4) is within rounding
    tolerance: float  # outside the band
    step: float  # inside it
    leaves: list[torch.Tensor]  # the five tensors and the pose


def truth(scene: Splats, pose: torch.Tensor = POSE, width: int = WIDTH, height: int = HEIGHT, **settings) -> Truth:
    """The oracle's picture, with tolerances derived from float32 rounding.

    A footprint is stored as float32 and evaluated at offsets of at most D pixels, its reach and the tile it is seen
    from: u = p dx + r dy is off by at most 4 roundings of (p + |r|) D, the exponent (u^2 + v^2) / 2 <= 5.6 by 3.4 x
    that, plus 16 roundings for the exponential and the opacity. The picture moves by T (c - what lies behind) per unit
    of alpha, and sum(alpha T) <= 1: so by at most the worst relative error of an alpha times the brightest colour.
    Twice that, and the sums' rounding, is the bound. It is a worst case, which decides what a rounding may flip; the
    errors themselves were never seen above 1e-6 of the brightest colour, and 1e-5 of it is asserted.
    """
    doubles = [t.detach().double().requires_grad_() for t in scene.tensors().values()]
    pose64 = pose.detach().double().requires_grad_()
    degree, antialias = settings.get("sh_degree", scene.sh_degree), settings.get("antialias", False)
    p = oracles.project(Splats(*doubles), K, width, height, pose64, degree, antialias, settings.get("near", 0.01))
    image, alpha = oracles.raster(p, width, height, torch.tensor(BACKGROUND, dtype=torch.float64))
    with torch.no_grad():
        far = torch.minimum(p.reach.amax(-1) + oracles.TILE, torch.tensor(3.0 * max(width, height)))
        off = EPSILON * (16 + 3.4 * 4 * (p.factor[:, 0] + p.factor[:, 1].abs() + p.factor[:, 2]) * far)
        free, light = oracles.shares(p, oracles.centres(0, width, 0, height))
        reached = light >= oracles.LIGHT_MIN * 0.99
        close = ((free / oracles.ALPHA_MIN).log().abs() < off) | ((free / oracles.ALPHA_MAX).log().abs() < off)
        worst = float(off.max()) if len(off) else EPSILON
        ending = ((light / oracles.LIGHT_MIN).log().abs() < 40 * worst + 1e-5).any(1)
        band = ((close & reached).any(1) | ending).reshape(height, width)
        bright = max(1.0, float(p.colour.max()) if len(off) else 0.0)
    return Truth(image, alpha, band, bright * min(2 * worst + 32 * EPSILON, 1e-5), bright * 2 / 255, [*doubles, pose64])


def compare(image: torch.Tensor, alpha: torch.Tensor, true: Truth, most_band: float = 0.02) -> None:
    """Tight outside the band, one threshold step inside it, and the band small."""
    image, alpha = image.detach(), alpha.detach()
    off = torch.maximum((image - true.image.detach()).abs().amax(-1), (alpha - true.alpha.detach()).abs())
    assert torch.isfinite(image).all()
    assert torch.isfinite(alpha).all()
    assert float(true.band.double().mean()) <= most_band
    assert float(torch.where(true.band, 0.0, off).max()) <= true.tolerance
    assert float(off.max()) <= max(true.step, true.tolerance)


def distance(found: torch.Tensor, true: torch.Tensor, nothing: float = 0.0) -> float:
    """Relative L2 distance; 0 where they differ by no more than `nothing`."""
    found, true = found.detach().double(), true.detach()
    off = float((found - true).norm())
    return 0.0 if off <= nothing else off / max(float(true.norm()), 1e-300)
