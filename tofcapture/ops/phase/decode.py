"""The float64 way from phasors to distance: the reference that the fast decoder is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.ops.phase.phasor import Complex128, Float64, ambiguity, frequencies, wrapped_range
from tofcapture.ops.phase.ranges import correct_range, range_to_radial
from tofcapture.ops.phase.unwrapping import Unwrapping, centred, fuse_likelihood, unwrap, unwrap_spatial
from tofcapture.rig import RangeError


@dataclass(frozen=True)
class Decoded:
    """What decoding yields, each (H, W).

    Attributes
    ----------
    radial
        float64, distance from the ToF camera along the ray, metres; NaN where it cannot be decoded.
    range_low, range_high
        float64, range of the lowest and of the highest frequency, metres: half the path from the illuminator over the
        surface to the camera, before fusion. The low one is wrapped at its own ambiguity, the high one is unwrapped.
    amplitude
        (F, H, W) float64 per frequency, raw units.
    confidence
        float64, raw units: amplitude of the highest frequency.
    saturated
        bool, at least one tap of at least one frame reached the saturation value.
    """

    radial: Float64
    range_low: Float64
    range_high: Float64
    amplitude: Float64
    confidence: Float64
    saturated: NDArray[np.bool_]


def decode(
    phasor: Complex128,
    modulation_hz: Sequence[float],
    camera: Camera,
    illuminator: NDArray[np.floating],
    range_errors: Sequence[RangeError] = (),
    celsius: float = 45.0,
    saturated: NDArray[np.bool_] | None = None,
    min_amplitude: float = 0.0,
    unwrapping: Unwrapping = "hierarchical",
    tap_sigma: float = 2.0,
    max_range: float = np.inf,
) -> Decoded:
    """Decode phasors of two frequencies to distance.

    Range errors are taken off per frequency, the high frequency is unwrapped by the low one, both are fused with
    weights proportional to f^2 (inverse variance at equal phase noise, method.md 4.3) and the path is turned into
    distance along the ray.

    Parameters
    ----------
    phasor
        (2, H, W), frequencies ascending.
    modulation_hz
        (K,) of the raw channels; gives the two frequencies.
    camera, illuminator
        Intrinsics, light source (3,) in metres.
    range_errors
        Calibration; frequencies without one are taken as they are.
    celsius
        Sensor temperature.
    saturated
        (H, W); those pixels become NaN.
    min_amplitude
        Pixels whose weaker amplitude is not above it become NaN; raw units.
    unwrapping
        ``hierarchical`` rounds, ``likelihood`` weighs both phasors by their amplitudes, ``spatial`` asks the neighbours
        where a pixel is too dark to be sure.
    tap_sigma
        Noise of a tap, raw units; for ``spatial``.
    max_range
        Nothing lies farther, metres; for ``likelihood``.

    Raises
    ------
    DataError
        When there are not exactly two frequencies or shapes disagree.
    """
    hz = frequencies(modulation_hz)
    if len(hz) != 2 or phasor.shape != (2, *camera.shape):
        raise DataError(
            f"decode: expected phasors (2, {camera.height}, {camera.width}), got {phasor.shape} for {hz}"
        )
    by_hz = {e.modulation_hz: e for e in range_errors}
    celsius = celsius if np.isfinite(celsius) else 45.0
    amplitude = np.abs(phasor)
    low, high = (
        correct_range(wrapped_range(z, f), by_hz.get(f, RangeError(f)), camera, celsius, A)
        for z, f, A in zip(phasor, hz, amplitude, strict=True)
    )
    R_low, R_high = ambiguity(hz[0]), ambiguity(hz[1])
    if unwrapping == "likelihood":
        high, fused = fuse_likelihood(low, high, amplitude, R_high, R_low, max_range)
    else:
        high = (
            unwrap(low, high, R_high, R_low)
            if unwrapping == "hierarchical"
            else unwrap_spatial(low, high, amplitude, R_high, R_low, tap_sigma)
        )
        # Where noise put the two on both sides of the wrap, the low one is the neighbour of the high one.
        weight = hz[0] ** 2 / (hz[0] ** 2 + hz[1] ** 2)
        gap = centred(low - high, R_low)
        if unwrapping == "spatial":
            gap = centred(gap, R_high)
        fused = np.mod(high + weight * gap, R_low)
    bad = ~(amplitude.min(axis=0) > min_amplitude)
    saturated = np.zeros(camera.shape, dtype=bool) if saturated is None else saturated
    radial = range_to_radial(fused, camera, illuminator)
    return Decoded(
        radial=np.where(bad | saturated, np.nan, radial),
        range_low=low,
        range_high=high,
        amplitude=amplitude,
        confidence=amplitude[1],
        saturated=saturated,
    )
