"""Robust Chamfer loss on the image grid (paper eq. 2 with the seven jitter candidates), exact.

The neighbours come from :mod:`tofcapture_model.losses.chamfer.trees` on a CPU with numba, from :mod:`tofcapture_model.losses.chamfer.tile_search` on a GPU with Triton,
else from :mod:`tofcapture_model.losses.chamfer.neighbours`. They carry no gradient; the pairs that they make do.
"""

from __future__ import annotations

import math
from types import EllipsisType, ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from tofcapture_model.geometry.intrinsics import PINHOLE
from tofcapture_model.losses.chamfer import neighbours, tile_search, trees
from tofcapture_model.losses.chamfer.neighbours import Found

JITTER = 0.010  # m, paper: 1 centimetre


class Chamfer(NamedTuple):
    """Result of :func:`robust_chamfer`.

    Attributes
    ----------
    loss
        (B,) m^2: mean squared distance P -> Q plus Q -> P of the best candidate; 0 for items without points.
    candidates
        (B, 7) without gradient: exact for the winner; for the others a bound from below that shows that they cannot win, or with
        ``softness`` or ``normals`` exact, too.
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


def robust_chamfer(
    p: Tensor,
    q: Tensor,
    p_mask: Tensor,
    q_mask: Tensor,
    intrinsics: Tensor,
    jitter: float = JITTER,
    *,
    normals: Tensor | None = None,
    softness: float = 0.0,
) -> Chamfer:
    """Chamfer distance of the best of seven slightly moved copies of P (paper eq. 2, sums taken as means).

    Parameters
    ----------
    p, q
        (B, 3, H, W) points of the prediction and of the ground truth on the same grid, metres; finite.
    p_mask, q_mask
        (B, 1, H, W) bool: which pixels belong to the clouds.
    intrinsics
        (B, 4) of the grid, or (B, 9): the lens says nothing of where the nearest points are, only how wide the slowest search looks.
    jitter
        Metres; 0 gives the plain Chamfer distance seven times.
    normals
        (B, 3, H, W) unit normals of Q: distances to the tangent plane at q instead of to q; neighbours stay the nearest points.
    softness
        m^2: above 0 the least of the seven is a soft one, ``-softness log mean exp(-loss / softness)``. It tends to the mean for a large softness,
        whose only minimum is the right place, and to the least, with its seven, for a small one.

    Returns
    -------
    Chamfer, in m^2
    """
    p, q = p.float(), q.float()
    shifts = candidate_shifts(jitter).to(p)
    items = [  # unbound, as the gradient of p[b] is a whole batch
        _item(
            one,
            q[b],
            p_mask[b, 0],
            q_mask[b, 0],
            intrinsics[b, :PINHOLE],
            shifts,
            None if normals is None else normals[b],
            softness,
        )
        for b, one in enumerate(p.unbind())
    ]
    loss, candidates, winner = (torch.stack(x) for x in zip(*items, strict=True))
    return Chamfer(loss, candidates, winner)


def _item(
    p: Tensor,
    q: Tensor,
    p_mask: Tensor,
    q_mask: Tensor,
    intrinsics: Tensor,
    shifts: Tensor,
    normals: Tensor | None,
    softness: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss (), candidates (7,), winner () of one pair of clouds."""
    window = _box(p_mask, q_mask)
    if window is None:
        nothing = 0.0 * torch.where(p_mask, p, 0.0).sum()
        return nothing, shifts.new_zeros(len(shifts)), torch.zeros((), dtype=torch.int64, device=p.device)

    box, corner = window
    p, q, p_mask, q_mask = p[box], q[box], p_mask[box], q_mask[box]
    intrinsics, normals = intrinsics - corner.to(intrinsics), None if normals is None else normals[box]

    def directed(found: Found, shift: Tensor) -> Tensor:
        return _directed(p, q, p_mask, q_mask, found.index, shift[:, None], normals)

    clouds = (p.detach(), q.detach(), p_mask, q_mask)
    compiled = _compiled(p.device)
    if softness == 0 and normals is None:
        k, found, scores = (
            compiled.nearest_of_best(*clouds, shifts)
            if compiled
            else neighbours.nearest_of_best(*clouds, intrinsics, shifts)
        )
        return directed(found, shifts[k]), scores, torch.tensor(k, device=p.device)
    every = compiled.nearest(*clouds, shifts) if compiled else neighbours.nearest(*clouds, intrinsics, shifts)
    losses = torch.stack([directed(f, s) for f, s in zip(every, shifts, strict=True)])
    winner = losses.argmin()
    soft = (
        -softness * (torch.logsumexp(-losses / softness, 0) - math.log(len(shifts)))
        if softness
        else losses[winner]
    )
    return soft, losses.detach(), winner


def _compiled(device: torch.device) -> ModuleType | None:
    """Return the compiled search that runs there, if one does."""
    return next((search for search in (trees, tile_search) if search.usable(device)), None)


def _box(p_mask: Tensor, q_mask: Tensor) -> tuple[tuple[EllipsisType, slice, slice], Tensor] | None:
    """Window of (..., H, W) that holds two masks (H, W), and what it takes from fx, fy, cx, cy; None if one is empty."""
    p_bytes, q_bytes = p_mask.view(torch.uint8), q_mask.view(torch.uint8)  # their amax is faster than any
    of_p, of_q = p_bytes.amax(1), q_bytes.amax(1)
    if not (of_p.any() and of_q.any()):
        return None
    rows = (of_p | of_q).nonzero()[:, 0].tolist()
    high = slice(rows[0], rows[-1] + 1)
    cols = (p_bytes[high] | q_bytes[high]).amax(0).nonzero()[:, 0].tolist()
    return (..., high, slice(cols[0], cols[-1] + 1)), torch.tensor([0.0, 0.0, cols[0], rows[0]])


def _directed(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, index: Tensor, shift: Tensor, normals: Tensor | None
) -> Tensor:
    """Symmetric mean squared distance of P + s and Q for given neighbours (2, H, W).

    The shift (3, 1) is added to differences, where it rounds least.
    """
    p, q = p.flatten(1), q.flatten(1)
    of_p, of_q = (mask.flatten().nonzero()[:, 0] for mask in (p_mask, q_mask))
    to_q, to_p = index[0].flatten()[of_p], index[1].flatten()[of_q]
    forward = p.index_select(1, of_p) - q.index_select(1, to_q) + shift
    backward = p.index_select(1, to_p) - q.index_select(1, of_q) + shift
    if normals is None:
        return forward.square().sum(0).mean() + backward.square().sum(0).mean()
    normals = normals.flatten(1)
    forward, backward = (forward * normals[:, to_q]).sum(0), (backward * normals[:, of_q]).sum(0)
    return forward.square().mean() + backward.square().mean()
