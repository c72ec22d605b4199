"""The lens from a board with cut-outs: every rim that the ToF camera sees against the nearest edge of the board's model.

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
from calibration.registration.gate import tukey_weights
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.poses import Float64, exp

MIN_VIEWS = 5
FEW = 500  # rims of a view; the rest repeats them
SCALES = (3.0, 2.0, 1.2, 0.8, 0.8, 0.8)  # px, Tukey's scale, a step each
SETTLED = 0.002  # px, root mean square of what a step still moves
MORE_STEPS = 12
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
STEP = np.array([0.01, 0.01, 0.01, 0.01, 1e-5, 1e-5, 1e-6, 1e-6, 1e-5])  # of a numerical derivative
# One sigma of what a lens may be from where it starts: only what the views do not settle is held by it.
PRIOR = np.array([30.0, 30.0, 15.0, 15.0, 0.5, 0.5, 0.01, 0.01, 0.5])
MODELS = {"pinhole": 4, "k1 k2 p1 p2": 8, "k1 k2 p1 p2 k3": 9}
BETTER = 0.98  # a richer lens must lower the error at left-out views to this share
WORSE = 1.2  # times the first look's error: one of the boards found in addition is another one
HALVINGS = 6  # of a step whose lens folds
NOISE = 0.3  # px, of a rim, against the priors


class LensRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Views that do not determine a lens."""


@dataclass(frozen=True)
class BoardSeen:
    """Rims of one view."""

    pixels: Float64  #: (N, 2) rims of the board, image as it was taken
    T_camera_board: Float64  #: (4, 4) first guess


Look = Callable[
    [Camera], tuple[list[BoardSeen], list[str]]
]  # boards found with a lens, and why others were not


