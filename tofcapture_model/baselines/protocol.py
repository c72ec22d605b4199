"""One protocol for all published baselines: how a depth map of the sensor's size becomes an answer at twice the resolution.

None of them was published with an x2 output or with normals. All get the same two steps that the sensor's own depth gets
(:mod:`tofcapture_model.baselines.sensor`): doubled without points in the air, normals by least squares on inverse depth.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from tofcapture.rig import SPEED_OF_LIGHT
from tofcapture_model.baselines.sensor import upsample_depth
from tofcapture_model.frame import Estimate, Frame, Target
from tofcapture_model.geometry import depth_to_normals, rays, scale_intrinsics

NORMAL_RADIUS = 4  # GeoNet's 9 x 9 window
NEAREST = 0.05  # m
_FAINT = 1e-10  # keeps atan2 differentiable where a pixel is dark


def turn(new: Tensor, old: Tensor) -> Tensor:
    """(B, 1, H, W) radians in [-pi, pi] from phasor ``old`` to phasor ``new``, each (B, 2, H, W) I and Q."""
    real = (new * old).sum(1, keepdim=True)
    imaginary = (new[:, 1] * old[:, 0] - new[:, 0] * old[:, 1])[:, None]
    return torch.atan2(imaginary, real + torch.where(real < 0, -_FAINT, _FAINT))


def turned_depth(frame: Frame, high: Tensor) -> Tensor:
    """Depth (B, 1, H, W), metres, that the frame would have had with ``high`` (B, 2, H, W) as its phasor of the high frequency.

    The phasor's turn moves the decoded depth along the ray: calibration and unwrapping stay those of the frame.
    """
    hertz = frame.modulation[:, 1].reshape(-1, 1, 1, 1)
    radial = turn(high, frame.phasor[:, 2:]) * (SPEED_OF_LIGHT / (4 * math.pi)) / hertz
    length = rays(frame.intrinsics, *frame.depth.shape[-2:]).square().sum(1, keepdim=True).sqrt()
    return frame.depth + radial / length


class Baseline(nn.Module):
    """A published network behind the interface of :class:`tofcapture_model.joint.JointModel`.

    A subclass says ``estimate_depth`` and ``loss``; everything else, training loop included, is shared.
    """

    def estimate_depth(self, frame: Frame) -> Tensor:
        """Return depth (B, 1, H, W), metres."""
        raise NotImplementedError

    def loss(self, estimate: Estimate, target: Target, frame: Frame) -> Tensor:
        """Scalar training loss as its publication has it."""
        raise NotImplementedError

    def forward(self, frame: Frame, stage: str = "depth") -> Estimate:
        """Estimate depth and, from it, normals; no error map: it is zero.

        Parameters
        ----------
        frame
            (B, ., H, W), any H and W.
        stage
            Not looked at: a baseline has one.

        Returns
        -------
        Estimate, at (2H, 2W)
        """
        del stage
        depth = upsample_depth(self.estimate_depth(frame).float().clamp_min(NEAREST))
        with torch.no_grad():
            normals = depth_to_normals(
                depth, torch.ones_like(depth), scale_intrinsics(frame.intrinsics, 2), NORMAL_RADIUS
            )
        return Estimate(depth, normals, torch.zeros_like(depth), depth, normals)
