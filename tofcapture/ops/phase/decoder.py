"""Decoding at the speed of the sensor and more: one camera's tables built once, float32, blocks that stay in the cache.

Range errors are taken off per frequency, the high one is unwrapped by the low one, and both are fused with weights
proportional to f^2, the inverse variance at equal phase noise (method.md 4.3).

With two frequencies the likelihood of both phasors chooses the very wrap that rounding chooses. Fewer wrong wraps come from the
neighbours' support only (:func:`unwrap_spatial`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.frames import TofFlag, TofInfo
from tofcapture.ops.phase.float32 import Correction, Float32, combine, tap_weights, turns_of
from tofcapture.ops.phase.phasors import Float64, TapNoise, ambiguity, frequencies
from tofcapture.rig import RangeError

_CERTAIN = 0.1  # wraps; at five standard deviations of the gap to half a wrap, rounding is right
_UNBELIEVABLE = 4.0  # standard deviations of a pixel's own gap that no neighbours make likely


def unwrap(range_low: Float64, range_high: Float64, ambiguity_high: float, ambiguity_low: float) -> Float64:
    """Unwrap the high frequency by the low one.

    ``k = round((r_low - r_high) / R_high) mod (R_low / R_high)``, method.md 4.3: for 20 and 100 MHz k is in 0..4. It fails
    only where the two disagree by more than half of R_high (0.75 m). The low ambiguity must be a whole multiple of the high
    one. The result is the range of the high frequency in [0, R_low), metres.
    """
    ratio = whole_ratio(ambiguity_low, ambiguity_high)
    k = np.mod(np.round((range_low - range_high) / ambiguity_high), ratio)
    return range_high + k * ambiguity_high


def unwrap_spatial(
    range_low: Float64, range_high: Float64, amplitude: Float64, ambiguity_high: float, ambiguity_low: float,
    tap_sigma: float | Float64, radius: int = 2,
) -> Float64:  # fmt: skip
    """Unwrap with the neighbours' support where a pixel alone cannot be sure.

    A pixel whose gap between the frequencies has a predicted standard deviation above a tenth of a wrap takes the low
    frequency's phasor from its window: the sum of the neighbours' phasors, each weighted by ``cos^4((phi_p - phi_q) / 2)``
    of the high frequency's phases, so that surfaces at another range have no say. A wrap that the pixel itself all but
    rules out, at four standard deviations of its own gap, is not taken.

    Parameters
    ----------
    range_low, range_high, ambiguity_high, ambiguity_low
        As for :func:`unwrap`, of shape (H, W).
    amplitude, tap_sigma
        (2, H, W) of the low and the high frequency, and a tap's standard deviation, scalar or (H, W); raw units.
    radius
        Of the window, pixels.
    """
    alone = unwrap(range_low, range_high, ambiguity_high, ambiguity_low)
    ratio = whole_ratio(ambiguity_low, ambiguity_high)
    with np.errstate(divide="ignore", invalid="ignore"):
        phase_sigma = np.asarray(tap_sigma) / (np.sqrt(2) * amplitude)
    gap_sigma = np.hypot(ratio * phase_sigma[0], phase_sigma[1]) / (2 * np.pi)
    low = amplitude[0] * np.exp(2j * np.pi * range_low / ambiguity_low)
    high = np.exp(2j * np.pi * range_high / ambiguity_high)
    H, W = range_high.shape
    low_wide, high_wide = (np.pad(z, radius) for z in (low, high))
    pooled = np.zeros_like(low)
    for dv in range(2 * radius + 1):
        for du in range(2 * radius + 1):
            window = (slice(dv, dv + H), slice(du, du + W))
            alike = (1 + (high * high_wide[window].conj()).real) / 2
            pooled += alike**2 * low_wide[window]
    shared = np.mod(np.angle(pooled), 2 * np.pi) * ambiguity_low / (2 * np.pi)
    together = unwrap(shared, range_high, ambiguity_high, ambiguity_low)
    own_gap = np.abs(centred(range_low - together, ambiguity_low)) / ambiguity_high
    asked = (gap_sigma > _CERTAIN) & (own_gap <= _UNBELIEVABLE * gap_sigma)
    return np.where(asked, together, alone)


def centred(difference: NDArray[np.floating[Any]], period: float) -> Float64:
    """Wrap a difference of two ranges into [-period/2, period/2)."""
    out: Float64 = np.mod(difference + period / 2, period) - period / 2
    return out


def whole_ratio(ambiguity_low: float, ambiguity_high: float) -> int:
    """Count the wraps of the high frequency in one of the low; :class:`DataError` when that is no whole number."""
    ratio = round(ambiguity_low / ambiguity_high)
    if abs(ambiguity_low / ambiguity_high - ratio) > 1e-9:
        raise DataError(f"unwrap: expected a whole frequency ratio, got {ambiguity_low / ambiguity_high:.6f}")
    return ratio


UNKNOWN_CELSIUS = 45.0
_BLOCK = 1 << 16  # pixels; temporaries stay in a core's caches, and calls stay long against their overhead
_AMBIGUOUS = 0.25  # wraps of disagreement between the frequencies
_UNCERTAIN = 0.020  # m, standard deviation from which a pixel is of low confidence
_STEEP = float(np.tan(np.radians(80)))


@dataclass(frozen=True)
class DepthMaps:
    """Hold what the decoder yields, each (H, W)."""

    depth: Float32  #: float32, z, metres; NaN where a tap is saturated or nothing can be decoded.
    confidence: Float32  #: float32, amplitude of the high frequency, raw units.
    flags: NDArray[np.uint8]  #: uint8, bits of :class:`tofcapture.frames.TofFlag`; 0 is a good pixel.


@dataclass(frozen=True)
class Signals:
    """Hold what was on the way from taps to depth."""

    phasor: Float32  #: (2, 2, H, W) float32: I and Q of the low, then of the high frequency; raw units.
    range_low: Float32  #: (H, W) by the low frequency alone, metres: half the path to the surface and back.
    #: (H, W) range of the low minus range of the high frequency, within half a range of the high one; metres,
    #: NaN where there is no light.
    gap: Float32


class Decoder:
    """Decodes raw frames of one camera; its buffers serve one thread.

    Raises :class:`DataError` when there are not exactly two frequencies in a whole ratio, or phases that determine no
    phasor.

    Parameters
    ----------
    info
        Channels, intrinsics, light source, saturation and range errors.
    noise, min_amplitude
        Of one tap: decides which pixels are of low confidence. Those whose weaker amplitude is not above the least, raw units,
        have no depth.
    """

    def __init__(self, info: TofInfo, noise: TapNoise | None = None, min_amplitude: float = 0.0) -> None:
        hz = frequencies(info.modulation_hz)
        if len(hz) != 2:
            raise DataError(f"decode: expected two frequencies, got {[f / 1e6 for f in hz]} MHz")
        self.info, self.noise = info, noise or TapNoise()
        self._rows = tap_weights(info)
        by_hz = {e.modulation_hz: e for e in info.range_errors}
        self._corrections = [Correction(by_hz.get(f, RangeError(f)), info.camera) for f in hz]
        self._R = ambiguity(hz[0]), ambiguity(hz[1])
        whole_ratio(*self._R)
        # Fusion leans on the high frequency by f^2: inverse variance at equal phase noise.
        self._lean = self._R[1] * hz[1] ** 2 / (hz[0] ** 2 + hz[1] ** 2)
        self._min_power = float(np.square(min_amplitude))
        self._dim = self._R[1] ** 2 / (8 * np.pi**2 * _UNCERTAIN**2)
        # z = (D^2 - |s|^2 / 4) / (D L - r . s / 2), r the ray with z = 1, L its length, s the light source.
        s = np.asarray(info.illuminator, dtype=np.float64)
        self._length = info.camera.ray_lengths.ravel().astype(np.float32)
        self._slant = (info.camera.rays @ s / 2).ravel().astype(np.float32)
        self._quarter, self._nearest = float(s @ s / 4), float(np.sqrt(s @ s) / 2)
        pixels = info.camera.width * info.camera.height
        size = min(_BLOCK, pixels)
        # In-phase, quadrature, amplitude and scratch of both frequencies, and the mean tap of the high one.
        self._buffers = np.empty((4, 2, size), np.float32), np.empty(size, np.float32)
        self._scratch = np.empty((2, pixels), np.float32)
        self._indices = np.empty(size, np.int32), np.empty(size, np.int64)
        self._dark = np.array([[c.dark] for c in self._corrections], np.float32)
        self._darkness = np.zeros((2, size if self._dark.any() else 0), np.float32)

    def __call__(self, raw: NDArray[Any], celsius: float = float("nan")) -> DepthMaps:
        """Decode one frame (K, H, W) of taps, any real dtype; :class:`DataError` when it is of another shape."""
        self._expect(raw.shape)
        return self._decode(raw, celsius, 1, raw.max(axis=0))

    def signals(self, raw: NDArray[Any], celsius: float = float("nan")) -> tuple[DepthMaps, Signals]:
        """Decode one frame (K, H, W), or the mean of some, and keep the phasors and the gap between the frequencies."""
        self._expect(raw.shape)
        kept = Signals(*(np.empty((*n, *self.info.camera.shape), np.float32) for n in ((2, 2), (), ())))
        return self._decode(raw, celsius, 1, raw.max(axis=0), kept), kept

    def burst(self, raw: NDArray[Any], celsius: float = float("nan")) -> DepthMaps:
        """Decode a burst (frames, K, H, W), averaged as I and Q; a pixel is saturated when it is in any frame."""
        self._expect(raw.shape[1:])
        return self._decode(raw.mean(axis=0, dtype=np.float64), celsius, len(raw), raw.max(axis=(0, 1)))

    def _expect(self, shape: tuple[int, ...]) -> None:
        expected = (len(self.info.modulation_hz), *self.info.camera.shape)
        if shape != expected:
            raise DataError(f"decode: expected raw of shape {expected}, got {shape}")

    def _decode(
        self,
        raw: NDArray[Any],
        celsius: float,
        frames: int,
        largest: NDArray[Any],
        kept: Signals | None = None,
    ) -> DepthMaps:
        camera = self.info.camera
        celsius = celsius if np.isfinite(celsius) else UNKNOWN_CELSIUS
        flat = np.ascontiguousarray(raw).reshape(len(raw), -1)
        n = flat.shape[1]
        depth, confidence, flags = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.uint8)
        bad = np.empty(n, bool)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for at in (slice(i, min(i + _BLOCK, n)) for i in range(0, n, _BLOCK)):
                iq = None if kept is None else kept.phasor.reshape(2, 2, -1)[..., at]
                phases = self._phases(flat[:, at], frames, confidence[at], flags[at], bad[at], iq)
                ranges = None if kept is None else (kept.range_low.reshape(-1)[at], kept.gap.reshape(-1)[at])
                self._ranges(phases, at, celsius, flags[at], ranges)
                self._depth(phases, at, depth[at], bad[at])
        # Integers are compared with an integer: not one of them is converted.
        limit = self.info.saturation if largest.dtype.kind == "f" else math.ceil(self.info.saturation)
        saturated = largest >= limit
        image, bits = depth.reshape(camera.shape), flags.reshape(camera.shape)
        bits |= saturated
        np.copyto(image, np.nan, where=bad.reshape(camera.shape) | saturated)
        bits |= flying_pixels(image, camera, self._scratch).view(np.uint8) * np.uint8(TofFlag.FLYING)
        return DepthMaps(image, confidence.reshape(camera.shape), bits)

    def _phases(
        self, raw: NDArray[Any], frames: int, confidence: Float32, flags: NDArray[np.uint8],
        bad: NDArray[np.bool_], iq: Float32 | None,
    ) -> tuple[Float32, Float32]:  # fmt: skip
        """Compute phases of both frequencies in turns, [0, 1), and scratch; amplitude and what it decides on the way."""
        n = raw.shape[1]
        real, imag, size, work = self._buffers[0][..., :n]
        limit = self._buffers[1][:n]
        for terms, out in zip(self._rows, (*real, *imag, limit), strict=True):
            combine(raw, terms, out, work[0])
        # Low confidence: power below what this tap noise needs for a range that is certain to _UNCERTAIN.
        limit *= self._dim / (frames * self.noise.electrons_per_unit)
        limit += self._dim / frames * self.noise.read**2
        np.multiply(real, real, out=size)
        np.multiply(imag, imag, out=work)
        size += work
        np.multiply((limit > size[1]).view(np.uint8), np.uint8(TofFlag.LOW_CONFIDENCE), out=flags)
        np.less_equal(np.minimum(size[0], size[1], out=work[0]), self._min_power, out=bad)
        np.sqrt(size, out=size)
        np.copyto(confidence, size[1])
        if self._darkness.size:
            np.divide(self._dark, size, out=self._darkness[:, :n])
        if iq is not None:
            iq[:, 0], iq[:, 1] = real, imag
        turns_of(real, imag, size, work)
        return size, work

    def _ranges(
        self, phases: tuple[Float32, Float32], at: slice, celsius: float, flags: NDArray[np.uint8],
        kept: tuple[Float32, Float32] | None,
    ) -> None:  # fmt: skip
        """Free ranges of their systematic errors, unwrap the high one, fuse both; the result lies in the low one."""
        (low, high), (gap, work) = phases
        indices = [index[: low.size] for index in self._indices]
        for correct, range_, dark in zip(self._corrections, (low, high), self._darkness, strict=True):
            correct(range_, at, celsius, work, indices, dark[: low.size])
        np.subtract(low, high, out=gap)
        gap *= 1 / self._R[1]
        gap -= np.rint(gap, out=work)
        if kept is not None:
            np.copyto(kept[0], low)
            np.multiply(gap, self._R[1], out=kept[1])
        np.abs(gap, out=work)
        flags |= (work > _AMBIGUOUS).view(np.uint8) * np.uint8(TofFlag.AMBIGUOUS)
        gap *= self._lean
        low -= gap
        np.multiply(low, 1 / self._R[0], out=work)
        np.floor(work, out=work)
        work *= self._R[0]
        low -= work

    def _depth(
        self, phases: tuple[Float32, Float32], at: slice, depth: Float32, bad: NDArray[np.bool_]
    ) -> None:
        (range_, _), (work, _) = phases
        bad |= range_ <= self._nearest
        np.multiply(range_, range_, out=work)
        work -= self._quarter
        range_ *= self._length[at]
        range_ -= self._slant[at]
        np.divide(work, range_, out=depth)


def flying_pixels(
    depth: NDArray[np.floating[Any]], camera: Camera, scratch: NDArray[np.floating[Any]] | None = None
) -> NDArray[np.bool_]:
    """Find pixels that neither neighbour of a row, or neither of a column, supports.

    A mixed pixel hangs between two surfaces (method.md 4.4): depth (H, W) jumps on both of its sides by more than a surface at
    80 degrees makes from one pixel to the next. Pixels beside holes (NaN) are not flagged for them. ``scratch`` (2, H W) of
    depth's dtype is overwritten.
    """
    step_of, steep_of = np.empty((2, depth.size), depth.dtype) if scratch is None else scratch
    out = np.zeros(depth.shape, dtype=bool)
    flat, jump = np.ascontiguousarray(depth).ravel(), np.zeros(depth.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        # Row after row as one: a step across a seam is taken for column 0, which has no left neighbour and is not asked.
        for stride, focal in ((1, camera.fx), (depth.shape[1], camera.fy)):
            step = np.subtract(flat[stride:], flat[:-stride], out=step_of[stride:])
            steep = np.multiply(flat[stride:], _STEEP / focal, out=steep_of[stride:])
            np.greater(np.abs(step, out=step), steep, out=jump.ravel()[stride:])
            if stride == 1:
                np.logical_and(jump[:, 1:-1], jump[:, 2:], out=out[:, 1:-1])
            else:
                out[1:-1] |= jump[1:-1] & jump[2:]
    return out
