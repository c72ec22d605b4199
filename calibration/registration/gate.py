"""Measure what a registration is worth, and refuse what cannot be believed.

Open3D answers identity for no correspondences, kiss-icp answers the initial guess, small_gicp says ``converged``: no library
says that it failed. So every result is measured again here against the clouds, and passes a gate or is refused by name.

The libraries stand behind one signature. The dense, clean cloud is the target: registering ToF points into it and inverting is four
times as accurate as the other way round, because its normals are good.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Cloud
from calibration.registration.search import Sights
from tofcapture.errors import ConfigError, DataError
from tofcapture.libraries import load_open3d
from tofcapture.poses import Float64, invert, rotation_angle, transform_points

INLIER_DISTANCE = 0.010  # m; a ToF point this near to a stereo point has found its surface, bias included
MIN_POINTS = 200  # fewer do not average the noise of a ToF pixel to a tenth
MIN_FITNESS = 0.3  # share of source points with a partner; the fields of view of a rig overlap by far more
MAX_CONDITION = 500.0  # a board held by its rims has 3 to 10, a corner below 100, a lone plane thousands
MAX_ROTATION = np.radians(10.0)  # from the initial guess, which a bracket's drawing gives to 1 or 2 degrees
MAX_TRANSLATION = 0.10  # m, from the initial guess, at the points
MAX_STEP_ROTATION = np.radians(0.5)  # one more Newton step of a converged result is far smaller
MAX_STEP_TRANSLATION = 0.003  # m
MIN_AGREEMENT = 0.95  # share of what both cameras have seen that free space allows; true answers reach 0.98, half turns 0.94
MAX_RMSE = 0.005  # m; below the 5.8 mm of residuals spread evenly over the inlier distance


class Refusal(StrEnum):
    """Why a registration is not believed."""

    EMPTY = "empty"
    NO_OVERLAP = "no overlap"
    PLANAR = "planar-degenerate"
    DIVERGED = "diverged"
    CONTRADICTED = "contradicts free space"
    UNCLEAR = "not clearly the best"
    NOT_CONVERGED = "did not converge"
    POOR_FIT = "poor fit"


@dataclass(frozen=True)
class Registration:
    """One measured registration."""

    T_target_source: Float64  #: (4, 4), maps source points into the target's frame
    inliers: int  #: Number of source points with a partner within ``INLIER_DISTANCE``
    rmse: float  #: Root mean square point-to-plane distance of the inliers, metres; NaN without inliers
    fitness: float  #: Inliers over source points
    #: (6, 6) of (translation of ``centre``, rotation about it) in target axes, 1/m^2 and 1/rad^2:
    #: ``J^T J / rmse^2``. Its inverse is the covariance that independent residuals would give; bias is
    #: not in it
    information: Float64
    #: Condition number of ``J^T J`` with rotations measured as motion at the inliers' mean radius;
    #: infinite when singular
    condition: float
    centre: Float64  #: (3,) centroid of the inliers, target frame, metres
    #: (6,) Newton step that is left at this result: (translation of ``centre``, rotation vector),
    #: metres and radians
    step: Float64
    agreement: float = 1.0  #: Share of what both cameras have seen that free space allows
    clear: bool = (
        True  #: False where another answer fits as well or better, or none was found without a guess
    )


@dataclass(frozen=True)
class Residuals:
    """Point-to-plane residuals of M matched points."""

    source: NDArray[np.intp]  #: (M,) indices into the source points
    #: (M, 3) moved source points and the normals of their partners, target frame
    points: Float64
    normals: Float64
    distance: Float64  #: (M,) signed distance of the points to their partners' tangent planes, metres

    def jacobian(self, centre: Float64) -> Float64:
        """Derive the residuals by (translation, rotation about ``centre`` (3,)), target axes: (M, 6)."""
        return np.concatenate([self.normals, np.cross(self.points - centre, self.normals)], axis=1)


def residuals(source: Float64, target: Cloud, T_target_source: Float64) -> Residuals:
    """Match every source point (N, 3), metres, with the nearest target point within ``INLIER_DISTANCE``."""
    from scipy.spatial import cKDTree

    # Rim points are repeated to weigh more: each is looked up once.
    starts = np.flatnonzero(np.concatenate([[True], (source[1:] != source[:-1]).any(axis=1)]))
    count = np.diff(np.append(starts, len(source)))
    moved = transform_points(T_target_source, source[starts])
    tree = cKDTree(target.points, balanced_tree=False, compact_nodes=False)
    distance, partner = tree.query(moved, distance_upper_bound=INLIER_DISTANCE)
    moved, distance, partner = (np.repeat(x, count, axis=0) for x in (moved, distance, partner))
    matched = np.flatnonzero(np.isfinite(distance))
    partner = partner[matched]
    normals = target.normals[partner]
    signed = ((moved[matched] - target.points[partner]) * normals).sum(axis=-1)
    return Residuals(matched, moved[matched], normals, signed)


def tukey_weights(distance: Float64, scale: float | Float64 = INLIER_DISTANCE) -> Float64:
    """Weigh residuals by Tukey's biweight ``(1 - (r/scale)^2)^2``, zero from ``scale`` on."""
    out: Float64 = np.square(np.maximum(1 - np.square(distance / scale), 0))
    return out


