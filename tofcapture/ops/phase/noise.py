"""Noise of a tap, measured: from bursts of still scenes (photon transfer), or from what a single frame cannot mean.

A decoder is told a camera's noise, or takes that of the frame before it: cameras differ in gain, bits, offset and unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofcapture.channels import TapNoise, WrapTable
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import float32
from tofcapture.ops.phase.float32 import Correction

_BINS = 48
_PER_BIN = 50  # taps at least, for a variance worth a point of the line
_OUTLIER = 30.0  # times the bin's median: hot taps, and whatever moved
_WHOLE = 1 / 12  # variance of rounding to whole raw units


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
    slope, dark = np.polyfit(points[:, 0], points[:, 1], 1, w=1 / points[:, 1].clip(min=_WHOLE))
    gain = 1 / slope if slope > 0 else np.inf
    floor = dark if slope > 0 else points[:, 1].mean()
    return TapNoise(float(gain), float(np.sqrt(max(floor - _WHOLE, 0.0))))


def _point(mean: NDArray[np.float64], variance: NDArray[np.float64]) -> tuple[float, float]:
    """Average tap and variance of a bin without its outliers."""
    usual = variance <= _OUTLIER * max(float(np.median(variance)), _WHOLE)
    return float(mean[usual].mean()), float(variance[usual].mean())


_PARTS = 7  # of a frame, by brightness
_SAMPLES = 1024  # pixels, about, that tell a frame's noise
_ROUNDING = 1 / 6  # variance of whole raw units, at least: rounded quiet taps are alike in most pixels
_EXACT = 1e-5  # of a tap: what single precision leaves of it
_ROUGH = 4.0  # times the variance that frequencies show of their noise: likeliest wraps flatter it
_REPEATS = 64  # pixels of a line at most, in all of which a stuck tap says the same
_APART = 1.25  # brighter parts of a frame, or noisier ones, tell how noise grows with light; else it is taken for shot noise


class NoiseLine(NamedTuple):
    """Hold the variance of a tap over the mean tap: ``slope mean + dark``, not below ``least``; raw units, squared where variances."""

    slope: float
    dark: float
    least: float

    @classmethod
    def of(cls, noise: TapNoise, frames: int) -> NoiseLine:
        """State the variance of a mean of frames."""
        dark = noise.read**2 / frames + 1e-12
        return cls(1 / (frames * noise.electrons_per_unit), dark, dark)

    def at(self, mean: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Compute the variance of taps of such means."""
        out: NDArray[np.floating[Any]] = np.maximum(self.slope * mean + self.dark, self.least)
        return out


