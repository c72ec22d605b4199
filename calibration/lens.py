"""The lens of the ToF camera: OpenCV's model fitted to target views in the amplitude image, or to the sensor's own rays.

A point (X, Y, Z) has x = X/Z, y = Y/Z, r^2 = x^2 + y^2 and is seen at ``x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y +
p2 (r^2 + 2 x^2)``, ``y' = y (...) + p1 (r^2 + 2 y^2) + 2 p2 x y``, ``u = fx x' + cx``, ``v = fy y' + cy``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError, QualityError
from tofcapture.poses import Float64, check_transform, rotation_exp, rotation_log, transform

MIN_VIEWS = 3
MIN_POINTS = 6  # per view
LOOSE_FOCAL = (
    0.01  # relative standard deviation of the focal length beyond which the views do not determine it
)
LOSS = 1.0  # px; residuals beyond count linearly
RIGHT_RMS = 3.0  # px; beyond it points and pixels do not belong together


class LensRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Views that do not determine a lens."""


@dataclass(frozen=True)
class Lens:
    """A pinhole camera behind a lens: OpenCV's five distortion coefficients.

    Attributes
    ----------
    camera
        Size, focal lengths and principal point.
    k1, k2, p1, p2, k3
        Distortion, dimensionless, in OpenCV's order.
    """

    camera: Camera
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def coefficients(self) -> Float64:
        """(5,) in OpenCV's order."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def project(self, points: NDArray[np.floating]) -> Float64:
        """Pixels (..., 2) of points (..., 3) in the camera frame, metres; NaN at or behind the camera."""
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return self.pixels(points[..., :2] / z)

    def pixels(self, xy: Float64) -> Float64:
        """Pixels (..., 2) of undistorted image coordinates (..., 2) at z = 1."""
        c = self.camera
        return distorted(xy, self.coefficients) * [c.fx, c.fy] + [c.cx, c.cy]

    def undistort(self, pixels: NDArray[np.floating], iterations: int = 30) -> Float64:
        """Undistorted coordinates (..., 2) at z = 1 of pixels (..., 2); Newton's method, to 1e-12.

        Raises
        ------
        DataError
            When the model folds before it reaches a pixel: it was fitted on a smaller part of the image.
        """
        c = self.camera
        goal = (np.asarray(pixels, dtype=np.float64) - [c.cx, c.cy]) / [c.fx, c.fy]
        xy = goal.copy()
        for _ in range(iterations):
            off = distorted(xy, self.coefficients) - goal
            xy = xy - np.linalg.solve(_distortion_jacobian(xy, self.coefficients), off[..., None])[..., 0]
        off = np.abs(distorted(xy, self.coefficients) - goal)
        if np.nanmax(off, initial=0.0) > 1e-9:
            raise DataError(
                "lens: the distortion cannot be inverted over the whole image",
                hint="targets must have covered the corners of the image; fit with fewer coefficients",
            )
        return xy

    @cached_property
    def rays(self) -> Float64:
        """(H, W, 3) rays with z = 1 through the pixel centres: what ``Camera.rays`` would be."""
        v, u = np.mgrid[0 : self.camera.height, 0 : self.camera.width].astype(np.float64)
        xy = self.undistort(np.stack([u, v], axis=-1))
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


@dataclass(frozen=True)
class LensView:
    """Points of a target and where one image shows them.

    Attributes
    ----------
    points
        (N, 3) target frame, metres; z = 0 on a plane target.
    pixels
        (N, 2) as (u, v), pixel centres at integers; NaN where a point was not found.
    radius
        Radius of round holes whose ellipses were centred, metres; 0 for points. The centre of an ellipse is not the image of
        the circle's centre: at 40 degrees and 0.5 m a 60 mm hole is off by some tenths of a pixel.
    """

    points: Float64
    pixels: Float64
    radius: float = 0.0


@dataclass(frozen=True)
class LensFit:
    """A fitted lens.

    Attributes
    ----------
    lens
        The answer.
    sigma
        (9,) standard deviations of fx, fy, cx, cy, k1, k2, p1, p2, k3; 0 for what was held.
    rms
        Root mean square distance, pixels.
    residuals
        (M, 2) pixels, predicted minus seen, all views.
    T_camera_target
        One (4, 4) per view; empty when fitted to rays.
    coverage
        Share of the image's width and height that the points span, the smaller one.
    """

    lens: Lens
    sigma: Float64
    rms: float
    residuals: Float64
    T_camera_target: tuple[Float64, ...]
    coverage: float


def distorted(xy: Float64, coefficients: Float64) -> Float64:
    """OpenCV's distortion of coordinates (..., 2) at z = 1."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _distortion_jacobian(xy: Float64, coefficients: Float64) -> Float64:
    k1, k2, p1, p2, k3 = coefficients
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy_ = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return np.stack([np.stack([xx, xy_], axis=-1), np.stack([xy_, yy], axis=-1)], axis=-2)


