"""The three networks of the paper, and their compact siblings: inputs and heads.

Every head answers at twice the resolution. Depth starts as the decoded ToF depth, normals of ``compact`` as those of planes fitted to it; those of
the paper's network start towards the camera, and its refinement makes them those of the depth. So an untrained model that sees the decoded depth is the
sensor, and training can only be judged by what it adds.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.config import SOURCES, Network
from tofcapture_model.data.frame import Frame, expect_channels
from tofcapture_model.geometry.intrinsics import rays
from tofcapture_model.geometry.maps import (
    doubled_parts,
    local_planes,
    plane_normals,
    side_window_planes,
    unit,
)
from tofcapture_model.networks.unet import (
    CONVEX_CHANNELS,
    UNet,
    bilinear_logits,
    convex_upsample,
    double_conv,
    he_initialised,
)

CUE_SCALE = (1.0, 1.0, 0.01, 0.3)  # what one may expect of each cue: most lenses scatter about one percent
RESIDUAL_UNIT = 0.01  # m; a head's output of 1 moves the depth by a centimetre
MIDDLE, REACH = (
    0.8,
    0.4,
)  # m; where depth starts, and a head's unit, where the decoded depth is not to be seen
FIT_RADII = (1, 2)  # px of the sensor, of the planes that compact fits to its own depth
_HEAD_WIDTH = 24
_HOLE = 1e-3  # weight of a filled pixel
_PHASOR_FLOOR = 1e-4  # of saturation; below it an amplitude is noise


class Features(NamedTuple):
    """What the heads read.

    Attributes
    ----------
    image
        (B, C, H, W) for the convolutions, about unit scale.
    candidates
        (B, K, H, W) classically denoised or corrected depths, metres; K may be 0.
    normals
        (B, 3, H, W) normals to start from; unit.
    rays
        (B, 3, H, W) of the sensor's pixels, z = 1; a lens takes some time to invert.
    """

    image: Tensor
    candidates: Tensor
    normals: Tensor
    rays: Tensor


class PaperInputs(nn.Module):
    """Stack the paper's inputs: 8 raw channels, confidence, decoded depth; in that order, 10 channels in all."""

    def __init__(self, sources: tuple[str, ...]) -> None:
        super().__init__()
        self.sources = sources
        self.channels = sum(SOURCES[s] for s in sources)

    def forward(self, frame: Frame) -> Features:
        """Take the chosen sources of a frame as they are; normals start towards the camera."""
        if "raw" in self.sources:
            expect_channels(frame.raw, SOURCES["raw"], "paper")
        image = torch.cat([getattr(frame, s) for s in self.sources], dim=1)
        r = rays(frame.intrinsics, *frame.depth.shape[-2:])
        return Features(image, frame.depth[:, :0], -unit(r), r)


