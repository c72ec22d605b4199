"""Define what the fast decoder is made of: taps to I and Q, these to phase, phase to range, ranges to wraps; float32.

Only additions, products, quotients and square roots are used, in one order, so that the same frame gives the same bits on every
machine.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import ambiguity, design, frequencies, solution
from tofcapture.frames import TofInfo
from tofcapture.libraries import compiled
from tofcapture.rig import RangeError

Float32 = NDArray[np.float32]
Real = float | np.floating[Any]

_TABLE = 1 << 14  # entries over one ambiguity: nearest is right to 5 micrometres for slopes of 0.1 at 100 MHz
_MARGIN = 0.5  # of an ambiguity beyond what a frame may hold, so that any temperature is inside the table
_BLOCK = 2048  # pixels; what a block needs stays in a core's nearest cache
SURE = 20.0  # of the log likelihood ratio, doubled, to the second-best wraps: wrong in one of 10,000; else neighbours are asked
DOUBTFUL = 9.0  # of the same, below which wraps are flagged
CLOSE = 9.0  # times the best misfit squared is less than the second's, or wraps are flagged: a quarter of the way between them
UNLIKELY = 16.0  # of the same: what a pixel itself rules out so clearly no neighbours make likely
_ONE, _HALF, _TINY = np.float32(1), np.float32(0.5), np.float32(1e-30)
# atan(t) / pi = t P(t^2) on [-1, 1], minimax to 5e-7 turns: 0.8 micrometres of range at 100 MHz.
_A0, _A1, _A2, _A3, _A4, _A5 = (
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
# sin(2 pi t) = t P(t^2) on [-1/4, 1/4], to 3e-6
_S0, _S1, _S2, _S3 = (np.float32(c) for c in (6.2831630, -41.3371480, 81.3407060, -70.9934340))


class TapRows(NamedTuple):
    """Hold weights (R, K) of taps, and where the rows of a frequency lie."""

    weights: NDArray[
        np.float64
    ]  #: I of F frequencies, Q of them, mean tap of the highest one, then what no cosine explains
    spare: tuple[
        tuple[int, int], ...
    ]  #: (F,) first row, and number, of what of a frequency's taps no cosine explains


def tap_rows(info: TofInfo) -> TapRows:
    """Compute the rows that turn taps into phasors, the mean tap, and unit combinations that are noise alone."""
    hz = frequencies(info.modulation_hz)
    F, K = len(hz), len(info.modulation_hz)
    rows, spare = [np.zeros(K) for _ in range(2 * F + 1)], []
    for i, f in enumerate(hz):
        channels, (mean, cosine, sine) = solution(info.modulation_hz, info.phase_rad, f, offset=info.offset)
        rows[i][channels], rows[F + i][channels] = cosine, -sine
        if i == F - 1:
            rows[2 * F][channels] = mean
        matrix = design(np.asarray(info.phase_rad)[channels], offset=info.offset)
        left = np.linalg.svd(matrix)[0][:, matrix.shape[1] :].T
        spare.append((len(rows), len(left)))
        for combination in left:
            row = np.zeros(K)
            row[channels] = combination
            rows.append(row)
    weights = np.stack(rows)
    weights[np.abs(weights) < 1e-12] = 0.0
    opposite = weights[F - 1] != 0
    if info.offset and opposite.sum() == 2 and abs(weights[F - 1].sum()) < 1e-12:
        weights[2 * F] = np.where(opposite, 0.5, 0.0)  # two opposite taps have the mean of all
    return TapRows(weights.round(15), tuple(spare))


def sparse(weights: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], Float32]:
    """List the entries of rows (R, K) that are not 0: where each row starts (R + 1,), columns, values."""
    rows, columns = np.nonzero(weights)
    return (
        np.searchsorted(rows, np.arange(len(weights) + 1)),
        columns,
        weights[rows, columns].astype(np.float32),
    )


@compiled
def combine(raw: NDArray[Any], starts: Any, columns: Any, weights: Any, out: Float32) -> None:
    """Add weighted taps (K, N) up to rows (R, N); a row without entries is 0."""
    n = raw.shape[1]
    for begin in range(0, n, _BLOCK):
        end = min(begin + _BLOCK, n)
        for row in range(len(starts) - 1):
            total = out[row, begin:end]
            total[:] = np.float32(0)
            for s in range(starts[row], starts[row + 1]):
                taps, weight = raw[columns[s], begin:end], weights[s]
                for i in range(len(total)):
                    total[i] += weight * np.float32(taps[i])


@compiled
def _turns(real: Any, imag: Any, size: Any) -> Any:
    """Compute the phase of a phasor in turns, [0, 1]: ``phi = 2 atan(imag / (size + |real|))``, on the left half a turn minus that."""
    t = imag / (size + abs(real) + _TINY)
    x = t * t
    turns = t * (_A0 + x * (_A1 + x * (_A2 + x * (_A3 + x * (_A4 + x * _A5)))))
    turns = _HALF - turns if real < 0 else turns
    return turns - np.floor(turns)


@compiled
def _sine(turns: Any) -> Any:
    """Compute the sine of any number of turns."""
    t = turns - np.floor(turns + _HALF)
    t = _HALF - t if t > np.float32(0.25) else t
    t = -_HALF - t if t < np.float32(-0.25) else t
    x = t * t
    return t * (_S0 + x * (_S1 + x * (_S2 + x * _S3)))


@lru_cache(maxsize=8)
def correction(error: RangeError, camera: Camera) -> Correction:
    """Return the table of a range error for a camera, made once: it takes longer than decoding a burst."""
    return Correction(error, camera)


class Correction:
    """Range error of one frequency as a table over its measured range, for one camera.

    The table holds ``t - (y - start)`` with ``t + h(t) = y``, h what of the error depends on the range: small numbers,
    which float32 keeps to nanometres. ``start`` is its first y, ``step`` its step, metres.
    """

    def __init__(self, error: RangeError, camera: Camera) -> None:
        self.R = ambiguity(error.modulation_hz)
        # By whole ambiguities nothing changes: small numbers are kept more exactly.
        fixed = error.pixels(camera).ravel()
        fixed = fixed - self.R * np.rint(np.median(fixed) / self.R)
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

    def of(self, pixels: NDArray[np.intp]) -> Correction:
        """Return the same for some pixels (n,) only."""
        some = copy(self)
        some.fixed = self.fixed[pixels]
        return some

    def __call__(self, real: Float32, imag: Float32, celsius: float, power: Float32, out: Float32) -> None:
        """Turn phasors (N,) into power, raw units squared, and ranges in [0, R], metres."""
        drift = self.per_kelvin * (celsius - self.reference)
        table = np.array([self.start], np.float32) if self.plain else self.table
        steps, warm, dark, step, R = map(
            np.float32, (self.R / self.step, drift, self.dark, self.step, self.R)
        )
        _ranges(real, imag, self.fixed, table, steps, warm, dark, step, R, power, out)


@compiled
def _ranges(
    real: Float32, imag: Float32, fixed: Float32, table: Float32, steps: Real, warm: Real, dark: Real, step: Real, R: Real,
    power: Float32, out: Float32,
) -> None:  # fmt: skip
    inverse = _ONE / R
    for i in range(len(real)):
        power[i] = real[i] * real[i] + imag[i] * imag[i]
        size = np.sqrt(power[i])
        out[i] = _turns(real[i], imag[i], size) * steps - fixed[i] - warm
        if dark != 0:
            out[i] -= dark / (size + _TINY)
    last = len(table) - 1
    if last == 0:
        for i in range(len(real)):
            out[i] = out[i] * step + table[0]
    else:
        for i in range(len(real)):
            entry = int(out[i]) if out[i] > 0 else 0  # NaN compares false
            out[i] = out[i] * step + table[min(last, entry)]
    for i in range(len(real)):
        out[i] -= R * np.floor(out[i] * inverse)


@compiled
def choose(
    ranges: Float32, power: Float32, variance: Float32, tops: Float32, bounds: Float32, U: Float32, weight: Float32, unit: Float32, limit: Real,
    which: NDArray[np.int32], margin: Float32, doubt: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Choose the wraps of each pixel by maximum likelihood.

    Parameters
    ----------
    ranges, power
        (F, N) wrapped ranges, metres, and power of the phasors.
    variance
        (N,) of a tap.
    tops, bounds, U
        (J,) metres that wraps add to the highest frequency, (2,) least and largest sum, and ambiguities (F,).
    weight, unit
        (F,) inverse variance of a range per power and tap variance; and of equal phase noise of 1 rad.
    limit
        Misfit at equal phase noise, radians squared, from which wraps are doubted.
    which, margin, doubt
        (N,) index of ``tops``; chi squared from it to the next; whether it is to be flagged.
    """
    F, n = ranges.shape
    top = F - 1
    scale = np.float32(0)
    for k in range(F):
        scale += unit[k]
    w, e = np.empty((F, _BLOCK), np.float32), np.empty((F, _BLOCK), np.float32)
    inverse, best = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    cost, linear = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    for begin in range(0, n, _BLOCK):
        m = min(_BLOCK, n - begin)
        chosen, second = which[begin : begin + m], margin[begin : begin + m]
        highest, strength = ranges[top, begin : begin + m], power[top, begin : begin + m]
        for i in range(m):
            inverse[i] = weight[top] * strength[i]
            best[i] = second[i] = np.float32(np.inf)
            chosen[i] = 0
        for k in range(top):
            wk, ek, power_k, ranges_k = w[k], e[k], power[k, begin : begin + m], ranges[k, begin : begin + m]
            for i in range(m):
                wk[i] = weight[k] * power_k[i]
                inverse[i] += wk[i]
                ek[i] = ranges_k[i] - highest[i]
        for i in range(m):
            inverse[i] = _ONE / (inverse[i] + _TINY)
        for j in range(len(tops)):
            if top == 1:  # no sum of what cancels: the one difference between the two
                w0, e0, period, inverse_period = w[0], e[0], U[0], _ONE / U[0]
                for i in range(m):
                    x = e0[i] - tops[j]
                    x -= period * np.floor(x * inverse_period + _HALF)
                    cost[i] = x * x * w0[i]
            elif top == 2:  # as below, in one pass
                w0, e0, w1, e1 = w[0], e[0], w[1], e[1]
                U0, U1, inverse0, inverse1 = U[0], U[1], _ONE / U[0], _ONE / U[1]
                for i in range(m):
                    x, z = e0[i] - tops[j], e1[i] - tops[j]
                    x -= U0 * np.floor(x * inverse0 + _HALF)
                    z -= U1 * np.floor(z * inverse1 + _HALF)
                    y, t = w0[i] * x, w1[i] * z
                    cost[i] = y * x + t * z - (y + t) * (y + t) * inverse[i]
            else:
                cost[:] = linear[:] = np.float32(0)
                for k in range(top):
                    wk, ek, period, inverse_period = w[k], e[k], U[k], _ONE / U[k]
                    for i in range(m):
                        x = ek[i] - tops[j]
                        x -= period * np.floor(x * inverse_period + _HALF)
                        y = wk[i] * x
                        cost[i] += y * x
                        linear[i] += y
                for i in range(m):
                    cost[i] -= linear[i] * linear[i] * inverse[i]
            number = np.int32(j)
            for i in range(m):
                far = highest[i] + tops[j]
                cost[i] = cost[i] if (far >= bounds[0]) & (far <= bounds[1]) else np.float32(np.inf)
                larger = max(best[i], cost[i])
                second[i] = min(second[i], larger)
                chosen[i] = number if cost[i] < best[i] else chosen[i]
                best[i] = min(best[i], cost[i])
        # What the best vector misfits at equal phase noise.
        if top == 1:
            w0, share = w[0], unit[0] * unit[1] / scale
            for i in range(m):
                cost[i] = best[i] / (w0[i] + _TINY) * share
                inverse[i] *= (
                    weight[top] * strength[i]
                )  # of the misfit: what the second range does not follow
        else:
            cost[:] = np.float32(0)
            linear[:] = np.float32(0)
            inverse[:] = _ONE
            for k in range(top):
                ek = e[k]
                for i in range(m):
                    x = ek[i] - tops[chosen[i]]
                    x -= U[k] * np.floor(x / U[k] + _HALF)
                    cost[i] += unit[k] * x * x
                    linear[i] += unit[k] * x
            for i in range(m):
                cost[i] -= linear[i] * linear[i] / scale
        noise, doubted = variance[begin : begin + m], doubt[begin : begin + m]
        for i in range(m):
            close = np.float32(CLOSE) * best[i] > second[i]
            second[i] = (second[i] - best[i]) * inverse[i] / noise[i]
            doubted[i] = (cost[i] > limit) | close | (second[i] < np.float32(DOUBTFUL))


