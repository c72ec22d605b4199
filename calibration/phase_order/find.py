"""Find frequency blocks, order, sign and start of the phases of raw four-phase frames from the data alone.

``C_k = B + A cos(phi + theta_k)`` (method.md 4.1). Taps half a period apart add up to 2 B, so the second harmonic over the four
taps of a block vanishes for the right pairing and for no other. With two frequencies, ``phi_high - ratio phi_low`` is nearly constant
over the image for the right blocks and the right relative sign. What no phase can tell, whether all signs are flipped, a reference
depth tells, or else that light grows weaker with distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.phase_order.pairing import PhaseOrderRefused, pairings, phasor, usable_pixels
from calibration.phase_order.sign import (
    assign,
    described,
    find_start,
    sign_from_brightness,
    sign_from_depth,
    values_at,
)
from tofcapture.ops.phase import frequencies

START_MARGIN = 0.8  # spread of A r^2 of the best start over that of the next

__all__ = ["PhaseOrder", "PhaseOrderRefused", "find_phase_order"]


@dataclass(frozen=True)
class PhaseOrder:
    """How raw channels are to be decoded.

    Attributes
    ----------
    modulation_hz, phase_rad
        (K,) as :func:`tofcapture.ops.phase.phasors` takes them: ``C_k = B + A cos(phi + phase_rad[k])``.
    confidence
        In (0, 1]: the smallest margin of the decisions taken; below 0.2 a look at the decoded depth is advised.
    sign_from
        ``reference depth`` or ``brightness``.
    start_known
        False where the start tap is only assumed: ranges then hold up to a multiple of a quarter period.
    second_harmonic
        RMS of the taps' second harmonic over the amplitude; 0 is perfect.
    concentration
        Of ``phi_high - ratio phi_low``, 1 is constant; 1 for a single frequency.
    offset_rad
        (F,) constant phase left over against the reference depth, ascending frequencies; NaN without one.
    """

    modulation_hz: tuple[float, ...]
    phase_rad: tuple[float, ...]
    confidence: float
    sign_from: str
    start_known: bool
    second_harmonic: float
    concentration: float
    offset_rad: tuple[float, ...]


def find_phase_order(
    raw: NDArray[Any], modulation_hz: Sequence[float], radial: NDArray[np.floating] | None = None
) -> PhaseOrder:
    """Find what each raw channel is.

    Parameters
    ----------
    raw
        (frames, K, H, W), or (K, H, W), any real dtype; K is 4 per frequency; unipolar or bipolar taps.
    modulation_hz
        The one or two modulation frequencies, in any order, Hz.
    radial
        (H, W) known distance along the ray, metres, NaN where unknown; None when there is none.

    Returns
    -------
    PhaseOrder

    Raises
    ------
    DataError
        Wrong shapes, other than one or two frequencies, NaN only.
    PhaseOrderRefused
        No four-phase structure, or more than one reading fits.
    """
    taps, pixels, shape = usable_pixels(raw, modulation_hz)
    hz = frequencies(modulation_hz)
    blocks, harmonic, pairing = pairings(taps)
    if len(hz) == 1:
        chosen, steady, margin = blocks[0], 1.0, 1.0
        flips: tuple[bool, ...] = (False,)
    else:
        chosen, flips, steady, margin = assign(taps, blocks, hz[1] / hz[0])
    z = [phasor(taps, b, flip=f) for b, f in zip(chosen, flips, strict=True)]
    if radial is not None:
        turned, sign, offsets = sign_from_depth(z, hz, values_at(radial, pixels, shape))
        source, known = "reference depth", True
    else:
        sign = sign_from_brightness(z[0], pixels, shape)
        turned, start = find_start([np.conj(p) if sign < 0 else p for p in z], hz)
        source, known, offsets = "brightness", start < START_MARGIN, (float("nan"),) * len(hz)
    return PhaseOrder(
        *described(chosen, flips, hz, sign, turned),
        confidence=float(min(pairing, margin, abs(sign))),
        sign_from=source,
        start_known=known,
        second_harmonic=harmonic,
        concentration=steady,
        offset_rad=offsets,
    )