class CompactInputs(nn.Module):
    """Turn a frame into what physics says matters: phasors, amplitudes, the frequencies' gap, plane fits at some scales."""

    def __init__(self, windows: tuple[int, ...]) -> None:
        super().__init__()
        self.windows = windows
        self.channels = 12 + len(CUE_SCALE) + 4 * len(windows)
        self.register_buffer("cue_scale", torch.tensor(CUE_SCALE).reshape(1, -1, 1, 1), persistent=False)
        self.cue_scale: Tensor

    @torch.no_grad()
    def forward(self, frame: Frame) -> Features:
        """Compute features; nothing here is learned."""
        r = rays(frame.intrinsics, *frame.depth.shape[-2:])
        planes = [side_window_planes(frame.depth, frame.valid + _HOLE, w) for w in self.windows]
        smooth = [1 / c[:, :1].clamp_min(1e-2) for c, _ in planes]
        normals = [plane_normals(c, frame.intrinsics, r) for c, _ in planes]
        channels = [
            *_phasor_channels(frame.phasor),
            (frame.depth - MIDDLE) / REACH,
            (frame.gap * 10).clamp(-2, 2),  # 20 MHz is noisy by centimetres
            (frame.cues * self.cue_scale * 100).clamp(-2, 2),  # multipath costs up to some cm
            frame.valid,
            r[:, :2],
            *((s - frame.depth).mul(50).clamp(-2, 2) for s in smooth),  # noise is some mm
            *((var.sqrt() * 50).clamp(0, 2) for _, var in planes),
            *((n[:, :2]) for n in normals),
        ]
        corrected = frame.depth - frame.cues * self.cue_scale
        return Features(
            torch.cat(channels, 1), torch.cat([*smooth, corrected], 1), normals[len(normals) // 2], r
        )


def _phasor_channels(phasor: Tensor) -> list[Tensor]:
    """Direction and log amplitude of each frequency, and the log of their ratio: 2 x 3 + 1 channels."""
    out: list[Tensor] = []
    logs = []
    for z in phasor.chunk(2, dim=1):
        amplitude = z.square().sum(1, keepdim=True).sqrt()
        out.append(z / (amplitude + _PHASOR_FLOOR))
        logs.append((amplitude + _PHASOR_FLOOR).log() / 3 + 1)
    return [*out, *logs, (logs[1] - logs[0]) * 3]


def _zeroed(inputs: int, outputs: int) -> nn.Conv2d:
    conv = nn.Conv2d(inputs, outputs, 1)
    nn.init.zeros_(conv.weight)
    nn.init.zeros_(conv.bias) if conv.bias is not None else None
    return conv


def _head(network: Network, channels: int, outputs: int) -> nn.Module:
    """Build a U-Net of its own for the paper, a 1 x 1 convolution on the shared backbone for compact."""
    if network.kind == "paper":
        return UNet(channels, outputs, network.width, network.levels, zero_last=True)
    return _zeroed(channels, outputs)


def sees_decoded(network: Network) -> bool:
    """Whether a network may use the decoded depth: only then is its answer a correction of it (paper, table IV: Conf., Raw)."""
    return network.kind != "paper" or "depth" in network.inputs


def _planes(image: Tensor) -> Tensor:
    """Single precision, a plane for each channel: what takes channels apart is slow where they lie side by side, as convolutions leave them."""
    return image.to(torch.float32, memory_format=torch.contiguous_format)


class Raw2Depth(nn.Module):
    """Decoded depth + gated steps to its candidates + residual, then convex upsampling; without it, depth about ``MIDDLE``."""

    def __init__(self, network: Network, channels: int) -> None:
        super().__init__()
        self.candidates = len(network.windows) + len(CUE_SCALE) if network.kind == "compact" else 0
        self.max_residual, self.learned = network.max_residual, network.learned_upsampling
        self.decoded = sees_decoded(network)
        self.net = _head(network, channels, self.candidates + 1 + CONVEX_CHANNELS)
        self.register_buffer("bilinear", bilinear_logits().reshape(1, -1, 1, 1), persistent=False)
        self.bilinear: Tensor

    def forward(self, shared: Tensor, features: Features, frame: Frame) -> Tensor:
        """Return depth (B, 1, 2H, 2W), metres."""
        out = _planes(self.net(shared))
        gates, residual, logits = torch.split(out, [self.candidates, 1, CONVEX_CHANNELS], dim=1)
        steps = (gates * (features.candidates - frame.depth)).sum(1, keepdim=True)
        start = frame.depth if self.decoded else torch.full_like(frame.depth, MIDDLE)
        unit_of = RESIDUAL_UNIT if self.decoded else REACH
        depth = start + steps + self._bounded(residual * unit_of)
        learned = logits if self.learned else torch.zeros_like(logits)
        return convex_upsample(depth.clamp_min(0.05), learned + self.bilinear)

    def _bounded(self, residual: Tensor) -> Tensor:
        limit = self.max_residual
        return limit * torch.tanh(residual / limit) if limit else residual


class ErrorMap(nn.Module):
    """Expected absolute error of the depth. Reads the depth detached: the error must not shape the depth."""

    def __init__(self, network: Network, channels: int) -> None:
        super().__init__()
        self.net = _head(network, channels + 4, 4)
        self.decoded = sees_decoded(network)
        self.register_buffer("calibration", torch.ones(()))  # set after training, see evaluate.calibrate
        self.calibration: Tensor

    def forward(self, shared: Tensor, depth: Tensor, frame: Frame) -> Tensor:
        """Return (B, 1, 2H, 2W), metres, positive."""
        fine = F.pixel_unshuffle(depth.detach(), 2)
        seen = (fine - frame.depth) * 20 if self.decoded else (fine - MIDDLE) / REACH
        out = self.net(torch.cat([shared, seen.clamp(-2, 2)], dim=1)).float()
        return F.softplus(F.pixel_shuffle(out, 2)) * (RESIDUAL_UNIT * self.calibration)


class Raw2Normal(nn.Module):
    """Residual on the starting normals, by sub-pixel convolution.

    ``compact`` also fits planes to its own depth, in windows of 3 and of 5 pixels, and steps towards their normals by learned
    gates: depth is denoised first, and normals follow from it where noise let them (depth to normal, as in the paper's IV-C).
    """

    def __init__(self, network: Network, channels: int) -> None:
        super().__init__()
        self.fits = FIT_RADII if network.kind == "compact" else ()
        self.net = (
            _two_layers(channels + 3 * (len(self.fits) + 1), 12 + 4 * len(self.fits))
            if self.fits
            else _head(network, channels, 12)
        )

    def forward(self, shared: Tensor, features: Features, depth: Tensor, frame: Frame) -> Tensor:
        """Return unit camera-facing normals (B, 3, 2H, 2W) of a depth (B, 1, 2H, 2W)."""
        if not self.fits:
            return unit(doubled(features.normals) + F.pixel_shuffle(self.net(shared).float(), 2))
        fitted = self._fitted(depth, frame, features.rays)
        out = _planes(self.net(torch.cat([shared, features.normals, *fitted], dim=1)))
        # sub-pixels side by side until the end: interpolating and interleaving each term costs more than the convolutions
        parts = torch.unflatten(out, 1, (-1, 4))
        normals = doubled_parts(features.normals) + parts[:, :3]
        for k, n in enumerate(fitted, 3):
            normals = torch.addcmul(normals, parts[:, k : k + 1], doubled_parts(n - features.normals))
        return F.pixel_shuffle(unit(normals).flatten(1, 2), 2)

    def _fitted(self, depth: Tensor, frame: Frame, directions: Tensor) -> list[Tensor]:
        coarse = F.avg_pool2d(depth, 2)
        weight = frame.valid + _HOLE
        return [
            plane_normals(local_planes(coarse, weight, radius)[0], frame.intrinsics, directions)
            for radius in self.fits
        ]


def doubled(image: Tensor) -> Tensor:
    """Bilinear x2."""
    return F.interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)


def _two_layers(inputs: int, outputs: int) -> nn.Module:
    """Build two 3 x 3 convolutions and a last one that starts at zero."""
    net = nn.Sequential(*double_conv(inputs, _HEAD_WIDTH), _zeroed(_HEAD_WIDTH, outputs))
    net[:-1].apply(he_initialised)
    return net
