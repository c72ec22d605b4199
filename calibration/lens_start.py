"""Where a lens fit starts: checked views, homographies, a first focal length and first poses (Zhang, PAMI 22(11), 2000)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.lens import LensView
from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.poses import Float64, transform

MIN_POINTS = 6  # per view


def checked(view: LensView, i: int, width: int, height: int) -> LensView:
    """Drop what was not found; :class:`DataError` names a view that cannot serve."""
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


def homography(points: Float64, pixels: Float64) -> Float64:
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


def initial_camera(homographies: Sequence[Float64], width: int, height: int) -> Camera:
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


def initial_pose(H: Float64, camera: Camera, i: int) -> Float64:
    """Pose of the target plane; :class:`DataError` when it is seen from behind."""
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
