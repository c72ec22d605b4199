"""The backend ``small-gicp``: point-to-plane by the optional library small_gicp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calibration.registration.clouds import Cloud
from calibration.registration.gate import Registration, check_clouds, measure_registration
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

MAX_ITERATIONS = 50
NEIGHBOURS = 20
STOP = 1e-6  # m and rad


def register_small_gicp(
    source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]
) -> Registration:
    """Register by small_gicp's point-to-plane ICP, coarse to fine, on one thread.

    A cross-check: it has no robust kernel, so what lies within the correspondence distance counts in full.
    Parameters and returns as of any backend (:mod:`calibration.registration.backends`).

    Raises
    ------
    ConfigError
        When small_gicp is not installed.
    """
    library = _load_small_gicp()
    if check_clouds(source, target) is not None:
        return measure_registration(initial, source, target)
    dense = library.PointCloud(target.points)
    tree = library.KdTree(dense, 1)
    # The library takes no normals from outside; on rims it finds those of a line, which hold less than ours.
    library.estimate_normals(dense, tree, NEIGHBOURS, 1)
    points = library.PointCloud(source)
    T = np.asarray(initial, dtype=np.float64)
    for distance in distances:
        T = library.align(
            dense, points, tree, T, "PLANE_ICP", distance, 1, MAX_ITERATIONS, STOP, STOP
        ).T_target_source  # fmt: skip
    return measure_registration(np.asarray(T), source, target)


def _load_small_gicp() -> Any:
    try:
        import small_gicp
    except ImportError as err:
        raise ConfigError(
            f"small-gicp is needed here and does not load: {err}", hint="pip install small-gicp"
        ) from err
    return small_gicp
