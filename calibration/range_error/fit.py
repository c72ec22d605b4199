"""The ToF camera's range error per frequency, fitted against the stereo surface jointly with the rig transform.

Unknown are the terms of every frequency (:mod:`calibration.range_error.terms`), a twist of the rig transform with the prior that the
alignment gives it, and per view and frequency a small error of its own, linear over the image: light that the surroundings throw
back. The size of the latter is estimated from the views (expectation maximisation, as in :mod:`calibration.alignment.joint`), so that a
spoilt frequency leans less on its views without being told.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.range_error.solve import Found, Problem, solve
from calibration.range_error.terms import MIN_GREY, MIN_KELVIN, ORDERS, Terms, greys, warmed
from calibration.range_error.views import RangeView, Seen, common_camera, range_view, wrapped
from tofcapture.errors import DataError, QualityError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import frequencies, radius_px
from tofcapture.poses import Float64, exp, invert, transform, transform_points
from tofcapture.rig import SPEED_OF_LIGHT, RangeError, image_places

MIN_VIEWS = 6
LOOSE = np.array([0.005] * 3 + [0.005] * 3)  # m, rad: one sigma of a rig transform nobody vouches for
FLOOR = 0.0005  # m; noise of a pixel that no burst shows: its own fixed offset, the stereo surface's ripple
ROUNDS = (3, 8)  # of spreads and weights, one number per pass over the surface at the transform found before


@dataclass(frozen=True)
class RangeFit:
    """Fitted range errors.

    Attributes
    ----------
    errors
        One per frequency, ascending: the maker's and what was found, together.
    terms
        Which terms each has.
    coefficients, sigma
        Per frequency (T,): found beside the maker's, and one sigma from leaving views out.
    T_tof_stereo
        (4, 4), moved within its prior.
    moved
        (6,) twist (rho, phi) about ``centre`` by which it moved, metres and radians.
    centre
        (3,) ToF frame, metres.
    spread
        (F,) one sigma of the views' own offsets, metres.
    own
        (V, F) the views' own offsets, metres.
    before, after, left_out
        Per view (F, N): error of the maker's calibration, of the fitted one, and of the one fitted to the other views, metres.
    views
        What was compared.
    refused
        Why other views were not.
    """

    errors: tuple[RangeError, ...]
    terms: tuple[Terms, ...]
    coefficients: tuple[Float64, ...]
    sigma: tuple[Float64, ...]
    T_tof_stereo: Float64
    moved: Float64
    centre: Float64
    spread: Float64
    own: Float64
    before: list[Float64]
    after: list[Float64]
    left_out: list[Float64]
    views: list[RangeView]
    refused: list[str]


def fit_ranges(
    seen: Sequence[Seen],
    T_tof_stereo: Float64,
    transform_sigma: Float64 = LOOSE,
    orders: Sequence[int] = ORDERS,
    centre: Float64 | None = None,
) -> RangeFit:
    """Fit the range errors of all frequencies.

    Parameters
    ----------
    seen
        At least six views, from the nearest to the farthest range that matters.
    T_tof_stereo
        (4, 4).
    transform_sigma
        (6,) what it is known to: metres and radians about ``centre``, ToF axes.
    orders
        Of the harmonics.
    centre
        (3,) ToF frame, metres; the middle of the surfaces by default.

    Raises
    ------
    DataError
        Too few views, or views of different cameras.
    QualityError
        Ranges that are no ranges of these surfaces.
    """
    if len(seen) < MIN_VIEWS:
        raise DataError(
            f"ranges: expected at least {MIN_VIEWS} views, got {len(seen)}",
            hint="record the board every 10 cm from the nearest to the farthest range you need",
        )
    info = common_camera(seen)
    T = T_tof_stereo
    if centre is None:
        centre = np.mean([transform_points(T, s.points.mean(axis=0, dtype=np.float64)) for s in seen], axis=0)
    W, moved = transform(np.eye(3), centre), np.zeros(6)
    for rounds in ROUNDS:
        views, refused = _compared(seen, T, centre)
        terms = _terms(info, views, tuple(orders))
        problem = _problem(info, views, terms, np.asarray(transform_sigma, dtype=np.float64), moved)
        found = solve(problem, rounds)
        moved = moved + found.x[:6]
        T = W @ exp(found.x[:6]) @ invert(W) @ T
    return _fit(info, views, terms, problem, found, (T, moved, centre), refused)


def _compared(
    seen: Sequence[Seen], T_tof_stereo: Float64, centre: Float64
) -> tuple[list[RangeView], list[str]]:
    views: list[RangeView] = []
    refused: list[str] = []
    for s in seen:
        try:
            views.append(range_view(s, T_tof_stereo, centre))
        except DataError as err:
            refused.append(err.message)
    if len(views) < MIN_VIEWS:
        raise DataError(
            f"ranges: expected at least {MIN_VIEWS} views that serve, got {len(views)} of {len(seen)}: {'; '.join(refused[:3])}",
            hint="is it the rig of this station? keep the board in the middle of both images",
        )
    return views, refused


def _terms(info: TofInfo, views: Sequence[RangeView], orders: tuple[int, ...]) -> tuple[Terms, ...]:
    by_hz = {e.modulation_hz: e for e in info.range_errors}
    return tuple(
        Terms(
            camera=info.camera,
            modulation_hz=f,
            orders=orders,
            warmth=warmed(views) >= MIN_KELVIN,
            darkness=greys(views, i) >= MIN_GREY,
            reference_celsius=by_hz.get(f, RangeError(f)).reference_celsius,
            amplitude=float(np.median(np.concatenate([v.amplitude[i] for v in views]))),
        )
        for i, f in enumerate(frequencies(info.modulation_hz))
    )


def _problem(
    info: TofInfo, views: Sequence[RangeView], terms: Sequence[Terms], sigma: Float64, moved: Float64
) -> Problem:
    ends = np.cumsum([6, *[len(t.names) for t in terms]])
    place = image_places(info.camera).reshape(-1, 2)
    shared, own, y, weight = [], [], [], []
    left = _left_by_factory(info, views, terms)
    for view, rest in zip(views, left, strict=True):
        A = np.zeros((len(terms), len(view.true), ends[-1]))
        A[:, :, :6] = view.lever
        for i, t in enumerate(terms):
            A[i, :, ends[i] : ends[i + 1]] = t.columns(view, i)
        shared.append(A)
        own.append(np.c_[np.ones(len(view.true)), place[view.pixels]])
        y.append(rest)
        weight.append(1 / (np.square(view.sigma) + FLOOR**2))
    prior = np.concatenate([sigma, *[t.prior for t in terms]])
    return Problem(shared, own, y, weight, prior, np.r_[-moved, np.zeros(len(prior) - 6)])


def _left_by_factory(info: TofInfo, views: Sequence[RangeView], terms: Sequence[Terms]) -> list[Float64]:
    """Measured minus true range minus the maker's error, (F, N) a view, its mean anywhere within the ambiguity."""
    by_hz = {e.modulation_hz: e for e in info.range_errors}
    radius, place = radius_px(info.camera).reshape(-1), image_places(info.camera).reshape(-1, 2)
    out = [np.empty_like(v.measured) for v in views]
    for i, t in enumerate(terms):
        hz = t.modulation_hz
        factory = by_hz.get(hz, RangeError(hz))
        raw = []
        for v in views:
            celsius = v.celsius if np.isfinite(v.celsius) else factory.reference_celsius
            turned = 4 * np.pi * hz / SPEED_OF_LIGHT * v.true
            known = factory.at(turned, radius[v.pixels], celsius, place[v.pixels], v.amplitude[i])
            raw.append(v.measured[i] - v.true - known)
        middle = _middle(np.concatenate(raw), hz)
        for own, r in zip(out, raw, strict=True):
            own[i] = middle + wrapped(r - middle, hz)
    return out


