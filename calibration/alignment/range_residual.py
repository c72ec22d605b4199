"""The range error that is left in a ToF camera, estimated as a nuisance of the alignment.

A demodulation that is not a pure sine makes planes wavy by millimetres even after a factory calibration, and ICP tilts to
follow the waves. The error is common to all views, so that the residuals of all pairs determine it together (method.md 0.4, 6):
``e = o + p rho + sum_m a_m cos(m k r) + b_m sin(m k r)``, with r the distance along the ray, ``k = 4 pi f / c`` and rho the
pixel's distance to the principal point. The offset o is told from a translation along the optical axis by the rims.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.registration.clouds import Cloud
from calibration.registration.gate import Registration, jacobian, residuals, tukey_weights
from tofcapture.camera import Camera
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT

ORDERS = (1, 2, 4)  # even orders of a square-wave light and the slow first one
PRIOR = np.array(
    [0.002, 3e-5] + [0.003] * 2 * len(ORDERS)
)  # one sigma of what a factory calibration leaves: m, m/px, m
NOISE = 0.011  # m, one sigma of a residual as if independent: 2 mm, times the root of ~30 neighbours that share their bias
STRIDE = 4  # source points skipped; thousands per view remain


@dataclass(frozen=True)
class RangeResidual:
    """The range error that is left.

    Attributes
    ----------
    camera
        Intrinsics of the ToF camera.
    modulation_hz
        The frequency whose wave number the orders are multiples of.
    coefficients
        (2 + 2 len(ORDERS),) float64: offset in metres, metres per pixel of radius, cosine and sine amplitude of each order in
        metres.
    """

    camera: Camera
    modulation_hz: float
    coefficients: Float64

    def correct(self, points: Float64) -> Float64:
        """Move points (N, 3) of the ToF frame along their rays to where they would be without the error."""
        error = self.terms(points) @ self.coefficients
        out: Float64 = points * (1 - error / np.linalg.norm(points, axis=-1))[:, None]
        return out

    def terms(self, points: Float64) -> Float64:
        """What each coefficient multiplies, (N, 2 + 2 len(ORDERS)), at points (N, 3) of the ToF frame."""
        radial = np.linalg.norm(points, axis=-1)
        focal = [self.camera.fx, self.camera.fy]
        radius = np.linalg.norm(points[:, :2] / points[:, 2:] * focal, axis=-1)
        phase = 4 * np.pi * self.modulation_hz / SPEED_OF_LIGHT * radial
        waves = [f(m * phase) for m in ORDERS for f in (np.cos, np.sin)]
        return np.stack([np.ones_like(radial), radius, *waves], axis=-1)


def no_residual(camera: Camera, modulation_hz: float) -> RangeResidual:
    """Start from nothing."""
    return RangeResidual(camera, modulation_hz, np.zeros(len(PRIOR)))


def fit_range_residual(
    sources: Sequence[Float64],
    targets: Sequence[Cloud],
    registrations: Sequence[Registration],
    start: RangeResidual,
) -> RangeResidual:
    """Estimate the range error from registered pairs.

    One linear least-squares problem in the shared coefficients and in a small motion of every pair, without which a pair's
    wrong pose would be explained by waves. Robust by Tukey's weights; a Gaussian prior keeps what the ranges at hand do not
    determine at zero.

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
    H = np.diag((NOISE / PRIOR) ** 2)
    g = -H @ start.coefficients
    for source, target, result in zip(sources, targets, registrations, strict=True):
        H_pair, g_pair = _pair_equations(source[::STRIDE], target, result, start)
        H += H_pair
        g += g_pair
    return RangeResidual(start.camera, start.modulation_hz, start.coefficients + np.linalg.solve(H, g))


def _pair_equations(
    source: Float64, target: Cloud, result: Registration, start: RangeResidual
) -> tuple[Float64, Float64]:
    found = residuals(source, target, result.T_target_source)
    points = source[found.source]
    radial = np.linalg.norm(points, axis=-1)
    rays = points / radial[:, None] @ result.T_target_source[:3, :3].T
    along = (found.normals * rays).sum(axis=-1)
    waves = start.terms(points) * along[:, None]
    weights = tukey_weights(found.distance)[:, None]
    J = jacobian(found, result.centre)
    # Schur complement: what the pair's own motion explains is taken out.
    motion = np.linalg.pinv((J * weights).T @ J)
    cross = (waves * weights).T @ J
    H = (waves * weights).T @ waves - cross @ motion @ cross.T
    g = (waves * weights).T @ found.distance - cross @ motion @ ((J * weights).T @ found.distance)
    return H, g