@dataclass(frozen=True)
class BoardLens:
    """A lens fitted to V board views."""

    camera: Camera  #: The answer
    model: str  #: Which of ``MODELS`` the views ask for
    sigma: Float64  #: (9,) one sigma of ``NAMES`` from leaving views out; 0 for what was held
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
    """One view's equations: of the lens and growth (N, 10), of the pose (N, 6), residual and weight (N,)."""

    shared: Float64
    own: Float64
    residual: Float64
    weight: Float64


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
    thin = [replace(v, pixels=v.pixels[:: max(1, len(v.pixels) // FEW)]) for v in views]
    best: BoardLens | None = None
    for name, free in MODELS.items():
        try:
            found = _fit(model, thin, best.camera if best else camera, name, free)
        except ConfigError:  # it folds: the views do not ask for that much lens
            if best is None:
                raise
            break
        if best is None or _rms(found.left_out) < BETTER * _rms(best.left_out):
            best = found
    if best is None or best.rms > 1.0:
        raise LensRefused(
            f"lens refused, poor fit: rims lie {best.rms if best else np.nan:.2f} px off the board's edges, expected below 1",
            hint="another board, a bent one, or a lens beyond this model (fish-eye)",
        )
    return best


def lens_values(camera: Camera) -> Float64:
    """Return the (9,) numbers of ``NAMES``."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *(camera.distortion or (0.0,) * 5)])


def _camera(values: Float64, like: Camera) -> Camera:
    fx, fy, cx, cy, *distortion = values.tolist()
    return Camera(like.width, like.height, fx, fy, cx, cy, tuple(distortion))


def _fit(model: Model, views: Sequence[BoardSeen], start: Camera, name: str, free: int) -> BoardLens:
    guess = _Guess(start, 0.0, tuple(v.T_camera_board for v in views))
    begin = lens_values(start)

    def linearised(scale: float) -> list[_Equations]:
        return [_equations(model, v, T, guess, scale) for v, T in zip(views, guess.poses, strict=True)]

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
    spread = (n - 1) / n * (without - without.mean(axis=0)).T @ (without - without.mean(axis=0))
    pixels = np.concatenate([v.pixels for v in views])
    return BoardLens(
        camera=guess.camera,
        model=name,
        sigma=np.sqrt(np.diag(spread))[:9],
        rms=_rms(np.array([_left(e, np.zeros(10)) for e in equations])),
        left_out=np.array([_left(e, d) for e, d in zip(equations, without, strict=True)]),
        growth=guess.growth,
        coverage=np.ptp(pixels, axis=0) / [start.width, start.height],
        pixel_sigma=_pixel_sigma(guess.camera, spread[:9, :9]),
    )


def _equations(model: Model, view: BoardSeen, T: Float64, guess: _Guess, scale: float) -> _Equations:
    camera = guess.camera
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
    by_lens = [(d * points[:, 2:] * slide).sum(axis=1) for d in _ray_derivatives(camera, view.pixels, rays)]
    shared = np.column_stack([*by_lens, -np.ones(len(xy))])
    good = clear_of_walls(T, model.board, xy, edges.outward) & np.isfinite(residual)
    weight = np.where(good, tukey_weights(np.nan_to_num(residual), scale), 0.0)
    return _Equations(shared, own, np.nan_to_num(residual), weight)


def _ray_derivatives(camera: Camera, pixels: Float64, rays: Float64) -> list[Float64]:
    """Derivative (N, 3) of the rays through pixels (N, 2) by each number of the lens."""
    out = []
    for k, h in enumerate(STEP):
        values = lens_values(camera)
        values[k] += h
        out.append((_camera(values, camera).rays_at(pixels) - rays) / h)
    return out


def _solve(equations: Sequence[_Equations], away: Float64, free: int) -> Float64:
    """Step (10,) of lens and growth, poses eliminated; what is not free stays."""
    use = np.r_[np.arange(free), 9]
    H = np.diag(np.r_[(NOISE / PRIOR) ** 2, 1e-3])
    g = np.r_[-((NOISE / PRIOR) ** 2) * away, 0.0]
    for e in equations:
        A, B, w = e.shared, e.own, e.weight[:, None]
        gain = (A * w).T @ B @ np.linalg.pinv((B * w).T @ B)
        H = H + (A * w).T @ A - gain @ ((B * w).T @ A)
        g = g - (A * w).T @ e.residual + gain @ ((B * w).T @ e.residual)
    out = np.zeros(10)
    out[use] = np.linalg.solve(H[np.ix_(use, use)], g[use])
    return out


def _without_fold(camera: Camera, delta: Float64) -> Float64:
    """Halve a step (10,) until its lens does not fold; :class:`ConfigError` when the smallest does.

    Far from the answer the first steps go too far.
    """
    for tried in range(HALVINGS + 1):
        try:
            _camera(lens_values(camera) + delta[:9], camera).rays  # noqa: B018  which inverts the lens at every pixel
            break
        except ConfigError:
            if tried == HALVINGS:
                raise
            delta = delta / 2
    return delta


def _pose_step(e: _Equations, delta: Float64) -> Float64:
    w = e.weight[:, None]
    out: Float64 = -np.linalg.pinv((e.own * w).T @ e.own) @ ((e.own * w).T @ (e.residual + e.shared @ delta))
    return out


def _moved(guess: _Guess, delta: Float64, equations: Sequence[_Equations], free: int) -> _Guess:
    values = lens_values(guess.camera) + np.where(np.arange(9) < free, delta[:9], 0.0)
    poses = tuple(exp(_pose_step(e, delta)) @ T for e, T in zip(equations, guess.poses, strict=True))
    return _Guess(_camera(values, guess.camera), guess.growth + float(delta[9]), poses)


def _left(e: _Equations, delta: Float64) -> float:
    """RMS of a view's rims, its own pose fitted again after the lens has moved by ``delta``."""
    left = e.residual + e.shared @ delta + e.own @ _pose_step(e, delta)
    return float(np.sqrt((e.weight * left**2).sum() / max(e.weight.sum(), 1e-9)))


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _pixel_sigma(camera: Camera, covariance: Float64) -> float:
    """Tell what the covariance means at the image's edge, once a turn of the camera, which no user sees, is taken off."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 7))
    pixels, focal = np.stack([u.ravel(), v.ravel()], axis=1), [camera.fx, camera.fy]
    rays = camera.rays_at(pixels)
    J = np.stack([(d[:, :2] * focal).ravel() for d in _ray_derivatives(camera, pixels, rays)], axis=1)
    crossed = [np.cross(axis, rays) for axis in np.eye(3)]
    turned = np.stack([(c[:, :2] - rays[:, :2] * c[:, 2:]) * focal for c in crossed]).reshape(3, -1)
    J = J - turned.T @ np.linalg.lstsq(turned.T, J, rcond=None)[0]
    return float(np.sqrt(np.einsum("ij,jk,ik->i", J, covariance, J).max()))
