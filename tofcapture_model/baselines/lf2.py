"""LF2 for two frequencies: the classical pipeline of libfreenect2's decoder, which Guo 2018 compares with; nothing is learned.

Joint bilateral filter of the phasors, decoding, edge filter. Unwrapping and calibration are those of the frame: the filtered phasor
turns the decoded range by its change of phase, low amplitudes and edges that fly are given up.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.baselines.protocol import NEAREST, NORMAL_RADIUS
from tofcapture_model.baselines.sensor import upsample_depth
from tofcapture_model.frame import Frame
from tofcapture_model.geometry import depth_to_normals, scale_intrinsics, shifted, turned_depth

GAUSSIAN = (0.1070, 0.1131, 0.1070, 0.1131, 0.1196, 0.1131, 0.1070, 0.1131, 0.1070)
RANGE = 1.442695 * 5.0  # of the phase distance (1 - cos) / 2
_FAINT = 1e-3  # of saturation: below it a neighbour has no say
_ROUGH = 0.05  # standard deviation over mean of the amplitude, from which a pixel may be an edge
_BELOW, _ABOVE, _STEP = 0.050, 0.030, 0.100  # m: to the nearest, to the farthest neighbour, and both together


def estimate(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Answer as LF2 does.

    Returns
    -------
    depth
        (B, 1, 2H, 2W) metres; pixels that the filter gives up carry the decoded depth and are not measured.
    normals
        (B, 3, 2H, 2W) unit.
    measured
        (B, 1, 2H, 2W) bool.
    """
    low, high = (bilateral(z) for z in frame.phasor.chunk(2, dim=1))
    depth = turned_depth(frame, high).clamp_min(NEAREST)
    amplitude = high.square().sum(1, keepdim=True).sqrt()
    dark = (amplitude < _FAINT) | (low.square().sum(1, keepdim=True).sqrt() < _FAINT)
    kept = (frame.valid > 0) & ~dark & ~flying(depth, amplitude)
    depth = upsample_depth(depth)
    normals = depth_to_normals(
        depth, torch.ones_like(depth), scale_intrinsics(frame.intrinsics, 2), NORMAL_RADIUS
    )
    return depth, normals, F.interpolate(kept.float(), scale_factor=2, mode="nearest") > 0


def bilateral(phasor: Tensor) -> Tensor:
    """Mean of the 3 x 3 phasors (B, 2, H, W), weighted by distance and by agreement in phase."""
    amplitude = phasor.square().sum(1, keepdim=True).sqrt()
    direction = phasor / amplitude.clamp_min(1e-9)
    total, weights = torch.zeros_like(phasor), torch.zeros_like(amplitude)
    for k, share in enumerate(GAUSSIAN):
        dy, dx = k // 3 - 1, k % 3 - 1
        apart = (1 - (shifted(direction, dy, dx) * direction).sum(1, keepdim=True)) / 2
        weight = share * torch.exp(-RANGE * apart) * (shifted(amplitude, dy, dx) >= _FAINT)
        total, weights = total + weight * shifted(phasor, dy, dx), weights + weight
    return torch.where(weights > 0, total / weights.clamp_min(1e-9), phasor)


def flying(depth: Tensor, amplitude: Tensor) -> Tensor:
    """(B, 1, H, W) bool: rough amplitude and a step in depth to both sides, the edge filter of LF2."""
    around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    a = torch.cat([shifted(amplitude, *s) for s in around], dim=1)
    d = torch.cat([shifted(depth, *s) for s in around], dim=1)
    rough = a.std(1, keepdim=True) >= _ROUGH * a.mean(1, keepdim=True).clamp_min(10 * _FAINT)
    below, above = depth - d.amin(1, keepdim=True), d.amax(1, keepdim=True) - depth
    return rough & (below > _BELOW) & (above > _ABOVE) & (below + above > _STEP)
