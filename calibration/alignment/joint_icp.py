"""One rig transform and one set of range errors from all board views together.

Unknown are the transform (6), the range errors of every frequency (:mod:`calibration.range_error.error`), and per view and frequency a
small range error, a polynomial of third degree over the image: what multipath and scattering do to this one view. The latter are
random effects: their size is itself estimated from the views (expectation maximisation), and they are eliminated view by view, so
that a view's bias is neither averaged away as if it were noise nor free to explain the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.alignment.fusion import jackknife
from calibration.alignment.joint_equations import (
    FINEST,
    INSET,
    MODES,
    RIM_MODES,
    RIM_SIGMA,
    SIDES,
    Equations,
    State,
    Trees,
    view_equations,
)
from calibration.alignment.joint_views import JointView
from calibration.range_error.error import TERMS, prior_sigma, unknowns
from tofcapture.errors import QualityError
from tofcapture.poses import Float64, exp, invert, transform

STAGES = (0.080, 0.040, 0.020, FINEST)  # m, correspondence distances from coarse to fine
RANGE_ROUNDS = 5  # for the range errors without scattered light, at the solved transform
FINE_ROUNDS = 8  # at the last distance; the steps fall below a micrometre
START_SPREAD = 0.001  # m, first guess of the size of the views' own range errors
BELIEF = 3.0  # views that the first guesses of the spreads count as


@dataclass(frozen=True)
class JointSolution:
    """What the views say together.

    Attributes
    ----------
    T_tof_stereo
        (4, 4).
    coefficients
        (U,) of :mod:`calibration.range_error.error`, shares of scattered light included.
    range_coefficients
        (U,) the same fitted without scattered light, at the solved transform: what ``rig.toml`` can hold.
    centre
        (3,) working point, ToF frame, metres.
    covariance
        (6, 6) of the twist (rho, phi) about ``centre`` in ToF axes that moves the truth to the result: leave-one-view-out,
        widened for few views, plus the priors' part and the rims' common inset.
    information
        (6, 6) inverse of the covariance that the model itself predicts, nuisances eliminated.
    view_information
        (V, 6, 6) what each view adds to it with the nuisances held.
    influence
        (V, 6) twist by which each view alone departs from the others, as leaving it out shows.
    spreads
        Estimated sigmas of the views' own errors: per frequency the polynomial's coefficients, then the rims' shift.
    rms
        (V,) root mean square of the highest frequency's residuals, metres.
    matched
        (V,) matched surface points.
    """

    T_tof_stereo: Float64
    coefficients: Float64
    range_coefficients: Float64
    centre: Float64
    covariance: Float64
    information: Float64
    view_information: Float64
    influence: Float64
    spreads: Float64
    rms: Float64
    matched: Float64


def joint_icp(views: Sequence[JointView], T_tof_stereo: Float64) -> JointSolution:
    """Align the cameras by one robust point-to-plane problem over all views.

    Parameters
    ----------
    views
        At least three.
    T_tof_stereo
        (4, 4) initial guess, good to a few degrees and centimetres.

    Returns
    -------
    JointSolution

    Raises
    ------
    QualityError
        Fewer than three views, or views that do not overlap at the initial guess.
    """
    from scipy.spatial import cKDTree

    if len(views) < 3:
        raise QualityError(
            f"joint alignment: expected at least 3 views, got {len(views)}", hint="record more board views"
        )
    trees = [(cKDTree(v.surface.points), cKDTree(v.held.points)) for v in views]
    state = _start(views, T_tof_stereo)
    for stage in (*STAGES, *[STAGES[-1]] * FINE_ROUNDS):
        free = slice(0, 6 if stage == STAGES[0] else -SIDES)
        equations = [view_equations(v, t, state, stage) for v, t in zip(views, trees, strict=True)]
        if sum(e.matched for e in equations) < 100 * len(views):
            raise QualityError(
                "joint alignment: the views' clouds do not overlap", hint="pass a better --initial"
            )
        state = _step(views, equations, state, free, fine=stage == STAGES[-1])
    equations = [view_equations(v, t, state, STAGES[-1]) for v, t in zip(views, trees, strict=True)]
    return _solution(views, equations, state, _storable_range_errors(views, trees, state))


def _storable_range_errors(views: Sequence[JointView], trees: Sequence[Trees], state: State) -> Float64:
    """Range errors (U,) at the solved transform without the halos, for which a rig has no place."""
    own = TERMS * len(views[0].modulation_hz)
    state = replace(state, coefficients=np.zeros_like(state.coefficients))
    for _ in range(RANGE_ROUNDS):
        equations = [view_equations(v, t, state, STAGES[-1]) for v, t in zip(views, trees, strict=True)]
        state = _step(views, equations, state, slice(6, 6 + own), fine=True)
    return state.coefficients[:-SIDES]


def _start(views: Sequence[JointView], T_tof_stereo: Float64) -> State:
    frequencies = len(views[0].modulation_hz)
    points = np.concatenate([v.points(frequencies - 1, np.zeros(len(v.rays))) for v in views])
    centre: Float64 = points.mean(axis=0)
    return State(
        invert(T_tof_stereo),
        np.zeros(unknowns(frequencies) + SIDES),
        centre,
        _first_variances(frequencies),
        RIM_SIGMA,
    )


def _eliminated(e: Equations, variances: Float64, size: int) -> tuple[Float64, Float64, Float64, Float64]:
    """Equations of the global unknowns alone; the own ones' gain and posterior covariance."""
    own = np.asarray(np.linalg.inv(e.H[size:, size:] + np.diag(1 / variances)), dtype=np.float64)
    gain: Float64 = e.H[:size, size:] @ own
    return e.H[:size, :size] - gain @ e.H[size:, :size], e.g[:size] - gain @ e.g[size:], gain, own