@compiled
def ask(
    unsure: NDArray[np.int64], radius: int, ranges: Float32, power: Float32, variance: Float32, good: NDArray[np.bool_],
    tops: Float32, bounds: Float32, U: Float32, weight: Float32, which: Any, doubt: Any,
) -> None:  # fmt: skip
    """Choose the wrap vector of some pixels with their neighbours' support.

    The window's phasors, turned by how much farther than the pixel the highest frequency says each neighbour is, are added up,
    weighted by ``cos^4`` of half that difference: other surfaces have no say. What the pixel itself rules out is not taken.

    ``unsure`` are flat indices; images are (F, H, W) and (H, W); others as for :func:`choose`.
    """
    F, H, W = ranges.shape
    top, J = F - 1, len(tops)
    real, imag = np.empty(F, np.float32), np.empty(F, np.float32)
    e, own, w, p = (
        np.empty(F, np.float32),
        np.empty(F, np.float32),
        np.empty(F, np.float32),
        np.empty(F, np.float32),
    )
    for at in unsure:
        v, u = at // W, at % W
        real[:], imag[:] = np.float32(0), np.float32(0)
        shared = np.float32(0)
        here = ranges[top, v, u]
        for y in range(max(v - radius, 0), min(v + radius + 1, H)):
            for x in range(max(u - radius, 0), min(u + radius + 1, W)):
                if not good[y, x]:
                    continue
                farther = (ranges[top, y, x] - here) / U[top]
                farther -= np.floor(farther + _HALF)
                alike = _HALF + _HALF * _sine(farther + np.float32(0.25))
                alike *= alike
                shared += alike * alike
                real[top] += alike * np.sqrt(power[top, y, x])
                for k in range(top):
                    turns = (ranges[k, y, x] - farther * U[top]) / U[k]
                    size = alike * np.sqrt(power[k, y, x])
                    real[k] += size * _sine(turns + np.float32(0.25))
                    imag[k] += size * _sine(turns)
        if shared <= 0:
            continue
        total, own_total = np.float32(0), np.float32(0)
        for k in range(F):
            square = real[k] * real[k] + imag[k] * imag[k]
            w[k], p[k] = weight[k] * square / shared, weight[k] * power[k, v, u]
            total += w[k]
            own_total += p[k]
            e[k] = _turns(real[k], imag[k], np.sqrt(square)) * U[k] - here
            own[k] = ranges[k, v, u] - here
        best, second, found, mine, least = (
            np.float32(np.inf),
            np.float32(np.inf),
            0,
            np.float32(0),
            np.float32(np.inf),
        )
        for j in range(J):
            square, linear, own_square, own_linear = (
                np.float32(0),
                np.float32(0),
                np.float32(0),
                np.float32(0),
            )
            for k in range(top):
                a, b = e[k] - tops[j], own[k] - tops[j]
                a -= U[k] * np.floor(a / U[k] + _HALF)
                b -= U[k] * np.floor(b / U[k] + _HALF)
                square += w[k] * a * a
                linear += w[k] * a
                own_square += p[k] * b * b
                own_linear += p[k] * b
            cost = square - linear * linear / (total + _TINY)
            own_cost = own_square - own_linear * own_linear / (own_total + _TINY)
            if here + tops[j] < bounds[0] or here + tops[j] > bounds[1]:
                continue
            least = min(least, own_cost)
            if cost < best:
                best, second, found, mine = cost, best, j, own_cost
            elif cost < second:
                second = cost
        if mine - least <= np.float32(UNLIKELY) * variance[v, u]:
            which[v, u] = found
            doubt[v, u] = (
                second - best < np.float32(DOUBTFUL) * variance[v, u] or np.float32(CLOSE) * best > second
            )


