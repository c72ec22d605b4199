"""MRM of FLAT: Guo, Frosio, Gallo, Zickler, Kautz, "Tackling 3D ToF Artifacts Through Learning and the FLAT Dataset", ECCV 2018.

A kernel-predicting network mixes the raw channels of every pixel into corrected ones, which the camera's own arithmetic
decodes, differentiably, as the loss is on the depth. Its flow module (MOM) is for moving scenes and is left out.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Estimate, Frame, Target, eight_taps
from tofcapture_model.losses import masked_mean
from tofcapture_model.networks.baselines import Baseline, decode
from tofcapture_model.networks.unet import pad_to_multiple

_SLOPE = 0.1

ENCODER = ((7, 64), (5, 64), (5, 64), (5, 128), (3, 128), (3, 128), (3, 256), (3, 256), (3, 256), (3, 512))
"""Kernel and channels of the ten convolutions; every third halves the resolution after the first of its level."""
_POOLED = (0, 3, 6, 9)
_UP = (
    (3, 256, 9), (3, 256, 8), (3, 256, 7), (3, 128, 6), (3, 128, 5),
    (3, 128, 4), (5, 64, 3), (5, 64, 2), (5, 64, 1), (7, 64, 0),
)  # fmt: skip
_SKIP = {9: 8, 6: 5, 3: 2}


class MRM(Baseline):
    """Multi-reflection module; 11,018,648 parameters for eight raw channels."""

    def __init__(self, channels: int = 8) -> None:
        super().__init__()
        self.channels = channels
        inputs = [channels, *(c for _, c in ENCODER)]
        self.encoder = nn.ModuleList(
            nn.Conv2d(a, b, k, padding=k // 2) for a, (k, b) in zip(inputs, ENCODER, strict=False)
        )
        self.decoder, self.skips = nn.ModuleList(), nn.ModuleDict()
        width = ENCODER[-1][1]
        for k, out, level in _UP:
            double = level in _POOLED
            self.decoder.append(
                nn.ConvTranspose2d(width, out, k, 2 if double else 1, k // 2, output_padding=int(double))
            )
            width = out
            if level in _SKIP:
                self.skips[str(level)] = nn.Conv2d(2 * out, 2 * out, 3, padding=1)
                width = 2 * out
        kernel = channels * (channels + 1)  # a matrix and biases, which the release predicts and does not add
        self.head = nn.ModuleList(nn.Conv2d(a, kernel, 3, padding=1) for a in (width, kernel, kernel))
        self.apply(_initialise)
        nn.init.zeros_(self.head[-1].weight)  # type: ignore[arg-type]

    def estimate_depth(self, frame: Frame) -> Tensor:
        """Decode the mixed channels, relative to the frame's own decoding: calibration stays the camera's."""
        raw, demodulation = eight_taps(frame)
        kernels = self.kernels(raw).float()
        with torch.autocast(raw.device.type, enabled=False):
            mixed = torch.einsum("bcihw,bchw->bihw", kernels, raw)
            low, high = torch.einsum("bpc,bchw->bphw", demodulation, mixed).chunk(2, dim=1)
        return decode(frame, low, high)[0]

    def kernels(self, raw: Tensor) -> Tensor:
        """Predict mixing matrices (B, C, C, H, W) about the identity: an untrained network changes nothing."""
        h, w = raw.shape[-2:]
        x, (top, left) = pad_to_multiple(raw, 16)
        skips: list[Tensor] = []
        for i, conv in enumerate(self.encoder):
            x = F.leaky_relu(conv(x), _SLOPE)
            skips.append(x)
            x = F.max_pool2d(x, 2) if i in _POOLED[:-1] else x
        x = F.max_pool2d(x, 2)
        for conv, (_, _, level) in zip(self.decoder, _UP, strict=True):
            x = F.leaky_relu(conv(x), _SLOPE)
            if level in _SKIP:
                both = torch.cat([x, skips[_SKIP[level]]], dim=1)
                x = F.leaky_relu(self.skips[str(level)](both), _SLOPE)
        for conv in self.head[:-1]:
            x = F.leaky_relu(conv(x), _SLOPE)
        c = self.channels
        x = self.head[-1](x)[:, : c * c, top : top + h, left : left + w]
        mix = x.unflatten(1, (c, c)).float()  # an export must not know the batch
        return mix + torch.eye(c, device=x.device).reshape(1, c, c, 1, 1)  # type: ignore[no-any-return]

    def loss(self, estimate: Estimate, target: Target, frame: Frame) -> Tensor:
        """Compute the root mean square error over the mask, metres."""
        del frame
        return (masked_mean((estimate.depth - target.depth).square(), target.good) + 1e-12).sqrt()


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