def _step(
    views: Sequence[JointView], equations: Sequence[Equations], state: State, free: slice, *, fine: bool
) -> State:
    size = 6 + len(state.coefficients)
    reduced = [_eliminated(e, state.variances, size) for e in equations]
    prior = _prior(views)
    H = sum(r[0] for r in reduced) + np.diag(np.r_[np.zeros(6), prior])
    g = sum(r[1] for r in reduced) - np.r_[np.zeros(6), prior * state.coefficients]
    x = np.zeros(size)
    x[free] = np.linalg.solve(H[free, free], g[free])
    variances, rim_sigma = state.variances, state.rim_sigma
    if fine:
        variances = _spread(equations, reduced, x, _inverse(H), _first_variances(len(views[0].modulation_hz)))
        r = np.concatenate([e.rim_residuals for e in equations])
        rim_sigma = float(1.4826 * np.median(np.abs(r)))
    W = transform(np.eye(3), state.centre)
    T = state.T_stereo_tof @ W @ exp(-x[:6]) @ invert(W)
    return State(_clean(T), state.coefficients + x[6:], state.centre, variances, rim_sigma)


def _spread(
    equations: Sequence[Equations],
    reduced: Sequence[tuple[Float64, Float64, Float64, Float64]],
    x: Float64,
    covariance: Float64,
    first: Float64,
) -> Float64:
    """Second moment of each view effect over the views: its estimate squared plus what is not known of it."""
    size = len(x)
    moments = []
    for e, (_, _, gain, own) in zip(equations, reduced, strict=True):
        b = own @ (e.g[size:] - e.H[size:, :size] @ x)
        moments.append(np.square(b) + np.diag(own) + np.einsum("ij,jk,ki->i", gain.T, covariance, gain))
    out: Float64 = (np.sum(moments, axis=0) + BELIEF * first) / (len(moments) + BELIEF)
    return out


def _inverse(H: Float64) -> Float64:
    """Inverse of the part that is solved for, zero elsewhere."""
    out = np.zeros_like(H)
    out[:-SIDES, :-SIDES] = np.linalg.inv(H[:-SIDES, :-SIDES])
    return out


def _first_variances(frequencies: int) -> Float64:
    out = np.full(MODES * frequencies + RIM_MODES, START_SPREAD**2)
    out[-RIM_MODES:] = (RIM_SIGMA / 4) ** 2
    return out


def _prior(views: Sequence[JointView]) -> Float64:
    sigma = np.r_[prior_sigma(len(views[0].modulation_hz)), np.full(SIDES, INSET)]
    out: Float64 = 1 / np.square(sigma)
    return out


def _clean(T: Float64) -> Float64:
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return transform(U @ Vt, T[:3, 3])


def _solution(
    views: Sequence[JointView], equations: Sequence[Equations], state: State, storable: Float64
) -> JointSolution:
    size = 6 + len(state.coefficients)
    reduced = [_eliminated(e, state.variances, size)[:2] for e in equations]
    prior = _prior(views)
    H = sum(r[0] for r in reduced) + np.diag(np.r_[np.zeros(6), prior])
    g = sum(r[1] for r in reduced) - np.r_[np.zeros(6), prior * state.coefficients]
    free = slice(0, size - SIDES)
    jack = np.stack([np.linalg.solve((H - h)[free, free], (g - b)[free])[:6] for h, b in reduced])
    influence, varying = jackknife(jack)
    all_known = _inverse(H)
    predicted = np.asarray(np.linalg.inv(all_known[:6, :6]), dtype=np.float64)
    believed = all_known[:6, 6:] * prior @ all_known[6:, :6]
    # Schmidt's consider covariance: the sides' insets are not solved for, their effect on the result is added.
    effect = (all_known @ H)[:6, size - SIDES :]
    considered = INSET**2 * effect @ effect.T
    return JointSolution(
        T_tof_stereo=invert(state.T_stereo_tof),
        coefficients=state.coefficients[:-SIDES],
        range_coefficients=storable,
        centre=state.centre,
        covariance=varying + believed + considered,
        information=predicted,
        view_information=np.stack([h[:6, :6] for h, _ in reduced]),
        influence=influence,
        spreads=np.sqrt(state.variances),
        rms=np.array([e.rms for e in equations]),
        matched=np.array([e.matched for e in equations]),
    )
