"""Our model: ToF raw data in, depth, error map and normals at twice the resolution out."""

from __future__ import annotations

from torch import nn

from tofcapture_model.config import Network
from tofcapture_model.data.frame import Estimate, Frame
from tofcapture_model.geometry.intrinsics import scale_intrinsics
from tofcapture_model.networks.heads import (
    CompactInputs,
    ErrorMap,
    PaperInputs,
    Raw2Depth,
    Raw2Normal,
    doubled,
)
from tofcapture_model.networks.refine import Refinement
from tofcapture_model.networks.unet import UNet


class JointModel(nn.Module):
    """Joint depth and normal estimation (paper section IV).

    Parameters
    ----------
    network
        Which network; the same class holds the paper's three U-Nets and the compact one.
    """

    def __init__(self, network: Network) -> None:
        super().__init__()
        compact = network.kind == "compact"
        self.inputs = CompactInputs(network.windows) if compact else PaperInputs(network.inputs)
        channels = network.width if compact else self.inputs.channels
        self.backbone = (
            UNet(self.inputs.channels, network.width, network.width, network.levels)
            if compact
            else nn.Identity()
        )
        self.raw2depth = Raw2Depth(network, channels)
        self.error_map = ErrorMap(network, channels)
        self.raw2normal = Raw2Normal(network, channels)
        self.refinement = Refinement(network.refine_iterations, network.refine_radius)

    def forward(self, frame: Frame, stage: str = "joint") -> Estimate:
        """Estimate depth, error map and normals.

        Parameters
        ----------
        frame
            (B, ., H, W), any H and W.
        stage
            A training stage; ``depth`` and ``normal`` skip the networks that do not take part in it.

        Returns
        -------
        Estimate, at (2H, 2W)
        """
        features = self.inputs(frame)
        shared = self.backbone(features.image)
        if stage == "normal":
            depth = doubled(frame.depth)
        else:
            depth = self.raw2depth(shared, features, frame)
        error = self.error_map(shared, depth, frame)
        if stage == "depth":
            normals = doubled(features.normals)
        else:
            normals = self.raw2normal(shared, features, depth, frame)
        if stage in ("depth", "normal"):
            return Estimate(depth, normals, error, depth, normals)
        fine_depth, fine_normals = self.refinement(
            depth, normals, error, scale_intrinsics(frame.intrinsics, 2)
        )
        return Estimate(fine_depth, fine_normals, error, depth, normals)
