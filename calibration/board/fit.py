"""The pose of a board by fitting its model: rims on its edges, surface points on its plane.

A rim counts by its ray alone. The ray meets the board's front, and the signed distance of that point to the nearest edge of the
model is the residual, so that a range error costs nothing and the board's size gives its distance. Surface points hold the
tilt. Two nuisances are unknowns too: a range error common to the surface, and how far all rims seem to lie off the material.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.board.geometry import Board
from calibration.board.model import Model, clear_of_walls, on_front
from calibration.registration.gate import tukey_weights
from tofcapture.poses import Float64, exp, hat, invert, transform_points

SCALES = (0.020, 0.010, 0.006, 0.004, 0.003)  # m, Tukey's scale on the rims, a few steps each
STEPS = 4
RIM_SIGMA = 0.0007  # m, one rim point
GROWTH_SIGMA = 0.0002  # m, by how much a camera may see all plates too large and all holes too small
UNKNOWNS = 8  # rho, phi, range error of the surface, growth
INDEPENDENT = (
    40  # surface points that count at most: neighbours share their bias, waves of the range error too
)
COMMON = 0.0002  # m, what all rims of a camera may be off sideways by together: a third of a stereo pixel
TILES = 4  # surface residuals share their bias over a piece of the board this many to a side


@dataclass(frozen=True)
class Sight:
    """What a camera sees of a board.

    Attributes
    ----------
    rims
        (N, 3) points on rims, camera frame, metres; only their rays count.
    surface
        (M, 3) surface points, camera frame, metres.
    sigma
        Noise of a surface point with the bias of its neighbourhood, metres.
    bias_sigma
        What a common range error may be, metres.
    """

    rims: Float64
    surface: Float64
    sigma: float
    bias_sigma: float


@dataclass(frozen=True)
class Fit:
    """A refined pose.

    Attributes
    ----------
    T
        (4, 4) ``T_camera_board``.
    bias, growth
        Common range error of the surface points, positive is measured too far; how far all rims lie off the material. Metres.
    covariance
        (6, 6) of (displacement of the board's origin, rotation vector), camera axes, m^2 and rad^2. Cluster-robust: what one hole or one
        piece of the surface has in common counts once.
    rim_residual
        (K,) signed, metres, of the rims that counted.
    surface_residual
        (M,) along the normal, bias taken off, metres.
    """

    T: Float64
    bias: float
    growth: float
    covariance: Float64
    rim_residual: Float64
    surface_residual: Float64


def refine(model: Model, sight: Sight, T: Float64, scales: Sequence[float] = SCALES) -> Fit:
    """Fit a pose by Gauss-Newton with Tukey's weights on the rims, coarse to fine.

    Parameters
    ----------
    model
        The board.
    sight
        Rims and surface of one plane.
    T
        (4, 4) ``T_camera_board`` to within 2 cm and 4 degrees.
    scales
        Tukey's scales, metres, descending.
    """
    nuisance = np.zeros(UNKNOWNS - 6)
    for scale in scales:
        for _ in range(STEPS):
            e = _equations(model, sight, T, nuisance, scale)
            H, g = _normal(e, nuisance, sight)
            step = -np.linalg.solve(H, g)
            T, nuisance = exp(step[:6]) @ T, nuisance + step[6:]
    e = _equations(model, sight, T, nuisance, scales[-1])
    rims = len(sight.rims)
    counted = e.weight[:rims] > 0
    return Fit(
        T,
        float(nuisance[0]),
        float(nuisance[1]),
        _covariance(e, sight, T),
        e.residual[:rims][counted],
        e.residual[rims:],
    )


@dataclass(frozen=True)
class _Equations:
    """Jacobian (K, 8), residuals, weights and clusters (K,), rims first."""

    J: Float64
    residual: Float64
    weight: Float64
    cluster: NDArray[np.intp]


def _equations(model: Model, sight: Sight, T: Float64, nuisance: Float64, scale: float) -> _Equations:
    board, n = model.board, T[:3, 2]
    xy = on_front(T, board, sight.rims)
    found = model.edges(xy)
    X = transform_points(T, np.column_stack([xy, np.full(len(xy), board.thickness)]))
    g = found.gradient @ T[:3, :2].T
    a = n * ((g * X).sum(axis=1) / (X @ n))[:, None] - g
    J_rim = np.column_stack([a, np.cross(X, a), np.zeros(len(a)), -np.ones(len(a))])
    r_rim = found.distance - nuisance[1]
    w_rim = tukey_weights(r_rim, scale) / RIM_SIGMA**2 * clear_of_walls(T, board, xy, found.outward)
    J_plane, r_plane, w_plane = _plane_equations(sight, T, nuisance[0], board.thickness, scale)
    tiles = 2000 + _tile(sight.surface, T, board)
    sides = np.where(found.ring == 0, found.segment, 1000 + found.ring)
    return _Equations(
        np.concatenate([J_rim, J_plane]),
        np.concatenate([r_rim, r_plane]),
        np.concatenate([w_rim, w_plane]),
        np.concatenate([sides, tiles]),
    )


def _plane_equations(
    sight: Sight, T: Float64, bias: float, thickness: float, scale: float
) -> tuple[Float64, Float64, Float64]:
    n = T[:3, 2]
    away = sight.surface / np.linalg.norm(sight.surface, axis=1, keepdims=True)
    P = sight.surface - bias * away
    r = (P - T[:3, 3]) @ n - thickness
    J = np.column_stack([np.broadcast_to(-n, P.shape), -np.cross(P, n), -(away @ n), np.zeros(len(P))])
    w = tukey_weights(r, max(scale, 6 * sight.sigma)) / sight.sigma**2
    return J, r, w * min(1.0, INDEPENDENT / max(len(P), 1))


def _tile(P: Float64, T: Float64, board: Board) -> NDArray[np.intp]:
    xy = transform_points(invert(T), P)[:, :2]
    low, span = board.outline.min(axis=0), np.ptp(board.outline, axis=0)
    cell = np.clip((xy - low) / span * TILES, 0, TILES - 1).astype(np.intp)
    return np.asarray(cell[:, 1] * TILES + cell[:, 0])


def _prior(sight: Sight) -> Float64:
    return np.diag([0.0] * 6 + [1 / sight.bias_sigma**2, 1 / GROWTH_SIGMA**2])


def _normal(e: _Equations, nuisance: Float64, sight: Sight) -> tuple[Float64, Float64]:
    prior = _prior(sight)
    weighted = (e.J * e.weight[:, None]).T
    H = weighted @ e.J + prior + 1e-6 * np.eye(UNKNOWNS)
    return H, weighted @ e.residual + prior @ np.concatenate([np.zeros(6), nuisance])


def _covariance(e: _Equations, sight: Sight, T: Float64) -> Float64:
    """Covariance at the board's origin: what the weights promise, plus what the clusters show, plus what all rims share.

    The second is the sandwich ``H^-1 (sum_c g_c g_c^T) H^-1`` over clusters (Liang and Zeger, Biometrika 73, 1986); a bias that
    runs across clusters is not in it, one of every point alone is all that is in the first.
    """
    H, _ = _normal(e, np.zeros(UNKNOWNS - 6), sight)
    names, place = np.unique(e.cluster, return_inverse=True)
    scores = np.zeros((len(names), UNKNOWNS))
    np.add.at(scores, place, e.J * (e.weight * e.residual)[:, None])
    bread = np.linalg.inv(H)
    meat = scores.T @ scores * len(names) / max(len(names) - 1, 1) + _prior(sight)
    C = (bread + bread @ meat @ bread)[:6, :6]
    move = np.eye(6)
    move[:3, 3:] = -hat(T[:3, 3])
    out: Float64 = move @ C @ move.T + np.diag([COMMON**2] * 3 + [0.0] * 3)
    return out
