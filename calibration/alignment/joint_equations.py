"""Normal equations of one board view in the joint problem: its surface per frequency, then its rims."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.alignment.joint_views import JointView
from calibration.board.rims import Rims
from calibration.range_error.error import design
from calibration.registration.clouds import Cloud
from calibration.registration.gate import tukey_weights
from tofcapture.poses import Float64, transform_points

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Trees = tuple[Any, Any]  # of a view's stereo surface and stereo rims

FINEST = 0.010  # m, last correspondence distance
RIM_DISTANCE = 0.003  # m, last distance for rims: eight sigma
KERNEL = 5.0  # sigmas at which Tukey's weight is zero, least
SHARED = 30.0  # neighbouring pixels that share their bias, which no polynomial takes up, and so count as one
FLOOR = 0.0007  # m, what is added to the noise of a range: fixed pattern and stereo plane
RIM_SIGMA = 0.0004  # m, first guess; replaced by what the rims show
RIM_MODES = 3
SIDES = 4  # of the image: rims that end right, down, left, up
# rad, one sigma by which rims of one side come out wrong in all views alike, a hundredth of a ToF pixel: the root mean square, over
# sides and ten stations that differ in rig, poses and surroundings, by which the rims of both cameras disagree at the true rig.
INSET = 4e-5
MODES = 10  # of a view's own range error over the image: the polynomials up to the third degree


@dataclass(frozen=True)
class Equations:
    """Normal equations of one view: global unknowns first, the view's own behind."""

    H: Float64
    g: Float64
    rim_residuals: Float64
    rms: float
    matched: int


@dataclass(frozen=True)
class State:
    """Where the solution stands.

    Attributes
    ----------
    T_stereo_tof
        (4, 4).
    coefficients
        (U + SIDES,) range errors, then the rims' insets in radians, which stay at zero.
    centre
        (3,) working point, ToF frame, metres.
    variances
        Of the views' own effects, in the order of the equations.
    rim_sigma
        Metres.
    """

    T_stereo_tof: Float64
    coefficients: Float64
    centre: Float64
    variances: Float64
    rim_sigma: float


def view_equations(view: JointView, trees: Trees, state: State, reach: float) -> Equations:
    """Linearise a view at a state; surface partners within ``reach`` metres, found with the highest frequency for all."""
    U, last = len(state.coefficients), len(view.modulation_hz) - 1
    size = 6 + U + MODES * (last + 1) + RIM_MODES
    H, g = np.zeros((size, size)), np.zeros(size)
    terms = design(view, last, state.coefficients[:-SIDES])
    moved = transform_points(state.T_stereo_tof, view.points(last, terms @ state.coefficients[:-SIDES]))
    distance, partner = trees[0].query(moved, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(distance))
    rms = np.nan
    if len(near):
        for f in range(last + 1):
            rms = _add_surface(H, g, view, f, near, partner[near], state, reach)
    rim_residuals = _add_rims(H, g, view.rims, view.held, trees[1], state, reach)
    return Equations(H, g, rim_residuals, rms, len(near))


def _add_surface(
    H: Float64,
    g: Float64,
    view: JointView,
    f: int,
    near: NDArray[np.intp],
    partner: NDArray[np.intp],
    state: State,
    reach: float,
) -> float:
    """Add one frequency's matched pixels; returns the root mean square of their residuals, metres."""
    U = len(state.coefficients)
    terms = design(view, f, state.coefficients[:-SIDES])
    p = view.points(f, terms @ state.coefficients[:-SIDES])[near]
    normal = view.surface.normals[partner]
    r = ((transform_points(state.T_stereo_tof, p) - view.surface.points[partner]) * normal).sum(axis=-1)
    n = normal @ state.T_stereo_tof[:3, :3]  # in ToF axes
    along = (n * view.rays[near]).sum(axis=-1)
    J = np.zeros((len(near), len(g)))
    J[:, :6] = -np.concatenate([n, np.cross(p - state.centre, n)], axis=1)
    J[:, 6 : 6 + U - SIDES] = -terms[near] * along[:, None]
    own = 6 + U + MODES * f
    J[:, own : own + MODES] = -_modes(view.rays[near]) * along[:, None]
    sigma = np.hypot(view.sigma[f][near], FLOOR) * np.abs(along)
    w = tukey_weights(r, np.maximum(reach, KERNEL * sigma)) / np.square(sigma) / SHARED
    H += (J * w[:, None]).T @ J
    g -= (J * w[:, None]).T @ r
    return float(np.sqrt(np.mean(np.square(r))))


def _modes(u: Float64) -> Float64:
    """Polynomials (N, MODES) up to the third degree of the image coordinates of unit rays (N, 3)."""
    x, y = u[:, 0] / u[:, 2] / 0.6, u[:, 1] / u[:, 2] / 0.45
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)


def _add_rims(
    H: Float64, g: Float64, rims: Rims, held: Cloud, tree: cKDTree, state: State, reach: float
) -> Float64:
    reach = max(RIM_DISTANCE, reach if reach > FINEST else 0.0)
    moved = transform_points(state.T_stereo_tof, rims.points)
    distance, partner = tree.query(moved, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(distance))
    normal = held.normals[partner[near]]
    r = ((moved[near] - held.points[partner[near]]) * normal).sum(axis=-1)
    n = normal @ state.T_stereo_tof[:3, :3]
    r = r + _insets(rims, near, n) @ state.coefficients[-SIDES:]
    J = np.zeros((len(near), len(g)))
    J[:, :6] = -np.concatenate([n, np.cross(rims.points[near] - state.centre, n)], axis=1)
    J[:, len(state.coefficients) + 6 - SIDES : len(state.coefficients) + 6] = _insets(rims, near, n)
    J[:, -RIM_MODES:] = n
    w = tukey_weights(r, reach) / state.rim_sigma**2
    H += (J * w[:, None]).T @ J
    g -= (J * w[:, None]).T @ r
    out: Float64 = r
    return out


def _insets(rims: Rims, near: NDArray[np.intp], normals: Float64) -> Float64:
    """Derivative (M, SIDES) of rim residuals by how far out, in radians, rims of each side of the image are seen."""
    outward = rims.outward[near]
    side = np.concatenate([outward[:, :2] > 0.5, outward[:, :2] < -0.5], axis=1)
    reach = (normals * outward).sum(axis=-1) * rims.points[near, 2]
    return np.asarray(side * reach[:, None])
