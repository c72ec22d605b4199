"""ToF phase: from taps to phasors to range, and back.

``C_k = B + A cos(phi + theta_k)``; with theta = 0, 90, 180, 270 deg, ``phi = atan2(C3 - C1, C0 - C2)``. A phasor is the
complex number ``A exp(i phi)``. Bursts are averaged as phasors, never as phases or depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.rig import SPEED_OF_LIGHT, RangeError

Float64 = NDArray[np.float64]
Complex128 = NDArray[np.complex128]


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


def frequencies(modulation_hz: Sequence[float]) -> tuple[float, ...]:
    """Distinct modulation frequencies, ascending."""
    return tuple(sorted({float(f) for f in modulation_hz}))


def ambiguity(modulation_hz: float) -> float:
    """Unambiguous range ``c / 2f`` in metres: 7.49481145 at 20 MHz, 1.49896229 at 100 MHz."""
    return SPEED_OF_LIGHT / (2 * modulation_hz)


def phasors(raw: NDArray[Any], modulation_hz: Sequence[float], phase_rad: Sequence[float]) -> Complex128:
    """Least-squares phasor of each frequency.

    Parameters
    ----------
    raw
        (..., K, H, W) taps, any real dtype, in any order of channels.
    modulation_hz, phase_rad
        (K,) frequency and demodulation phase of each channel; per frequency the phases must be spread evenly.

    Returns
    -------
    (..., F, H, W) complex128, ``A exp(i phi)``, frequencies ascending.

    Raises
    ------
    DataError
        When channels and descriptions disagree, or the phases of a frequency do not determine a phasor.
    """
    f = np.asarray(modulation_hz, dtype=np.float64)
    theta = np.asarray(phase_rad, dtype=np.float64)
    if raw.shape[-3] != len(f) or len(f) != len(theta):
        raise DataError(f"raw: expected {len(f)} channels for {len(theta)} phases, got shape {raw.shape}")
    out = []
    for hz in frequencies(modulation_hz):
        k = np.flatnonzero(f == hz)
        # Solve [B, A cos phi, -A sin phi] from the taps: exact for any >= 3 distinct phases.
        design = np.stack([np.ones(len(k)), np.cos(theta[k]), np.sin(theta[k])], axis=1)
        if len(k) < 3 or np.linalg.cond(design) > 1e3:
            raise DataError(
                f"{hz / 1e6:g} MHz: the phases {np.degrees(theta[k]).tolist()} deg do not determine a phasor"
            )
        solve = np.linalg.pinv(design)
        taps = np.moveaxis(raw[..., k, :, :], -3, -1).astype(np.float64)
        out.append(taps @ (solve[1] - 1j * solve[2]))
    return np.stack(out, axis=-3)


def mean_phasors(raw: NDArray[Any], modulation_hz: Sequence[float], phase_rad: Sequence[float]) -> Complex128:
    """Phasors (F, H, W) of a burst (frames, K, H, W), averaged over the frames as I and Q."""
    return phasors(raw.mean(axis=0, dtype=np.float64), modulation_hz, phase_rad)


def taps(
    phasor: Complex128, offset: Float64, modulation_hz: Sequence[float], phase_rad: Sequence[float]
) -> Float64:
    """Noise-free taps of phasors; the inverse of :func:`phasors`.

    Parameters
    ----------
    phasor
        (F, H, W), frequencies ascending.
    offset
        (F, H, W), the tap's mean B.
    modulation_hz, phase_rad
        (K,).

    Returns
    -------
    (K, H, W) float64
    """
    index = {hz: i for i, hz in enumerate(frequencies(modulation_hz))}
    out = [
        offset[index[float(hz)]] + (phasor[index[float(hz)]] * np.exp(1j * theta)).real
        for hz, theta in zip(modulation_hz, phase_rad, strict=True)
    ]
    return np.stack(out)


def wrapped_range(phasor: Complex128, modulation_hz: float) -> Float64:
    """Range in [0, c / 2f) of a phasor, metres."""
    out: Float64 = np.mod(np.angle(phasor), 2 * np.pi) * SPEED_OF_LIGHT / (4 * np.pi * modulation_hz)
    return out


def unwrap(range_low: Float64, range_high: Float64, ambiguity_high: float, ambiguity_low: float) -> Float64:
    """Unwrap the high frequency by the low one.

    ``k = round((r_low - r_high) / R_high) mod (R_low / R_high)``, method.md 4.3: for 20 and 100 MHz k is in 0..4. It fails
    only where the two disagree by more than half of R_high (0.75 m).

    Parameters
    ----------
    range_low, range_high
        Wrapped ranges, metres, same shape.
    ambiguity_high, ambiguity_low
        Unambiguous ranges; the low one must be a whole multiple of the high one.

    Returns
    -------
    Unwrapped range of the high frequency in [0, R_low), metres.
    """
    ratio = round(ambiguity_low / ambiguity_high)
    if abs(ambiguity_low / ambiguity_high - ratio) > 1e-9:
        raise DataError(f"unwrap: expected a whole frequency ratio, got {ambiguity_low / ambiguity_high:.6f}")
    k = np.mod(np.round((range_low - range_high) / ambiguity_high), ratio)
    return range_high + k * ambiguity_high


def range_to_radial(
    range_: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Distance along the ray from half the path illuminator - surface - camera.

    The surface point lies on the ellipsoid with foci camera and illuminator:
    ``radial = (4 D^2 - |s|^2) / (2 (2 D - u . s))``, exact for any illuminator position s and unit ray u.

    Parameters
    ----------
    range_
        (..., H, W), metres.
    camera
        Intrinsics.
    illuminator
        (3,) in the ToF frame, metres.
    """
    s = np.asarray(illuminator, dtype=np.float64)
    u = camera.rays / camera.ray_lengths[..., None]
    path = 2 * np.asarray(range_, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = (path**2 - s @ s) / (2 * (path - u @ s))
    out: Float64 = np.where(path > np.linalg.norm(s), radial, np.nan)
    return out


def radial_to_range(
    radial: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Half the path illuminator - surface - camera, of a distance along the ray; inverse of :func:`range_to_radial`."""
    u = camera.rays / camera.ray_lengths[..., None]
    points = np.asarray(radial, dtype=np.float64)[..., None] * u
    out: Float64 = (
        np.asarray(radial, dtype=np.float64) + np.linalg.norm(points - np.asarray(illuminator), axis=-1)
    ) / 2
    return out


def radius_px(camera: Camera) -> Float64:
    """(H, W) distance of each pixel to the principal point, pixels."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    out: Float64 = np.hypot(u - camera.cx, v - camera.cy)
    return out


def correct_range(range_: Float64, error: RangeError, camera: Camera, celsius: float) -> Float64:
    """Take the systematic error of one frequency off its wrapped range and wrap again.

    The error is a function of the true phase; two fixed-point steps from the measured one leave a residual below 1 % of
    the wiggle for slopes below 10 %.
    """
    R = ambiguity(error.modulation_hz)
    radius = radius_px(camera)
    true = range_
    for _ in range(3):
        true = range_ - error.at(true * 2 * np.pi / R, radius, celsius)
    return np.mod(true, R)


def decode(
    phasor: Complex128,
    modulation_hz: Sequence[float],
    camera: Camera,
    illuminator: NDArray[np.floating],
    range_errors: Sequence[RangeError] = (),
    celsius: float = 45.0,
    saturated: NDArray[np.bool_] | None = None,
    min_amplitude: float = 0.0,
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
    low, high = (
        correct_range(wrapped_range(z, f), by_hz.get(f, RangeError(f)), camera, celsius)
        for z, f in zip(phasor, hz, strict=True)
    )
    R_low, R_high = ambiguity(hz[0]), ambiguity(hz[1])
    high = unwrap(low, high, R_high, R_low)
    # Where noise put the two on both sides of the wrap, the low one is the neighbour of the high one.
    gap = np.mod(low - high + R_low / 2, R_low) - R_low / 2
    weight = hz[0] ** 2 / (hz[0] ** 2 + hz[1] ** 2)
    fused = np.mod(high + weight * gap, R_low)
    amplitude = np.abs(phasor)
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
