"""Robust Chamfer loss on the image grid (paper eq. 2 with its seven jitter candidates), exact.

Neighbours come from :mod:`.trees` on a CPU, from :mod:`.tiles` on a GPU with Triton, else from brute force. They carry no
gradient; the pairs that they make do.
"""

from __future__ import annotations

import math
import os
from shutil import which
from typing import NamedTuple

import torch
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture_model.losses.chamfer import neighbours
from tofcapture_model.losses.chamfer.neighbours import Found

JITTER = 0.010  # m, paper: 1 centimetre


class Chamfer(NamedTuple):
    """Result of :func:`robust_chamfer`.

    Attributes
    ----------
    loss
        (B,) m^2: mean squared distance P -> Q plus Q -> P of the best candidate; 0 for items without points.
    candidates
        (B, 7) without gradient. Exact for the winner; of the others a bound from below that shows that they cannot win. With
        ``softness`` or ``normals`` all are exact.
    winner
        (B,) int64 index into :func:`candidate_shifts`; worth logging, see docs/decisions/0005-network.md.
    """

    loss: Tensor
    candidates: Tensor
    winner: Tensor


def candidate_shifts(jitter: float = JITTER) -> Tensor:
    """Return (7, 3) shifts in metres: none, then +x, -x, +y, -y, +z, -z."""
    axes = torch.eye(3).repeat_interleave(2, 0) * torch.tensor([1.0, -1.0]).repeat(3)[:, None]
    return torch.cat([torch.zeros(1, 3), jitter * axes])


def robust_chamfer(
    p: Tensor,
    q: Tensor,
    p_mask: Tensor,
    q_mask: Tensor,
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
    jitter
        Metres; 0 gives the plain Chamfer distance seven times.
    normals
        (B, 3, H, W) unit normals of Q: distances to the tangent plane at q instead of to q; neighbours stay the nearest points.
    softness
        m^2: above 0 the least of the seven is a soft one, ``-softness log mean exp(-loss / softness)``. A large softness gives
        the mean, whose only minimum is the right place, a small one the least.
    """
    shifts = candidate_shifts(jitter).to(p.device)
    of_normals = [None] * len(p) if normals is None else normals.unbind()
    items = [  # unbound, as the gradient of p[b] is a whole batch
        _item(*clouds, shifts, n, softness)
        for *clouds, n in zip(
            p.float().unbind(), q.float().unbind(), p_mask[:, 0], q_mask[:, 0], of_normals, strict=True
        )
    ]
    loss, candidates, winner = (torch.stack(x) for x in zip(*items, strict=True))
    return Chamfer(loss, candidates, winner)


def _item(
    p: Tensor,
    q: Tensor,
    p_mask: Tensor,
    q_mask: Tensor,
    shifts: Tensor,
    normals: Tensor | None,
    softness: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss (), candidates (7,), winner () of one pair of clouds."""
    if not (p_mask.any() and q_mask.any()):
        nothing = 0.0 * torch.where(p_mask, p, 0.0).sum()
        return nothing, shifts.new_zeros(len(shifts)), torch.zeros((), dtype=torch.int64, device=p.device)
    rows, cols = ((p_mask | q_mask).any(axis).nonzero()[:, 0].tolist() for axis in (1, 0))
    box = (..., slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
    p, q, p_mask, q_mask = p[box], q[box], p_mask[box], q_mask[box]
    clouds = (p.detach(), q.detach(), p_mask, q_mask)
    if softness == 0 and normals is None:
        k, found, scores = _nearest_of_best(*clouds, shifts)
        loss = _directed(p, q, p_mask, q_mask, found.index[0], shifts[k, :, None], None)
        return loss, scores, torch.tensor(k, device=p.device)
    normals = None if normals is None else normals[box]
    every = _nearest(*clouds, shifts).index
    losses = torch.stack(
        [_directed(p, q, p_mask, q_mask, i, s[:, None], normals) for i, s in zip(every, shifts, strict=True)]
    )
    winner = losses.argmin()
    if not softness:
        return losses[winner], losses.detach(), winner
    soft = -softness * (torch.logsumexp(-losses / softness, 0) - math.log(len(shifts)))
    return soft, losses.detach(), winner


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


def _nearest(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor) -> Found:
    """Ask the engine of the device."""
    if p.device.type == "cpu":
        try:
            from tofcapture_model.losses.chamfer import trees
        except ConfigError:  # no numba: minutes for a whole image
            return neighbours.nearest(p, q, p_mask, q_mask, shifts)
        return trees.nearest(p, q, p_mask, q_mask, shifts)
    # PyTorch's wheels for GPUs bring Triton along, which asks for a C compiler
    if p.device.type == "cuda" and any(which(c) for c in (os.environ.get("CC", "gcc"), "gcc", "clang")):
        try:
            from tofcapture_model.losses.chamfer import tiles
        except ImportError:
            return neighbours.nearest(p, q, p_mask, q_mask, shifts)
        return tiles.nearest(p, q, p_mask, q_mask, shifts)
    return neighbours.nearest(p, q, p_mask, q_mask, shifts)


def _nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Found, Tensor]:
    """Return the best shift, its neighbours (1, 2, H, W) and the scores (7,) of all, m^2."""
    if p.device.type == "cpu":
        try:
            from tofcapture_model.losses.chamfer import trees
        except ConfigError:
            pass
        else:
            return trees.nearest_of_best(p, q, p_mask, q_mask, shifts)
    squared, index = _nearest(p, q, p_mask, q_mask, shifts)
    masks = torch.stack([p_mask, q_mask])
    scores = (torch.where(masks, squared, 0.0).sum((2, 3)) / masks.sum((1, 2))).sum(1)
    k = int(scores.argmin())
    return k, Found(squared[k : k + 1], index[k : k + 1]), scores
