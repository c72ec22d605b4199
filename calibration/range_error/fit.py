"""The ToF camera's range error per frequency, fitted against the stereo surface jointly with the rig transform.

One linear least-squares problem over all views. Unknown are the terms of every frequency (:mod:`calibration.range_error.terms`), a
twist of the rig transform with the prior that the alignment gives it, and per view and frequency a small error linear over the image:
light that the surroundings throw back. The size of the latter is estimated from the views (expectation maximisation), so that a spoilt
frequency leans less on its views without being told.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.range_error.terms import IMAGE, ORDERS, WAVES, Terms, jackknife, waves
from calibration.range_error.views import RangeView, Seen, common_camera, range_view, wrapped
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.errors import DataError, QualityError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import ambiguity, frequencies, radius_px
from tofcapture.poses import Float64, exp, invert, transform, transform_points
from tofcapture.rig import RangeError, image_places

MIN_VIEWS = 6
LOOSE = np.array([0.005] * 3 + [0.005] * 3)  # m, rad: one sigma of a rig transform nobody vouches for
FLOOR = 0.0005  # m; noise of a pixel that no burst shows: its own fixed offset, the stereo surface's ripple
ROUNDS = (3, 8)  # of spreads and weights, one number per pass over the surface at the transform found before
OWN = 3  # numbers of a view's own error: offset and slopes over the image
START_SPREAD = 0.001  # m
BELIEF = 3.0  # views that the first guess of the spread counts as
TUKEY = 4.685
MIN_KELVIN = 1.0  # K of spread between views below which temperature says nothing
MIN_GREY = 0.35  # of ln A about its fall with range, below which amplitude and range are one
# One sigma of what a maker's calibration may leave, or a camera without one may have. They only settle what the views do not.
PRIOR_WAVE = 0.03  # rad over a whole period; of less, a wave, the offset and the scale look the same: so much less is believed
MOST_WAVE = 0.071  # rad; what square waves and four taps make: no sensor has more
TIGHTER = 20  # times at most that the waves beyond it are held tighter
PRIOR_DARK = 0.003  # m at the median amplitude
PRIOR = {
    "offset": 0.3,
    "scale": 0.01,
    "radius": 3e-4,
    "image": 0.005,
    "temperature": 5e-4,
}  # m, per px, per K


@dataclass(frozen=True)
class RangeFit:
    """Fitted range errors of F frequencies."""

    camera: Camera  #: Of the ToF
    errors: tuple[RangeError, ...]  #: One per frequency, ascending: the maker's and what was found, together
    terms: tuple[Terms, ...]  #: Which terms each has
    #: Per frequency (T,): found beside the maker's, and one sigma from leaving views out
    coefficients: tuple[Float64, ...]
    sigma: tuple[Float64, ...]
    T_tof_stereo: Float64  #: (4, 4), moved within its prior
    moved: Float64  #: (6,) twist (rho, phi) about the centre by which it moved, metres and radians
    spread: Float64  #: (F,) one sigma of the views' own offsets, metres
    #: Per view (F, N): error of the maker's calibration, of the fitted one, and of the one fitted to the other views, metres
    before: list[Float64]
    after: list[Float64]
    left_out: list[Float64]
    views: list[RangeView]  #: What was compared
    refused: list[str]  #: Why other views were not


def fit_ranges(
    seen: Sequence[Seen],
    T_tof_stereo: Float64,
    transform_sigma: Float64 = LOOSE,
    orders: Sequence[int] = ORDERS,
    centre: Float64 | None = None,
) -> RangeFit:
    """Fit the range errors of all frequencies.

    At least six views, from the nearest to the farthest range that matters. ``T_tof_stereo`` (4, 4) is known to ``transform_sigma``
    (6,), metres and radians about ``centre`` (3,), ToF frame, metres: the middle of the surfaces by default. ``orders`` are those of the
    harmonics.

    :class:`DataError` for too few views, or views of different cameras; :class:`QualityError` for ranges that are none of these surfaces.
    """
    if len(seen) < MIN_VIEWS:
        raise DataError(
            f"ranges: expected at least {MIN_VIEWS} views, got {len(seen)}",
            hint="record the board every 10 cm from the nearest to the farthest range you need",
        )
    info, T = common_camera(seen), T_tof_stereo
    if centre is None:
        centre = np.mean([transform_points(T, _middle_point(s)) for s in seen], axis=0)
    W, moved = transform(np.eye(3), centre), np.zeros(6)
    for rounds in ROUNDS:
        views, refused = _compared(seen, T, centre)
        terms = _terms(info, views, orders)
        problem = _problem(info, views, terms, np.asarray(transform_sigma, dtype=np.float64), moved)
        found = _physical(problem, terms, rounds)
        moved = moved + found.x[:6]
        T = W @ exp(found.x[:6]) @ invert(W) @ T
    parts = _parts(terms)
    sigma = np.sqrt(np.diag(found.covariance))
    covered = _covered(views)
    return RangeFit(
        camera=info.camera,
        errors=tuple(
            replace(t.added(e, found.x[part]), fitted_m=covered)
            for t, e, part in zip(terms, _makers(info), parts, strict=True)
        ),
        terms=terms,
        coefficients=tuple(found.x[part] for part in parts),
        sigma=tuple(sigma[part] for part in parts),
        T_tof_stereo=T,
        moved=moved,
        spread=np.sqrt(found.variances[:, 0]),
        before=[y - A[..., :6] @ found.x[:6] for y, A in zip(problem.y, problem.shared, strict=True)],
        after=[y - A @ found.x for y, A in zip(problem.y, problem.shared, strict=True)],
        left_out=[y - A @ x for y, A, x in zip(problem.y, problem.shared, found.left_out, strict=True)],
        views=views,
        refused=refused,
    )


def warmed(views: Sequence[RangeView]) -> float:
    """Return the standard deviation of the views' temperatures, kelvin; 0 when the camera does not say."""
    celsius = np.array([v.celsius for v in views])
    return float(celsius.std()) if np.isfinite(celsius).all() else 0.0


