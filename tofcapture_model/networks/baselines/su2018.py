"""ToFNet: Su, Heide, Wetzstein, Heidrich, "Deep End-to-End Time-of-Flight Imaging", CVPR 2018.

The generator as released: residual encoder-decoder without normalisation, additive skips, tanh over the depth range. It reads
unit phasors of two frequencies. In the released recipe the discriminator never sees the depth: l1 and an edge-weighted total
variation train the generator, and so they do here. One thing differs. As released it starts in the middle of the tanh, at 5 m,
and on a rig below 1.5 m the first hundred steps drive it into saturation for good. It starts at ``START`` here.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Estimate, Frame, Target
from tofcapture_model.losses import masked_mean
from tofcapture_model.networks.baselines import Baseline
from tofcapture_model.networks.unet import pad_to_multiple

FAR = 10.0  # m, range of the tanh, as released
START = 0.8  # m
TV = 1e-4  # weight of the total variation, both terms as means; the released code sums it, which flattens everything
_FAINT = 1e-6


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.ReplicationPad2d(1),
            nn.Conv2d(width, width, 3),
            nn.ReLU(),
            nn.ReplicationPad2d(1),
            nn.Conv2d(width, width, 3),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Add what the two convolutions say."""
        out: Tensor = x + self.net(x)
        return out


class ToFNet(Baseline):
    """Generator of ToFNet; 12,028,225 parameters at width 64, with ``blocks`` residual ones at a quarter of the resolution."""

    def __init__(self, width: int = 64, blocks: int = 9) -> None:
        super().__init__()
        w = width
        self.first = nn.Sequential(
            nn.ReplicationPad2d(3), nn.Conv2d(4, w, 7), nn.ReLU(), _conv(w, w), nn.ReLU()
        )
        self.down1 = nn.Sequential(_conv(w, 2 * w, 2), nn.ReLU(), _conv(2 * w, 2 * w), nn.ReLU())
        self.down2 = nn.Sequential(_conv(2 * w, 4 * w, 2), nn.ReLU())
        self.residual = nn.Sequential(*(_Residual(4 * w) for _ in range(blocks)))
        self.up1 = nn.ConvTranspose2d(4 * w, 2 * w, 4, 2, 1)
        self.after1 = nn.Sequential(_conv(2 * w, 2 * w), nn.ReLU())
        self.up2 = nn.ConvTranspose2d(2 * w, w, 4, 2, 1)
        self.after2 = nn.Sequential(_conv(w, w), nn.ReLU())
        self.last = nn.Sequential(nn.ReplicationPad2d(1), nn.Conv2d(w, 1, 3))
        self.apply(_initialise)
        nn.init.constant_(self.last[-1].bias, math.atanh(2 * START / FAR - 1))  # type: ignore[arg-type]

    def estimate_depth(self, frame: Frame) -> Tensor:
        """Compute depth from unit phasors alone; the decoded depth is not read."""
        h, w = frame.depth.shape[-2:]
        x, (top, left) = pad_to_multiple(unit_phasors(frame), 4)
        skip2 = self.first(x)
        skip1 = self.down1(skip2)
        x = self.residual(self.down2(skip1))
        x = self.after1(F.relu(self.up1(x) + skip1))
        x = self.after2(F.relu(self.up2(x) + skip2))
        with torch.autocast(x.device.type, enabled=False):  # eight bits of mantissa are steps of 12 mm here
            out: Tensor = (torch.tanh(self.last(x.float())) + 1) * (FAR / 2)
        return out[..., top : top + h, left : left + w]

    def loss(self, estimate: Estimate, target: Target, frame: Frame) -> Tensor:
        """Add l1 and TV where the amplitude is smooth, both in units of half the range as in the release."""
        l1 = masked_mean((estimate.depth - target.depth).abs(), target.good)
        return (l1 + TV * weighted_variation(estimate.depth, frame)) / (FAR / 2)


def unit_phasors(frame: Frame) -> Tensor:
    """Divide I and Q of each frequency by their amplitude: (B, 4, H, W)."""
    pairs = frame.phasor.chunk(2, dim=1)
    return torch.cat([z / (z.square().sum(1, keepdim=True).sqrt() + _FAINT) for z in pairs], dim=1)


def weighted_variation(depth: Tensor, frame: Frame) -> Tensor:
    """Average ``sqrt((w_x dx)^2 + (w_y dy)^2)``, ``w = exp(-|grad amplitude|)``, amplitude stretched to [0, 1]; metres."""
    amplitude = frame.phasor[:, :2].square().sum(1, keepdim=True).sqrt()
    least, most = amplitude.amin((2, 3), keepdim=True), amplitude.amax((2, 3), keepdim=True)
    smooth = F.interpolate(
        (amplitude - least) / (most - least).clamp_min(_FAINT),
        scale_factor=2,
        mode="bilinear",
        align_corners=False,
    )
    steps = [(_step(depth, axis) * torch.exp(-_step(smooth, axis).abs())).square() for axis in (-1, -2)]
    return (steps[0] + steps[1] + 1e-12).sqrt().mean()


def _step(image: Tensor, axis: int) -> Tensor:
    """Difference to the next pixel; zero at the border."""
    return torch.diff(image, dim=axis, append=image.narrow(axis, image.shape[axis] - 1, 1))


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.constant_(module.bias, 0.01)
