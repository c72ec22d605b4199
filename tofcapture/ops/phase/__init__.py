"""ToF phase: from taps to phasors to range, and back.

``C_k = B + A cos(phi + theta_k)``; with theta = 0, 90, 180, 270 deg, ``phi = atan2(C3 - C1, C0 - C2)``. A phasor is the
complex number ``A exp(i phi)``. Bursts are averaged as phasors, never as phases or depths.

:class:`Decoder` turns taps into depth at more than a thousand frames a second.
"""

from tofcapture.channels import TapNoise, ambiguity, frequencies
from tofcapture.ops.phase.decoder import Decoder, DepthMaps, Signals, flying_pixels
from tofcapture.ops.phase.noise import photon_transfer
from tofcapture.ops.phase.phasors import (
    Complex128,
    Float64,
    information,
    mean_phasors,
    phasors,
    radial_to_range,
    taps,
    wrapped_range,
)
from tofcapture.rig import radius_px

__all__ = [
    "Complex128",
    "Decoder",
    "DepthMaps",
    "Float64",
    "Signals",
    "TapNoise",
    "ambiguity",
    "flying_pixels",
    "frequencies",
    "information",
    "mean_phasors",
    "phasors",
    "photon_transfer",
    "radial_to_range",
    "radius_px",
    "taps",
    "wrapped_range",
]