def circle_centres(T: Float64, centres: Float64, radius: float) -> Float64:
    """Centres (N, 2), at z = 1, of the ellipses that circles (N, 3) in planes z = const of the target appear as.

    From the dual conic: ``C* = H diag(r^2, r^2, -1) H^T`` with H = [R_x, R_y, T c]; its last column is the centre.
    """
    at = centres @ T[:3, :3].T + T[:3, 3]
    plane = T[:3, :2] @ T[:3, :2].T * radius**2
    last = plane[2] - at * at[:, 2:]
    return np.asarray(last[:, :2] / last[:, 2:])


def fit_lens(
    views: Sequence[LensView], width: int, height: int, guess: Camera | None = None, *, k3: bool = True
) -> LensFit:
    """Fit a lens to views of plane targets.

    Bundle adjustment over intrinsics, distortion and one pose per view, started by homographies (Zhang, PAMI 22(11), 2000).

    Parameters
    ----------
    views
        At least three, tilted in different directions.
    width, height
        Image size, pixels.
    guess
        Focal length and principal point to start from; found from the views when None.
    k3
        Fit the third radial coefficient; without it 0.

    Returns
    -------
    LensFit

    Raises
    ------
    DataError
        Too few views or points, NaN points, mirrored targets, targets that are not plane.
    LensRefused
        Views that determine no focal length, or points and pixels that do not belong together.
    """
    from scipy.optimize import least_squares

    seen = [_checked(v, i, width, height) for i, v in enumerate(views)]
    if len(seen) < MIN_VIEWS:
        raise DataError(
            f"lens: expected at least {MIN_VIEWS} views, got {len(seen)}",
            hint="record the target tilted 20 to 40 degrees in all directions, also in the corners of the image",
        )
    homographies = [_homography(v.points[:, :2], v.pixels) for v in seen]
    camera = guess or _initial_camera(homographies, width, height)
    poses = [_initial_pose(H, camera, i) for i, H in enumerate(homographies)]
    free = np.array([True] * 8 + [k3])
    start = np.concatenate(
        [np.array([camera.fx, camera.fy, camera.cx, camera.cy, 0, 0, 0, 0, 0])[free]]
        + [np.r_[T[:3, 3], rotation_log(T[:3, :3])] for T in poses]
    )

    def off(values: Float64) -> Float64:
        lens, placed = _unpacked(values, free, width, height)
        return np.concatenate([_view_residual(lens, T, v) for T, v in zip(placed, seen, strict=True)]).ravel()

    found = least_squares(off, start, x_scale="jac", loss="soft_l1", f_scale=LOSS, max_nfev=100)
    lens, placed = _unpacked(found.x, free, width, height)
    residual = off(found.x).reshape(-1, 2)
    sigma = _sigma(found.jac, residual, free)
    fit = LensFit(lens, sigma, _rms(residual), residual, tuple(placed), _coverage(seen, width, height))
    _check_fit(fit)
    return fit


