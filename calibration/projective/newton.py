"""Robust Gauss-Newton on SE(3) for rays that meet tangent planes.

Only elementwise operations and sums in a fixed order over the points: no BLAS, no threads, so that the same input gives the
same bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.poses import Float64, rotation_exp, transform

MAX_TURN = np.radians(4.0)  # of one step; farther the planes no longer say where to
MAX_SHIFT = 0.05  # m, of one step
_RIDGE = 1e-9  # of the trace: keeps a lone plane's normal matrix invertible


@dataclass(frozen=True)
class Match:
    """Linearised residuals of the rays that met a plane.

    Attributes
    ----------
    rays
        (M,) indices of the rays.
    points
        (3, M) where the rays should have ended, target frame, metres.
    normals
        (3, M) unit normals there.
    distance
        (M,) signed distance of the measured points to the tangent planes, metres.
    variance
        (M,) of ``distance``, m^2.
    reach
        (M,) predicted length of the rays, metres.
    seen
        How many rays end in the camera's field of view, whether they meet a plane there or not.
    """

    rays: NDArray[np.intp]
    points: Float64
    normals: Float64
    distance: Float64
    variance: Float64
    reach: Float64
    seen: int = 0


def tukey(u: Float64) -> Float64:
    """Tukey's weight ``(1 - u^2)^2`` of residuals in units of the kernel's scale; zero from 1 on."""
    out: Float64 = np.square(np.maximum(1 - np.square(u), 0))
    return out


def normal_equations(match: Match, weights: Float64, centre: Float64) -> tuple[Float64, Float64]:
    """``J^T W J`` (6, 6) and ``J^T W e`` (6,) in (translation of ``centre``, rotation about it), target axes."""
    J = jacobian(match, centre)
    weighted = J * weights
    H = np.empty((6, 6))
    for i in range(6):
        for j in range(i, 6):
            H[i, j] = H[j, i] = np.sum(weighted[i] * J[j])
    return H, np.sum(weighted * match.distance, axis=1)


def jacobian(match: Match, centre: Float64) -> Float64:
    """Derivative (6, M) of the distances by (translation of ``centre``, rotation about it), target axes."""
    J = np.empty((6, len(match.rays)))
    J[:3] = match.normals
    x, y, z = match.points - centre[:, None]
    a, b, c = match.normals
    J[3], J[4], J[5] = y * c - z * b, z * a - x * c, x * b - y * a
    return J


def newton_step(H: Float64, g: Float64) -> Float64:
    """Solve ``H step = -g`` (6,), shortened where it would leave the neighbourhood in which planes are planes."""
    ridge = _RIDGE * np.diag(np.repeat([np.trace(H[:3, :3]), np.trace(H[3:, 3:])], 3))
    step = np.asarray(-np.linalg.solve(H + ridge, g), dtype=np.float64)
    size = max(_norm(step[:3]) / MAX_SHIFT, _norm(step[3:]) / MAX_TURN)
    out: Float64 = step / max(size, 1.0)
    return out


def moved(T: Float64, step: Float64, centre: Float64) -> Float64:
    """Move a transform (4, 4) by a step (6,) about ``centre``."""
    R = rotation_exp(step[3:])
    M = transform(R, centre - np.einsum("ij,j->i", R, centre) + step[:3])
    out: Float64 = np.einsum("ij,jk->ik", M, T)
    return out


def robust_scale(normalised: Float64) -> float:
    """Standard deviation of residuals by their median absolute value, 1.4826 MAD about zero."""
    return float(1.4826 * np.median(np.abs(normalised)))


def _norm(v: Float64) -> float:
    return float(np.sqrt(np.sum(v * v)))
