"""Find the table and keep what stands on it.

The table is the dominant plane, or a parallel one below it: from close by, an object's flat top may fill more of the view.
The scene's object is what stands above the table, not far from where the camera looks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.libraries import compiled
from tofcapture.poses import Float64

TRIALS = 1000  # finds a plane of a fifth of the points but for 3 in 10 000
LEVEL_TRIALS = 8000  # finds a plane of a twelfth of the points but for 1 in 100
SAMPLE = 20_000  # points that vote
INLIER = 0.004  # m
VOTED = 400  # level planes that are voted on: where many are level, most are the table
REFINED = 40  # of them
DOMINANT = 0.2  # share of the points below which there is no dominant plane
LEVEL = 0.08  # the same for a level plane: seldom anything but a table is one
UPRIGHT = 0.985  # cos 10 deg; a table is at most this far from level
SLANTED = 0.866  # cos 30 deg
TALLEST = 0.4  # m; a parallel plane further below a flat top is the floor, not the table
ABOVE = 3.0  # standard deviations of the table's points; one in 700 of them is higher
LOWEST = 0.0008  # m; single points are no surer of a table
LOWEST_SMOOTH = 0.00025  # m; nor are depths of planes that were fitted to many
FINEST = 0.00015  # m; the same where the table's scatter is so small that SURE of it are less
SURE = 12.0  # standard deviations: beside things, smoothed points scatter more than the table at large
WHOLE = 100.0  # m; a crop of this radius or more is no crop
ABOVE_SMOOTH = 4.0  # standard deviations of smoothed points; a small far object has a hundred times fewer pixels than its table
FEWEST = 500  # table points that tell its scatter
PARALLEL = 0.05  # share of the points that makes a parallel plane below


@dataclass(frozen=True)
class Crop:
    """Tell where the scene's object is, ToF frame."""

    normal: Float64  #: (3,) of the table ``normal . p = offset``, unit, towards the camera; NaN: no table.
    offset: float  #: Metres.
    centre: Float64  #: (3,) what the camera looks at, metres.
    radius: float  #: Largest distance from the centre along the table, metres.
    clearance: float  #: Smallest height above the table, metres.
    far: float  #: Largest depth, metres.


def _plane_of(points: Float64) -> tuple[Float64, float]:
    """Fit a plane to (N, 3) points, its normal towards the origin."""
    mean = points.mean(axis=0)
    normal = np.linalg.eigh(np.cov((points - mean).T))[1][:, 0]
    normal = normal if normal @ mean < 0 else -normal
    return normal, float(normal @ mean)


