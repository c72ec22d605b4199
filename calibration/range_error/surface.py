"""The stereo surface as the ToF camera's pixels see it: a plane fitted to inverse depth about every pixel."""

from __future__ import annotations

import numpy as np

from calibration.registration.clouds import TOF_MARGIN, Mask, dilate, plane_departure
from tofcapture.camera import Camera
from tofcapture.poses import Float64

WINDOW = 2  # px about a ToF pixel whose stereo points make its plane
FEWEST = 30  # stereo points in the window
BENT = 0.0015  # m; scatter of the points about the plane of a pixel that sees more than one surface
JUMP = 0.004  # m; departure of the surface from its neighbours that marks an edge
GRAZING = 0.5  # smallest cosine between ray and normal


def surface_at_pixels(points: Float64, camera: Camera) -> tuple[Float64, Mask]:
    """Plane of the points about every pixel.

    Inverse depth is linear over the image on a plane, ``1/z = m . (x, y, 1)``: m is fitted to the points that fall into the
    window of a pixel, so that flat and slightly bent boards, walls and boxes all serve.

    Parameters
    ----------
    points
        (M, 3) camera frame, metres.
    camera
        Intrinsics.

    Returns
    -------
    planes
        (H, W, 3) m with ``m . p = 1``, 1 / metres; NaN where too few points are.
    good
        (H, W) the window holds one smooth surface, not seen at a grazing angle.
    """
    points = points[points[:, 2] > 0]
    moments, present = _moments(points, camera)
    M = np.zeros((*camera.shape, 3, 3))
    count = moments[..., 0]
    for k, (i, j) in enumerate(((2, 2), (2, 0), (2, 1), (0, 0), (0, 1), (1, 1))):
        M[..., i, j] = M[..., j, i] = moments[..., k]
    right = moments[..., 6:9]
    enough = (count >= FEWEST) & (np.abs(np.linalg.det(M)) > 1e-12 * np.maximum(count, 1) ** 3)
    planes = np.full((*camera.shape, 3), np.nan)
    # Coordinates are centred on the pixel's ray, where the matrices are best conditioned.
    local = np.linalg.solve(M[enough], right[enough][..., None])[..., 0]
    square = moments[..., 9][enough] - (local * right[enough]).sum(axis=-1)
    scatter = np.full(camera.shape, np.inf)
    scatter[enough] = np.sqrt(np.maximum(square, 0) / count[enough]) / np.square(local[:, 2])
    ray = camera.rays[enough]
    local[:, 2] -= local[:, 0] * ray[:, 0] + local[:, 1] * ray[:, 1]
    planes[enough] = local
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = 1 / (planes * camera.rays).sum(axis=-1)
        cosine = 1 / (depth * camera.ray_lengths * np.linalg.norm(planes, axis=-1))
        edge = dilate(plane_departure(depth) > JUMP, TOF_MARGIN)
        good = enough & ~edge & ~dilate(~present, 1) & (scatter < BENT) & (cosine > GRAZING) & (depth > 0)
    return planes, good


def _moments(points: Float64, camera: Camera) -> tuple[Float64, Mask]:
    """Sums (H, W, 10) over the windows of 1, x, y, xx, xy, yy, xw, yw, w, ww, centred, and which pixels hold a point."""
    H, W = camera.shape
    pixels, z = camera.project(points)
    at = np.rint(pixels)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < W) & (at[:, 1] < H)
    u, v = at[inside].astype(np.intp).T
    own = v * W + u
    x, y = (points[inside, :2] / z[inside, None]).T
    w = 1 / z[inside]
    middle = camera.rays[H // 2, W // 2, :2]
    x, y = x - middle[0], y - middle[1]
    terms = (np.ones_like(w), x, y, x * x, x * y, y * y, x * w, y * w, w, w * w)
    total: Float64 = np.stack(
        [np.bincount(own, t, H * W).reshape(H, W).astype(np.float64) for t in terms], axis=-1
    )
    present = total[..., 0] > 0
    total = _box(total)
    return _shifted(total, camera.rays[..., :2] - middle), present


def _box(image: Float64) -> Float64:
    """Sum over windows."""
    size = 2 * WINDOW + 1
    for axis in (0, 1):
        pad = [(0, 0)] * image.ndim
        pad[axis] = (WINDOW + 1, WINDOW)
        run = np.cumsum(np.pad(image, pad), axis=axis)
        n = image.shape[axis]
        image = np.take(run, range(size, size + n), axis) - np.take(run, range(n), axis)
    return image


def _shifted(m: Float64, to: Float64) -> Float64:
    """Moments about another origin ``to`` (H, W, 2)."""
    a, b = to[..., 0], to[..., 1]
    n, x, y, xx, xy, yy, xw, yw, w, ww = np.moveaxis(m, -1, 0)
    return np.stack(
        [
            n,
            x - a * n,
            y - b * n,
            xx - 2 * a * x + a * a * n,
            xy - a * y - b * x + a * b * n,
            yy - 2 * b * y + b * b * n,
            xw - a * w,
            yw - b * w,
            w,
            ww,
        ],
        axis=-1,
    )