def _middle(values: Float64, hz: float) -> float:
    """Circular mean, metres; refuses values all round the circle."""
    turn = 4 * np.pi * hz / SPEED_OF_LIGHT
    z = np.exp(1j * turn * values).mean()
    if abs(z) < 0.5:
        raise QualityError(
            f"ranges: at {hz / 1e6:g} MHz measured and true ranges have no fixed difference (concentration {abs(z):.2f})",
            hint="wrong frequency, phase order or sign (tofcapture calibrate phase-order), or the rig of another station",
        )
    return float(np.angle(z) / turn)


def _fit(
    info: TofInfo,
    views: list[RangeView],
    terms: tuple[Terms, ...],
    p: Problem,
    found: Found,
    placed: tuple[Float64, Float64, Float64],
    refused: list[str],
) -> RangeFit:
    ends = np.cumsum([6, *[len(t.names) for t in terms]])
    parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
    by_hz = {e.modulation_hz: e for e in info.range_errors}
    sigma = np.sqrt(np.diag(found.covariance))

    return RangeFit(
        errors=tuple(
            t.added(by_hz.get(t.modulation_hz, RangeError(t.modulation_hz)), found.x[part])
            for t, part in zip(terms, parts, strict=True)
        ),
        terms=terms,
        coefficients=tuple(found.x[part] for part in parts),
        sigma=tuple(sigma[part] for part in parts),
        T_tof_stereo=placed[0],
        moved=placed[1],
        centre=placed[2],
        spread=np.sqrt(found.variances[:, 0]),
        own=found.own[..., 0],
        before=[y - A[..., :6] @ found.x[:6] for y, A in zip(p.y, p.shared, strict=True)],
        after=[y - A @ found.x for y, A in zip(p.y, p.shared, strict=True)],
        left_out=[y - A @ x for y, A, x in zip(p.y, p.shared, found.left_out, strict=True)],
        views=views,
        refused=refused,
    )
