"""Published methods that the model is compared with, one file each, and what they share: the sensor's own answer.

None was published with an x2 output or with normals. All get the two steps that the sensor's depth gets: doubled without
points in the air, normals by least squares on inverse depth in GeoNet's 9 x 9 window.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Estimate, Frame, Target
from tofcapture_model.geometry.maps import (
    depth_to_normals,
    metres_per_radian,
    rays,
    scale_intrinsics,
    shifted,
    turn,
)

NORMAL_RADIUS = 4
NEAREST = 0.05  # m
_WHOLE = 1e-4  # of a frequency ratio
_JUMP = 0.05  # m; across a larger step of depth a bilinear mean would be a point in the air


def upsample_depth(depth: Tensor) -> Tensor:
    """Double the resolution of (B, 1, H, W) metres: bilinear on surfaces, nearest across depth jumps."""
    around = [shifted(depth, dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    stack = torch.cat(around, dim=1)
    jump = (stack.amax(1, keepdim=True) - stack.amin(1, keepdim=True)) > _JUMP
    nearest = F.interpolate(depth, scale_factor=2, mode="nearest")
    smooth = F.interpolate(depth, scale_factor=2, mode="bilinear", align_corners=False)
    return torch.where(F.interpolate(jump.float(), scale_factor=2, mode="nearest") > 0, nearest, smooth)


def fine_normals(depth: Tensor, frame: Frame) -> Tensor:
    """Fit normals (B, 3, 2H, 2W) to a depth at twice the resolution of its frame."""
    fine = scale_intrinsics(frame.intrinsics, 2)
    return depth_to_normals(depth, torch.ones_like(depth), fine, NORMAL_RADIUS)


def sensor_estimate(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Answer as the sensor does, without denoising: row one of the paper's table.

    Returns depth (B, 1, 2H, 2W), metres, in which holes carry their nearest measured neighbour, so that coverage is equal to the
    model's; unit normals (B, 3, 2H, 2W); and what was measured, (B, 1, 2H, 2W) bool.
    """
    depth = upsample_depth(frame.depth)
    measured = F.interpolate(frame.valid, scale_factor=2, mode="nearest") > 0
    return depth, fine_normals(depth, frame), measured


def decode(frame: Frame, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Decode a frame again with other phasors (B, 2, H, W), differentiably: both frequencies, unwrapped and fused as the decoder does.

    Their turns move the ranges, so calibration stays that of the frame; the wrap is the one that leaves the smallest gap.
    Rounding has no gradient. Holes turn, but their wraps stay: no gap is known there.

    Returns depth (B, 1, H, W), ``frame.depth`` where the phasors are the frame's, and the gap, both in metres.
    """
    low_metres, high_metres = metres_per_radian(frame, 0), metres_per_radian(frame, 1)
    low_range, high_range = 2 * math.pi * low_metres, 2 * math.pi * high_metres
    lean = high_metres.square() / (low_metres.square() + high_metres.square())  # f^2: inverse variance
    turned = turn(high, frame.phasor[:, 2:]) * high_metres
    gap = frame.gap + turn(low, frame.phasor[:, :2]) * low_metres - turned
    # in another ratio there is no next wrap at the same gap: the decoder's stay
    ratio = low_range / high_range
    whole = (ratio - torch.round(ratio)).abs() < _WHOLE
    wraps = whole * frame.valid * high_range * torch.round(gap / high_range)
    gap = gap - wraps
    length = rays(frame.intrinsics, *frame.depth.shape[-2:]).square().sum(1, keepdim=True).sqrt()
    # the decoder's ranges lie within that of the low frequency
    rounds = whole * low_range * torch.floor((frame.depth * length + wraps) / low_range)
    moved = turned + wraps - frame.valid * rounds + lean * (gap - frame.gap)
    return frame.depth + moved / length, gap


class Baseline(nn.Module):
    """A published network behind the interface of :class:`tofcapture_model.networks.joint.JointModel`.

    A subclass says ``estimate_depth`` and ``loss``; everything else, training loop included, is shared.
    """

    def estimate_depth(self, frame: Frame) -> Tensor:
        """Return depth (B, 1, H, W), metres."""
        raise NotImplementedError

    def loss(self, estimate: Estimate, target: Target, frame: Frame) -> Tensor:
        """Compute the scalar training loss as its publication has it."""
        raise NotImplementedError

    def forward(self, frame: Frame, stage: str = "depth") -> Estimate:
        """Estimate depth and normals at (2H, 2W); the error map is zero. A baseline has one stage only."""
        del stage
        depth = upsample_depth(self.estimate_depth(frame).float().clamp_min(NEAREST))
        with torch.no_grad():
            normals = fine_normals(depth, frame)
        return Estimate(depth, normals, torch.zeros_like(depth), depth, normals)
