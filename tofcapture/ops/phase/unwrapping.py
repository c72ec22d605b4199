"""Which wrap of the high frequency: by the low one alone, or with the neighbours' support.

With two frequencies the likelihood of both phasors chooses the very wrap that rounding chooses, whatever the amplitudes:
its best value within a wrap falls with the gap that this wrap leaves. Fewer wrong wraps come from neighbours only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError
from tofcapture.ops.phase.phasors import Float64

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
