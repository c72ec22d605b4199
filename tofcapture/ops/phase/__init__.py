"""ToF phase: from taps to phasors to range, and back.

``C_k = B + A cos(phi + theta_k)``; with theta = 0, 90, 180, 270 deg, ``phi = atan2(C3 - C1, C0 - C2)``. A phasor is the
complex number ``A exp(i phi)``. Bursts are averaged as phasors, never as phases or depths.

:func:`decode` is the float64 reference, :class:`Decoder` the same in float32 at more than a thousand frames a second.
"""

from tofcapture.ops.phase.decode import Decoded, decode
from tofcapture.ops.phase.decoder import Decoder, DepthMaps, Signals
from tofcapture.ops.phase.flying import flying_pixels
from tofcapture.ops.phase.noise import TapNoise, photon_transfer
from tofcapture.ops.phase.phasor import (
    Complex128,
    Float64,
    ambiguity,
    frequencies,
    mean_phasors,
    phasors,
    taps,
    wrapped_range,
)
from tofcapture.ops.phase.ranges import correct_range, radial_to_range, radius_px, range_to_radial
from tofcapture.ops.phase.unwrapping import Unwrapping, fuse_likelihood, unwrap, unwrap_spatial

__all__ = [
    "Complex128",
    "Decoded",
    "Decoder",
    "DepthMaps",
    "Float64",
    "Signals",
    "TapNoise",
    "Unwrapping",
    "ambiguity",
    "correct_range",
    "decode",
    "flying_pixels",
    "frequencies",
    "fuse_likelihood",
    "mean_phasors",
    "phasors",
    "photon_transfer",
    "radial_to_range",
    "radius_px",
    "range_to_radial",
    "taps",
    "unwrap",
    "unwrap_spatial",
    "wrapped_range",
]
