"""The range error that is left in a ToF camera, estimated as a nuisance of the alignment.

A demodulation that is not a pure sine makes planes wavy by millimetres even after a factory calibration, and ICP tilts to
follow the waves. The waves are a function of the range alone, common to all views, so that the point-to-plane residuals of
all pairs determine them together: ``e(r) = sum_m a_m cos(m k r) + b_m sin(m k r)``, ``k = 4 pi f / c`` (method.md 0.4, 6).

A constant offset is left out on purpose: it acts like a translation along the optical axis and is not observable here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.clouds import Cloud
from calibration.registration import Registration, jacobian, residuals, tukey_weights
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT

ORDERS = (1, 2, 4)  # even orders of a square-wave light and the slow first one
PRIOR = 0.003  # m, one sigma of a coefficient: a factory calibration leaves no more
NOISE = 0.011  # m, one sigma of a residual as if independent: 2 mm, times the root of ~30 neighbours that share their bias
STRIDE = 4  # source points skipped; thousands per view remain


@dataclass(frozen=True)
class RangeResidual:
    """Harmonics of the range error that is left.

    Attributes
    ----------
    modulation_hz
        The frequency whose wave number they are multiples of.
    coefficients
        (2 len(ORDERS),) float64 metres: cosine and sine amplitude of each order.
    """

    modulation_hz: float
    coefficients: Float64

    def correct(self, points: Float64) -> Float64:
        """Move points (N, 3) of the ToF frame along their rays to where they would be without the error."""
        radial = np.linalg.norm(points, axis=-1)
        error = _harmonics(radial, self.modulation_hz) @ self.coefficients
        return points * (1 - error / radial)[:, None]


def no_residual(modulation_hz: float) -> RangeResidual:
    """Start from nothing."""
    return RangeResidual(modulation_hz, np.zeros(2 * len(ORDERS)))


def fit_range_residual(
    sources: Sequence[Float64], targets: Sequence[Cloud], registrations: Sequence[Registration], start: RangeResidual
) -> RangeResidual:
    """Estimate the range error from registered pairs.

    One linear least-squares problem in the shared harmonics and in a small motion of every pair, without which a pair's
    wrong pose would be explained by waves. Robust by Tukey's weights; a Gaussian prior keeps what the ranges at hand do not
    determine at ``start``.

    Parameters
    ----------
    sources
        ToF points (N, 3) of each pair, as already corrected by ``start``, metres.
    targets, registrations
        Cloud and result of each pair.
    start
        What was corrected before.

    Returns
    -------
    RangeResidual
        Start plus the correction found.
    """
    size = len(start.coefficients)
    H = np.eye(size) * (NOISE / PRIOR) ** 2
    g = -H @ start.coefficients
    for source, target, result in zip(sources, targets, registrations, strict=True):
        H_pair, g_pair = _pair_equations(source[::STRIDE], target, result, start.modulation_hz)
        H += H_pair
        g += g_pair
    return RangeResidual(start.modulation_hz, start.coefficients + np.linalg.solve(H, g))


def _pair_equations(
    source: Float64, target: Cloud, result: Registration, modulation_hz: float
) -> tuple[Float64, Float64]:
    found = residuals(source, target, result.T_target_source)
    points = source[found.source]
    radial = np.linalg.norm(points, axis=-1)
    rays = points / radial[:, None] @ result.T_target_source[:3, :3].T
    along = (found.normals * rays).sum(axis=-1)
    waves = _harmonics(radial, modulation_hz) * along[:, None]
    weights = tukey_weights(found.distance)[:, None]
    J = jacobian(found, result.centre)
    # Schur complement: what the pair's own motion explains is taken out.
    motion = np.linalg.pinv((J * weights).T @ J)
    cross = (waves * weights).T @ J
    H = (waves * weights).T @ waves - cross @ motion @ cross.T
    g = (waves * weights).T @ found.distance - cross @ motion @ ((J * weights).T @ found.distance)
    return H, g


def _harmonics(radial: NDArray[np.floating], modulation_hz: float) -> Float64:
    phase = 4 * np.pi * modulation_hz / SPEED_OF_LIGHT * np.asarray(radial, dtype=np.float64)
    return np.stack([f(m * phase) for m in ORDERS for f in (np.cos, np.sin)], axis=-1)
