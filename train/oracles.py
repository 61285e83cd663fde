"""What the native train kernels compute, as short float64 torch: the definitions, and the truth in tests.

`project`, `raster` and `ssim` carry the names of the kernels. Gradients are torch's own. `raster_tiled` is the same
picture by 16 x 16 tiles: the reference that benchmarks are told against.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch

from spikerig.train.splat import Splats

ALPHA_MAX = 0.99  # one splat never takes more of the light than this
ALPHA_MIN = 1 / 255  # below this a splat leaves a pixel untouched
LIGHT_MIN = 1.1e-4  # a pixel with less light left is finished; a little above (1 - ALPHA_MAX)^2
DILATION = 0.3  # pixels^2
COMPENSATION_MIN = 0.005
CLAMP_MARGIN, CULL_MARGIN = 0.3, 1.0  # of half the picture, beyond its border
LOG_SCALE_MAX = 30.0
QUAT_MIN = 1e-24
TILE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Footprints:
    """M visible splats on the picture, nearest first; float64.

    Args:
        index: [M] which splat. centre: [M,2] pixels. factor: [M,3] p, r, s of the inverse covariance's Cholesky
        factor, power = ((p dx + r dy)^2 + (s dy)^2) / 2. log_opacity: [M]. colour: [M,3]. reach: [M,2] half size of
        the box that holds all alpha >= 1/255.
    """

    index: torch.Tensor
    centre: torch.Tensor
    factor: torch.Tensor
    log_opacity: torch.Tensor
    colour: torch.Tensor
    reach: torch.Tensor

    def only(self, rows: torch.Tensor) -> Footprints:
        """Those of a boolean mask."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.__slots__})


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """[N,4] w x y z of any length -> [N,3,3]; lengths below 1e-12 mean no rotation."""
    length2 = (quats**2).sum(-1, keepdim=True)
    unit = torch.where(length2 >= QUAT_MIN, quats / length2.clamp(min=QUAT_MIN).sqrt(), 0.0)
    w, x, y, z = unit.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def harmonics(degree: int, direction: torch.Tensor) -> torch.Tensor:
    """Real spherical harmonics [N,(degree+1)^2] at unit directions [N,3], in 3DGS's order and signs."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    rows = [torch.full_like(x, 0.28209479177387814)]
    rows += [
        k * v for k, v in zip((-0.4886025119029199, 0.4886025119029199, -0.4886025119029199), (y, z, x), strict=True)
    ]
    rows += [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return torch.stack(rows[: (degree + 1) ** 2], -1)


def project(
    splats: Splats, K: Any, width: int, height: int, pose: torch.Tensor, sh_degree: int, antialias: bool, near: float
) -> Footprints:
    """Splats (float64 tensors) to footprints, culled and sorted; differentiable.

    Source: EWA splatting (Zwicker et al. 2001) with the Jacobian frozen outside 1.3 x the picture; Mip-Splatting's
    2D compensation. det is a sum of squares (Cauchy-Binet), which needles of any condition survive.
    """
    fx, fy, cx, cy = float(K[0][0]), float(K[1][1]), float(K[0][2]), float(K[1][2])
    eye = splats.means @ pose[:, :3].T + pose[:, 3]
    keep = eye[:, 2] > near
    uv = eye[:, :2] / torch.where(keep, eye[:, 2], 1.0)[:, None]
    low = torch.tensor([-cx / fx, -cy / fy], dtype=eye.dtype)
    high = torch.tensor([(width - cx) / fx, (height - cy) / fy], dtype=eye.dtype)
    half = (high - low) / 2
    keep = keep & ((uv > low - CULL_MARGIN * half) & (uv < high + CULL_MARGIN * half)).all(-1)
    index = keep.nonzero()[:, 0]
    eye, uv = eye[index], uv[index]
    frozen = torch.maximum(torch.minimum(uv, high + CLAMP_MARGIN * half), low - CLAMP_MARGIN * half)
    focal = torch.tensor([fx, fy], dtype=eye.dtype)
    jw = (pose[None, :2, :3] - frozen[:, :, None] * pose[None, 2:, :3]) * (focal / eye[:, 2:])[:, :, None]
    scale = splats.log_scales[index].clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX).exp()
    ab = jw @ rotations(splats.quats[index]) * scale[:, None, :]
    a, b = ab.unbind(1)
    det0 = (torch.linalg.cross(a, b) ** 2).sum(-1)
    aa, bb, c12 = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    c11, c22, det = aa + DILATION, bb + DILATION, det0 + DILATION * (aa + bb) + DILATION**2
    log_opacity = torch.nn.functional.logsigmoid(splats.logit_opacities[index])
    if antialias:
        log_opacity = log_opacity + 0.5 * (det0 / det).clamp(min=COMPENSATION_MIN**2).log()
    root = (c22 * det).sqrt()
    factor = torch.stack([c22 / root, -c12 / root, c22.rsqrt()], -1)
    centre = focal * uv + torch.tensor([cx, cy], dtype=eye.dtype)
    room = log_opacity.detach() - math.log(ALPHA_MIN)
    reach = (2 * room.clamp(min=0)[:, None] * torch.stack([c11, c22], -1).detach()).sqrt() * 1.0001 + 1e-3
    out = Footprints(index, centre, factor, log_opacity, _colour(splats, index, pose, sh_degree), reach)
    order = torch.sort(eye[:, 2].detach().float(), stable=True).indices
    order = order[room[order] > 0]
    return out.only(order)


def _colour(splats: Splats, index: torch.Tensor, pose: torch.Tensor, degree: int) -> torch.Tensor:
    from_centre = splats.means[index] + pose[:, 3] @ pose[:, :3]
    direction = torch.nn.functional.normalize(from_centre, dim=-1, eps=0.0)
    basis = harmonics(degree, direction)
    return ((basis[:, :, None] * splats.sh[index, : basis.shape[1]]).sum(1) + 0.5).clamp(min=0)


def shares(p: Footprints, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unclipped alpha [P,M] of each footprint at pixel centres [P,2], and the light [P,M] that reaches it."""
    dx, dy = (pixels[:, None, :] - p.centre).unbind(-1)
    power = ((p.factor[:, 0] * dx + p.factor[:, 1] * dy) ** 2 + (p.factor[:, 2] * dy) ** 2) / 2
    free = (p.log_opacity - power).exp()
    alpha = torch.where(free >= ALPHA_MIN, free.clamp(max=ALPHA_MAX), 0.0)
    light = (
        torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1]], 1), 1) if len(p.index) else alpha
    )
    return free, light


