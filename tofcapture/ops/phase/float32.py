"""Define what the fast decoder is made of: taps to I and Q, these to phase, phase to range; float32, in place.

Only additions, products, quotients and square roots are used, so that the same frame gives the same bits on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.frames import TofInfo
from tofcapture.ops.phase.phasors import ambiguity, frequencies, solution
from tofcapture.rig import RangeError

Float32 = NDArray[np.float32]

_TABLE = 1 << 14  # entries over one ambiguity: nearest is right to 5 micrometres for slopes of 0.1 at 100 MHz
_MARGIN = 0.5  # of an ambiguity beyond what a frame may hold, so that any temperature is inside the table
# atan(t) / pi = t P(t^2) on [-1, 1], minimax to 5e-7 turns: 0.8 micrometres of range at 100 MHz.
_ATAN = tuple(
    np.float32(c)
    for c in (
        0.31830263137817383,
        -0.10587713122367859,
        0.06160581111907959,
        -0.03705969080328941,
        0.016758160665631294,
        -0.0037303119897842407,
    )
)
_SIGN = np.uint32(0x80000000)


def tap_weights(info: TofInfo) -> NDArray[np.float64]:
    """Compute the rows (5, K) that turn taps into I of both frequencies, Q of both, and the mean tap of the high one."""
    hz = frequencies(info.modulation_hz)
    rows = np.zeros((5, len(info.modulation_hz)))
    for i, f in enumerate(hz):
        channels, (mean, cosine, sine) = solution(info.modulation_hz, info.phase_rad, f)
        rows[i, channels], rows[2 + i, channels] = cosine, -sine
        if i:
            rows[4, channels] = mean
    rows[np.abs(rows) < 1e-12] = 0.0
    opposite = rows[1] != 0
    if opposite.sum() == 2 and abs(rows[1].sum()) < 1e-12:
        rows[4] = np.where(opposite, 0.5, 0.0)  # two opposite taps have the mean of all
    return rows


def combine(raw: NDArray[Any], row: NDArray[np.float64], out: Float32, work: Float32) -> None:
    """Add weighted channels (K, n) up; sums and differences of two, the usual case, are taken in one pass."""
    first, *others = np.flatnonzero(row)
    if len(others) == 1 and abs(abs(row[first]) - abs(row[others[0]])) < 1e-12:
        pair = np.add if row[first] * row[others[0]] > 0 else np.subtract
        pair(raw[first], raw[others[0]], out=out, dtype=np.float32, casting="same_kind")
        out *= np.float32(row[first])
        return
    np.multiply(raw[first], np.float32(row[first]), out=out, dtype=np.float32, casting="same_kind")
    for k in others:
        np.multiply(raw[k], np.float32(row[k]), out=work, dtype=np.float32, casting="same_kind")
        out += work


def turns_of(real: Float32, imag: Float32, size: Float32, work: Float32) -> None:
    """Compute the phase of a phasor in turns, [0, 1); the result replaces its size, all else is used up.

    ``phi = 2 atan(imag / (size + |real|))`` on the right half plane; on the left one it is half a turn minus that.
    """
    np.abs(real, out=work)
    work += size
    imag /= work
    np.multiply(imag, imag, out=work)
    turns = size
    np.multiply(work, _ATAN[-1], out=turns)
    for c in _ATAN[-2:0:-1]:
        turns += c
        turns *= work
    turns += _ATAN[0]
    turns *= imag
    turns -= np.float32(0.25)
    sign = real.view(np.uint32)
    sign &= _SIGN
    bits = turns.view(np.uint32)
    bits ^= sign
    turns += np.float32(0.25)
    turns -= np.floor(turns, out=work)


class Correction:
    """Range error of one frequency as a table over its measured range, for one camera.

    The table holds ``t - (y - start)`` with ``t + h(t) = y``, h what of the error depends on the range: small numbers,
    which float32 keeps to nanometres. ``start`` is its first y, ``step`` its step, metres.
    """

    def __init__(self, error: RangeError, camera: Camera) -> None:
        self.R = ambiguity(error.modulation_hz)
        fixed = error.pixels(camera).ravel()
        self.start, self.step = -float(fixed.max()) - _MARGIN * self.R, self.R / _TABLE
        count = int(((1 + 2 * _MARGIN) * self.R + float(np.ptp(fixed))) / self.step) + 2
        # An entry stands for the interval in whose middle it is computed.
        y = self.start + self.step * (np.arange(count) + 0.5)
        varying = RangeError(error.modulation_hz, scale=error.scale, harmonics=error.harmonics)
        t = y.copy()
        for _ in range(40):
            t = y - varying.at(t * 2 * np.pi / self.R, 0.0, 0.0)
        self.table = (t - y + self.start).astype(np.float32)
        self.fixed = ((fixed + self.start) / self.step).astype(np.float32)
        self.per_kelvin, self.reference = error.per_kelvin / self.step, error.reference_celsius
        self.plain = not (error.harmonics or error.scale)
        self.dark = error.per_inverse_amplitude / self.step

    def __call__(
        self,
        turns: Float32,
        at: slice,
        celsius: float,
        work: Float32,
        indices: Sequence[NDArray[Any]],
        darkness: Float32,
    ) -> None:
        """Turn phases in [0, 1) into ranges, metres, in place; ``darkness`` holds the error by amplitude, steps."""
        turns *= np.float32(self.R / self.step)
        turns -= self.fixed[at]
        if self.dark:
            turns -= darkness
        if self.per_kelvin:
            turns -= np.float32(self.per_kelvin * (celsius - self.reference))
        if self.plain:
            turns *= np.float32(self.step)
            turns += np.float32(self.start)
            return
        whole, index = indices
        np.copyto(whole, turns, casting="unsafe")
        np.copyto(index, whole)
        np.take(self.table, index, out=work, mode="clip")
        turns *= np.float32(self.step)
        turns += work
