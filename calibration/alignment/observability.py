"""Which motions of the rig the views hold, how well, and which tilt would help most next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcapture.poses import Float64

NAMES = ("along x", "along y", "along z", "about x", "about y", "about z")
RADIUS = 0.2  # m, half a board: a rotation counts by how far it moves a board's edge
WEAK_SIGMA = 0.002  # m; a motion known no better than this is not held at all by a board's views
TILTS_DEG = (20.0, 30.0, 40.0)
TURNS = 12
POINTS = 200  # that a suggested view is judged by
POINT_SIGMA = (
    0.011  # m, of one of them, as if independent: 2 mm times the root of the neighbours that share its bias
)


@dataclass(frozen=True)
class Observability:
    """Eigenvalues of an information matrix, and what they mean.

    Attributes
    ----------
    eigenvalues
        (6,) ascending, 1/m^2, rotations measured as motion at ``RADIUS``.
    motions
        (6, 6) rows: their unit motions, (x, y, z, then rotations times ``RADIUS``).
    unconstrained
        Names of the motions that are not held.
    """

    eigenvalues: Float64
    motions: Float64
    unconstrained: tuple[str, ...]

    @property
    def sigma_mm(self) -> Float64:
        """(6,) one sigma of each motion, millimetres."""
        out: Float64 = 1e3 / np.sqrt(np.maximum(self.eigenvalues, 1e-12))
        return out


def observability(information: Float64) -> Observability:
    """Take an information (6, 6) of the twist (rho, phi) about the working point, ToF axes, apart."""
    scale = np.repeat([1.0, 1 / RADIUS], 3)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    weak = np.maximum(values, 0) < 1 / WEAK_SIGMA**2
    names = tuple(motion_name(v) for v in vectors.T[weak])
    return Observability(np.maximum(values, 0), vectors.T, names)


def motion_name(motion: Float64) -> str:
    """Name a unit motion (6,) by its largest parts, largest first."""
    order = np.argsort(-np.abs(motion))
    parts = [f"{NAMES[i]} ({abs(motion[i]):.2f})" for i in order if abs(motion[i]) > 0.35]
    return " with ".join(parts)


def plane_information(normal: Float64, centre: Float64, working_point: Float64) -> Float64:
    """Information (6, 6) that a board without rims adds, seen at ``centre`` (3,) with ``normal`` (3,), ToF frame, metres."""
    a, b = _in_plane(normal)
    side = np.linspace(-RADIUS, RADIUS, 9)
    points = centre + (side[:, None, None] * a + side[None, :, None] * b).reshape(-1, 3)
    J = np.concatenate([np.tile(normal, (len(points), 1)), np.cross(points - working_point, normal)], axis=1)
    out: Float64 = J.T @ J * POINTS / len(points) / POINT_SIGMA**2
    return out


def suggest_view(information: Float64, working_point: Float64) -> dict[str, Any]:
    """Name the tilt of the board that lowers the largest uncertainty most.

    Every candidate adds the information of a tilted plane at the working point; the best has the smallest largest eigenvalue of
    the covariance, and among equals the smallest trace.

    Returns
    -------
    dict
        ``tilt_deg``, ``towards_deg`` (direction in the image in which the board's normal leans, 0 right, 90 down),
        ``motion`` that is weakest now, ``sigma_mm`` of it before and ``expected_sigma_mm`` after.
    """
    now = observability(information)
    best = min(_candidates(), key=lambda c: _cost(information, c, working_point))
    after = observability(information + plane_information(_normal(*best), working_point, working_point))
    return {
        "tilt_deg": best[0],
        "towards_deg": best[1],
        "motion": motion_name(now.motions[0]),
        "sigma_mm": float(now.sigma_mm[0]),
        "expected_sigma_mm": float(after.sigma_mm[0]),
    }


def _candidates() -> Sequence[tuple[float, float]]:
    return [(tilt, 360.0 * k / TURNS) for tilt in TILTS_DEG for k in range(TURNS)]


def _cost(
    information: Float64, candidate: tuple[float, float], working_point: Float64
) -> tuple[float, float]:
    added = information + plane_information(_normal(*candidate), working_point, working_point)
    values = np.maximum(observability(added).eigenvalues, 1e-6)
    return round(float(1 / values[0]), 12), float((1 / values).sum())


def _normal(tilt_deg: float, towards_deg: float) -> Float64:
    t, d = np.radians(tilt_deg), np.radians(towards_deg)
    return np.array([np.sin(t) * np.cos(d), np.sin(t) * np.sin(d), -np.cos(t)])


def _in_plane(normal: Float64) -> tuple[Float64, Float64]:
    a = np.cross(normal, [0.0, 1.0, 0.0])
    a /= np.linalg.norm(a)
    return a, np.cross(normal, a)