def check_clouds(source: Float64, target: Cloud) -> Refusal | None:
    """Say ``EMPTY`` when either side has too few points to register.

    :class:`DataError` when the source is not (N, 3) finite numbers: some libraries drop such rows silently.
    """
    if source.ndim != 2 or source.shape[1] != 3 or not np.isfinite(source).all():
        raise DataError(f"source points: expected finite (N, 3), got shape {source.shape}")
    return Refusal.EMPTY if min(len(source), len(target)) < MIN_POINTS else None


def measure_registration(T_target_source: Float64, source: Float64, target: Cloud) -> Registration:
    """Measure what a transform achieves between source points (N, 3), metres, and a target cloud.

    When nothing lies near, the result has no inliers, an infinite condition and an rmse of NaN.
    """
    if check_clouds(source, target) is not None:
        return _nothing(T_target_source, 0, 0.0)
    found = residuals(source, target, T_target_source)
    fitness = len(found.source) / len(source)
    if len(found.source) < MIN_POINTS:
        return _nothing(T_target_source, len(found.source), fitness)
    centre = found.points.mean(axis=0)
    J = found.jacobian(centre)
    weights = tukey_weights(found.distance)[:, None]
    rmse = float(np.sqrt(np.mean(np.square(found.distance))))
    radius = float(np.sqrt(np.mean(np.square(found.points - centre).sum(axis=-1))))
    even = J * np.repeat([1, 1 / radius], 3) / np.sqrt(len(J))
    eigenvalues = np.linalg.eigvalsh(even.T @ even)
    condition = float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 1e-15 else np.inf
    step = -np.linalg.pinv((J * weights).T @ J) @ ((J * weights).T @ found.distance)
    information = J.T @ J / max(rmse, 1e-9) ** 2
    agreement = Sights(source, target).agreement(T_target_source).share
    return Registration(
        T_target_source, len(J), rmse, fitness, information, condition, centre, step, agreement
    )


def _nothing(T: Float64, inliers: int, fitness: float) -> Registration:
    return Registration(T, inliers, np.nan, fitness, np.zeros((6, 6)), np.inf, T[:3, 3], np.zeros(6))


def check_registration(
    result: Registration, source: Float64, target: Cloud, initial: Float64 | None
) -> Refusal | None:
    """Gate a registration measured on these clouds.

    ``initial`` (4, 4) is the ``T_target_source`` that the operator believes to about 2 degrees and 2 cm, None where nothing is
    believed. The answer is the first reason not to believe the result, None when it passes.
    """
    if check_clouds(source, target) is not None:
        return Refusal.EMPTY
    if result.inliers < MIN_POINTS or result.fitness < MIN_FITNESS:
        return Refusal.NO_OVERLAP
    if result.condition > MAX_CONDITION:
        return Refusal.PLANAR
    if not result.clear:
        return Refusal.UNCLEAR
    if initial is not None and not _near(result.T_target_source, initial, result.centre):
        return Refusal.DIVERGED
    if result.agreement < MIN_AGREEMENT:
        return Refusal.CONTRADICTED
    left, turn = np.linalg.norm(result.step[:3]), np.linalg.norm(result.step[3:])
    if left > MAX_STEP_TRANSLATION or turn > MAX_STEP_ROTATION:
        return Refusal.NOT_CONVERGED
    return Refusal.POOR_FIT if result.rmse > MAX_RMSE else None


def _near(T_target_source: Float64, initial: Float64, centre: Float64) -> bool:
    moved = T_target_source @ invert(initial)
    shift = transform_points(moved, centre) - centre
    return bool(rotation_angle(moved) <= MAX_ROTATION and np.linalg.norm(shift) <= MAX_TRANSLATION)


COARSE_TO_FINE = (0.080, 0.040, 0.020, 0.010)  # m, correspondence distances
FINE = (0.020, 0.010)  # m, from a good initial guess
COARSE_STRIDE = 4  # above FINE every fourth point finds the same basin
MAX_ITERATIONS = 50
NEIGHBOURS = 20  # that small_gicp makes a normal of

Backend = Callable[[Float64, Cloud, Float64, Sequence[float]], Float64]