def _candidates(points: Float64, rng: np.random.Generator, trials: int) -> tuple[Float64, Float64]:
    """Draw planes (T, 3), (T,) through random triples."""
    a, b, c = np.moveaxis(points[rng.integers(0, len(points), (trials, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-9] / length[length > 1e-9, None]
    return normals, np.einsum("tc,tc->t", normals, a[length > 1e-9])


def dominant_plane(
    points: Float64, rng: np.random.Generator, up: Float64 | None = None
) -> tuple[Float64, float, float] | None:
    """Find the plane that most points lie on: RANSAC over random triples, then three rounds of least squares over the inliers.

    Parameters
    ----------
    points, rng
        (N, 3) finite, metres; what draws the triples.
    up
        (3,) unit; only planes within 10 degrees of level count. ``None``: any.

    Returns
    -------
    Unit normal (3,) towards the origin, offset, and the inliers' RMS distance in metres; ``None`` when fewer than a
    fifth of the points agree on any plane, or a twelfth on any level one.
    """
    if len(points) < 50:
        return None
    points = points[:: max(1, len(points) // SAMPLE)]
    normals, offsets = _candidates(points, rng, TRIALS if up is None else LEVEL_TRIALS)
    if up is not None:
        level = np.flatnonzero(np.abs(normals @ up) > UPRIGHT)[:VOTED]
        normals, offsets = normals[level], offsets[level]
    if len(normals) == 0:
        return None
    voters = points[:: max(1, len(points) // 2000)]
    votes = (np.abs(voters @ normals.T - offsets) < INLIER).sum(axis=0)
    for best in np.argsort(-votes, kind="stable")[: 1 if up is None else REFINED]:
        found = _refined(points, normals[best], float(offsets[best]), DOMINANT if up is None else LEVEL)
        # Least squares may slide from a level triple to the inclined plane that it was drawn from.
        if found is not None and (up is None or abs(found[0] @ up) > UPRIGHT):
            return found
    return None


def _refined(
    points: Float64, normal: Float64, offset: float, share: float
) -> tuple[Float64, float, float] | None:
    """Fit the plane to its inliers three times; ``None`` when they become fewer than a share of the points."""
    for _ in range(3):
        inliers = points[np.abs(points @ normal - offset) < INLIER]
        if len(inliers) < max(10, share * len(points)):
            return None
        normal, offset = _plane_of(inliers)
    return normal, offset, float(np.sqrt(np.mean((inliers @ normal - offset) ** 2)))


def table_plane(
    points: Float64, rng: np.random.Generator, up: Float64
) -> tuple[Float64, float, float] | None:
    """Find the plane that things stand on.

    It is the dominant level plane, or the lowest parallel one within an object's height below it. Without a level one (an
    arm on a wall) any dominant plane is taken that is more than 30 degrees from level; one in between is an inclined object
    that fills the view. Arguments and result are those of :func:`dominant_plane`.
    """
    found = dominant_plane(points, rng, up)
    if found is None:
        found = dominant_plane(points, rng)
        if found is None or abs(found[0] @ up) > SLANTED:
            return None
    normal, offset, _ = found
    below = offset - points @ normal
    below = below[(below > 2 * INLIER) & (below < TALLEST)]
    counts, edges = np.histogram(below, bins=np.arange(0.0, TALLEST + 2 * INLIER, INLIER))
    planes = np.flatnonzero(counts[:-1] + counts[1:] >= PARALLEL * len(points))
    if len(planes) == 0:
        return found
    lower = _refined(points, normal, offset - float(edges[planes[-1] + 1]), PARALLEL / 2)
    return lower or found


def find_crop(
    points: NDArray[np.floating],
    up: Float64,
    rng: np.random.Generator,
    radius: float = 0.35,
    far: float = 2.0,
) -> Crop:
    """Find the table and the region above it that holds the scene's object.

    Without a dominant plane, or with a radius of 100 m or more, everything within ``far`` is kept.

    Parameters
    ----------
    points
        (..., 3), ToF frame, metres; NaN: not measured.
    up, rng
        (3,) unit, ToF frame: z of the arm's base, of any sign as an arm may hang; for the plane search.
    radius, far
        Largest distance of the object from the point the camera looks at, along the table; largest depth; metres.
    """
    everything = Crop(np.full(3, np.nan), np.nan, np.zeros(3), np.inf, 0.0, far)
    if radius >= WHOLE:
        return everything
    cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    cloud = cloud[np.isfinite(cloud[:, 2]) & (cloud[:, 2] > 0) & (cloud[:, 2] < far)]
    found = table_plane(cloud, rng, up)
    if found is None:
        return everything
    normal, offset, rms = found
    depth = offset / normal[2] if abs(normal[2]) > 0.1 else np.inf  # where the optical axis meets the table
    axis = np.array([0.0, 0.0, depth if 0 < depth < far else float(np.median(cloud[:, 2]))])
    return Crop(normal, offset, axis, radius, max(LOWEST, ABOVE * rms), far)


def refine_clearance(crop: Crop, points: NDArray[np.floating]) -> Crop:
    """Lower a crop's clearance to what smoothed points allow: foreground begins where the table's own scatter ends.

    :func:`find_crop` made it for single measured points. For those of the smoothed surface, ``points`` (..., 3), ToF frame, it
    becomes four standard deviations (1.48 MAD) of what the crop takes for table: at least a quarter of a millimetre or,
    from close by, twelve of them, and never more than before.
    """
    if not np.isfinite(crop.offset):
        return crop
    height = points @ crop.normal - crop.offset
    height = height[np.abs(height) < crop.clearance]
    if len(height) < FEWEST:
        return crop
    middle = np.median(height)
    scatter = 1.4826 * float(np.median(np.abs(height - middle)))
    least = min(LOWEST_SMOOTH, max(FINEST, SURE * scatter))
    clearance = max(least, float(middle) + ABOVE_SMOOTH * scatter)
    return replace(crop, clearance=min(crop.clearance, clearance))


def crop_depth(
    crop: Crop, depth: NDArray[np.floating], camera: Camera, T_tof_camera: Float64 | None = None
) -> NDArray[np.floating]:
    """Keep the depths (H, W) of a camera whose points belong to the scene's object; the others become NaN.

    ``T_tof_camera`` (4, 4) is where that camera stands; ``None``: it is the ToF camera. The result has depth's dtype.
    """
    depth, rays = np.ascontiguousarray(depth), camera.rays
    x, y = rays[..., 0], rays[..., 1]
    if not camera.distortion:  # a row and a column tell all: the image of rays need not be read
        x, y = np.broadcast_to(x[:1], depth.shape), np.broadcast_to(y[:, :1], depth.shape)
    out = np.empty_like(depth)
    pose = np.eye(4) if T_tof_camera is None else T_tof_camera
    limits = np.array([crop.clearance, crop.radius, crop.far])
    _keep(depth, x, y, np.append(crop.normal, crop.offset), crop.centre, limits, pose, out)
    return out


@compiled
def _keep(
    z: NDArray[np.floating], x: Float64, y: Float64, plane: Float64, centre: Float64, limits: Float64,
    pose: Float64, out: NDArray[np.floating],
) -> None:  # fmt: skip
    """Keep depths over a table and near its centre; ``x`` and ``y`` (H, W) are rays, a NaN offset keeps all within far.

    ``plane`` (4,) is normal and offset, ``limits`` clearance, radius and far, in the frame that ``pose`` maps to.
    """
    p = np.empty(3)
    for v in range(z.shape[0]):
        for u in range(z.shape[1]):
            out[v, u] = np.nan
            for k in range(3):
                p[k] = z[v, u] * (pose[k, 0] * x[v, u] + pose[k, 1] * y[v, u] + pose[k, 2]) + pose[k, 3]
            if not 0 < p[2] < limits[2]:
                continue
            height = plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[3]
            dx, dy, dz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            along = plane[0] * dx + plane[1] * dy + plane[2] * dz
            near = dx * dx + dy * dy + dz * dz - along * along < limits[1] ** 2
            if not np.isfinite(plane[3]) or (height > limits[0] and near):
                out[v, u] = z[v, u]
