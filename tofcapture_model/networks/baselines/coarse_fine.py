"""Coarse-Fine CNN: Agresti and Zanuttigh, "Deep learning for multi-path error removal in ToF sensors", ECCV workshops 2018.

A coarse branch at a quarter of the resolution sees far around, a fine branch keeps the detail. Three frequencies have the
published five features, two have three: the high range, low minus high range, and the ratio of amplitudes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Estimate, Frame, Target
from tofcapture_model.losses import masked_mean
from tofcapture_model.networks.baselines import Baseline

FEATURES = 3
_FAINT = 1e-4  # of saturation
_RATIO = 3.0  # amplitude ratios beyond it are noise


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)


class CoarseFine(Baseline):
    """Two shallow branches; 144,386 parameters for five features, the channels of the input."""

    def __init__(self, features: int = FEATURES) -> None:
        super().__init__()
        self.coarse = nn.Sequential(
            _conv(features, 32),
            nn.ReLU(),
            nn.MaxPool2d(2),
            _conv(32, 32),
            nn.ReLU(),
            nn.MaxPool2d(2),
            _conv(32, 32),
            nn.ReLU(),
            _conv(32, 32),
            nn.ReLU(),
            _conv(32, 1),
        )
        self.detail = nn.Sequential(
            _conv(features, 64), nn.ReLU(), _conv(64, 64), nn.ReLU(), _conv(64, 64), nn.ReLU()
        )
        self.fine = nn.Sequential(_conv(65, 64), nn.ReLU(), _conv(64, 1))

    def estimate_depth(self, frame: Frame) -> Tensor:
        """Add what both branches say to the decoded depth."""
        features = mpi_features(frame)
        size = frame.depth.shape[-2:]
        coarse = frame.depth + F.interpolate(
            self.coarse(features), size=size, mode="bilinear", align_corners=False
        )
        out: Tensor = frame.depth + self.fine(torch.cat([self.detail(features), coarse], dim=1))
        return out

    def loss(self, estimate: Estimate, target: Target, frame: Frame) -> Tensor:
        """Average the absolute error, metres (the publication's l1 of the fine branch)."""
        del frame
        return masked_mean((estimate.depth - target.depth).abs(), target.good)


def mpi_features(frame: Frame) -> Tensor:
    """Stack high range (m), low minus high range (m), ratio of amplitudes - 1, clipped: (B, 3, H, W)."""
    low, high = (z.square().sum(1, keepdim=True).sqrt() for z in frame.phasor.chunk(2, dim=1))
    ratio = (low / (high + _FAINT)).clamp(0, _RATIO) - 1
    return torch.cat([frame.depth, frame.gap.clamp(-1, 1), ratio], dim=1)
