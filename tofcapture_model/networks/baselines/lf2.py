"""LF2 for two frequencies: the classical pipeline of libfreenect2's decoder, which Guo 2018 compares with; nothing is learned.

Joint bilateral filter of the phasors, unwrapping, rejection by residual, depth, edge filter. Calibration is that of the frame.
Low amplitudes, frequencies that disagree and edges are given up.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Frame
from tofcapture_model.geometry.maps import metres_per_radian, shifted
from tofcapture_model.networks.baselines import NEAREST, decode, fine_normals, upsample_depth

GAUSSIAN = (0.1070, 0.1131, 0.1070, 0.1131, 0.1196, 0.1131, 0.1070, 0.1131, 0.1070)
RANGE = 1.442695 * 5.0  # of the phase distance (1 - cos) / 2
_FAINT = 1e-3  # of saturation: below it a neighbour has no say
_ROUGH = 0.05  # standard deviation over mean of the amplitude, from which a pixel may be an edge
_BELOW, _ABOVE, _STEP = 0.050, 0.030, 0.100  # m: to the nearest, to the farthest neighbour, larger of both
_APART = 2.5  # sum of phase distances to the eight neighbours, from which a pixel is an edge
_COUNTS = 3 / _FAINT  # amplitude of 1 in raw units of Kinect v2, whose faintest is 3
_RESIDUAL = (20 * math.pi / 180, 35 * math.pi / 180)  # rad, tolerated at large and at small amplitudes
_SLOPE, _OFFSET = -0.5330578, 0.7694894 * math.log2(10)  # ln of the tolerated residual over ln of counts


def estimate(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Answer as LF2 does: depth (B, 1, 2H, 2W), metres, unit normals (B, 3, 2H, 2W), and what was measured, bool.

    Pixels that the filter gives up carry the decoded depth and are not measured.
    """
    (low, low_apart), (high, high_apart) = (bilateral(z) for z in frame.phasor.chunk(2, dim=1))
    depth, gap = decode(frame, low, high)
    depth = torch.where(frame.valid > 0, depth, frame.depth).clamp_min(NEAREST)
    faint, amplitude = (z.square().sum(1, keepdim=True).sqrt() for z in (low, high))
    dark = torch.minimum(faint, amplitude) < _FAINT
    edge = flying(depth, amplitude) | (torch.maximum(low_apart, high_apart) >= _APART)
    kept = (frame.valid > 0) & ~dark & ~edge & ~disagreeing(frame, gap, torch.maximum(faint, amplitude))
    depth = upsample_depth(depth)
    return depth, fine_normals(depth, frame), F.interpolate(kept.float(), scale_factor=2, mode="nearest") > 0


def disagreeing(frame: Frame, gap: Tensor, amplitude: Tensor) -> Tensor:
    """Mark phases further from those of any range than LF2 tolerates at this amplitude, the larger of the two: (B, 1, H, W) bool.

    The residual is the distance, radians, of the two unwrapped phases from the line along which they grow with the range.
    """
    residual = gap.abs() / torch.hypot(metres_per_radian(frame, 0), metres_per_radian(frame, 1))
    tolerated = torch.exp(_SLOPE * (_COUNTS * amplitude).clamp_min(1e-9).log() + _OFFSET)
    return residual > tolerated.clamp(*_RESIDUAL)


def bilateral(phasor: Tensor) -> tuple[Tensor, Tensor]:
    """Average 3 x 3 phasors (B, 2, H, W) by distance and agreement in phase; with the (B, 1, H, W) sum of phase distances."""
    amplitude = phasor.square().sum(1, keepdim=True).sqrt()
    direction = phasor / amplitude.clamp_min(1e-9)
    total, weights, distance = (torch.zeros_like(x) for x in (phasor, amplitude, amplitude))
    for k, share in enumerate(GAUSSIAN):
        dy, dx = k // 3 - 1, k % 3 - 1
        apart = (1 - (shifted(direction, dy, dx) * direction).sum(1, keepdim=True)) / 2
        heard = shifted(amplitude, dy, dx) >= _FAINT
        weight = share * torch.exp(-RANGE * apart) * heard
        distance = distance + apart * heard
        total, weights = total + weight * shifted(phasor, dy, dx), weights + weight
    return torch.where(weights > 0, total / weights.clamp_min(1e-9), phasor), distance


def flying(depth: Tensor, amplitude: Tensor) -> Tensor:
    """Mark rough amplitudes with a step in depth to both sides, (B, 1, H, W) bool: the edge filter of LF2."""
    around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    a = torch.cat([shifted(amplitude, *s) for s in around], dim=1)
    d = torch.cat([shifted(depth, *s) for s in around], dim=1)
    rough = a.std(1, correction=0, keepdim=True) >= _ROUGH * a.mean(1, keepdim=True).clamp_min(10 * _FAINT)
    below, above = depth - d.amin(1, keepdim=True), d.amax(1, keepdim=True) - depth
    return rough & (below > _BELOW) & (above > _ABOVE) & (torch.maximum(below, above) > _STEP)
