"""The paper's losses: free functions of prediction, target and mask. All lengths in metres, all in float32.

Sums of the paper are means over the mask, so that weights do not depend on the size of a crop.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tofcapture_model.config import Losses
from tofcapture_model.frame import Estimate, Target
from tofcapture_model.geometry.maps import unit, unproject
from tofcapture_model.losses.chamfer import robust_chamfer

_PER_MM2 = 1e6  # m^2 to mm^2, so that the Chamfer weight is of the order of the others
DELTA = 0.020  # m, paper: threshold 20 (mm) of eq. 1
EPSILON = 1e-6  # m, paper: 0.001 (mm) in lambda = d / (e + epsilon)
MIN_ERROR = 0.001  # m; see reweighting()
_SMALL_CHORD = 1e-3  # the root has no slope at zero
MIN_SCALE = 1e-4  # m; the likelihood of a perfect pixel has no bound


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Average ``values`` over ``mask`` (any numeric weight); exactly 0, with zero gradient, where it is empty."""
    weight = mask.to(values.dtype).expand_as(values)
    kept = torch.where(weight > 0, values, torch.zeros_like(values))
    return (kept * weight).sum() / weight.sum().clamp_min(1e-6)


def _inside(gt: Tensor, mask: Tensor, otherwise: Tensor) -> Tensor:
    """Ground truth inside the mask; outside it may be NaN, whose gradient no later mask would stop."""
    return torch.where(mask > 0, gt.float(), otherwise.detach().float())


def reweighting(gt: Tensor, error: Tensor, mask: Tensor) -> Tensor:
    """Weigh pixels by lambda of eq. 1: ``d_gt / (e + epsilon)``, detached, e clamped to 1 mm, divided by its mean.

    Detached, lest the network lower the loss by inflating e. Clamped, as e = 0 would give one pixel a weight of 1e6. Divided
    by its mean, so that the learning rate does not depend on how good the depth is.
    """
    weight = gt / (error.detach().clamp_min(MIN_ERROR) + EPSILON)
    return (weight / masked_mean(weight, mask).clamp_min(1e-12)).detach()


def smooth_l1(difference: Tensor, delta: float) -> Tensor:
    """Compute eq. 1 without lambda: ``(d/delta)^2 / 2`` below delta, ``|d/delta| - 1/2`` above."""
    scaled = difference.abs() / delta
    return torch.where(scaled < 1, scaled.square() / 2, scaled - 0.5)


def reweighted_smooth_l1(
    depth: Tensor, gt: Tensor, error: Tensor, mask: Tensor, delta: float = DELTA
) -> Tensor:
    """Compute the reweighted smooth l1 loss (eq. 1), mean over the mask; a scalar without unit.

    ``depth``, ``gt`` and ``error``, the expected absolute error, are (B, 1, H, W) metres; ``mask`` is bool, or a weight per pixel.
    Scaling all lengths by k, delta included, leaves it unchanged.
    """
    gt = _inside(gt, mask, depth)
    weight = reweighting(gt, error.float(), mask)
    return masked_mean(weight * smooth_l1(depth.float() - gt, delta), mask)


def error_map_loss(error: Tensor, depth: Tensor, gt: Tensor, mask: Tensor, delta: float = DELTA) -> Tensor:
    """Hold the error map against ``|d - d_gt|`` of the detached depth, l1 in units of delta, mean over the mask."""
    truth = (depth.detach().float() - _inside(gt, mask, depth)).abs()
    return masked_mean((error.float() - truth).abs() / delta, mask)


def laplace_loss(scale: Tensor, depth: Tensor, gt: Tensor, mask: Tensor, delta: float = DELTA) -> Tensor:
    """Compute the negative log likelihood of the detached depth under a Laplace distribution; mean over the mask.

    ``scale`` (B, 1, H, W), metres, is the predicted b, whose sigma is ``sqrt(2) b``; ``delta`` is its unit.
    """
    truth = (depth.detach().float() - _inside(gt, mask, depth)).abs()
    scale = scale.float().clamp_min(MIN_SCALE)
    return masked_mean(truth / scale + (scale / delta).log(), mask)


def cosine_loss(normals: Tensor, gt: Tensor, mask: Tensor) -> Tensor:
    """Compute the cosine embedded loss (eq. 3): mean of ``1 - n1 . n2`` of normals (B, 3, H, W) over the mask."""
    both = unit(normals.float()) * unit(_inside(gt, mask, normals))  # torch's own is 5 times slower on CPU
    return masked_mean(1 - both.sum(1, keepdim=True), mask)


def angle_loss(normals: Tensor, gt: Tensor, mask: Tensor) -> Tensor:
    """Average the chord ``|n1 - n2|`` of unit normals over the mask: about the angle, where eq. 3, half its square, hardly pulls."""
    apart = unit(normals.float()) - unit(_inside(gt, mask, normals))
    return masked_mean((apart.square().sum(1, keepdim=True) + _SMALL_CHORD**2).sqrt() - _SMALL_CHORD, mask)


class Objective(NamedTuple):
    """Total loss of a step and its parts, scalars without unit; ``winners`` counts the Chamfer candidates (7,)."""

    total: Tensor
    parts: dict[str, Tensor]
    winners: Tensor


def objective(
    weights: Losses,
    stage: str,
    estimate: Estimate,
    target: Target,
    intrinsics: Tensor,
    share: Tensor | None = None,
) -> Objective:
    """Weigh the losses that take part in a stage; ``intrinsics`` (B, 4 or 12) are of the estimate's grid.

    ``share`` (B, 1, 1, 1) is by how much each image counts, 1 where nothing is said.

    ``depth``: eq. 1, eq. 2 and the error map on the initial depth. ``normal``: eq. 3 on the initial normals. ``refine``: eq. 1
    and eq. 3 on the refined maps. ``joint``: everything on the refined maps.
    """
    weight = target.good.float() + weights.context * target.context.float()
    if share is not None:
        weight = weight * share
    depth = estimate.initial_depth if stage == "depth" else estimate.depth
    normals = estimate.initial_normals if stage == "normal" else estimate.normals
    parts: dict[str, Tensor] = {}
    winners = torch.zeros(7)
    if stage != "normal":
        error = estimate.error if weights.reweight else target.depth  # lambda = d / d is the same everywhere
        smooth = reweighted_smooth_l1(depth, target.depth, error, weight, weights.delta)
        parts["depth"] = weights.depth * smooth
    if stage in ("depth", "joint"):
        uncertainty = laplace_loss if weights.uncertainty == "laplace" else error_map_loss
        told = uncertainty(estimate.error, depth, target.depth, weight, weights.delta)
        parts["error"] = weights.error * told
        if weights.chamfer:  # both clouds live where the ground truth does
            p, q = unproject(depth, intrinsics), unproject(target.depth, intrinsics)
            chamfer = robust_chamfer(p, q, target.good, target.good, weights.jitter)
            parts["chamfer"] = weights.chamfer * _PER_MM2 * chamfer.loss.mean()
            winners = torch.bincount(chamfer.winner.cpu(), minlength=7).float()
    if stage != "depth":
        distance = angle_loss if weights.normals == "angle" else cosine_loss
        parts["normal"] = weights.normal * distance(normals, target.normals, weight)
    if share is not None:  # means are over weights: a batch that counts little is a small step
        parts = {name: part * share.mean() for name, part in parts.items()}
    return Objective(torch.stack(list(parts.values())).sum(), parts, winners)
