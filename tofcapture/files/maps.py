"""What a shard holds of one view, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.files.hdf import Array
from tofcapture.files.layout import TofFlag
from tofcapture.poses import Float64

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class GroundTruth:
    """Stereo ground truth on the ToF plane at one scale.

    Attributes
    ----------
    depth
        (sH, sW) float32, metres; NaN exactly where the mask says ``NOT_HIT``.
    normals
        (sH, sW, 3) float32, ToF frame, unit, facing the camera; NaN where depth is.
    mask
        (sH, sW) uint8, bits of :class:`tofcapture.files.layout.MaskBit`; 0 is good ground truth.
    """

    depth: Float32
    normals: Float32
    mask: NDArray[np.uint8]


@dataclass(frozen=True)
class TofMaps:
    """The sensor's own answer for a burst, averaged as I and Q.

    Attributes
    ----------
    depth
        (H, W) float32, metres; NaN: none.
    confidence
        (H, W) float32, amplitude of the highest frequency, raw units.
    flags
        (H, W) uint8, bits of :class:`tofcapture.frames.TofFlag`; 0 is a good pixel. An array of bool says which are saturated.
    """

    depth: Float32
    confidence: Float32
    flags: NDArray[np.uint8]

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """(H, W) bool, a tap of a frame reached saturation."""
        out: NDArray[np.bool_] = (self.flags & np.uint8(TofFlag.SATURATED)) != 0
        return out


@dataclass(frozen=True)
class ExactMaps:
    """What only a simulator knows, on the ToF plane at 2x: depth (2H, 2W), metres, and normals (2H, 2W, 3)."""

    depth: Float32
    normals: Float32


@dataclass(frozen=True)
class Sample:
    """One view of a shard: what :func:`tofcapture.dataset.sample.make_sample` makes and the writer stacks.

    Attributes
    ----------
    index
        Number of the view in its recording.
    raw
        (F, K, H, W) phase images as the sensor gave them.
    celsius, time_ns
        (F,).
    tof
        Decoded burst.
    native_depth
        (SH, SW) float32, cropped and denoised stereo depth, stereo frame; NaN: none.
    ground_truth
        By scale: 1 and 2, and 4 where it is wanted.
    T_base_tof
        (4, 4), from the measured joints.
    truth
        Only from a simulator.
    """

    index: int
    raw: Array
    celsius: Float64
    time_ns: NDArray[np.int64]
    tof: TofMaps
    native_depth: Float32
    ground_truth: Mapping[int, GroundTruth]
    T_base_tof: Float64
    truth: ExactMaps | None = None