def blend(p: Footprints, pixels: torch.Tensor, background: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours [P,3] and alphas [P] at pixel centres [P,2]."""
    free, light = shares(p, pixels)
    alpha = torch.where((free >= ALPHA_MIN) & (light >= LIGHT_MIN), free.clamp(max=ALPHA_MAX), 0.0)
    left = torch.prod(1 - alpha, 1)
    return (alpha * light) @ p.colour + left[:, None] * background, 1 - left


def centres(x0: int, x1: int, y0: int, y1: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Pixel centres [P,2] of a half-open box, row by row."""
    y, x = torch.meshgrid(torch.arange(y0, y1, dtype=dtype), torch.arange(x0, x1, dtype=dtype), indexing="ij")
    return torch.stack([x.reshape(-1) + 0.5, y.reshape(-1) + 0.5], -1)


def raster(p: Footprints, width: int, height: int, background: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Every footprint at every pixel: image [H,W,3], alpha [H,W]. The definition; memory M x H x W."""
    image, alpha = blend(p, centres(0, width, 0, height, p.centre.dtype), background)
    return image.reshape(height, width, 3), alpha.reshape(height, width)


def absgrad(
    p: Footprints, width: int, height: int, background: torch.Tensor, image_grad: torch.Tensor, alpha_grad: torch.Tensor
) -> torch.Tensor:
    """Sums over pixels [M,2] of |d loss / d centre|, given d loss / d image and alpha: each pixel gets its own centres.

    Source: AbsGS (Ye et al. 2024): signed sums cancel where the two sides of a large splat pull apart.
    """
    own = p.centre.detach().expand(width * height, -1, -1).clone().requires_grad_()
    image, alpha = blend(replace(p, centre=own), centres(0, width, 0, height, p.centre.dtype), background)
    loss = (image * image_grad.reshape(-1, 3)).sum() + (alpha * alpha_grad.reshape(-1)).sum()
    return torch.autograd.grad(loss, own)[0].abs().sum(0)


def raster_tiled(p: Footprints, width: int, height: int, background: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The same picture by tiles: only the footprints whose box meets a tile are blended there."""
    rows = []
    low, high = p.centre.detach() - p.reach, p.centre.detach() + p.reach
    for y0 in range(0, height, TILE):
        y1, row = min(y0 + TILE, height), []
        for x0 in range(0, width, TILE):
            x1 = min(x0 + TILE, width)
            near = (low[:, 0] < x1) & (high[:, 0] > x0) & (low[:, 1] < y1) & (high[:, 1] > y0)
            image, alpha = blend(p.only(near), centres(x0, x1, y0, y1, p.centre.dtype), background)
            row.append(torch.cat([image, alpha[:, None]], 1).reshape(y1 - y0, x1 - x0, 4))
        rows.append(torch.cat(row, 1))
    whole = torch.cat(rows, 0)
    return whole[..., :3], whole[..., 3]


def render(
    splats: Splats,
    K: Any,
    width: int,
    height: int,
    cam_from_world: torch.Tensor,
    *,
    background: Any = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialias: bool = False,
    near: float = 0.01,
    tiled: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """`splat.render` in the tensors' own type (float64 in tests): image [H,W,3] and alpha [H,W]."""
    degree = splats.sh_degree if sh_degree is None else sh_degree
    p = project(splats, K, width, height, cam_from_world, degree, antialias, near)
    light = torch.as_tensor(background, dtype=p.centre.dtype)
    return (raster_tiled if tiled else raster)(p, width, height, light)


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """SSIM [H,W,3] of two pictures [H,W,3] of range 1: 11 x 11 Gaussian window, sigma 1.5, zero outside (Inria's).

    Source: Wang et al. 2004, with variances clamped at 0.
    """
    taps = torch.exp(-((torch.arange(11, dtype=image.dtype) - 5) ** 2) / (2 * 1.5**2))
    taps = taps / taps.sum()

    def mean(x: torch.Tensor) -> torch.Tensor:
        planes = x.permute(2, 0, 1)[:, None]
        planes = torch.nn.functional.conv2d(planes, taps.reshape(1, 1, 11, 1), padding=(5, 0))
        return torch.nn.functional.conv2d(planes, taps.reshape(1, 1, 1, 11), padding=(0, 5))[:, 0].permute(1, 2, 0)

    ma, mb = mean(image), mean(target)
    saa = (mean(image * image) - ma * ma).clamp(min=0)
    sbb = (mean(target * target) - mb * mb).clamp(min=0)
    sab = mean(image * target) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return (2 * ma * mb + c1) * (2 * sab + c2) / ((ma * ma + mb * mb + c1) * (saa + sbb + c2))


def l1_ssim(
    image: torch.Tensor, target: torch.Tensor, ssim_weight: float = 0.2, valid: torch.Tensor | None = None
) -> torch.Tensor:
    """(1 - w) mean |image - target| + w mean (1 - SSIM); pixels not valid count as outside the picture."""
    on = torch.ones(image.shape[:2], dtype=torch.bool) if valid is None else valid
    if not on.any():
        return image.sum() * 0
    a, b = torch.where(on[:, :, None], image, 0.0), torch.where(on[:, :, None], target, 0.0)
    return (1 - ssim_weight) * (a - b)[on].abs().mean() + ssim_weight * (1 - ssim_map(a, b))[on].mean()