def fit_lens_to_rays(rays: NDArray[np.floating], *, k3: bool = True) -> LensFit:
    """Fit a lens to the directions a sensor reports for its pixels.

    Parameters
    ----------
    rays
        (H, W, 3), any length, z forward; NaN where unknown. Unit vectors, points of a depth image, or a lookup table.
    k3
        Fit the third radial coefficient.

    Returns
    -------
    LensFit

    Raises
    ------
    DataError
        Wrong shape, too few rays, or rays that point backwards.
    LensRefused
        Rays that no lens of this model makes.
    """
    from scipy.optimize import least_squares

    rays = np.asarray(rays, dtype=np.float64)
    if rays.ndim != 3 or rays.shape[2] != 3:
        raise DataError(f"lens: expected rays (H, W, 3), got shape {rays.shape}")
    height, width = rays.shape[:2]
    known = np.isfinite(rays).all(axis=-1)
    if known.sum() < 100 or (rays[known][:, 2] <= 0).any():
        raise DataError(
            f"lens: expected rays with z > 0, got {int(known.sum())} finite ones, {int((rays[known][:, 2] <= 0).sum())} backwards",
            hint="zeros that stand for missing points must be NaN",
        )
    pixels = np.argwhere(known)[:, ::-1].astype(np.float64)
    xy = rays[known][:, :2] / rays[known][:, 2:]
    (fx, cx), (fy, cy) = (np.polyfit(xy[:, i], pixels[:, i], 1) for i in range(2))
    if fx <= 0 or fy <= 0:
        raise DataError(
            f"lens: expected x to the right and y down, got focal lengths {fx:.0f} and {fy:.0f}",
            hint="mirrored axes: flip the rays' x or y, or the image",
        )
    free = np.array([True] * 8 + [k3])

    def off(values: Float64) -> Float64:
        return np.asarray((_unpacked(values, free, width, height)[0].pixels(xy) - pixels).ravel())

    start = np.array([fx, fy, cx, cy, 0, 0, 0, 0, 0])[free]
    found = least_squares(off, start, x_scale="jac")
    residual = off(found.x).reshape(-1, 2)
    lens = _unpacked(found.x, free, width, height)[0]
    fit = LensFit(lens, _sigma(found.jac, residual, free), _rms(residual), residual, (), 1.0)
    _check_fit(fit)
    return fit


def _checked(view: LensView, i: int, width: int, height: int) -> LensView:
    points, pixels = np.asarray(view.points, dtype=np.float64), np.asarray(view.pixels, dtype=np.float64)
    if points.shape != (len(pixels), 3) or pixels.shape != (len(points), 2):
        raise DataError(
            f"lens: view {i}: expected points (N, 3) and pixels (N, 2), got {points.shape} and {pixels.shape}"
        )
    found = np.isfinite(pixels).all(axis=1) & np.isfinite(points).all(axis=1)
    points, pixels = points[found], pixels[found]
    if len(points) < MIN_POINTS:
        raise DataError(
            f"lens: view {i}: expected at least {MIN_POINTS} found points, got {len(points)}",
            hint="drop empty views",
        )
    if np.abs(points[:, 2]).max() > 1e-9:
        raise DataError(
            f"lens: view {i}: expected a plane target with z = 0, got z up to {np.abs(points[:, 2]).max():.3g} m"
        )
    inside = (pixels > -1).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    if not inside.all():
        raise DataError(
            f"lens: view {i}: expected pixels inside {width} x {height}, got {pixels[~inside][0].tolist()}",
            hint="pixels are (u, v): column first; or the image size is wrong",
        )
    return LensView(points, pixels, view.radius)


def _homography(points: Float64, pixels: Float64) -> Float64:
    """Normalised direct linear transform from the target plane to pixels."""
    (p, N_p), (q, N_q) = _normalised(points), _normalised(pixels)
    one, zero = np.c_[p, np.ones(len(p))], np.zeros((len(p), 3))
    rows = np.concatenate([np.c_[one, zero, -q[:, :1] * one], np.c_[zero, one, -q[:, 1:] * one]])
    H = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    out = np.linalg.inv(N_q) @ H @ N_p
    return np.asarray(out / np.linalg.norm(out) * np.sign(out[2] @ np.r_[points.mean(axis=0), 1]))


def _normalised(x: Float64) -> tuple[Float64, Float64]:
    centre, scale = x.mean(axis=0), np.sqrt(2) / max(float(np.std(x - x.mean(axis=0))), 1e-12)
    N = np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])
    return (x - centre) * scale, N