def greys(views: Sequence[RangeView], frequency: int) -> float:
    """Return the spread of ln A about its fall with range: what tells a term of amplitude from one of range."""
    level = np.concatenate([np.log(v.amplitude[frequency]) for v in views])
    far = np.log(np.concatenate([v.true for v in views]))
    fall = np.polyfit(far, level, 2)
    return float(np.std(level - np.polyval(fall, far)))


def _middle_point(seen: Seen) -> Float64:
    points = seen.depth[::2, ::2, None] * seen.stereo.rays[::2, ::2]
    return np.asarray(np.nanmean(points.reshape(-1, 3), axis=0), dtype=np.float64)


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


def _makers(info: TofInfo) -> list[RangeError]:
    """Range errors that the camera came with, one per frequency."""
    by_hz = {e.modulation_hz: e for e in info.range_errors}
    return [by_hz.get(f, RangeError(f)) for f in frequencies(info.modulation_hz)]


def _terms(info: TofInfo, views: Sequence[RangeView], orders: Sequence[int]) -> tuple[Terms, ...]:
    names = ("offset", "scale", "radius", *IMAGE, *waves(orders))
    warmth = ("temperature",) if warmed(views) >= MIN_KELVIN else ()
    return tuple(
        Terms(
            maker.modulation_hz,
            (*names, *warmth, *(("darkness",) if greys(views, i) >= MIN_GREY else ())),
            maker.reference_celsius,
        )
        for i, maker in enumerate(_makers(info))
    )


def _covered(views: Sequence[RangeView]) -> tuple[float, float]:
    """Return the ranges that the views cover, metres, but for one pixel in a thousand at either end."""
    near, far = np.quantile(np.concatenate([v.true for v in views]), [0.001, 0.999])
    return float(near), float(far)


def _prior(terms: Terms, amplitude: float, covered: tuple[float, float]) -> Float64:
    """One sigma of each coefficient; ``amplitude`` is the median, raw units, the ranges ``covered`` are in metres."""
    known = {**PRIOR, "darkness": PRIOR_DARK * amplitude}
    turns = (covered[1] - covered[0]) / ambiguity(terms.modulation_hz)
    out = []
    for kind, _, index in (name.partition(" ") for name in terms.names):
        seen = min(1.0, int(index) * turns) if kind in WAVES else 1.0
        out.append(seen * PRIOR_WAVE * _radian(terms) if kind in WAVES else known[kind])
    return np.array(out)


