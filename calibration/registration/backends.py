"""Libraries that register two clouds, behind one signature.

The dense, clean cloud is the target: registering ToF points into it and inverting is four times as accurate as the other way
round, because its normals are good.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from calibration.registration.clouds import Cloud
from calibration.registration.gate import Registration, check_clouds, measure_registration
from tofcapture.errors import ConfigError
from tofcapture.libraries import load_open3d
from tofcapture.poses import Float64

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
    initial: Float64,
    distances: Sequence[float] = COARSE_TO_FINE,
) -> Registration:
    """Register by the backend of that name and measure the result with our own code.

    The source (N, 3), finite, source frame, metres, goes into the dense target from ``initial`` (4, 4), ``T_target_source``, and
    stays there where the clouds are empty. ``distances`` are correspondence distances, metres, descending, and the scale of a
    robust kernel.

    :class:`ConfigError` for an unknown backend, or a library that is not installed. Open3D and kiss-icp sum in parallel: they are
    bit-reproducible only in a process that was held to one core before it loaded them, ``Pool(1, pinned=True)`` of
    :mod:`tofcapture.pool`.
    """
    method = backend_named(backend)
    empty = check_clouds(source, target) is not None
    return measure_registration(
        initial if empty else method(source, target, initial, distances), source, target
    )


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
