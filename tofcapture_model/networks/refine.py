"""Joint refinement: depth to normals to depth, a few rounds (paper section IV-C, after GeoNet).

The geometry has no parameters; each round learns two gains, which start at one: what the geometry says is taken whole, as in GeoNet,
until training knows better. A bad normal map can make depth worse, so every round asks the plane of a neighbour only where normals agree and its vote lies near (``propagate_depth``), trusts
neighbours by the inverse square of their expected error, and goes only as far as its gain says.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tofcapture_model.geometry.maps import depth_to_normals, propagate_depth, unit

_MIN_ERROR = 1e-3  # m; the same floor as in eq. 1
_GAIN_UNIT = 5.0  # gains learn at the pace of the weights of a layer, which move by much less than 1


class Refinement(nn.Module):
    """Rounds of depth -> normal -> depth with learned gains."""

    def __init__(self, iterations: int, radius: int) -> None:
        super().__init__()
        self.radius = radius
        self.depth_gain = nn.Parameter(torch.full((iterations,), 1 / _GAIN_UNIT))
        self.normal_gain = nn.Parameter(torch.full((iterations,), 1 / _GAIN_UNIT))

    def forward(
        self, depth: Tensor, normals: Tensor, error: Tensor, intrinsics: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Refine.

        Parameters
        ----------
        depth, normals, error
            (B, 1, H, W) metres, (B, 3, H, W) unit, (B, 1, H, W) metres; all at output resolution.
        intrinsics
            (B, 4) of that resolution.

        Returns
        -------
        depth, normals
            Same shapes.
        """
        confidence = error.detach().clamp_min(_MIN_ERROR) ** -2
        confidence = confidence / confidence.amax(dim=(2, 3), keepdim=True)
        # by number: a loop over an empty parameter is an operation that torch.export cannot read back
        for k in range(len(self.depth_gain)):
            depth_gain, normal_gain = self.depth_gain[k], self.normal_gain[k]
            # a measurement of the present depth, not a path for gradients: those reach the depth by propagation
            fitted = depth_to_normals(depth.detach(), confidence, intrinsics, radius=4)
            normals = unit(normals + _GAIN_UNIT * normal_gain * (fitted - normals))
            moved = propagate_depth(depth, normals, intrinsics, confidence, self.radius, step=2)
            depth = depth + _GAIN_UNIT * depth_gain * (moved - depth)
        return depth, normals
