"""Our model: ToF raw data in, depth, error map and normals at twice the resolution out."""

from __future__ import annotations

from torch import Tensor, nn

from tofcapture_model.config import Network
from tofcapture_model.frame import Estimate, Frame
from tofcapture_model.geometry.maps import scale_intrinsics
from tofcapture_model.networks.heads import (
    CORRECTIONS,
    CompactInputs,
    CompactNormals,
    ErrorMap,
    Features,
    PaperInputs,
    PaperNormals,
    Raw2Depth,
    Refinement,
    doubled,
    zeroed_conv,
)
from tofcapture_model.networks.unet import CONVEX_CHANNELS, UNet


class JointModel(nn.Module):
    """Joint depth and normal estimation (paper section IV); :class:`PaperModel` and :class:`CompactModel` have the parts."""

    raw2depth: Raw2Depth
    error_map: ErrorMap
    raw2normal: nn.Module
    refinement: Refinement

    def read(self, frame: Frame) -> tuple[Features, Tensor]:
        """Return the features of a frame and the image (B, C, H, W) that all heads share."""
        raise NotImplementedError

    def forward(self, frame: Frame, stage: str = "joint") -> Estimate:
        """Estimate depth, error map and normals of a frame (B, ., H, W), any H and W, at (2H, 2W).

        ``stage`` is one of training; ``depth`` and ``normal`` skip the networks that do not take part in it.
        """
        features, shared = self.read(frame)
        depth = doubled(frame.depth) if stage == "normal" else self.raw2depth(shared, features, frame)
        error = self.error_map(shared, features, depth, frame)
        if stage == "depth":
            normals = doubled(features.normals)
        else:
            normals = self.raw2normal(shared, features, depth, frame)
        if stage in ("depth", "normal"):
            return Estimate(depth, normals, error, depth, normals, features.trust)
        fine = scale_intrinsics(frame.intrinsics, 2)
        fine_depth, fine_normals = self.refinement(depth, normals, error, fine)
        return Estimate(fine_depth, fine_normals, error, depth, normals, features.trust)


class PaperModel(JointModel):
    """The paper's network: a U-Net for depth, one for its error, one for the normals."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.inputs = PaperInputs(network.inputs)
        channels, decoded = self.inputs.channels, "depth" in network.inputs

        def head(inputs: int, outputs: int) -> UNet:
            return UNet(inputs, outputs, network.width, network.levels, zero_last=True)

        # without the decoded depth among its inputs, the answer is no correction of it (table IV: Conf., Raw)
        self.raw2depth = Raw2Depth(head(channels, 1 + CONVEX_CHANNELS), network, decoded=decoded)
        self.error_map = ErrorMap(head(channels + 4, 4), decoded=decoded)
        self.raw2normal = PaperNormals(head(channels, 12))
        self.refinement = Refinement(network.refine_iterations, network.refine_radius)

    def read(self, frame: Frame) -> tuple[Features, Tensor]:
        """Take the inputs as they are."""
        features = self.inputs(frame)
        return features, features.image


class CompactModel(JointModel):
    """One small U-Net on classical features, and three small heads."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.inputs, width = CompactInputs(network.windows), network.width
        candidates = len(network.windows) + CORRECTIONS
        self.backbone = UNet(self.inputs.channels, width, width, network.levels, leak=network.leak)
        depth_net = zeroed_conv(width, candidates + 1 + CONVEX_CHANNELS)
        self.raw2depth = Raw2Depth(depth_net, network, candidates=candidates)
        self.error_map = ErrorMap(zeroed_conv(width + 4, 4))
        self.raw2normal = CompactNormals(width)
        self.refinement = Refinement(network.refine_iterations, network.refine_radius)

    def read(self, frame: Frame) -> tuple[Features, Tensor]:
        """Compute features and let the backbone look at them."""
        features = self.inputs(frame)
        return features, self.backbone(features.image)
