"""Decoding at the speed of the sensor and more: one camera's tables built once, float32, a pass for each thing.

Range errors are taken off per frequency. The wraps are those of maximum likelihood among the consistent vectors of this camera
(:func:`tofcapture.channels.wrap_table`). Neighbours are asked where a pixel alone cannot tell. Ranges are fused by inverse
variance at equal phase noise: systematic errors are alike in phase, and outweigh noise where it is bright.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import TapNoise, frequencies, wrap_table
from tofcapture.errors import DataError
from tofcapture.frames import TofFlag, TofInfo
from tofcapture.ops.phase import float32
from tofcapture.ops.phase.float32 import Float32, correction
from tofcapture.ops.phase.noise import NoiseLine, NoiseMeter, middle, stuck_lines
from tofcapture.ops.phase.phasors import information
from tofcapture.ops.phase.reference import UNKNOWN_CELSIUS
from tofcapture.rig import RangeError

RADIUS = 2  # px of the window that is asked where a pixel alone cannot tell its wraps
UNCERTAIN = 0.020  # m, standard deviation from which a pixel is of low confidence
_STEEP = float(np.tan(np.radians(80)))
_BROKEN = 0.25  # of a row's or column's pixels, more than noise has, are odd: all of it is inconsistent
_ODD = 0.1  # of the pixels, as far as noise goes
GROSS = np.float32(0.25**2)  # of the power: more is off in no sound tap, whatever the noise of the frame


def rare(count: int) -> float:
    """Chi squared of so many degrees of freedom that noise exceeds in one of 30,000 pixels."""
    return 17 + 2.8 * count


def odd_beyond(count: int) -> float:
    """Chi squared of so many degrees of freedom that noise exceeds in :data:`_ODD` of the pixels, or a little fewer."""
    return 0.6 + 2.1 * count


@dataclass(frozen=True)
class DepthMaps:
    """Hold what the decoder yields, each (H, W)."""

    depth: Float32  #: float32, z, metres; NaN where a tap is saturated or nothing can be decoded.
    confidence: Float32  #: float32, amplitude of the highest frequency, raw units.
    flags: NDArray[np.uint8]  #: uint8, bits of :class:`tofcapture.frames.TofFlag`; 0 is a good pixel.


@dataclass(frozen=True)
class Signals:
    """Hold what was on the way from taps to depth, of F frequencies, ascending."""

    phasor: Float32  #: (F, 2, H, W) float32: I and Q of each frequency; raw units.
    #: (F, H, W) by each frequency alone, unwrapped, metres: half the path to the surface and back; NaN where there is no light.
    ranges: Float32

    @property
    def gap(self) -> Float32:
        """Range of the lowest minus range of the highest frequency, (H, W) metres: 0 with one frequency."""
        out: Float32 = self.ranges[0] - self.ranges[-1]
        return out

    @property
    def offsets(self) -> NDArray[np.float64]:
        """Medians by which ranges of each frequency differ from the highest one's, (F,) metres: what nobody calibrated; 0 without light.

        Wraps are those that agree best: an offset beyond half of what two of them differ by looks like a smaller one.
        """
        apart = (self.ranges - self.ranges[-1]).reshape(len(self.ranges), -1)
        return np.array([middle(each[np.isfinite(each)]) for each in apart])


class Decoder:
    """Decodes raw frames of one camera; its buffers serve one thread.

    Parameters
    ----------
    info
        Channels, intrinsics, light source, saturation, range errors and reach.
    noise, min_amplitude
        Of one tap: decides which pixels are of low confidence and where neighbours are asked; what ``info`` says, or without that
        what each frame or burst shows. Pixels whose weakest amplitude is not above the least, raw units, have no depth.
    """

    def __init__(self, info: TofInfo, noise: TapNoise | None = None, min_amplitude: float = 0.0) -> None:
        hz = frequencies(info.modulation_hz)
        self.info, self.noise = info, noise or info.noise
        rows = float32.tap_rows(info)
        self._rows, self._spare = float32.sparse(rows.weights), rows.spare
        by_hz = {e.modulation_hz: e for e in info.range_errors}
        self._corrections = [correction(by_hz.get(f, RangeError(f)), info.camera) for f in hz]
        known = information(info)
        self.wraps = wrap_table(hz, known, info.reach)
        unit = np.square(2 * np.pi / self.wraps.U)
        self._tops, self._lean, self._weight, self._unit, self._periods, self._bounds = (
            np.asarray(x, np.float32)
            for x in (self.wraps.tops, self.wraps.lean, unit * known, unit, self.wraps.U, self.wraps.bounds)
        )
        self._uncertain = (np.square(self.wraps.lean / UNCERTAIN) / (unit * known)).astype(np.float32)
        self._limit = np.float32(np.square(self.wraps.apart / 4))
        self._min_power = np.float32(np.square(min_amplitude))
        s = np.asarray(info.illuminator, dtype=np.float64)
        self._length = info.camera.ray_lengths.ravel().astype(np.float32)
        self._slant = (info.camera.rays @ s / 2).ravel().astype(np.float32)
        self._quarter, self._nearest = np.float32(s @ s / 4), np.float32(np.sqrt(s @ s) / 2)
        F, pixels = len(hz), info.camera.width * info.camera.height
        self._meter = NoiseMeter(info, self.wraps, self._corrections, self._weight)
        self._taps = np.empty((len(rows.weights), pixels), np.float32)
        self._ranges, self._power = np.empty((2, F, pixels), np.float32)
        self._which, self._doubt = np.empty(pixels, np.int32), np.empty(pixels, bool)
        self._margin, self._variance, self._rounds = np.empty((3, pixels), np.float32)
        self._scratch = np.empty((2, pixels), np.float32)

    def __call__(self, raw: NDArray[Any], celsius: float = float("nan")) -> DepthMaps:
        """Decode one frame (K, H, W) of taps, any real dtype; :class:`DataError` when it is of another shape."""
        self._expect(raw.shape)
        return self._decode(raw, raw[None], celsius, self._saturated(raw))

    def signals(self, raw: NDArray[Any], celsius: float = float("nan")) -> tuple[DepthMaps, Signals]:
        """Decode one frame (K, H, W), or the mean of some, and keep the phasors and the ranges of all frequencies."""
        maps = self(raw, celsius)
        F, shape = len(self._power), self.info.camera.shape
        phasor = self._taps[: 2 * F].reshape(2, F, *shape).swapaxes(0, 1)
        ranges = self._ranges - self._rounds
        ranges[:, ~(self._power.min(axis=0) > self._min_power)] = np.nan
        return maps, Signals(np.ascontiguousarray(phasor), ranges.reshape(F, *shape))

    def burst(self, raw: NDArray[Any], celsius: float = float("nan")) -> DepthMaps:
        """Decode a burst (frames, K, H, W), averaged as I and Q; a pixel is saturated when it is in any frame."""
        self._expect(raw.shape[1:])
        saturated = self._saturated(raw.reshape(-1, *raw.shape[2:]))
        return self._decode(raw.mean(axis=0, dtype=np.float64), raw, celsius, saturated)

    def _expect(self, shape: tuple[int, ...]) -> None:
        expected = (len(self.info.modulation_hz), *self.info.camera.shape)
        if shape != expected:
            raise DataError(f"decode: expected raw of shape {expected}, got {shape}")

    def _saturated(self, raw: NDArray[Any]) -> NDArray[np.bool_]:
        """Tell of taps (n, H, W) in which pixels (H W,) any is saturated."""
        saturated = self.info.saturated(raw.max(axis=0))
        if raw.dtype.kind != "u":
            saturated |= self.info.saturated(raw.min(axis=0))
        return saturated.ravel()

    def _decode(
        self, raw: NDArray[Any], each: NDArray[Any], celsius: float, saturated: NDArray[np.bool_]
    ) -> DepthMaps:
        """Decode taps (K, H, W) that are the mean of ``each`` (frames, K, H, W)."""
        celsius = celsius if np.isfinite(celsius) else UNKNOWN_CELSIUS
        float32.combine(np.ascontiguousarray(raw).reshape(len(raw), -1), *self._rows, self._taps)
        F = len(self._power)
        for k, correct in enumerate(self._corrections):
            correct(self._taps[k], self._taps[F + k], celsius, self._power[k], self._ranges[k])
        confidence = np.sqrt(self._power[-1])
        # Taps without an offset do not tell how much light there was: at least their amplitude.
        mean = self._taps[2 * F] if self.info.offset else confidence
        bad = ~(self._power.min(axis=0) > self._min_power) | saturated
        stuck = stuck_lines(raw)
        line = NoiseLine.of(self.noise, len(each)) if self.noise else self._meter(each, celsius, stuck)
        np.multiply(mean, np.float32(line.slope), out=self._variance)
        self._variance += np.float32(line.dark)
        np.maximum(self._variance, np.float32(line.least), out=self._variance)
        self._unwrap(bad)
        depth = np.empty(len(bad), np.float32)
        float32.finish(
            self._ranges, self._which, self._tops, self._periods, self._lean, np.float32(self.wraps.start), np.float32(self.wraps.period),
            self._length, self._slant, self._quarter, self._nearest, bad, depth, self._rounds,
        )  # fmt: skip
        shape = self.info.camera.shape
        image = depth.reshape(shape)
        flags = self._flags(stuck, saturated, self._meter.noisier(raw, saturated, line)).reshape(shape)
        flags |= flying_pixels(image, self.info.camera, self._scratch).view(np.uint8) * np.uint8(
            TofFlag.FLYING
        )
        return DepthMaps(image, confidence.reshape(shape), flags)

    def _unwrap(self, bad: NDArray[np.bool_]) -> None:
        """Choose wraps: pixel by pixel, then with neighbours where a pixel alone cannot tell."""
        float32.choose(
            self._ranges, self._power, self._variance, self._tops, self._bounds, self._periods, self._weight, self._unit, self._limit,
            self._which, self._margin, self._doubt,
        )  # fmt: skip
        good = ~bad
        unsure = np.flatnonzero((self._margin < float32.SURE) & good)
        if not len(unsure):
            return
        shape = self.info.camera.shape
        images = self._ranges.reshape(-1, *shape), self._power.reshape(-1, *shape)
        float32.ask(
            unsure, RADIUS, *images, self._variance.reshape(shape), good.reshape(shape), self._tops, self._bounds, self._periods,
            self._weight, self._which.reshape(shape), self._doubt.reshape(shape),
        )  # fmt: skip

    def _flags(
        self, stuck: NDArray[np.bool_], saturated: NDArray[np.bool_], noisier: list[float]
    ) -> NDArray[np.uint8]:
        """Raise all flags (H W,) but those of flying pixels; ``noisier`` is what the meter says of each frequency."""
        flags = saturated.view(np.uint8) * np.uint8(TofFlag.SATURATED)
        flags |= self._doubt.view(np.uint8) * np.uint8(TofFlag.AMBIGUOUS)
        float32.dim(self._power, self._variance, self._uncertain, int(TofFlag.LOW_CONFIDENCE), flags)
        shape = self.info.camera.shape
        odd = [np.zeros(n, np.int32) for n in shape]
        for power, (first, count), times in zip(self._power, self._spare, noisier, strict=True):
            if count:
                spare = self._taps[first : first + count]
                float32.inconsistent(
                    spare, power, self._variance, saturated, np.float32(rare(count)), np.float32(odd_beyond(count)),
                    np.float32(times), GROSS, int(TofFlag.INCONSISTENT), flags, *odd,
                )  # fmt: skip
                rows, columns = (line > most_odd(n) for line, n in zip(odd, shape[::-1], strict=True))
                stuck = stuck | rows[:, None] | columns if rows.any() or columns.any() else stuck
        if stuck.any():
            flags |= np.uint8(TofFlag.INCONSISTENT) * (stuck.ravel() & ~saturated)
        return flags


def most_odd(pixels: int) -> float:
    """Tell how many of a line's pixels are odd by noise: beyond it all is inconsistent. Some values of a stuck tap are right by chance."""
    return float((_ODD + _BROKEN) * pixels + 3.5 * np.sqrt(_ODD * (1 - _ODD) * max(pixels, 4)))


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
