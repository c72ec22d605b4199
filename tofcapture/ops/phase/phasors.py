"""Phasors of taps and taps of phasors: ``C_k = B + A cos(phi + theta_k)``, a phasor is ``A exp(i phi)``.

Beside them the noise of a tap: its model, and its measurement from bursts (photon transfer).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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


_BINS = 48
_PER_BIN = 50  # taps at least, for a variance worth a point of the line
_OUTLIER = 30.0  # times the bin's median: hot taps, and whatever moved
_ROUNDING = 1 / 12  # variance of rounding to whole raw units


@dataclass(frozen=True)
class TapNoise:
    """Noise of one tap of one frame: variance ``tap / electrons_per_unit + read^2`` in raw units squared."""

    electrons_per_unit: float = 16.0  #: Photo-electrons per raw unit.
    read: float = 1.25  #: Standard deviation of the electronics, raw units.


def photon_transfer(bursts: Iterable[NDArray[np.generic]], saturation: float) -> TapNoise:
    """Measure the noise of a sensor from bursts of still scenes: the line of variance over mean.

    The shot noise of ``n`` electrons has the variance ``n``, so the slope is the raw units that an electron makes. What is
    left in the dark is the electronics', less the rounding to whole units. Taps are sorted by their mean into bins of equal
    number, which are weighted by what their variance is worth. Pixels noisier than all others of their brightness are left out.
    Where brighter taps are not noisier there are infinite electrons per unit.

    Parameters
    ----------
    bursts
        Each (frames, ...) raw taps of at least two frames, raw units.
    saturation
        Taps that reach it in any frame say nothing of noise; :class:`DataError` when too few others are left.
    """
    means, variances = [], []
    for burst in bursts:
        taps = np.asarray(burst, dtype=np.float64).reshape(len(burst), -1)
        if len(taps) < 2:
            raise DataError(f"photon transfer: expected bursts of two frames at least, got {len(taps)}")
        below = taps.max(0) < saturation
        means.append(taps.mean(0)[below])
        variances.append(taps.var(0, ddof=1)[below])
    mean, variance = np.concatenate(means or [[]]), np.concatenate(variances or [[]])
    bins = min(_BINS, len(mean) // _PER_BIN)
    if bins < 2:
        raise DataError(
            f"photon transfer: expected {2 * _PER_BIN} taps below saturation ({saturation:g}), got {len(mean)}",
            hint="shorten the exposure",
        )
    order = np.argsort(mean, kind="stable")
    points = np.array([_point(mean[part], variance[part]) for part in np.array_split(order, bins)])
    slope, dark = np.polyfit(points[:, 0], points[:, 1], 1, w=1 / points[:, 1].clip(min=_ROUNDING))
    gain = 1 / slope if slope > 0 else np.inf
    floor = dark if slope > 0 else points[:, 1].mean()
    return TapNoise(float(gain), float(np.sqrt(max(floor - _ROUNDING, 0.0))))


def _point(mean: NDArray[np.float64], variance: NDArray[np.float64]) -> tuple[float, float]:
    """Average tap and variance of a bin without its outliers."""
    usual = variance <= _OUTLIER * max(float(np.median(variance)), _ROUNDING)
    return float(mean[usual].mean()), float(variance[usual].mean())