def register(
    backend: str,
    source: Float64,
    target: Cloud,
    initial: Float64 | None,
    distances: Sequence[float] = COARSE_TO_FINE,
) -> Registration:
    """Register by the backend of that name and measure the result with our own code.

    The source (N, 3), finite, source frame, metres, goes into the dense target from ``initial`` (4, 4), ``T_target_source``, and
    stays there where the clouds are empty. ``distances`` are correspondence distances, metres, descending, and the scale of a
    robust kernel. A library is asked only from where it can succeed: where a few coarse steps of our own from the guess end in a
    contradiction, or there is no guess, the clouds are searched as a whole.

    :class:`ConfigError` for an unknown backend, or a library that is not installed. Open3D and kiss-icp sum in parallel: they are
    bit-reproducible only in a process that was held to one core before it loaded them, ``Pool(1, pinned=True)`` of
    :mod:`tofcapture.pool`.
    """
    method = backend_named(backend)
    if check_clouds(source, target) is not None:
        return measure_registration(np.eye(4) if initial is None else initial, source, target)
    start, clear = initial, True
    if start is None or distances[0] > max(FINE):
        start, distances, clear = _start(Sights(source, target), initial, distances)
    answer = method(source, target, start, distances) if distances else start
    return replace(measure_registration(answer, source, target), clear=clear)


def _start(
    sights: Sights, initial: Float64 | None, distances: Sequence[float]
) -> tuple[Float64, Sequence[float], bool]:
    """Choose where a library starts, its distances (none: it is not asked), and say whether no other start is as good."""
    end = np.eye(4) if initial is None else sights.followed(initial)
    if initial is not None and sights.agreement(end).share >= MIN_AGREEMENT and not sights.outdone(end):
        return initial, distances, True
    found = sights.located()
    if found is None or not (found[1] or initial is None):
        return end, (), False
    return found[0], FINE, found[1]


def backend_named(name: str) -> Backend:
    """Look a backend up; :class:`ConfigError` names those there are."""
    if name not in BACKENDS:
        raise ConfigError(f"backend: expected one of {', '.join(BACKENDS)}, got {name!r}")
    return BACKENDS[name]


def _open3d(source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]) -> Float64:
    """Point-to-plane with Tukey's robust kernel, coarse to fine."""
    o3d = load_open3d()
    icp = o3d.pipelines.registration
    dense = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(target.points))
    dense.normals = o3d.utility.Vector3dVector(target.normals)
    stop = icp.ICPConvergenceCriteria(1e-7, 1e-7, MAX_ITERATIONS)
    T = initial
    for distance in distances:
        thin = source[:: COARSE_STRIDE if distance > max(FINE) else 1]
        points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(thin))
        to_plane = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(k=distance))
        T = icp.registration_icp(points, dense, distance, T, to_plane, stop).transformation
    return T


def _kiss_icp(source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]) -> Float64:
    """Point-to-point with a Geman-McClure kernel: a cross-check, made for odometry and less accurate."""
    mapping = _library("kiss_icp.mapping", "pip install 'tofcapture[capture]'")
    registration = _library("kiss_icp.registration", "pip install 'tofcapture[capture]'")
    solver = registration.Registration(2 * MAX_ITERATIONS, 1e-5, 1)
    T = initial
    for distance in distances:
        # The map looks for partners in the 27 voxels around a point only, so its voxels must be as large as the distance.
        dense = mapping.VoxelHashMap(distance, 100.0, 20)
        dense.add_points(target.points)
        T = solver.align_points_to_map(source[::COARSE_STRIDE], dense, T, distance, distance / 3)
    return T


def _small_gicp(source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]) -> Float64:
    """Point-to-plane on one thread: a cross-check without a robust kernel, so that all within the distance counts in full."""
    library = _library("small_gicp", "pip install 'tofcapture[gicp]'")
    dense = library.PointCloud(target.points)
    tree = library.KdTree(dense, 1)
    # The library takes no normals from outside; on rims it finds those of a line, which hold less than ours.
    library.estimate_normals(dense, tree, NEIGHBOURS, 1)
    points = library.PointCloud(source)
    T = np.asarray(initial, dtype=np.float64)
    for distance in distances:
        found = library.align(dense, points, tree, T, "PLANE_ICP", distance, 1, MAX_ITERATIONS, 1e-6, 1e-6)
        T = found.T_target_source
    return np.asarray(T)


BACKENDS: dict[str, Backend] = {"open3d": _open3d, "kiss-icp": _kiss_icp, "small-gicp": _small_gicp}


def _library(module: str, hint: str) -> Any:
    try:
        return import_module(module)
    except ImportError as err:
        name = module.split(".", maxsplit=1)[0].replace("_", "-")
        raise ConfigError(f"{name} is needed here and does not load: {err}", hint) from err