def _radian(terms: Terms) -> float:
    """Return the metres of range in a radian of phase."""
    return ambiguity(terms.modulation_hz) / (2 * np.pi)


def _physical(problem: _Problem, terms: Sequence[Terms], rounds: int) -> _Found:
    """Solve, and hold the waves that come out larger than a sensor's can be tighter, until none is."""
    for _ in range(TIGHTER):
        found = _solve(problem, rounds)
        tighter = np.ones_like(problem.prior)
        for t, part in zip(terms, _parts(terms), strict=True):
            x = found.x[part]
            waves = [k for k, name in enumerate(t.names) if name.startswith("cos ")]
            for k in waves:  # the sine stands behind its cosine
                over = float(np.hypot(x[k], x[k + 1])) / (MOST_WAVE * _radian(t))
                tighter[part][k : k + 2] = min(1.0, 0.9 / over) if over > 1 else 1.0
        if (tighter == 1).all():
            break
        problem = replace(problem, prior=problem.prior * tighter)
    return found


def _parts(terms: Sequence[Terms]) -> list[slice]:
    """Tell where each frequency's coefficients stand among the shared unknowns, behind the transform's six."""
    ends = np.cumsum([6, *[len(t.names) for t in terms]]).tolist()
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


@dataclass(frozen=True)
class _Problem:
    """Linear equations of every view."""

    shared: list[Float64]  # (F, N, U) columns of the shared unknowns: twist, then terms
    own: list[Float64]  # (N, OWN) columns of the view's own
    y: list[Float64]  # (F, N) what is left to explain, metres
    weight: list[Float64]  # (F, N), 1 / m^2
    prior: Float64  # (U,) one sigma
    expected: Float64  # (U,) before any view: what is left of the transform's prior after it was moved


@dataclass(frozen=True)
class _Found:
    """Solution of the equations."""

    x: Float64  # (U,) shared unknowns
    left_out: Float64  # (V, U) the same without each view
    covariance: Float64  # (U, U)
    variances: Float64  # (F, OWN) of the views' own errors


def _problem(
    info: TofInfo, views: Sequence[RangeView], terms: Sequence[Terms], sigma: Float64, moved: Float64
) -> _Problem:
    places, radii = image_places(info.camera).reshape(-1, 2), radius_px(info.camera).reshape(-1)
    parts = _parts(terms)
    shared, own, weight = [], [], []
    for view in views:
        A = np.zeros((len(terms), len(view.true), parts[-1].stop))
        A[:, :, :6] = view.lever
        place, radius = places[view.pixels], radii[view.pixels]
        for i, (t, part) in enumerate(zip(terms, parts, strict=True)):
            A[i, :, part] = t.columns(view.true, radius, place, view.celsius, view.amplitude[i])
        shared.append(A)
        own.append(np.c_[np.ones(len(view.true)), place])
        weight.append(1 / (np.square(view.sigma) + FLOOR**2))
    median = [float(np.median(np.concatenate([v.amplitude[i] for v in views]))) for i in range(len(terms))]
    covered = _covered(views)
    prior = np.concatenate([sigma, *(_prior(t, A, covered) for t, A in zip(terms, median, strict=True))])
    expected = np.r_[-moved, np.zeros(len(prior) - 6)]
    return _Problem(shared, own, _left_by_maker(info, views), weight, prior, expected)


def _left_by_maker(info: TofInfo, views: Sequence[RangeView]) -> list[Float64]:
    """Measured minus true range minus the maker's error, (F, N) a view, its mean anywhere within the ambiguity."""
    radius, place = radius_px(info.camera).reshape(-1), image_places(info.camera).reshape(-1, 2)
    out = [np.empty_like(v.measured) for v in views]
    for i, maker in enumerate(_makers(info)):
        hz, raw = maker.modulation_hz, []
        for v in views:
            celsius = v.celsius if np.isfinite(v.celsius) else maker.reference_celsius
            turned = 4 * np.pi * hz / SPEED_OF_LIGHT * v.true
            known = maker.at(turned, radius[v.pixels], celsius, place[v.pixels], v.amplitude[i])
            raw.append(v.measured[i] - v.true - known)
        middle = _circular_mean(np.concatenate(raw), hz)
        for own, r in zip(out, raw, strict=True):
            own[i] = middle + wrapped(r - middle, hz)
    return out