@compiled
def finish(
    ranges: Float32, which: Any, tops: Float32, U: Float32, lean: Float32, start: Real, period: Real, length: Float32, slant: Float32,
    quarter: Real, nearest: Real, bad: Any, depth: Float32, rounds: Float32,
) -> None:  # fmt: skip
    """Unwrap the ranges (F, N), fuse them within one period from ``start``, and turn them into depth (N,).

    ``z = (D^2 - |s|^2 / 4) / (D L - r . s / 2)``, r the ray with z = 1, L its length, s the light source.
    """
    F, n = ranges.shape
    for begin in range(0, n, _BLOCK):
        end = min(begin + _BLOCK, n)
        fused, chosen, highest = depth[begin:end], which[begin:end], ranges[F - 1, begin:end]
        for i in range(len(fused)):
            highest[i] += tops[chosen[i]]
            fused[i] = lean[F - 1] * highest[i]
        for k in range(F - 1):
            own, share, period_k, inverse_period = ranges[k, begin:end], lean[k], U[k], _ONE / U[k]
            for i in range(len(fused)):
                x = own[i] - highest[i]
                own[i] -= period_k * np.floor(x * inverse_period + _HALF)
                fused[i] += share * own[i]
    for i in range(n):
        rounds[i] = period * np.floor((depth[i] - start) / period)
        D = depth[i] - rounds[i]
        bad[i] |= not nearest < D
        depth[i] = (D * D - quarter) / (D * length[i] - slant[i]) if not bad[i] else np.float32(np.nan)