def fit_line(
    mean: NDArray[np.floating[Any]], square: NDArray[np.floating[Any]], degrees: int, least: float
) -> NoiseLine | None:
    """Fit the noise of a frame by medians of parts of one brightness: a texture here and there is no noise; ``None`` of too few pixels.

    Where a frame has one brightness, its noise is taken for shot noise. Few pixels are believed to have a little more noise than
    they show.

    Parameters
    ----------
    mean, square
        (N,) mean tap, and an estimate of the variance of a tap, chi squared of so many ``degrees`` over these.
    least
        Variance that any tap has, such as of rounding.
    """
    parts = min(_PARTS, len(mean) // 16)
    count = len(mean) // parts if parts else 0
    if not count:
        return None
    order = np.argsort(mean, kind="stable")[: parts * count].reshape(parts, count)
    error = 1.5 / np.sqrt(count * degrees)  # of a part's noise, as a share
    usual = median_of_chi_squared(degrees) / (1 + error)
    light = mean[order[:, count // 2]].astype(np.float64)
    noise = np.sort(square[order], axis=1)[:, count // 2].astype(np.float64) / usual
    noise = np.maximum(noise, least)
    if noise[-1] < _APART**2 * noise[0] and light[-1] < _APART * light[0]:
        return NoiseLine(
            float(noise[parts // 2] / light[parts // 2]), 0.0, max(float(noise.min()) / 2, least)
        )
    slope, dark = 0.0, noise
    for _ in range(2):  # all parts are known to the same share of their noise
        weight = np.square(1 / np.maximum(slope * light + dark, least))
        total = sum(weight)
        middle, usual = sum(weight * light) / total, sum(weight * noise) / total
        spread = max(sum(weight * np.square(light - middle)), 1e-30)
        slope = max(sum(weight * (light - middle) * (noise - usual)) / spread, 0.0) + error / np.sqrt(spread)
        dark = usual - slope * middle
    return NoiseLine(float(slope), float(dark), max(float(noise.min()) / 2, least))


def median_of_chi_squared(degrees: int) -> float:
    """Compute it as a share of the degrees of freedom."""
    return (1 - 2 / (9 * degrees)) ** 3


class NoiseMeter:
    """Measures the noise of a camera's frames on some of their pixels.

    A burst tells it by its repeats. A frame of four phases or more tells it by what no cosine explains, another one by what rows
    are not smooth, or the frequencies do not agree.
    """

    def __init__(
        self, info: TofInfo, wraps: WrapTable, corrections: list[Correction], weight: NDArray[Any]
    ) -> None:
        rows = float32.tap_rows(info)
        self._info, self._wraps, self._weight = info, wraps, weight[:, None]
        self._rows, self._F = float32.sparse(rows.weights), len(wraps.U)
        self._rough, self._spare = len(rows.weights) == 2 * self._F + 1, rows.spare
        W, pixels = info.camera.width, info.camera.width * info.camera.height
        some = np.arange(0, pixels, max(1, pixels // _SAMPLES) | 1)
        self.some = some[(some % W > 1) & (some % W < W - 2)] if self._rough else some
        self._corrections = [c.of(self.some) for c in corrections]
        self._taps = np.empty((len(rows.weights), len(self.some)), np.float32)
        self._ranges, self._power = np.empty((2, self._F, len(self.some)), np.float32)

    @np.errstate(invalid="ignore", over="ignore")
    def __call__(self, raw: NDArray[Any], celsius: float, stuck: NDArray[np.bool_]) -> NoiseLine:
        """Measure the variance of the mean of frames (frames, K, H, W), but where taps are ``stuck`` (H, W)."""
        frames, K = raw.shape[:2]
        taps = raw.reshape(frames, K, -1)[:, :, self.some]
        seen = taps[0] if frames == 1 else taps.mean(axis=0, dtype=np.float64)
        float32.combine(seen, *self._rows, self._taps)
        F = self._F
        for k, correct in enumerate(self._corrections):
            correct(self._taps[k], self._taps[F + k], celsius, self._power[k], self._ranges[k])
        lit = (self._power.min(axis=0) > 0) & ~stuck.ravel()[self.some]
        lit &= ~self._info.saturated(taps).any(axis=(0, 1))
        if frames > 1:
            square, degrees = (
                taps.var(axis=0, ddof=1, dtype=np.float64).mean(axis=0) / frames,
                K * (frames - 1),
            )
        elif self._rough:
            square, degrees = _fourth_differences(raw.reshape(K, -1), self.some), K
        else:
            spare = self._taps[2 * F + 1 :]
            square, degrees = np.square(spare).mean(axis=0), len(spare)
        lit &= np.isfinite(square)
        mean = (self._taps[2 * F] if self._info.offset else np.sqrt(self._power[-1]))[lit]
        least = 0.0 if raw.dtype.kind == "f" else _ROUNDING / frames
        least = max(least, (_EXACT * middle(np.abs(mean))) ** 2, 1e-24)
        line = fit_line(mean, square[lit], degrees, least)
        if line is None:
            return NoiseLine.of(TapNoise(), frames)
        if frames > 1 or not self._rough or F == 1:
            return line
        # What is not smooth may be the scene. Then the frequencies agree far better than such noise lets them.
        share = min(1.0, _ROUGH * self._disagreement(lit, line.at(mean)))
        return NoiseLine(line.slope * share, line.dark * share, max(line.least * share, least))

    @np.errstate(invalid="ignore", over="ignore")
    def noisier(self, raw: NDArray[Any], saturated: NDArray[np.bool_], line: NoiseLine) -> list[float]:
        """Tell for each frequency how many times the variance of ``line`` a frame has, by the median of what no cosine explains.

        ``raw`` (K, H, W) are taps of a frame, or of the mean of some, ``saturated`` (H, W) its pixels that are. 1 where three phases
        explain anything.
        """
        F, some = self._F, raw.reshape(len(raw), -1)[:, self.some]
        float32.combine(some, *self._rows, self._taps)
        power = np.square(self._taps[:F]) + np.square(self._taps[F : 2 * F])
        mean = self._taps[2 * F] if self._info.offset else np.sqrt(power[-1])
        variance = line.at(mean)
        out = []
        for own, (first, count) in zip(power, self._spare, strict=True):
            lit = ~saturated.ravel()[self.some] & (own > 0)
            ratio = (np.square(self._taps[first : first + count]).sum(axis=0) / variance)[lit]
            out.append(max(1.0, middle(ratio) / (count * median_of_chi_squared(count))) if count else 1.0)
        return out

    def _disagreement(self, lit: NDArray[np.bool_], variance: NDArray[Any]) -> float:
        """Tell how many times the variance of lit pixels the misfit of their likeliest wraps shows."""
        ranges, power = self._ranges[:, lit], self._power[:, lit]
        U, weight, best = self._wraps.U[:, None], self._weight * power, np.full(ranges.shape[1], np.inf)
        for top in self._wraps.tops:
            apart = ranges - (ranges[-1] + top)
            apart -= U * np.floor(apart / U + 0.5)
            weighted = weight * apart
            misfit = (weighted * apart).sum(axis=0) - np.square(weighted.sum(axis=0)) / weight.sum(axis=0)
            best = np.minimum(best, misfit)
        degrees = self._F - 1
        return middle(best / variance) / (degrees * median_of_chi_squared(degrees))


def _fourth_differences(taps: NDArray[Any], pixels: NDArray[np.intp]) -> NDArray[np.float64]:
    """Estimate the variance of a tap at pixels (n,) of flat taps (K, N), by what rows are not smooth: chi squared of K degrees over K.

    Two pixels to the left and right of each are looked at.
    """
    a, b, c, d, e = (taps[:, pixels + k].astype(np.float64) for k in range(-2, 3))
    out: NDArray[np.float64] = np.square(a + e - 4 * (b + d) + 6 * c).mean(axis=0) / 70
    return out


def stuck_lines(raw: NDArray[Any]) -> NDArray[np.bool_]:
    """Find rows and columns (H, W) of a frame (K, H, W) along which some taps, not most, repeat one value.

    With three phases nothing else tells.
    """
    stuck = np.zeros(raw.shape[1:], bool)
    for axis, taps in ((1, raw), (0, raw.swapaxes(1, 2))):
        lines = np.zeros(taps.shape[1], bool)
        float32.repeated(taps, max(1, taps.shape[2] // _REPEATS), lines)
        stuck |= np.expand_dims(lines, axis)
    return stuck


def middle(values: NDArray[np.floating[Any]]) -> float:
    """Return the upper median of values (N,); 0 of none."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2]) if len(values) else 0.0
