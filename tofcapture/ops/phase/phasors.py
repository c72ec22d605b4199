"""Phasors of taps and taps of phasors: ``C_k = B + A cos(phi + theta_k)``, a phasor is ``A exp(i phi)``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT, frequencies, solution
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo

Float64 = NDArray[np.float64]
Complex128 = NDArray[np.complex128]


def phasors(
    raw: NDArray[Any], modulation_hz: Sequence[float], phase_rad: Sequence[float], *, offset: bool = True
) -> Complex128:
    """Fit the phasor of each frequency by least squares: (..., F, H, W), ``A exp(i phi)``, frequencies ascending.

    Raises :class:`DataError` when channels and descriptions disagree, or the phases of a frequency do not determine a
    phasor.

    Parameters
    ----------
    raw
        (..., K, H, W) taps, any real dtype, in any order of channels.
    modulation_hz, phase_rad
        (K,) frequency and demodulation phase of each channel.
    offset
        Taps carry an offset, which is fitted; I and Q alone do not.
    """
    if raw.shape[-3] != len(modulation_hz) or len(modulation_hz) != len(phase_rad):
        raise DataError(
            f"raw: expected {len(modulation_hz)} channels for {len(phase_rad)} phases, got shape {raw.shape}"
        )
    out = []
    for hz in frequencies(modulation_hz):
        k, solve = solution(modulation_hz, phase_rad, hz, offset=offset)
        taps = np.moveaxis(raw[..., k, :, :], -3, -1).astype(np.float64)
        out.append(taps @ (solve[1] - 1j * solve[2]))
    return np.stack(out, axis=-3)


def mean_phasors(
    raw: NDArray[Any], modulation_hz: Sequence[float], phase_rad: Sequence[float], *, offset: bool = True
) -> Complex128:
    """Average a burst (frames, K, H, W) over its frames as I and Q: phasors (F, H, W)."""
    return phasors(raw.mean(axis=0, dtype=np.float64), modulation_hz, phase_rad, offset=offset)


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


def information(info: TofInfo) -> Float64:
    """Compute what each frequency (F,) tells of its phase, per power and tap variance: half its phases where these are evenly spread.

    The variance of a phase is ``tap variance / (information * power)``, averaged over the turn.
    """
    weights = [
        solution(info.modulation_hz, info.phase_rad, f, offset=info.offset)[1]
        for f in frequencies(info.modulation_hz)
    ]
    return np.array([2 / np.square(w[1:]).sum() for w in weights])


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
