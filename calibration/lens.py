"""The lens from boards: every rim of cut-outs against the nearest edge of the model, every corner of a pattern against its place.

No centre of a hole is measured: a rim pixel's ray meets the board's front, and its distance to the nearest edge, in pixels, is the
residual. Unknown are the lens, one pose per view, and by how much all plates look too large; ranges play no part. The lens is
OpenCV's, as :class:`tofcapture.camera.Camera` has it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from calibration.board.fit import Model, clear_of_walls, on_front
from calibration.registration.clouds import Mask
from calibration.registration.gate import tukey_weights
from tofcapture.camera import LENS_NAMES, Camera, distorted, distortion_jacobian
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.poses import Float64, exp, transform_points

MIN_VIEWS = 5
FEW = 500  # rims of a view; the rest repeats them
SCALES = (3.0, 2.0, 1.2, 0.8, 0.8, 0.8)  # px, Tukey's scale, a step each
TYPICAL = 4.0  # times the median distance: the least scale
SETTLED = 0.002  # px, root mean square of what a step still moves
MORE_STEPS = 12
NAMES = ("fx", "fy", "cx", "cy", *LENS_NAMES)
LENS = len(NAMES)  # numbers of a lens; the growth of plates stands behind them
# One sigma of what a lens may be from where it starts: only what the views do not settle is held by it.
PRIOR = np.array([30.0, 30.0, 15.0, 15.0, 0.5, 0.5, 0.01, 0.01, 0.5, *[0.5] * 3])
MODELS = {"pinhole": 4, "k1 k2 p1 p2": 8, "k1 k2 p1 p2 k3": 9, "k1 k2 p1 p2 k3 k4 k5 k6": 12}
BETTER = 0.98  # a richer lens must lower the error at left-out views to this share
NEAR = 0.5  # px, root mean square, up to which a richer lens starts from a poorer one's answer
SURER = 0.995  # the same where it also makes rays surer
WORSE = 1.2  # times the first look's error: one of the boards found in addition is another one
LOST = 2.0  # px: the most that one rim can say against a lens
TINY = 1e-6  # of a numerical derivative by a pose or a number of the lens
HALVINGS = 6  # of a step whose lens folds
NOISE = 0.3  # px, of a rim, against the priors


class LensRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Views that do not determine a lens."""


