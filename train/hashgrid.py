"""A multiresolution hash grid of features: layout, native encode for CPU float32, the same in torch for the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spikerig import _native
from spikerig.dataset.errors import UsageError

FEATURES = 2  # numbers a vertex
PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True, slots=True)
class Layout:
    """Levels of the grid: int64[L,4] rows of (cells along an axis, mask or -1 where dense, first row, rows)."""

    table: np.ndarray

    @property
    def rows(self) -> int:
        """Rows of the table of features."""
        return int(self.table[-1, 2] + self.table[-1, 3])

    @property
    def width(self) -> int:
        """Numbers of an encoded point."""
        return FEATURES * len(self.table)


def layout_of(levels: int, coarsest: int, finest: int, table_log2: int) -> Layout:
    """Levels whose cells grow geometrically from `coarsest` to `finest` along an axis, at most 2^table_log2 rows each.

    Source: Mueller et al. 2022 (instant-ngp), Eq. 2-4.
    """
    if not (1 <= levels <= 24 and 1 <= coarsest <= finest <= 1 << 20 and 4 <= table_log2 <= 24):
        raise UsageError(
            "no such hash grid",
            value=f"{levels} levels of {coarsest} to {finest} cells, 2^{table_log2} rows",
            expected="1 to 24 levels, cells up to 2^20, 2^4 to 2^24 rows",
        )
    rows, first = [], 0
    for level in range(levels):
        cells = round(coarsest * (finest / coarsest) ** (level / max(levels - 1, 1)))
        dense = (cells + 1) ** 3 <= 1 << table_log2
        count = (cells + 1) ** 3 if dense else 1 << table_log2
        rows.append((cells, -1 if dense else count - 1, first, count))
        first += count
    return Layout(np.array(rows, np.int64))


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, layout: Layout) -> Tensor:
        out = torch.empty((len(points), layout.width))
        _native.hash_encode(layout.table, points.detach().numpy(), table.detach().numpy(), out.numpy())
        ctx.points, ctx.layout, ctx.shape = points.detach(), layout, table.shape
        ctx.table = table.detach() if ctx.needs_input_grad[0] else None
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        to = torch.empty(ctx.shape)
        _native.hash_encode_back(ctx.layout.table, ctx.points.numpy(), grads[0].contiguous().numpy(), to.numpy())
        by_points = None if ctx.table is None else _points_back(ctx.points, ctx.table, ctx.layout, grads[0])
        return by_points, to, None


def _points_back(points: Tensor, table: Tensor, layout: Layout, grad: Tensor) -> Tensor:
    """Gradient [N,3] of the blend in the points: from each cell's corners, level by level; 0 outside the cube."""
    corners = _corners(points.device)
    where = torch.nan_to_num(points, nan=0.0).clamp(0, 1)
    inside = (points >= 0) & (points <= 1)
    total = torch.zeros_like(points)
    for number, (cells, mask, first, _) in enumerate(layout.table.tolist()):
        row, part = _rows(where, corners, cells, mask)
        one = torch.where(corners == 1, part[:, None], 1 - part[:, None])  # [N,8,3] weights along each axis
        push = (table[row + first] * grad[:, None, FEATURES * number : FEATURES * (number + 1)]).sum(-1)
        for axis in range(3):
            others = one[..., (axis + 1) % 3] * one[..., (axis + 2) % 3]
            total[:, axis] += cells * (push * others * (2 * corners[:, axis] - 1)).sum(-1)
    return torch.where(inside, total, 0.0)


def _corners(device: torch.device) -> Tensor:
    return torch.tensor([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)], device=device)


def _rows(where: Tensor, corners: Tensor, cells: int, mask: int) -> tuple[Tensor, Tensor]:
    """Rows [N,8] of the corners around points of [0, 1], of one level, and the places [N,3] in their cells."""
    at = where * cells
    cell = at.detach().long().clamp(max=cells - 1)
    vertex = cell[:, None] + corners
    if mask < 0:
        return (vertex[..., 2] * (cells + 1) + vertex[..., 1]) * (cells + 1) + vertex[..., 0], at - cell
    mixed = [(vertex[..., k] * PRIMES[k]) & 0xFFFFFFFF for k in range(3)]
    return (mixed[0] ^ mixed[1] ^ mixed[2]) & mask, at - cell


def hash_encode(points: Tensor, table: Tensor, layout: Layout) -> Tensor:
    """Features of points, blended from the eight vertices around them in every level.

    Args:
        points: [N,3] in [0, 1]; beyond, and NaN, is clamped.
        table: [rows, 2].
        layout: of the table.

    Returns:
        [N, 2 L], differentiable in `table` and `points` (on a face between cells: as the upper one's). On the CPU in
        float32 the same bits for any thread count.

    Raises:
        UsageError: shapes that do not fit.
    Cost: 8 reads of 8 bytes a point and level, twice that backward; with a gradient of points some
        microseconds a point more, in torch. Oracle: `ray_oracles.hash_encode`.
    """
    if points.ndim != 2 or points.shape[1] != 3 or tuple(table.shape) != (layout.rows, FEATURES):
        raise UsageError(
            "a hash grid needs points [N,3] and its table",
            value=(tuple(points.shape), tuple(table.shape)),
            expected=f"table ({layout.rows}, {FEATURES})",
        )
    if points.device.type != "cpu" or points.dtype != torch.float32 or table.dtype != torch.float32:
        return hash_encode_torch(points, table, layout)
    return _Encode.apply(points.contiguous(), table.contiguous(), layout)  # type: ignore[return-value]


def hash_encode_torch(points: Tensor, table: Tensor, layout: Layout) -> Tensor:
    """What `hash_encode` computes, in torch operations, for other devices and dtypes."""
    where = torch.nan_to_num(points, nan=0.0).clamp(0, 1)
    corners = _corners(points.device)
    levels = []
    for cells, mask, first, _ in layout.table.tolist():
        row, part = _rows(where, corners, cells, mask)
        weight = torch.where(corners == 1, part[:, None], 1 - part[:, None]).prod(-1)
        levels.append((table[row + first] * weight[..., None]).sum(1))
    return torch.cat(levels, -1)
