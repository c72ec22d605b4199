"""Noise of a tap: the model, and its measurement from bursts (photon transfer)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError

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