@dataclass(frozen=True)
class BoardSeen:
    """Rims of one view."""

    pixels: Float64  #: (N, 2) rims or corners of the board, image as it was taken
    T_camera_board: Float64  #: (4, 4) first guess
    at: Float64 | None = (
        None  #: (N, 2) where on the board's front they are, metres: corners of a pattern; None: on an edge
    )

    def thinned(self) -> BoardSeen:
        """Leave out rims that repeat the rest."""
        step = slice(None, None, max(1, len(self.pixels) // FEW))
        return replace(self, pixels=self.pixels[step], at=None if self.at is None else self.at[step])


Look = Callable[
    [Camera], tuple[list[BoardSeen], list[str]]
]  # boards found with a lens, and why others were not


@dataclass(frozen=True)
class BoardLens:
    """A lens fitted to V board views."""

    camera: Camera  #: The answer
    model: str  #: Which of ``MODELS`` the views ask for
    sigma: Float64  #: (12,) one sigma of ``NAMES`` from leaving views out; 0 for what was held
    rms: float  #: Root mean square distance of rims to edges, pixels
    left_out: Float64  #: (V,) the same at each view with the lens of the others
    growth: float  #: How far rims lie off the material, pixels
    coverage: Float64  #: (2,) share of the image's width and height that rims span
    #: Largest one sigma over the image's corners of where a ray is seen, pixels, a common shift of pose taken off
    pixel_sigma: float


@dataclass(frozen=True)
class _Guess:
    """Tell where the fit stands."""

    camera: Camera
    growth: float
    poses: tuple[Float64, ...]


@dataclass(frozen=True)
class _Equations:
    """One view's equations: of the lens and growth (N, 13), of the pose (N, 6), residual and weight (N,)."""

    shared: Float64
    own: Float64
    residual: Float64
    weight: Float64
    usable: Mask  # (N,) the ray meets the board's front, clear of the walls of its holes


def fit_lens(model: Model, look: Look, camera: Camera) -> tuple[BoardLens, list[str]]:
    """Look for boards, fit a lens, and look once more with it for boards that the wrong lens hid.

    ``look`` finds the boards of all views with a lens, and says why it did not find others; ``camera`` is where to start, good to some
    per cent.

    Returns the lens of the second look, unless the boards found in addition do not fit it, and why views were not used.
    Raises as :func:`fit_lens_to_board`.
    """
    views, refused = look(camera)
    fit = fit_lens_to_board(model, views, camera)
    if refused:
        again, still = look(fit.camera)
        if len(again) > len(views):
            with suppress(ConfigError, QualityError):  # the first fit stands
                second = fit_lens_to_board(model, again, camera)
                refused, fit = (still, second) if second.rms < WORSE * fit.rms else (refused, fit)
    return fit, refused


def fit_lens_to_board(model: Model, views: Sequence[BoardSeen], camera: Camera) -> BoardLens:
    """Fit a lens to rims, as rich as the views ask for.

    At least five views, tilted, that together reach the corners of the image; ``camera`` is where to start, good to some per cent.

    :class:`DataError` for too few views, :class:`LensRefused` where no lens fits.
    """
    if len(views) < MIN_VIEWS:
        raise DataError(
            f"lens: expected at least {MIN_VIEWS} views with the board, got {len(views)}",
            hint="record the board tilted 20 to 40 degrees in all directions, also in the corners of the image",
        )
    thin = [v.thinned() for v in views]
    best, at = None, _Guess(camera, 0.0, tuple(v.T_camera_board for v in thin))
    for name, free in MODELS.items():
        found, there = _fit(model, thin, _saturating(at) if free == LENS else at, camera, name, free)
        # Where rays become surer too, less will do.
        share = SURER if best and found.pixel_sigma < best.pixel_sigma else BETTER
        if best is None or _rms(found.left_out) < share * _rms(best.left_out):
            best, at = found, there if found.rms < NEAR else at
    if best is None or best.rms > 1.0:
        raise LensRefused(
            f"lens refused, poor fit: rims lie {best.rms if best else np.nan:.2f} px off the board's edges, expected below 1",
            hint="another board, a bent one, or a lens beyond this model (fish-eye)",
        )
    return best


def lens_values(camera: Camera) -> Float64:
    """Return the (12,) numbers of ``NAMES``."""
    known = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    return np.pad(known, (0, LENS - len(known)))


def _camera(values: Float64, like: Camera) -> Camera:
    fx, fy, cx, cy, *distortion = values.tolist()
    return Camera(like.width, like.height, fx, fy, cx, cy, tuple(distortion))


def _saturating(guess: _Guess) -> _Guess:
    """Start a rational lens near a polynomial barrel, as ``(1 + a r^2) / (1 + b r^2)``; with 9 a > b it folds nowhere."""
    k1, k2, p1, p2 = lens_values(guess.camera)[4:8].tolist()
    if k1 >= 0:
        return guess
    b = max(-k2 / k1, 0.0)  # the Pade approximant
    a, b = (k1 + b, b) if 8 * (k1 + b) > b else (-k1 / 7, -8 * k1 / 7)
    return replace(guess, camera=replace(guess.camera, distortion=(a, 0.0, p1, p2, 0.0, b, 0.0, 0.0)))


def _fit(
    model: Model, views: Sequence[BoardSeen], guess: _Guess, believed: Camera, name: str, free: int
) -> tuple[BoardLens, _Guess]:
    """Fit a model of ``free`` numbers from where the last one got to; what the views leave open is held at what was believed."""
    begin = lens_values(believed)

    def linearised(scale: float) -> list[_Equations]:
        return _weighed(
            [_equations(model, v, T, guess) for v, T in zip(views, guess.poses, strict=True)], scale
        )

    for step in range(len(SCALES) + MORE_STEPS):
        equations = linearised(SCALES[min(step, len(SCALES) - 1)])
        delta = _without_fold(guess.camera, _solve(equations, lens_values(guess.camera) - begin, free))
        guess = _moved(guess, delta, equations, free)
        moves = [np.mean((e.shared @ delta) ** 2) for e in equations]
        if step >= len(SCALES) and np.sqrt(np.mean(moves)) < SETTLED:
            break
    equations = linearised(SCALES[-1])
    away = lens_values(guess.camera) - begin
    without = np.stack([_solve([e for e in equations if e is not own], away, free) for own in equations])
    n = len(equations)
    few = (n - 1) / max(n - 3, 1)  # Student's t has that variance
    spread = few * (n - 1) / n * (without - without.mean(axis=0)).T @ (without - without.mean(axis=0))
    pixels = np.concatenate([v.pixels for v in views])
    fitted = BoardLens(
        camera=guess.camera,
        model=name,
        sigma=np.sqrt(np.diag(spread))[:LENS],
        rms=_rms(np.array([_left(e, np.zeros(LENS + 1)) for e in equations])),
        left_out=np.array([_left(e, d) for e, d in zip(equations, without, strict=True)]),
        growth=guess.growth,
        coverage=np.ptp(pixels, axis=0) / [believed.width, believed.height],
        pixel_sigma=_pixel_sigma(guess.camera, spread[:LENS, :LENS]),
    )
    return fitted, guess


def _weighed(equations: Sequence[_Equations], scale: float) -> list[_Equations]:
    """Weigh rims by Tukey's rule; far from the answer most lie farther off than ``scale``, pixels, and none may be lost."""
    off = np.abs(np.concatenate([e.residual[e.usable] for e in equations]))
    scale = max(scale, TYPICAL * float(np.median(off))) if len(off) else scale
    return [replace(e, weight=e.weight * tukey_weights(e.residual, scale)) for e in equations]


def _equations(model: Model, view: BoardSeen, T: Float64, guess: _Guess) -> _Equations:
    camera = guess.camera
    if view.at is not None:
        return _corner_equations(
            np.column_stack([view.at, np.full(len(view.at), model.board.thickness)]), view, T, guess
        )
    rays = camera.rays_at(view.pixels)
    xy = on_front(T, model.board, rays)
    edges = model.edges(xy)
    points = np.column_stack([xy, np.full(len(xy), model.board.thickness)]) @ T[:3, :3].T + T[:3, 3]
    per_metre = 0.5 * (camera.fx + camera.fy) / points[:, 2]  # pixels
    residual = edges.distance * per_metre - guess.growth
    gradient = edges.gradient * per_metre[:, None]
    n = T[:3, 2]
    across = gradient @ T[:3, :2].T
    # The ray meets the front elsewhere when the ray or the board moves: the part along the ray keeps the point on the plane.
    slide = across - ((across * rays).sum(axis=1) / (rays @ n))[:, None] * n
    own = -np.column_stack([slide, np.cross(points, slide)])
    by_lens = [(d * points[:, 2:] * slide).sum(axis=1) for d in _ray_derivatives(camera, rays)]
    shared = np.column_stack([*by_lens, -np.ones(len(xy))])
    good = clear_of_walls(T, model.board, xy, edges.outward) & np.isfinite(residual)
    return _Equations(shared, own, np.nan_to_num(residual), good.astype(np.float64), good)


def _ray_derivatives(camera: Camera, rays: Float64) -> Float64:
    """Derivative (12, N, 3) of the rays (N, 3) through fixed pixels by each number of the lens, by the implicit function theorem."""
    c = np.pad(np.array(camera.distortion), (0, 8 - len(camera.distortion)))
    xy, (x, y) = rays[:, :2], rays[:, :2].T
    r2 = x * x + y * y
    under = 1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7]))
    radial = (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))) / under
    powers = np.stack([r2, r2**2, r2**3])
    k = np.concatenate([powers / under, -powers * radial / under])[..., None] * xy
    p1, p2 = np.stack([2 * x * y, r2 + 2 * y * y], axis=1), np.stack([r2 + 2 * x * x, 2 * x * y], axis=1)
    goal = distorted(xy, c)
    wide, high = np.array([1.0, 0.0]) / camera.fx, np.array([0.0, 1.0]) / camera.fy
    middle = np.ones_like(xy)
    moved = np.stack([goal * wide, goal * high, middle * wide, middle * high, k[0], k[1], p1, p2, *k[2:]])
    inverse = np.linalg.pinv(distortion_jacobian(xy, c))  # where the image nearly folds it has no inverse
    return np.pad(-np.einsum("nij,knj->kni", inverse, moved), ((0, 0), (0, 0), (0, 1)))