@compiled
def dim(power: Float32, variance: Float32, limits: Float32, bit: int, flags: NDArray[np.uint8]) -> None:
    """Flag pixels (N,) whose range is uncertain: ``sum_k limit_k / power_k`` times the variance of a tap is above 1."""
    n = power.shape[1]
    total = np.zeros(n, np.float32)
    for k in range(len(limits)):
        own = power[k]
        for i in range(n):
            total[i] += limits[k] / own[i]
    for i in range(n):
        flags[i] |= np.uint8(0 if total[i] * variance[i] < _ONE else bit)


@compiled
def inconsistent(
    spare: Float32, power: Float32, variance: Float32, saturated: Any, rare: Real, odd: Real, noisier: Real, gross: Real, bit: int,
    flags: NDArray[np.uint8], rows: Any, columns: Any,
) -> None:  # fmt: skip
    """Flag pixels (N,) in which the sum of squares of ``spare`` (R, N) is beyond noise, and count odd ones in each row and column.

    ``rare`` and ``odd`` are chi squared that noise seldom and sometimes exceeds, ``noisier`` how many times its variance the frame has,
    ``gross`` a share of power.
    """
    n = spare.shape[1]
    misfit = np.zeros(n, np.float32)
    for row in range(spare.shape[0]):
        own = spare[row]
        for i in range(n):
            misfit[i] += own[i] * own[i]
    W = len(columns)
    rows[:] = columns[:] = 0
    for v in range(len(rows)):
        count = 0
        for u in range(W):
            i = v * W + u
            noise, most = variance[i] * noisier, power[i] * gross
            limit = max(variance[i] * rare, min(noise * rare, most))
            flags[i] |= np.uint8(bit if (misfit[i] > limit) & (not saturated[i]) else 0)
            strange = 1 if (misfit[i] > noise * odd) & (not saturated[i]) else 0
            count += strange
            columns[u] += strange
        rows[v] = count


@compiled
def repeated(taps: NDArray[Any], step: int, lines: Any) -> None:
    """Note rows (H,) of taps (K, H, W) along which some taps, not most, say the same in every ``step``-th pixel: they are stuck."""
    K, H, W = taps.shape
    for v in range(H):
        same = 0
        for k in range(K):
            u = step
            while u < W and taps[k, v, u] == taps[k, v, 0]:
                u += step
            same += 1 if u >= W else 0
        lines[v] = 0 < same <= K // 2
