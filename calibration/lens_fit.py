"""A lens fitted to target views in the amplitude image, or to the sensor's own rays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.lens import LensFit, LensRefused, LensView, circle_centres, pixels_of
from calibration.lens_start import checked, homography, initial_camera, initial_pose
from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.poses import Float64, check_transform, rotation_exp, rotation_log, transform

MIN_VIEWS = 3
LOOSE_FOCAL = (
    0.01  # relative standard deviation of the focal length beyond which the views do not determine it
)
LOSS = 1.0  # px; residuals beyond count linearly
RIGHT_RMS = 3.0  # px; beyond it points and pixels do not belong together


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

    seen = [checked(v, i, width, height) for i, v in enumerate(views)]
    if len(seen) < MIN_VIEWS:
        raise DataError(
            f"lens: expected at least {MIN_VIEWS} views, got {len(seen)}",
            hint="record the target tilted 20 to 40 degrees in all directions, also in the corners of the image",
        )
    homographies = [homography(v.points[:, :2], v.pixels) for v in seen]
    camera = guess or initial_camera(homographies, width, height)
    poses = [initial_pose(H, camera, i) for i, H in enumerate(homographies)]
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
        return np.asarray((pixels_of(_unpacked(values, free, width, height)[0], xy) - pixels).ravel())

    start = np.array([fx, fy, cx, cy, 0, 0, 0, 0, 0])[free]
    found = least_squares(off, start, x_scale="jac")
    residual = off(found.x).reshape(-1, 2)
    lens = _unpacked(found.x, free, width, height)[0]
    fit = LensFit(lens, _sigma(found.jac, residual, free), _rms(residual), residual, (), 1.0)
    _check_fit(fit)
    return fit


def _unpacked(
    values: Float64, free: NDArray[np.bool_], width: int, height: int
) -> tuple[Camera, list[Float64]]:
    inner = np.zeros(9)
    count = int(free.sum())
    inner[free] = values[:count]
    focal = np.maximum(inner[:2], 1e-3)
    fx, fy = focal.tolist()
    cx, cy = inner[2:4].tolist()
    camera = Camera(width, height, fx, fy, cx, cy, tuple(inner[4:].tolist()))
    poses = [transform(rotation_exp(p[3:]), p[:3]) for p in values[count:].reshape(-1, 6)]
    return camera, poses


def _view_residual(lens: Camera, T: Float64, view: LensView) -> Float64:
    if view.radius:
        return pixels_of(lens, circle_centres(T, view.points, view.radius)) - view.pixels
    at = view.points @ T[:3, :3].T + T[:3, 3]
    return pixels_of(lens, at[:, :2] / np.maximum(at[:, 2:], 1e-3)) - view.pixels


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
    camera = fit.camera
    loose = float(max(fit.sigma[0] / camera.fx, fit.sigma[1] / camera.fy))
    if loose > LOOSE_FOCAL:
        raise LensRefused(
            f"lens refused, focal length undetermined: its standard deviation is {100 * loose:.0f} %, expected below "
            f"{100 * LOOSE_FOCAL:.0f} %",
            hint="tilt the target by 20 to 40 degrees in all directions; views parallel to the image say nothing of it",
        )
    for T in fit.T_camera_target:
        check_transform(T, "lens: target pose")