def _corner_equations(at: Float64, view: BoardSeen, T: Float64, guess: _Guess) -> _Equations:
    """Equations of corners (N, 3), board frame, seen at known pixels: both coordinates of each."""
    camera, values = guess.camera, lens_values(guess.camera)

    def off(camera: Camera, T: Float64) -> Float64:
        out: Float64 = (camera.project(transform_points(T, at))[0] - view.pixels).reshape(-1)
        return out

    residual, turns = off(camera, T), TINY * np.eye(6)
    own = np.stack([(off(camera, exp(turn) @ T) - residual) / TINY for turn in turns], axis=1)
    changed = [_camera(values + TINY * row, camera) for row in np.eye(LENS)]
    by_lens = [(off(c, T) - residual) / TINY for c in changed]
    shared = np.column_stack([*by_lens, np.zeros(len(residual))])
    good = np.isfinite(np.column_stack([residual, own, shared])).all(axis=1)
    shared, own, residual = (np.where(np.isfinite(x), x, 0.0) for x in (shared, own, residual))
    return _Equations(shared, own, residual, good.astype(np.float64), np.asarray(good))


def _solve(equations: Sequence[_Equations], away: Float64, free: int) -> Float64:
    """Step (13,) of lens and growth, poses eliminated; what is not free stays."""
    use = np.r_[np.arange(free), LENS]
    H = np.diag(np.r_[(NOISE / PRIOR) ** 2, 1e-3])
    g = np.r_[-((NOISE / PRIOR) ** 2) * away, 0.0]
    for e in equations:
        A, B, w = e.shared, e.own, e.weight[:, None]
        gain = (A * w).T @ B @ np.linalg.pinv((B * w).T @ B)
        H = H + (A * w).T @ A - gain @ ((B * w).T @ A)
        g = g - (A * w).T @ e.residual + gain @ ((B * w).T @ e.residual)
    out = np.zeros(LENS + 1)
    out[use] = np.linalg.solve(H[np.ix_(use, use)], g[use])
    return out


