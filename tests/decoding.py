"""The float64 way from phasors to distance: the oracle that the decoder is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.ops.phase.decoder import centred, unwrap, unwrap_spatial
from tofcapture.ops.phase.phasors import Complex128, Float64, ambiguity, frequencies, wrapped_range
from tofcapture.rig import RangeError, image_places, radius_px

_STEPS, _SETTLED = 20, 1e-8  # of the fixed point, m


@dataclass(frozen=True)
class Decoded:
    """What decoding yields, float64; ranges are half the path from the illuminator over the surface to the camera."""

    radial: Float64  #: (H, W) distance along the ray, metres; NaN where it cannot be decoded.
    range_low: Float64  #: (H, W) by the low frequency alone, metres, wrapped at its own ambiguity.
    range_high: Float64  #: (H, W) by the high frequency alone, metres, unwrapped.
    amplitude: Float64  #: (2, H, W), raw units; that of the high frequency is the confidence.


def decode(
    phasor: Complex128, modulation_hz: Sequence[float], camera: Camera, illuminator: NDArray[np.floating],
    range_errors: Sequence[RangeError] = (), celsius: float = 45.0, saturated: NDArray[np.bool_] | None = None,
    tap_sigma: float | None = None,
) -> Decoded:  # fmt: skip
    """Decode phasors (2, H, W); with the noise of a tap, neighbours decide the wrap where a pixel is too dark."""
    hz = frequencies(modulation_hz)
    by_hz = {e.modulation_hz: e for e in range_errors}
    celsius = celsius if np.isfinite(celsius) else 45.0
    amplitude = np.abs(phasor)
    low, high = (
        correct_range(wrapped_range(z, f), by_hz.get(f, RangeError(f)), camera, celsius, A)
        for z, f, A in zip(phasor, hz, amplitude, strict=True)
    )
    R_low, R_high = ambiguity(hz[0]), ambiguity(hz[1])
    # Where noise put the two on both sides of the wrap, the low one is the neighbour of the high one.
    if tap_sigma is None:
        high = unwrap(low, high, R_high, R_low)
        gap = centred(low - high, R_low)
    else:
        high = unwrap_spatial(low, high, amplitude, R_high, R_low, tap_sigma)
        gap = centred(centred(low - high, R_low), R_high)
    fused = np.mod(high + hz[0] ** 2 / (hz[0] ** 2 + hz[1] ** 2) * gap, R_low)
    bad = ~(amplitude.min(axis=0) > 0)
    bad |= False if saturated is None else saturated
    radial = np.where(bad, np.nan, range_to_radial(fused, camera, illuminator))
    return Decoded(radial, low, high, amplitude)


def correct_range(
    range_: Float64, error: RangeError, camera: Camera, celsius: float, amplitude: Float64 | None = None
) -> Float64:
    """Take the systematic error of one frequency off its wrapped range and wrap again, metres.

    The error is a function of the true phase: a fixed point, iterated until it moves less than 0.01 micrometres.
    """
    R = ambiguity(error.modulation_hz)
    radius, place = radius_px(camera), image_places(camera)
    true = range_
    for _ in range(_STEPS):
        before, true = true, range_ - error.at(true * 2 * np.pi / R, radius, celsius, place, amplitude)
        if not (np.abs(true - before) > _SETTLED).any():
            break
    return np.mod(true, R)


def range_to_radial(
    range_: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Turn half the path illuminator - surface - camera (..., H, W) into distance along the ray, metres.

    The surface point lies on the ellipsoid with foci camera and illuminator:
    ``radial = (4 D^2 - |s|^2) / (2 (2 D - u . s))``, exact for any illuminator position s and unit ray u.
    """
    s = np.asarray(illuminator, dtype=np.float64)
    u = camera.rays / camera.ray_lengths[..., None]
    path = 2 * np.asarray(range_, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = (path**2 - s @ s) / (2 * (path - u @ s))
    out: Float64 = np.where(path > np.linalg.norm(s), radial, np.nan)
    return out
