"""Robust Chamfer loss on the image grid (paper eq. 2 with its seven jitter candidates), exact.

Neighbours come from :mod:`.trees` on a CPU, from :mod:`.tiles` on a GPU with Triton, else from brute force. They carry no
gradient; the pairs that they make do.
"""

from __future__ import annotations

import os
from shutil import which
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture_model.losses.chamfer import neighbours

JITTER = 0.010  # m, paper: 1 centimetre


class Chamfer(NamedTuple):
    """Result of :func:`robust_chamfer`."""

    loss: (
        Tensor  #: (B,) m^2: mean squared distance P -> Q plus Q -> P of the best candidate; 0 without points
    )
    #: (B, 7) without gradient; exact for the winner, of the others a bound from below that shows that they cannot win
    candidates: Tensor
    winner: Tensor  #: (B,) int64 index into candidate_shifts; worth logging (docs/decisions/0005-network.md)


def candidate_shifts(jitter: float = JITTER) -> Tensor:
    """Return (7, 3) shifts in metres: none, then +x, -x, +y, -y, +z, -z."""
    axes = torch.eye(3).repeat_interleave(2, 0) * torch.tensor([1.0, -1.0]).repeat(3)[:, None]
    return torch.cat([torch.zeros(1, 3), jitter * axes])


def robust_chamfer(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, jitter: float = JITTER) -> Chamfer:
    """Chamfer distance of the best of seven slightly moved copies of P (paper eq. 2, sums taken as means).

    Parameters
    ----------
    p, q
        (B, 3, H, W) points of the prediction and of the ground truth on the same grid, metres; finite.
    p_mask, q_mask
        (B, 1, H, W) bool: which pixels belong to the clouds.
    jitter
        Metres; 0 gives the plain Chamfer distance seven times.
    """
    shifts = candidate_shifts(jitter).to(p.device)
    # unbound, as the gradient of p[b] is a whole batch
    clouds = zip(p.float().unbind(), q.float().unbind(), p_mask[:, 0], q_mask[:, 0], strict=True)
    loss, candidates, winner = (
        torch.stack(x) for x in zip(*(_item(*c, shifts) for c in clouds), strict=True)
    )
    return Chamfer(loss, candidates, winner)


def _item(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss (), candidates (7,), winner () of one pair of clouds."""
    if not (p_mask.any() and q_mask.any()):
        nothing = 0.0 * torch.where(p_mask, p, 0.0).sum()
        return nothing, shifts.new_zeros(len(shifts)), torch.zeros((), dtype=torch.int64, device=p.device)
    rows, cols = ((p_mask | q_mask).any(axis).nonzero()[:, 0].tolist() for axis in (1, 0))
    box = (..., slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
    p, q, p_mask, q_mask = p[box], q[box], p_mask[box], q_mask[box]
    winner, index, scores = _engine(p.device).nearest_of_best(p.detach(), q.detach(), p_mask, q_mask, shifts)
    loss = _distance(p, q, p_mask, q_mask, index, shifts[winner, :, None])
    return loss, scores, torch.tensor(winner, device=p.device)


def _distance(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, index: Tensor, shift: Tensor) -> Tensor:
    """Symmetric mean squared distance of P + s and Q for given neighbours (2, H, W).

    The shift (3, 1) is added to differences, where it rounds least.
    """
    p, q = p.flatten(1), q.flatten(1)
    of_p, of_q = (mask.flatten().nonzero()[:, 0] for mask in (p_mask, q_mask))
    to_q, to_p = index[0].flatten()[of_p], index[1].flatten()[of_q]
    forward = p.index_select(1, of_p) - q.index_select(1, to_q) + shift
    backward = p.index_select(1, to_p) - q.index_select(1, of_q) + shift
    return forward.square().sum(0).mean() + backward.square().sum(0).mean()


def _engine(device: torch.device) -> ModuleType:
    """Choose who finds the neighbours there; brute force, where nothing else runs, takes minutes for whole images."""
    try:
        if device.type == "cpu":  # with numba
            from tofcapture_model.losses.chamfer import trees

            return trees
        # PyTorch's wheels for GPUs bring Triton along, which asks for a C compiler
        if device.type == "cuda" and any(which(c) for c in (os.environ.get("CC", "gcc"), "gcc", "clang")):
            from tofcapture_model.losses.chamfer import tiles

            return tiles
    except (ConfigError, ImportError):
        pass
    return neighbours
