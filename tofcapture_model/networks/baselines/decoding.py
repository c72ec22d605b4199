"""Decoding of a frame whose phasors were changed, for baselines that filter or mix taps and leave the camera its arithmetic."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tofcapture_model.data.frame import Frame
from tofcapture_model.geometry.intrinsics import rays
from tofcapture_model.geometry.maps import metres_per_radian, turn


def decode(frame: Frame, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Decode a frame again with other phasors, differentiably: both frequencies, unwrapped and fused as the decoder does.

    Their turns move the ranges, so calibration stays that of the frame; the wrap is the one that leaves the smallest gap. Rounding
    has no gradient. Holes turn, but their wraps stay: no gap is known there.

    Parameters
    ----------
    frame
        Decoded from ``frame.phasor``.
    low, high
        (B, 2, H, W) phasors of the low and the high frequency.

    Returns
    -------
    depth
        (B, 1, H, W) metres, ``frame.depth`` where the phasors are the frame's.
    gap
        (B, 1, H, W) metres, range of the low minus range of the high frequency, within half a range of the high one but in holes.
    """
    low_metres, high_metres = metres_per_radian(frame, 0), metres_per_radian(frame, 1)
    low_range, high_range = 2 * math.pi * low_metres, 2 * math.pi * high_metres
    lean = high_metres.square() / (low_metres.square() + high_metres.square())  # f^2: inverse variance
    turned = turn(high, frame.phasor[:, 2:]) * high_metres
    gap = frame.gap + turn(low, frame.phasor[:, :2]) * low_metres - turned
    wraps = frame.valid * high_range * torch.round(gap / high_range)
    gap = gap - wraps
    length = rays(frame.intrinsics, *frame.depth.shape[-2:]).square().sum(1, keepdim=True).sqrt()
    # the decoder's ranges lie within that of the low frequency
    rounds = low_range * torch.floor((frame.depth * length + wraps) / low_range)
    moved = turned + wraps - frame.valid * rounds + lean * (gap - frame.gap)
    return frame.depth + moved / length, gap
