"""Libraries that register two clouds, behind one signature.

Every backend maps ``(source, target, initial, distances)`` to a measured :class:`~calibration.registration.gate.Registration`. The
dense, clean cloud is the target: registering ToF points into it and inverting is four times as accurate as the other way
round, because its normals are good.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from calibration.registration.clouds import Cloud
from calibration.registration.gate import Registration, check_clouds, measure_registration
from calibration.registration.small_gicp_backend import register_small_gicp
from tofcapture.errors import ConfigError
from tofcapture.o3d import load_open3d
from tofcapture.poses import Float64

COARSE_TO_FINE = (0.080, 0.040, 0.020, 0.010)  # m, correspondence distances
FINE = (0.020, 0.010)  # m, from a good initial guess
COARSE_STRIDE = (
    4  # above FINE every fourth source point finds the same basin; point-to-point gains nothing from the rest
)
MAX_ITERATIONS = 50

Backend = Callable[[Float64, Cloud, Float64, Sequence[float]], Registration]


def register_open3d(
    source: Float64, target: Cloud, initial: Float64, distances: Sequence[float] = COARSE_TO_FINE
) -> Registration:
    """Register by Open3D's point-to-plane ICP with Tukey's robust kernel, coarse to fine.

    Parameters
    ----------
    source
        (N, 3) finite, source frame, metres.
    target
        Dense cloud with normals, target frame.
    initial
        (4, 4) ``T_target_source`` to start from.
    distances
        Correspondence distances, metres, descending; also the kernel's scale.

    Returns
    -------
    Registration
        Measured by our own code. Where the clouds are empty it stays at ``initial``.

    Notes
    -----
    Open3D sums in parallel and is bit-reproducible only on one core that was pinned before its import:
    :mod:`calibration.registration.pinned`.
    """
    if check_clouds(source, target) is not None:
        return measure_registration(initial, source, target)
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
    return measure_registration(T, source, target)


def register_kiss_icp(
    source: Float64, target: Cloud, initial: Float64, distances: Sequence[float] = COARSE_TO_FINE
) -> Registration:
    """Register by kiss-icp's point-to-point ICP with a Geman-McClure kernel, coarse to fine.

    A cross-check of the default backend: kiss-icp is made for odometry, and point-to-point is less accurate.
    Parameters, returns and notes as in :func:`register_open3d`.

    Raises
    ------
    ConfigError
        When kiss-icp is not installed.
    """
    if check_clouds(source, target) is not None:
        return measure_registration(initial, source, target)
    mapping, registration = _load_kiss_icp()
    solver = registration.Registration(2 * MAX_ITERATIONS, 1e-5, 1)
    T = initial
    for distance in distances:
        # The map looks for partners in the 27 voxels around a point only, so its voxels must be as large as the distance.
        dense = mapping.VoxelHashMap(distance, 100.0, 20)
        dense.add_points(target.points)
        T = solver.align_points_to_map(source[::COARSE_STRIDE], dense, T, distance, distance / 3)
    return measure_registration(T, source, target)


BACKENDS: dict[str, Backend] = {
    "open3d": register_open3d,
    "kiss-icp": register_kiss_icp,
    "small-gicp": register_small_gicp,
}


def backend_named(name: str) -> Backend:
    """Look a backend up.

    Raises
    ------
    ConfigError
        Unknown name.
    """
    if name not in BACKENDS:
        raise ConfigError(f"backend: expected one of {', '.join(BACKENDS)}, got {name!r}")
    return BACKENDS[name]


def register(
    name: str, source: Float64, target: Cloud, initial: Float64, distances: Sequence[float] = COARSE_TO_FINE
) -> Registration:
    """Register by the backend of that name; a plain function, so that it travels to a worker process."""
    return backend_named(name)(source, target, initial, distances)


def _load_kiss_icp() -> tuple[Any, Any]:
    try:
        from kiss_icp import mapping, registration
    except ImportError as err:
        raise ConfigError(
            f"kiss-icp is needed here and does not load: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err
    return mapping, registration