def _circular_mean(values: Float64, hz: float) -> float:
    """Circular mean, metres; refuses values all round the circle."""
    turn = 4 * np.pi * hz / SPEED_OF_LIGHT
    z = np.exp(1j * turn * values).mean()
    if abs(z) < 0.5:
        raise QualityError(
            f"ranges: at {hz / 1e6:g} MHz measured and true ranges have no fixed difference (concentration {abs(z):.2f})",
            hint="wrong frequency, phase order or sign (tofcapture calibrate phase-order), or the rig of another station",
        )
    return float(np.angle(z) / turn)


def _solve(p: _Problem, rounds: int) -> _Found:
    """Solve for the shared unknowns, with so many rounds of spreads and robust weights."""
    robust = [np.ones_like(y) for y in p.y]
    variances: Float64 = np.full((len(p.y[0]), OWN), START_SPREAD**2)
    for _ in range(rounds):
        reduced = [_reduced(p, v, robust[v], variances) for v in range(len(p.y))]
        H = sum(r[0] for r in reduced) + np.diag(p.prior**-2.0)
        g = sum(r[1] for r in reduced) + p.expected / np.square(p.prior)
        x = np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        own = [_own(p, v, robust[v], variances, x) for v in range(len(p.y))]
        moments = np.stack([m for _, m in own])
        variances = np.asarray(
            (moments.sum(axis=0) + BELIEF * START_SPREAD**2) / (len(p.y) + BELIEF), dtype=np.float64
        )
        robust = [_tukey(p, v, x, b) for v, (b, _) in enumerate(own)]
    left_out = np.stack([np.linalg.solve(H - h, g - b) for h, b in reduced])
    covariance = np.linalg.inv(H)
    believed = covariance @ np.diag(p.prior**-2.0) @ covariance
    return _Found(x, left_out, jackknife(left_out)[1] + believed, variances)


def _eliminated(
    p: _Problem, v: int, i: int, robust: Float64, variances: Float64
) -> tuple[Float64, Float64, Float64, Float64]:
    """Columns (N, U) of one view and frequency, its weights times them, and of its own errors the weighted columns and covariance."""
    w = (robust[i] * p.weight[v][i])[:, None]
    BW = p.own[v] * w
    return p.shared[v][i], p.shared[v][i] * w, BW, np.linalg.inv(BW.T @ p.own[v] + np.diag(1 / variances[i]))


def _reduced(p: _Problem, v: int, robust: Float64, variances: Float64) -> tuple[Float64, Float64]:
    """Equations of the shared unknowns of one view, its own ones eliminated."""
    H, g = np.zeros((len(p.prior), len(p.prior))), np.zeros(len(p.prior))
    for i, y in enumerate(p.y[v]):
        A, AW, BW, C = _eliminated(p, v, i, robust, variances)
        gain = (AW.T @ p.own[v]) @ C
        H += AW.T @ A - gain @ (BW.T @ A)
        g += AW.T @ y - gain @ (BW.T @ y)
    return H, g


def _own(p: _Problem, v: int, robust: Float64, variances: Float64, x: Float64) -> tuple[Float64, Float64]:
    """A view's own errors (F, OWN) and their second moments."""
    out, moments = np.zeros_like(variances), np.zeros_like(variances)
    for i, y in enumerate(p.y[v]):
        A, _, BW, C = _eliminated(p, v, i, robust, variances)
        out[i] = C @ (BW.T @ (y - A @ x))
        moments[i] = np.square(out[i]) + np.diag(C)
    return out, moments


def _tukey(p: _Problem, v: int, x: Float64, own: Float64) -> Float64:
    left = p.y[v] - p.shared[v] @ x - own @ p.own[v].T
    scaled = left * np.sqrt(p.weight[v])
    scale = np.maximum(1.4826 * np.median(np.abs(scaled), axis=1, keepdims=True), 1.0)
    out: Float64 = np.square(np.clip(1 - np.square(scaled / scale / TUKEY), 0, None))
    return out
