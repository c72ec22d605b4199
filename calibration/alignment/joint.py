"""One rig transform and one set of range errors from all board views together.

Unknown are the transform (6), the range errors of every frequency (:meth:`calibration.alignment.views.JointView.terms`), and per view
and frequency a small range error, a polynomial of third degree over the image: what multipath and scattering do to this one view.
The latter are random effects. Their size is itself estimated from the views (expectation maximisation), and they are eliminated view
by view, so that a view's bias is neither averaged away as if it were noise nor free to explain the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.alignment.views import HALO_RADII, TERMS, JointView
from calibration.range_error.terms import jackknife
from calibration.registration.gate import tukey_weights
from tofcapture.errors import QualityError
from tofcapture.poses import Float64, exp, invert, transform, transform_points

DISTANCES = (0.080, 0.040, 0.020, 0.010)  # m, correspondence distances from coarse to fine
RANGE_ROUNDS = 5  # for the range errors without scattered light, at the solved transform
FINE_ROUNDS = 8  # at the last distance; the steps fall below a micrometre
START_SPREAD = 0.001  # m, first guess of the size of the views' own range errors
BELIEF = 3.0  # views that the first guesses of the spreads count as
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
# One sigma of the range errors before any view was seen, wide enough for a camera without a factory calibration. It only settles
# what the views do not: metres, metres per pixel, metres for each wave, share of the light.
PRIOR_OWN = (0.02, 2e-4, *[0.006] * (TERMS - 2))
PRIOR_HALO = 0.003

Trees = tuple[Any, Any]  # of a view's stereo surface and stereo rims


@dataclass(frozen=True)
class JointSolution:
    """Hold what V views say together."""

    T_tof_stereo: Float64  #: (4, 4)
    #: Range errors of :meth:`JointView.terms` at the solved transform, without scattered light: what
    #: ``rig.toml`` can hold
    range_coefficients: Float64
    centre: Float64  #: (3,) working point, ToF frame, metres
    #: (6, 6) of the twist (rho, phi) about ``centre`` in ToF axes that moves the truth to the result:
    #: leave-one-view-out, widened for few views, plus the priors' part and the rims' common inset
    covariance: Float64
    #: (V, 6) twist by which each view alone departs from the others, as leaving it out shows
    influence: Float64


@dataclass(frozen=True)
class _Estimate:
    """Tell where the solution stands."""

    T: Float64  # T_stereo_tof
    coefficients: Float64  # (U + SIDES,) range errors, then the rims' insets in radians, which stay at zero
    centre: Float64
    variances: Float64  # of the views' own effects, in the order of the equations
    rim_sigma: float  # m


@dataclass(frozen=True)
class _Equations:
    """Normal equations of one view: global unknowns first, the view's own behind."""

    H: Float64
    g: Float64
    rim_residuals: Float64
    matched: int


def joint_icp(views: Sequence[JointView], T_tof_stereo: Float64) -> JointSolution:
    """Align the cameras by one robust point-to-plane problem over all views.

    ``T_tof_stereo`` (4, 4) is good to a few degrees and centimetres. :class:`QualityError` where there are fewer than three views,
    or views that do not overlap at it.
    """
    from scipy.spatial import cKDTree

    if len(views) < 3:
        raise QualityError(
            f"joint alignment: expected at least 3 views, got {len(views)}", hint="record more board views"
        )
    trees = [(cKDTree(v.surface.points), cKDTree(v.held.points)) for v in views]
    F, finest = len(views[0].modulation_hz), DISTANCES[-1]
    centre = np.concatenate([v.points(F - 1, np.zeros(len(v.rays))) for v in views]).mean(axis=0)
    nothing = np.zeros(F * TERMS + len(HALO_RADII) + SIDES)
    now = _Estimate(invert(T_tof_stereo), nothing, centre, _first_variances(F), RIM_SIGMA)
    for reach in (*DISTANCES, *[finest] * FINE_ROUNDS):
        free = slice(0, 6 if reach == DISTANCES[0] else -SIDES)
        equations = _linearised(views, trees, now, reach)
        if sum(e.matched for e in equations) < 100 * len(views):
            raise QualityError(
                "joint alignment: the views' clouds do not overlap", hint="pass a better --initial"
            )
        now = _step(equations, now, free, fine=reach == finest)
    return _solution(_linearised(views, trees, now, finest), now, _storable_range_errors(views, trees, now))


