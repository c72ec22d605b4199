"""Define what a network reads, what it is held against, and what it answers: batches of frames, targets and estimates."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# m; a decoded depth beyond them is an unwrapping failure on this rig and counts as a hole
MIN_RANGE, MAX_RANGE = 0.05, 5.0


_EIGHT = 8
# of B + A cos(phi + k pi / 2), k = 0 to 3
_QUARTERS = torch.tensor([[0.5, 0.0, -0.5, 0.0], [0.0, -0.5, 0.0, 0.5]])


class Frame(NamedTuple):
    """One ToF frame per batch item, float32."""

    raw: Tensor  #: (B, K, H, W) raw channels in units of the sensor's saturation value
    #: (B, 4, H, W) I and Q of the lowest, then of the highest frequency, in the same unit; one frequency is there twice
    phasor: Tensor
    depth: Tensor  #: (B, 1, H, W) decoded depth (z), m; holes carry their nearest measured neighbour
    valid: Tensor  #: (B, 1, H, W) 1 where depth was measured, 0 where it was filled
    confidence: Tensor  #: (B, 1, H, W) amplitude of the highest frequency in units of the saturation value
    gap: (
        Tensor  #: (B, 1, H, W) range of the lowest minus range of the highest frequency, m: the multipath cue
    )
    cues: Tensor  #: (B, 5, H, W) depth errors and a gap that physics expects, m: geometry.multipath
    #: (B, F) lowest, highest, then other modulation frequencies, Hz; one frequency is there twice
    modulation: Tensor
    intrinsics: Tensor  #: (B, 4 or 12) of the (H, W) grid, px; see geometry.maps
    demodulation: Tensor  #: (B, 2F, K) weights that turn taps into I and Q of each of these frequencies
    #: (B, 2) amplitude of the lowest and the highest frequency, in units of the saturation value, by which a white surface would
    #: answer that faces the sensor at 1 m: estimated over the whole frame. Lamp, gain and contrast are in it, and in nothing else
    light: Tensor
    noise: Tensor  #: (B, 5) data.augment.BurstNoise, where noise is drawn anew; else 0


NO_MAPS = frozenset({"modulation", "intrinsics", "demodulation", "light", "noise"})
"""Fields of a frame that have no pixels: neither cropped nor mirrored."""


class Target(NamedTuple):
    """Ground truth at twice the resolution."""

    depth: Tensor  #: (B, 1, 2H, 2W) float32 m; finite everywhere, meaningless outside good and context
    normals: Tensor  #: (B, 3, 2H, 2W) float32, unit, facing the camera
    good: Tensor  #: (B, 1, 2H, 2W) bool: no mask bit is set; what metrics are taken over
    context: Tensor  #: (B, 1, 2H, 2W) bool: measured surface outside the object crop; never evaluated


class Estimate(NamedTuple):
    """Hold what a model answers, float32 at twice the resolution, after and before refinement."""

    depth: Tensor  #: (B, 1, 2H, 2W) m
    normals: Tensor  #: (B, 3, 2H, 2W) unit, facing the camera
    #: (B, 1, 2H, 2W) m, positive: the expected absolute error of the depth (losses.uncertainty = l1, paper), or one sigma,
    #: within which 68 % of the errors should be (laplace, compact)
    error: Tensor
    initial_depth: Tensor
    initial_normals: Tensor
    #: (B, 1, H, W) of the sensor's pixels: 1 where all that was read is like what was learned from, 0 where the sensor's depth stands
    #: instead; None: the network does not know
    trust: Tensor | None = None


def eight_taps(frame: Frame) -> tuple[Tensor, Tensor]:
    """Give any camera the raw channels of the paper's: four phases, a quarter apart, of the lowest and of the highest frequency.

    Returns taps (B, 8, H, W) and the weights (B, 4, 8) that turn them into I and Q of both frequencies. Eight channels are what the camera
    has; fewer or more are replaced by those that its phasors and the mean of its taps would have made.
    """
    if frame.raw.shape[1] == _EIGHT:
        return frame.raw, frame.demodulation[:, :4]
    offset = frame.raw.mean(1, keepdim=True)
    weights = torch.kron(torch.eye(2), _QUARTERS).to(frame.raw)
    taps = offset + 2 * torch.einsum("pk,bphw->bkhw", weights, frame.phasor)
    return taps, weights.expand(len(frame.raw), -1, -1)


def frame_to(frame: Frame, device: torch.device) -> Frame:
    """Move a frame to a device."""
    return Frame(*(x.to(device) for x in frame))


def target_to(target: Target, device: torch.device) -> Target:
    """Move a target to a device."""
    return Target(*(x.to(device) for x in target))
