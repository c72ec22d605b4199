"""Range errors per modulation frequency as linear unknowns, and their way into ``rig.toml``.

``e_f = o + p rho + sum_m a_m cos(m phi) + b_m sin(m phi)``, phi the phase of the modulation f over the whole path, rho the
pixel's distance to the principal point (docs: method 0.4), and beside it the light that the lens scatters, whose shares are
common to all frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.alignment.joint_views import HALO_RADII, JointView
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT, RangeError

ORDERS = (1, 2, 4)  # the slow first one and the even orders of a square-wave light
TERMS = 2 + 2 * len(ORDERS)
# One sigma of what is not known before, wide enough for a camera without a factory calibration. It only settles what the
# views do not: metres, metres per pixel, metres, share of the light.
PRIOR_OFFSET = 0.02
PRIOR_RADIUS = 2e-4
PRIOR_HARMONIC = 0.006
PRIOR_HALO = 0.003


def unknowns(frequencies: int) -> int:
    """How many coefficients describe the range error of so many frequencies."""
    return frequencies * TERMS + len(HALO_RADII)


def prior_sigma(frequencies: int) -> Float64:
    """One sigma (U,) of each coefficient before any view was seen."""
    own = [PRIOR_OFFSET, PRIOR_RADIUS, *[PRIOR_HARMONIC] * (2 * len(ORDERS))]
    return np.array(own * frequencies + [PRIOR_HALO] * len(HALO_RADII))


def design(view: JointView, frequency: int, coefficients: Float64) -> Float64:
    """What each coefficient multiplies, (N, U), in the range error of one frequency at a view's pixels.

    The error is a function of the true range, so the measured one is first freed of ``coefficients`` (U,).
    """
    count = len(view.modulation_hz)
    out = np.zeros((len(view.rays), unknowns(count)))
    out[:, count * TERMS :] = view.halos[frequency]
    own = slice(frequency * TERMS, (frequency + 1) * TERMS)
    true = view.ranges[frequency]
    for _ in range(2):
        phase = 4 * np.pi * view.modulation_hz[frequency] / SPEED_OF_LIGHT * true
        waves = [f(m * phase) for m in ORDERS for f in (np.cos, np.sin)]
        out[:, own] = np.stack([np.ones_like(phase), view.radius_px, *waves], axis=-1)
        true = view.ranges[frequency] - out @ coefficients
    return out


def composed(
    factory: Sequence[RangeError], modulation_hz: Sequence[float], coefficients: Float64
) -> tuple[RangeError, ...]:
    """Sum of the factory's range errors and the fitted ones, one per frequency.

    Parameters
    ----------
    factory
        What was taken off before the fit; may lack frequencies.
    modulation_hz
        (F,) ascending.
    coefficients
        (U,) of :func:`design`; shares of scattered light have no place in a :class:`RangeError` and are left out.
    """
    known = {e.modulation_hz: e for e in factory}
    return tuple(
        _sum(known.get(hz, RangeError(hz)), coefficients[i * TERMS : (i + 1) * TERMS])
        for i, hz in enumerate(modulation_hz)
    )


def _sum(error: RangeError, own: Float64) -> RangeError:
    waves = {m: np.array([a, b]) for m, a, b in error.harmonics}
    for i, m in enumerate(ORDERS):
        waves[m] = waves.get(m, np.zeros(2)) + own[2 + 2 * i : 4 + 2 * i]
    return replace(
        error,
        offset=error.offset + float(own[0]),
        per_pixel_radius=error.per_pixel_radius + float(own[1]),
        harmonics=tuple((m, float(a), float(b)) for m, (a, b) in sorted(waves.items())),
    )
