"""One protocol for all published baselines: how a depth map of the sensor's size becomes an answer at twice the resolution.

None of them was published with an x2 output or with normals. All get the same two steps that the sensor's own depth gets
(:mod:`tofcapture_model.networks.baselines.sensor`): doubled without points in the air, normals by least squares on inverse depth.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tofcapture_model.data.frame import Estimate, Frame, Target
from tofcapture_model.geometry.intrinsics import scale_intrinsics
from tofcapture_model.geometry.maps import depth_to_normals
from tofcapture_model.networks.baselines.sensor import upsample_depth

NORMAL_RADIUS = 4  # GeoNet's 9 x 9 window
NEAREST = 0.05  # m


class Baseline(nn.Module):
    """A published network behind the interface of :class:`tofcapture_model.networks.joint.JointModel`.

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