def _storable_range_errors(views: Sequence[JointView], trees: Sequence[Trees], now: _Estimate) -> Float64:
    """Range errors (U,) at the solved transform without the halos, for which a rig has no place."""
    own = TERMS * len(views[0].modulation_hz)
    now = replace(now, coefficients=np.zeros_like(now.coefficients))
    for _ in range(RANGE_ROUNDS):
        equations = _linearised(views, trees, now, DISTANCES[-1])
        now = _step(equations, now, slice(6, 6 + own), fine=True)
    return now.coefficients[:-SIDES]


def _linearised(
    views: Sequence[JointView], trees: Sequence[Trees], now: _Estimate, reach: float
) -> list[_Equations]:
    """Equations of all views: the surface per frequency, then the rims.

    Partners lie within ``reach`` metres, and are found with the highest frequency for all.
    """
    out = []
    for view, (surface, held) in zip(views, trees, strict=True):
        U, last = len(now.coefficients), len(view.modulation_hz) - 1
        size = 6 + U + MODES * (last + 1) + RIM_MODES
        H, g = np.zeros((size, size)), np.zeros(size)
        own = now.coefficients[:-SIDES]
        moved = transform_points(now.T, view.points(last, view.terms(last, own) @ own))
        distance, partner = surface.query(moved, distance_upper_bound=reach)
        near = np.flatnonzero(np.isfinite(distance))
        for f in range(last + 1 if len(near) else 0):
            _add_surface(H, g, view, f, near, partner[near], now, reach)
        rim_residuals = _add_rims(H, g, view, held, now, reach)
        out.append(_Equations(H, g, rim_residuals, len(near)))
    return out


def _add_surface(
    H: Float64,
    g: Float64,
    view: JointView,
    f: int,
    near: NDArray[np.intp],
    partner: NDArray[np.intp],
    now: _Estimate,
    reach: float,
) -> None:
    """Add one frequency's matched pixels."""
    U = len(now.coefficients)
    terms = view.terms(f, now.coefficients[:-SIDES])
    p = view.points(f, terms @ now.coefficients[:-SIDES])[near]
    normal = view.surface.normals[partner]
    r = ((transform_points(now.T, p) - view.surface.points[partner]) * normal).sum(axis=-1)
    n = normal @ now.T[:3, :3]  # in ToF axes
    along = (n * view.rays[near]).sum(axis=-1)
    J = np.zeros((len(near), len(g)))
    J[:, :6] = -np.concatenate([n, np.cross(p - now.centre, n)], axis=1)
    J[:, 6 : 6 + U - SIDES] = -terms[near] * along[:, None]
    own = 6 + U + MODES * f
    J[:, own : own + MODES] = -_modes(view.rays[near]) * along[:, None]
    sigma = np.hypot(view.sigma[f][near], FLOOR) * np.abs(along)
    w = tukey_weights(r, np.maximum(reach, KERNEL * sigma)) / np.square(sigma) / SHARED
    H += (J * w[:, None]).T @ J
    g -= (J * w[:, None]).T @ r


def _modes(u: Float64) -> Float64:
    """Polynomials (N, MODES) up to the third degree of the image coordinates of unit rays (N, 3)."""
    x, y = u[:, 0] / u[:, 2] / 0.6, u[:, 1] / u[:, 2] / 0.45
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)


def _add_rims(H: Float64, g: Float64, view: JointView, tree: Any, now: _Estimate, reach: float) -> Float64:
    """Add the matched rims; returns their residuals, metres."""
    rims, held, U = view.rims, view.held, len(now.coefficients)
    reach = max(RIM_DISTANCE, reach if reach > DISTANCES[-1] else 0.0)
    moved = transform_points(now.T, rims.points)
    distance, partner = tree.query(moved, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(distance))
    normal = held.normals[partner[near]]
    r: Float64 = ((moved[near] - held.points[partner[near]]) * normal).sum(axis=-1)
    n = normal @ now.T[:3, :3]
    J = np.zeros((len(near), len(g)))
    J[:, :6] = -np.concatenate([n, np.cross(rims.points[near] - now.centre, n)], axis=1)
    # By how far out, in radians, rims of each side of the image are seen.
    out = rims.outward[near]
    side = np.concatenate([out[:, :2] > 0.5, out[:, :2] < -0.5], axis=1)
    J[:, 6 + U - SIDES : 6 + U] = side * ((n * out).sum(axis=-1) * rims.points[near, 2])[:, None]
    J[:, -RIM_MODES:] = n
    w = tukey_weights(r, reach) / now.rim_sigma**2
    H += (J * w[:, None]).T @ J
    g -= (J * w[:, None]).T @ r
    return r


