"""Channels of a ToF camera as data: what its frequencies and phases determine, before any image is seen.

Channel k is ``C_k = B + A cos(phi + phase_k)`` of its frequency, or without ``B`` where taps carry no offset. A frequency f knows a
range modulo ``U = c / 2f``. Ranges of several frequencies agree on a few vectors of wraps only: :func:`wrap_table`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, DataError

Float64 = NDArray[np.float64]
Reach = tuple[float, float]
SPEED_OF_LIGHT = 299_792_458.0  # m/s, exact

#: Standard deviations of noise between two wrap vectors, at 1 rad of noise in every phase, below which they pass for one.
TOLD_APART = 0.5
BARELY_APART = 0.1  # the same, within a reach that somebody states: bright surfaces only are told apart
_MOST_WRAPS = 200  # of the highest frequency; as far as anybody looks who does not say how far
_SAME = 0.02  # as TOLD_APART counts; closer vectors are the same for everybody
_NOISE = 0.25  # wraps that noise may carry a range across a wrap's end


@dataclass(frozen=True)
class TapNoise:
    """Noise of one tap of one frame: variance ``tap / electrons_per_unit + read^2`` in raw units squared."""

    electrons_per_unit: float = 16.0  #: Photo-electrons per raw unit.
    read: float = 1.25  #: Standard deviation of the electronics, raw units.

    def __post_init__(self) -> None:
        if not (self.electrons_per_unit > 0 and 0 <= self.read < np.inf):
            raise ConfigError(
                f"noise: expected electrons_per_unit above 0 and read of 0 at least, got {self.electrons_per_unit:g} and {self.read:g}"
            )


def frequencies(modulation_hz: Sequence[float]) -> tuple[float, ...]:
    """Sort the distinct modulation frequencies, ascending."""
    return tuple(sorted({float(f) for f in modulation_hz}))


def ambiguity(modulation_hz: float) -> float:
    """Compute the unambiguous range ``c / 2f``, metres: 7.49481145 at 20 MHz, 1.49896229 at 100 MHz."""
    return SPEED_OF_LIGHT / (2 * modulation_hz)


def design(phase_rad: Sequence[float] | NDArray[np.floating], *, offset: bool) -> Float64:
    """Build the matrix (n, 3 or 2) that makes taps of ``B``, ``A cos phi`` and ``-A sin phi``; without an offset of the last two."""
    theta = np.asarray(phase_rad, dtype=np.float64)
    columns = [np.ones(len(theta))] * offset + [np.cos(theta), np.sin(theta)]
    return np.stack(columns, axis=1)


def solution(
    modulation_hz: Sequence[float], phase_rad: Sequence[float], hz: float, *, offset: bool = True
) -> tuple[NDArray[np.int64], Float64]:
    """Solve for the channels (n,) of one frequency, and their least-squares weights (3, n).

    The weights times those taps give ``B``, ``A cos phi`` and ``-A sin phi``; ``B`` is 0 without an ``offset``.
    :class:`DataError` when the phases do not determine a phasor.
    """
    k = np.flatnonzero(np.asarray(modulation_hz, dtype=np.float64) == hz)
    phases = np.asarray(phase_rad, dtype=np.float64)[k]
    matrix = design(phases, offset=offset)
    if len(k) < matrix.shape[1] or np.linalg.cond(matrix) > 1e3:
        least = "three phases, spread over the turn" if offset else "two phases that are not opposite"
        raise DataError(
            f"{hz / 1e6:g} MHz: the phases {np.degrees(phases).round(3).tolist()} deg do not determine a phasor; expected at least "
            f"{least}",
            hint="two are enough where taps carry no offset, as I and Q do: offset = false" if offset else "",
        )
    # Rounded, so that a half is a half: of equal taps nothing is left, not 1e-14 on either side of a wrap.
    weights = np.zeros((3, len(k)))
    weights[0 if offset else 1 :] = np.linalg.pinv(matrix).round(15)
    return k, weights


def check_channels(
    modulation_hz: Sequence[float],
    phase_rad: Sequence[float],
    *,
    offset: bool,
    reach: Reach | None,
    where: str,
) -> None:
    """Refuse channels that nobody could decode, by name.

    :class:`DataError`: none at all, not one phase for each frequency, numbers that are not finite, phases that determine no phasor,
    a reach of ranges that is empty or longer than the frequencies tell apart.
    """
    K = len(modulation_hz)
    if not K or len(phase_rad) != K:
        raise DataError(
            f"{where}: expected a phase for each of {K} channels, at least one, got {len(phase_rad)} phases"
        )
    if not (np.isfinite(modulation_hz).all() and min(modulation_hz) > 0 and np.isfinite(phase_rad).all()):
        raise DataError(
            f"{where}: expected frequencies above 0 Hz and finite phases, got {list(modulation_hz)} Hz, {list(phase_rad)} rad"
        )
    hz = frequencies(modulation_hz)
    if min(hz) < 1e5:
        raise DataError(f"{where}: expected frequencies in Hz, got {min(hz):g}", hint="20 MHz are 20e6")
    for f in hz:
        try:
            solution(modulation_hz, phase_rad, f, offset=offset)
        except DataError as err:
            raise DataError(f"{where}: {err.message}", err.hint) from None
    if reach is None:
        return
    low, high = reach
    if not (np.isfinite(reach).all() and 0 <= low < high):
        raise DataError(
            f"{where}: expected a reach of two ranges in metres, ascending from 0, got {list(reach)}"
        )
    most = unambiguous(hz, BARELY_APART)
    if high - low > most * (1 + 1e-9):
        raise DataError(
            f"{where}: {', '.join(f'{f / 1e6:g}' for f in hz)} MHz tell ranges apart over {most:.3f} m only, "
            f"and the reach is {low:g} to {high:g} m",
            hint="state a shorter reach, or record with one more frequency",
        )


def mismatch(ranges: NDArray[np.floating], hz: Sequence[float]) -> Float64:
    """Compute how far unwrapped ranges (..., F) of frequencies (F,) are from agreeing, as :data:`TOLD_APART` counts."""
    return _fitted(np.asarray(ranges, dtype=np.float64), np.array([ambiguity(f) for f in hz]))[1]


def _fitted(ranges: Float64, U: Float64) -> tuple[Float64, Float64]:
    """Fit one range (...) to ranges (..., F) of equal phase noise, and say by how much it misfits."""
    weight = np.square(2 * np.pi / U)
    fitted = ranges @ weight / weight.sum()
    return fitted, np.sqrt(np.square(ranges - fitted[..., None]) @ weight)


def channels_in_words(modulation_hz: Sequence[float], phase_rad: Sequence[float]) -> str:
    """Say what the channels are: "20 MHz at 0, 90, 180, 270 deg, then 100 MHz at 0, 90, 180, 270 deg"."""
    runs: list[tuple[float, list[str]]] = []
    for hz, phase in zip(modulation_hz, phase_rad, strict=True):
        if not runs or runs[-1][0] != hz:
            runs.append((hz, []))
        runs[-1][1].append(f"{np.degrees(phase):.4g}")
    return ", then ".join(f"{hz / 1e6:g} MHz at {', '.join(phases)} deg" for hz, phases in runs)


def unambiguous(hz: Sequence[float], apart: float = TOLD_APART) -> float:
    """Compute the range over which distinct frequencies (F,), Hz, tell all ranges apart, metres.

    It is the least common multiple of their ambiguities where ratios are whole numbers. Where they are not, it is the range at
    which two wrap vectors are less than ``apart``, less some noise: 20.0 and 99.9 MHz are good for 7.50 m.
    """
    period, gap = _repeat(hz, apart)
    return period if gap < _SAME else period - 2 * _NOISE * ambiguity(max(hz))


def _repeat(hz: Sequence[float], apart: float) -> tuple[float, float]:
    """Find the first range at which wraps of all frequencies coincide but for ``apart``, and by how much they do not."""
    U = np.array([ambiguity(f) for f in hz])
    if len(U) == 1:
        return float(U[0]), 0.0
    top = np.arange(1, _MOST_WRAPS + 1)[:, None] * U.min()
    range_, gap = _fitted(np.rint(top / U) * U, U)
    same = np.flatnonzero(gap < apart)
    first = same[0] if len(same) else -1
    return float(range_[first]), float(gap[first])


class WrapTable(NamedTuple):
    """Hold the wraps that F frequencies, ascending, may have within their reach.

    Once the wraps of the highest frequency are chosen, those of the others are the nearest ones: a vector of wraps is its number.
    """

    tops: Float64  #: (J,) metres that each number of wraps adds to the range of the highest frequency
    U: Float64  #: (F,) ambiguities, metres
    lean: Float64  #: (F,) shares in the range: inverse variances at equal phase noise; their sum is 1
    period: float  #: metres after which ranges look the same
    start: float  #: metres; ranges are given from here over one period
    bounds: Float64  #: (2,) metres, ranges of the highest frequency within the reach and its noise; infinite when all are
    apart: float  #: closest two vectors, as :data:`TOLD_APART` counts; infinite when there is one


def wrap_table(
    hz: Sequence[float], information: Sequence[float] | Float64, reach: Reach | None = None
) -> WrapTable:
    """List the wraps of frequencies (F,) that ranges of the ``reach``, metres, may show, and noise at its ends.

    ``information`` (F,) is that of each phasor per power and tap variance: half the number of phases where they are evenly
    spread. Without a reach it is all that the frequencies tell apart.
    """
    U = np.array([ambiguity(f) for f in hz])
    low, high = reach or (0.0, unambiguous(hz))
    period, gap = _repeat(hz, TOLD_APART if high - low <= unambiguous(hz) else BARELY_APART)
    first, last = np.floor(low / U[-1] - _NOISE), np.ceil(high / U[-1] + _NOISE)
    most = round(period / U[-1])  # more look like the first ones
    if last - first > most:
        first = np.floor((low + high) / 2 / U[-1] - most / 2 + 0.5)
        last = first + most
    wraps = np.arange(first, last)
    steps = np.arange(1, len(wraps))[:, None] * U[-1]
    gaps = _fitted(np.rint(steps / U) * U, U)[1]
    weight = np.asarray(information) / np.square(U)
    noise = _NOISE * U[-1]
    whole = gap < _SAME and high - low > period - 2 * noise  # what is beyond an end looks like the other end
    bounds = np.array([-np.inf, np.inf]) if whole else np.array([max(low - noise, 0.0), high + noise])
    apart = float(gaps.min(initial=np.inf))
    return WrapTable(
        wraps * U[-1], U, weight / weight.sum(), period, (low + high - period) / 2, bounds, apart
    )


def parse_reach(value: object, where: str) -> Reach | None:
    """Read a ``reach``, two numbers or nothing; :class:`ConfigError` for anything else."""
    if value is None:
        return None
    try:
        low, high = map(float, value)  # type: ignore[call-overload]
    except (TypeError, ValueError) as err:
        raise ConfigError(f"{where}: reach: expected two ranges in metres, got {value!r}") from err
    return low, high


def noise_table(noise: TapNoise | None) -> dict[str, float | None] | None:
    """Write noise as JSON types; where light makes none there are no electrons per unit."""
    if noise is None:
        return None
    gain = noise.electrons_per_unit
    return {"electrons_per_unit": gain if np.isfinite(gain) else None, "read": noise.read}


def parse_noise(value: object, where: str) -> TapNoise | None:
    """Read what :func:`noise_table` wrote, or nothing; :class:`ConfigError` for anything else."""
    if value is None:
        return None
    try:
        gain, read = value.get("electrons_per_unit"), value["read"]  # type: ignore[attr-defined, index]
        return TapNoise(np.inf if gain is None else float(gain), float(read))
    except (AttributeError, KeyError, TypeError, ValueError) as err:
        expected = "{electrons_per_unit = 16.0, read = 1.25}, raw units"
        raise ConfigError(f"{where}: noise: expected {expected}, got {value!r}") from err
