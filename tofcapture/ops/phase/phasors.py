"""Phasors of taps and taps of phasors: ``C_k = B + A cos(phi + theta_k)``, a phasor is ``A exp(i phi)``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.rig import SPEED_OF_LIGHT

Float64 = NDArray[np.float64]
Complex128 = NDArray[np.complex128]


def frequencies(modulation_hz: Sequence[float]) -> tuple[float, ...]:
    """Sort the distinct modulation frequencies, ascending."""
    return tuple(sorted({float(f) for f in modulation_hz}))


def ambiguity(modulation_hz: float) -> float:
    """Compute the unambiguous range ``c / 2f``, metres: 7.49481145 at 20 MHz, 1.49896229 at 100 MHz."""
    return SPEED_OF_LIGHT / (2 * modulation_hz)


def solution(
    modulation_hz: Sequence[float], phase_rad: Sequence[float], hz: float
) -> tuple[NDArray[np.int64], Float64]:
    """Solve for the channels (n,) of one frequency, and their least-squares weights (3, n).

    The weights times those taps give ``B``, ``A cos phi`` and ``-A sin phi``; :class:`DataError` when the phases do not
    determine a phasor.
    """
    theta = np.asarray(phase_rad, dtype=np.float64)
    k = np.flatnonzero(np.asarray(modulation_hz, dtype=np.float64) == hz)
    design = np.stack([np.ones(len(k)), np.cos(theta[k]), np.sin(theta[k])], axis=1)
    if len(k) < 3 or np.linalg.cond(design) > 1e3:
        raise DataError(
            f"{hz / 1e6:g} MHz: the phases {np.degrees(theta[k]).tolist()} deg do not determine a phasor"
        )
    # Rounded, so that a half is a half: of equal taps nothing is left, not 1e-14 on either side of a wrap.
    weights: Float64 = np.linalg.pinv(design).round(15)
    return k, weights


def phasors(raw: NDArray[Any], modulation_hz: Sequence[float], phase_rad: Sequence[float]) -> Complex128:
    """Fit the phasor of each frequency by least squares: (..., F, H, W), ``A exp(i phi)``, frequencies ascending.

    Raises :class:`DataError` when channels and descriptions disagree, or the phases of a frequency do not determine a
    phasor.

    Parameters
    ----------
    raw
        (..., K, H, W) taps, any real dtype, in any order of channels.
    modulation_hz, phase_rad
        (K,) frequency and demodulation phase of each channel.
    """
    if raw.shape[-3] != len(modulation_hz) or len(modulation_hz) != len(phase_rad):
        raise DataError(
            f"raw: expected {len(modulation_hz)} channels for {len(phase_rad)} phases, got shape {raw.shape}"
        )
    out = []
    for hz in frequencies(modulation_hz):
        k, solve = solution(modulation_hz, phase_rad, hz)
        taps = np.moveaxis(raw[..., k, :, :], -3, -1).astype(np.float64)
        out.append(taps @ (solve[1] - 1j * solve[2]))
    return np.stack(out, axis=-3)


def mean_phasors(raw: NDArray[Any], modulation_hz: Sequence[float], phase_rad: Sequence[float]) -> Complex128:
    """Average a burst (frames, K, H, W) over its frames as I and Q: phasors (F, H, W)."""
    return phasors(raw.mean(axis=0, dtype=np.float64), modulation_hz, phase_rad)


def taps(
    phasor: Complex128, offset: Float64, modulation_hz: Sequence[float], phase_rad: Sequence[float]
) -> Float64:
    """Compute noise-free taps (K, H, W) of phasors (F, H, W) and mean taps ``offset`` (F, H, W): inverse of :func:`phasors`."""
    index = {hz: i for i, hz in enumerate(frequencies(modulation_hz))}
    out = [
        offset[index[float(hz)]] + (phasor[index[float(hz)]] * np.exp(1j * theta)).real
        for hz, theta in zip(modulation_hz, phase_rad, strict=True)
    ]
    return np.stack(out)


def wrapped_range(phasor: Complex128, modulation_hz: float) -> Float64:
    """Turn a phasor into its range in [0, c / 2f), metres."""
    out: Float64 = np.mod(np.angle(phasor), 2 * np.pi) * SPEED_OF_LIGHT / (4 * np.pi * modulation_hz)
    return out


def radial_to_range(
    radial: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Compute half the path illuminator - surface - camera of distances along the rays (..., H, W), metres."""
    radial = np.asarray(radial, dtype=np.float64)
    points = radial[..., None] * (camera.rays / camera.ray_lengths[..., None])
    out: Float64 = (radial + np.linalg.norm(points - np.asarray(illuminator), axis=-1)) / 2
    return out