def _eliminated(e: _Equations, variances: Float64, size: int) -> tuple[Float64, Float64, Float64, Float64]:
    """Equations of the global unknowns alone; the own ones' gain and posterior covariance."""
    own = np.asarray(np.linalg.inv(e.H[size:, size:] + np.diag(1 / variances)), dtype=np.float64)
    gain: Float64 = e.H[:size, size:] @ own
    return e.H[:size, :size] - gain @ e.H[size:, :size], e.g[:size] - gain @ e.g[size:], gain, own


def _summed(reduced: Sequence[tuple[Float64, ...]], now: _Estimate) -> tuple[Float64, Float64, Float64]:
    """Normal equations of the global unknowns of all views with the prior, and the prior's informations."""
    F = (len(now.coefficients) - len(HALO_RADII) - SIDES) // TERMS
    prior = 1 / np.square([*PRIOR_OWN * F, *[PRIOR_HALO] * len(HALO_RADII), *[INSET] * SIDES])
    H = sum(r[0] for r in reduced) + np.diag(np.r_[np.zeros(6), prior])
    g = sum(r[1] for r in reduced) - np.r_[np.zeros(6), prior * now.coefficients]
    return H, g, prior


def _step(equations: Sequence[_Equations], now: _Estimate, free: slice, *, fine: bool) -> _Estimate:
    size = 6 + len(now.coefficients)
    reduced = [_eliminated(e, now.variances, size) for e in equations]
    H, g, _ = _summed(reduced, now)
    x = np.zeros(size)
    x[free] = np.linalg.solve(H[free, free], g[free])
    variances, rim_sigma = now.variances, now.rim_sigma
    if fine:
        variances = _spread(equations, reduced, x, _inverse(H))
        r = np.concatenate([e.rim_residuals for e in equations])
        rim_sigma = float(1.4826 * np.median(np.abs(r)))
    W = transform(np.eye(3), now.centre)
    T = now.T @ W @ exp(-x[:6]) @ invert(W)
    U, _, Vt = np.linalg.svd(T[:3, :3])  # rounding must not add up
    return _Estimate(transform(U @ Vt, T[:3, 3]), now.coefficients + x[6:], now.centre, variances, rim_sigma)


def _spread(
    equations: Sequence[_Equations],
    reduced: Sequence[tuple[Float64, Float64, Float64, Float64]],
    x: Float64,
    covariance: Float64,
) -> Float64:
    """Second moment of each view effect over the views: its estimate squared plus what is not known of it."""
    size = len(x)
    moments = []
    for e, (_, _, gain, own) in zip(equations, reduced, strict=True):
        b = own @ (e.g[size:] - e.H[size:, :size] @ x)
        moments.append(np.square(b) + np.diag(own) + np.einsum("ij,jk,ki->i", gain.T, covariance, gain))
    first = _first_variances((len(moments[0]) - RIM_MODES) // MODES)
    out: Float64 = (np.sum(moments, axis=0) + BELIEF * first) / (len(moments) + BELIEF)
    return out


def _inverse(H: Float64) -> Float64:
    """Inverse of the part that is solved for, zero elsewhere."""
    out = np.zeros_like(H)
    out[:-SIDES, :-SIDES] = np.linalg.inv(H[:-SIDES, :-SIDES])
    return out


def _first_variances(frequencies: int) -> Float64:
    return np.array([START_SPREAD**2] * (MODES * frequencies) + [(RIM_SIGMA / 4) ** 2] * RIM_MODES)


def _solution(equations: Sequence[_Equations], now: _Estimate, storable: Float64) -> JointSolution:
    size = 6 + len(now.coefficients)
    reduced = [_eliminated(e, now.variances, size) for e in equations]
    H, g, prior = _summed(reduced, now)
    free = slice(0, size - SIDES)
    left_out = [np.linalg.solve((H - h)[free, free], (g - b)[free])[:6] for h, b, _, _ in reduced]
    influence, varying = jackknife(np.stack(left_out))
    all_known = _inverse(H)
    believed = all_known[:6, 6:] * prior @ all_known[6:, :6]
    # Schmidt's consider covariance: the sides' insets are not solved for, their effect on the result is added.
    effect = (all_known @ H)[:6, size - SIDES :]
    considered = INSET**2 * effect @ effect.T
    return JointSolution(
        T_tof_stereo=invert(now.T),
        range_coefficients=storable,
        centre=now.centre,
        covariance=varying + believed + considered,
        influence=influence,
    )