def _without_fold(camera: Camera, delta: Float64) -> Float64:
    """Halve a step (13,) until its lens does not fold, and take none where the smallest does: far from the answer steps go too far."""
    for _ in range(HALVINGS):
        with suppress(ConfigError):
            _camera(lens_values(camera) + delta[:LENS], camera).rays_at(_grid(camera))
            return delta
        delta = delta / 2
    return np.zeros_like(delta)


def _pose_step(e: _Equations, delta: Float64) -> Float64:
    w = e.weight[:, None]
    out: Float64 = -np.linalg.pinv((e.own * w).T @ e.own) @ ((e.own * w).T @ (e.residual + e.shared @ delta))
    return out


def _moved(guess: _Guess, delta: Float64, equations: Sequence[_Equations], free: int) -> _Guess:
    values = lens_values(guess.camera) + np.where(np.arange(LENS) < free, delta[:LENS], 0.0)
    poses = tuple(exp(_pose_step(e, delta)) @ T for e, T in zip(equations, guess.poses, strict=True))
    return _Guess(_camera(values, guess.camera), guess.growth + float(delta[LENS]), poses)


def _left(e: _Equations, delta: Float64) -> float:
    """RMS of a view's rims, its own pose fitted again after the lens has moved by ``delta``; none counts as farther than ``LOST``."""
    left = e.residual + e.shared @ delta + e.own @ _pose_step(e, delta)
    return (
        float(np.sqrt(np.square(np.minimum(np.abs(left[e.usable]), LOST)).mean())) if e.usable.any() else LOST
    )


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _grid(camera: Camera) -> Float64:
    """Return pixels (N, 2) all over the image, its border with them."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 13), np.linspace(0, camera.height - 1, 9))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def _pixel_sigma(camera: Camera, covariance: Float64) -> float:
    """Tell what the covariance means at the image's edge, once a turn of the camera, which no user sees, is taken off."""
    rays, focal = camera.rays_at(_grid(camera)), [camera.fx, camera.fy]
    J = np.stack([(d[:, :2] * focal).ravel() for d in _ray_derivatives(camera, rays)], axis=1)
    crossed = [np.cross(axis, rays) for axis in np.eye(3)]
    turned = np.stack([(c[:, :2] - rays[:, :2] * c[:, 2:]) * focal for c in crossed]).reshape(3, -1)
    J = J - turned.T @ np.linalg.lstsq(turned.T, J, rcond=None)[0]
    return float(np.sqrt(np.einsum("ij,jk,ik->i", J, covariance, J).max()))
