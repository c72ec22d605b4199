"""The sensor's own answer: the decoded depth of the same single frame, upsampled, and normals fitted to it.

Row one of the paper's table. Nothing is denoised: a frame is decoded with the camera's own calibration, doubled in size, and
normals come from least squares on inverse depth in GeoNet's 9 x 9 window at the output resolution.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.data.frame import Frame
from tofcapture_model.geometry.intrinsics import scale_intrinsics
from tofcapture_model.geometry.maps import depth_to_normals, shifted

_JUMP = 0.05  # m; across a larger step of depth a bilinear mean would be a point in the air


def upsample_depth(depth: Tensor) -> Tensor:
    """Double the resolution: bilinear on surfaces, nearest across depth jumps.

    Parameters
    ----------
    depth
        (B, 1, H, W) metres, finite.

    Returns
    -------
    (B, 1, 2H, 2W)
    """
    around = [shifted(depth, dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    stack = torch.cat(around, dim=1)
    jump = (stack.amax(1, keepdim=True) - stack.amin(1, keepdim=True)) > _JUMP
    nearest = F.interpolate(depth, scale_factor=2, mode="nearest")
    smooth = F.interpolate(depth, scale_factor=2, mode="bilinear", align_corners=False)
    return torch.where(F.interpolate(jump.float(), scale_factor=2, mode="nearest") > 0, nearest, smooth)


def estimate(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Answer as the sensor does.

    Returns
    -------
    depth
        (B, 1, 2H, 2W) metres; holes carry their nearest measured neighbour, so that coverage is equal to the model's.
    normals
        (B, 3, 2H, 2W) unit.
    measured
        (B, 1, 2H, 2W) bool: not such a hole.
    """
    depth = upsample_depth(frame.depth)
    measured = F.interpolate(frame.valid, scale_factor=2, mode="nearest") > 0
    normals = depth_to_normals(depth, torch.ones_like(depth), scale_intrinsics(frame.intrinsics, 2), radius=4)
    return depth, normals, measured