def _initial_camera(homographies: Sequence[Float64], width: int, height: int) -> Camera:
    """Focal lengths from the orthogonality of the plane's axes, principal point in the middle of the image."""
    cx, cy = (width - 1) / 2, (height - 1) / 2
    rows, right = [], []
    for H in homographies:
        a, b = (H[:, i] - [cx * H[2, i], cy * H[2, i], 0] for i in (0, 1))
        for one, two in ((a, b), (a + b, a - b)):
            scale = max(abs(one[2] * two[2]), np.linalg.norm(one[:2]) * np.linalg.norm(two[:2]) / width**2)
            rows.append([one[0] * two[0] / scale, one[1] * two[1] / scale])
            right.append(-one[2] * two[2] / scale)
    inverse = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    focal = np.sqrt(1 / inverse) if (inverse > 0).all() else np.full(2, 0.9 * width)
    focal = np.clip(focal, 0.2 * width, 10 * width)
    return Camera(width, height, float(focal[0]), float(focal[1]), cx, cy)


def _initial_pose(H: Float64, camera: Camera, i: int) -> Float64:
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    M = np.linalg.inv(K) @ H
    M = M / np.sqrt(np.linalg.norm(M[:, 0]) * np.linalg.norm(M[:, 1]))
    R = np.c_[M[:, 0], M[:, 1], np.cross(M[:, 0], M[:, 1])]
    if R[2, 2] < 0 and np.linalg.det(np.c_[M[:, 0], M[:, 1], [0, 0, 1]]) < 0:
        raise DataError(
            f"lens: view {i}: the target is seen from behind, or its axes are mirrored",
            hint="target points must have x right, y down as seen by the camera, or the image is flipped",
        )
    U, _, Vt = np.linalg.svd(R)
    return transform(U @ Vt, M[:, 2])


def _unpacked(
    values: Float64, free: NDArray[np.bool_], width: int, height: int
) -> tuple[Lens, list[Float64]]:
    inner = np.zeros(9)
    count = int(free.sum())
    inner[free] = values[:count]
    focal = np.maximum(inner[:2], 1e-3)
    camera = Camera(width, height, float(focal[0]), float(focal[1]), float(inner[2]), float(inner[3]))
    poses = [transform(rotation_exp(p[3:]), p[:3]) for p in values[count:].reshape(-1, 6)]
    return Lens(camera, *inner[4:].tolist()), poses


def _view_residual(lens: Lens, T: Float64, view: LensView) -> Float64:
    if view.radius:
        return lens.pixels(circle_centres(T, view.points, view.radius)) - view.pixels
    at = view.points @ T[:3, :3].T + T[:3, 3]
    return lens.pixels(at[:, :2] / np.maximum(at[:, 2:], 1e-3)) - view.pixels


def _sigma(J: Float64, residual: Float64, free: NDArray[np.bool_]) -> Float64:
    freedom = max(residual.size - J.shape[1], 1)
    variance = float(np.square(residual).sum()) / freedom
    out = np.zeros(9)
    out[free] = np.sqrt(
        np.maximum(np.diag(np.linalg.pinv(J.T @ J, hermitian=True))[: int(free.sum())] * variance, 0)
    )
    return out


def _rms(residual: Float64) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def _coverage(views: Sequence[LensView], width: int, height: int) -> float:
    pixels = np.concatenate([v.pixels for v in views])
    return float(min(np.ptp(pixels[:, 0]) / width, np.ptp(pixels[:, 1]) / height))


def _check_fit(fit: LensFit) -> None:
    if fit.rms > RIGHT_RMS:
        raise LensRefused(
            f"lens refused, poor fit: expected residuals below {RIGHT_RMS} px, got {fit.rms:.1f}",
            hint="points and pixels in different order, a wrong target, or a lens beyond this model (fish-eye)",
        )
    camera = fit.lens.camera
    loose = float(max(fit.sigma[0] / camera.fx, fit.sigma[1] / camera.fy))
    if loose > LOOSE_FOCAL:
        raise LensRefused(
            f"lens refused, focal length undetermined: its standard deviation is {100 * loose:.0f} %, expected below "
            f"{100 * LOOSE_FOCAL:.0f} %",
            hint="tilt the target by 20 to 40 degrees in all directions; views parallel to the image say nothing of it",
        )
    for T in fit.T_camera_target:
        check_transform(T, "lens: target pose")
