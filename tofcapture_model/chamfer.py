"""Robust Chamfer loss on the image grid (paper eq. 2 with the seven jitter candidates).

Both clouds live on the same pixel grid, so the nearest neighbour of a point lies within a few pixels of its own: every pair
of pixels at most ``radius`` apart is looked at, once for both directions and all seven candidates
(``|x + s - y|^2 = |x - y|^2 + 2 s . (x - y) + |s|^2``). The search is exact when ``radius`` covers the jitter and the
distance between the clouds in pixels (:func:`search_radius`). The search carries no gradient; the winning pairs do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

JITTER = 0.010  # m, paper: 1 centimetre


class Chamfer(NamedTuple):
    """Result of :func:`robust_chamfer`.

    Attributes
    ----------
    loss
        (B,) m^2: mean squared distance P -> Q plus Q -> P of the best candidate; 0 for items without points.
    candidates
        (B, 7) the same of every candidate, without gradient.
    winner
        (B,) int64 index into :func:`candidate_shifts`; worth logging, see docs/decisions/0005-network.md.
    """

    loss: Tensor
    candidates: Tensor
    winner: Tensor


def candidate_shifts(jitter: float = JITTER) -> Tensor:
    """(7, 3) shifts in metres: none, then +x, -x, +y, -y, +z, -z."""
    axes = torch.eye(3).repeat_interleave(2, 0) * torch.tensor([1.0, -1.0]).repeat(3)[:, None]
    return torch.cat([torch.zeros(1, 3), jitter * axes])


def search_radius(focal: float, nearest: float, reach: float = JITTER) -> int:
    """Pixels that ``reach`` metres span at depth ``nearest``, plus one."""
    return math.ceil(focal * reach / nearest) + 1


def _windows(h: int, w: int, dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of pixels i and of pixels i + (dy, dx), both inside the image."""
    rows, cols = slice(max(-dy, 0), h - max(dy, 0)), slice(max(-dx, 0), w - max(dx, 0))
    return (rows, cols), (slice(rows.start + dy, rows.stop + dy), slice(cols.start + dx, cols.stop + dx))


@torch.no_grad()
def _search(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, radius: int, shifts: Tensor
) -> tuple[Tensor, Tensor]:
    """Flat pixel index (B, 7, H, W) of the nearest neighbour in Q of every p + s, and in P + s of every q."""
    b, _, h, w = p.shape
    index = torch.arange(h * w, device=p.device).reshape(1, 1, h, w)
    best_p, best_q = (torch.full((b, len(shifts), h, w), torch.inf, device=p.device) for _ in range(2))
    near_p, near_q = (index.expand(b, len(shifts), h, w).clone() for _ in range(2))
    penalty_p = torch.where(p_mask, 0.0, torch.inf)
    penalty_q = torch.where(q_mask, 0.0, torch.inf)
    reach = range(-radius, radius + 1)
    for dy, dx in ((y, x) for y in reach for x in reach if abs(y) < h and abs(x) < w):
        i, j = _windows(h, w, dy, dx)
        apart = p[:, :, i[0], i[1]] - q[:, :, j[0], j[1]]
        squared = apart.square().sum(1, keepdim=True) + shifts.square().sum(1).reshape(1, -1, 1, 1)
        squared = squared + 2 * torch.einsum("sc,bchw->bshw", shifts, apart)
        for best, near, here, there, wall in (
            (best_p, near_p, i, j, penalty_q[:, :, j[0], j[1]]),
            (best_q, near_q, j, i, penalty_p[:, :, i[0], i[1]]),
        ):
            at = (slice(None), slice(None), *here)
            value = squared + wall
            closer = value < best[at]
            best[at] = torch.where(closer, value, best[at])
            near[at] = torch.where(closer, index[:, :, there[0], there[1]], near[at])
    return near_p, near_q


def _gather(points: Tensor, index: Tensor) -> Tensor:
    """Points (B, 3, H, W) at flat pixel indices (B, H, W)."""
    flat = points.flatten(2)
    return flat.gather(2, index.flatten(1)[:, None].expand(-1, 3, -1)).reshape(points.shape)


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """(B,) mean of (B, 1, H, W) over the mask; 0 where it is empty."""
    return torch.where(mask, values, torch.zeros_like(values)).sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(
        1
    )


def _directed(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, near_p: Tensor, near_q: Tensor, s: Tensor
) -> Tensor:
    """(B,) symmetric mean squared distance of P + s and Q for given neighbours."""
    moved = p + s
    forward = (moved - _gather(q, near_p)).square().sum(1, keepdim=True)
    backward = (_gather(moved, near_q) - q).square().sum(1, keepdim=True)
    return _mean(forward, p_mask) + _mean(backward, q_mask)


def robust_chamfer(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, radius: int, jitter: float = JITTER
) -> Chamfer:
    """Chamfer distance of the best of seven slightly moved copies of P (paper eq. 2, sums taken as means).

    Parameters
    ----------
    p, q
        (B, 3, H, W) points of the prediction and of the ground truth on the same grid, metres; finite.
    p_mask, q_mask
        (B, 1, H, W) bool: which pixels belong to the clouds.
    radius
        Search window, pixels.
    jitter
        Metres; 0 gives the plain Chamfer distance seven times.

    Returns
    -------
    Chamfer, in m^2
    """
    p, q = p.float(), q.float()
    shifts = candidate_shifts(jitter).to(p)
    near_p, near_q = _search(p.detach(), q, p_mask, q_mask, radius, shifts)
    with torch.no_grad():
        scores = torch.stack(
            [
                _directed(p, q, p_mask, q_mask, near_p[:, k], near_q[:, k], s.reshape(1, 3, 1, 1))
                for k, s in enumerate(shifts)
            ],
            dim=1,
        )
    winner = scores.argmin(1)
    item = torch.arange(len(p), device=p.device)
    s = shifts[winner].reshape(-1, 3, 1, 1)
    loss = _directed(p, q, p_mask, q_mask, near_p[item, winner], near_q[item, winner], s)
    usable = p_mask.flatten(1).any(1) & q_mask.flatten(1).any(1)
    return Chamfer(torch.where(usable, loss, torch.zeros_like(loss)), scores, winner)
