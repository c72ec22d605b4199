"""The backend ``projective``: our registration on the clouds that every backend gets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.clouds import Cloud
from calibration.projective.cloud_map import CloudMap, cloud_map
from calibration.projective.newton import moved, newton_step, normal_equations, tukey
from calibration.registration import MIN_POINTS, Registration, check_clouds, measure_registration
from tofcapture.poses import Float64

COARSE_STRIDE = 4  # above FINE_DISTANCE every fourth source point finds the same basin
FINE_DISTANCE = 0.020  # m
STEPS = 50
COARSE_STOP, FINE_STOP = 1e-4, 5e-6  # m and rad; a stage ends when its step is shorter in both


def register_projective_clouds(
    source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]
) -> Registration:
    """Register by our point-to-plane Gauss-Newton with projective association and Tukey's kernel, coarse to fine.

    Clouds carry no noise model, so every point weighs the same and repeated ones as often as they are repeated.
    :func:`calibration.projective_icp.register_projective` is the full method, for an organised stereo map.

    Parameters
    ----------
    source
        (N, 3) finite, source frame, metres.
    target
        Dense cloud with normals, seen from the origin of its frame.
    initial
        (4, 4) ``T_target_source`` to start from.
    distances
        Correspondence distances, metres, descending; also the kernel's scale.

    Returns
    -------
    Registration
        The same bits for the same input.
    """
    if check_clouds(source, target) is not None:
        return measure_registration(initial, source, target)
    seen = cloud_map(target)
    T = np.asarray(initial, dtype=np.float64)
    for distance in distances:
        T = _stage(source[:: COARSE_STRIDE if distance > FINE_DISTANCE else 1], seen, T, distance)
    return measure_registration(T, source, target)


def _stage(source: Float64, seen: CloudMap, T: Float64, distance: float) -> Float64:
    stop = COARSE_STOP if distance > FINE_DISTANCE else FINE_STOP
    before = np.zeros(6)
    for _ in range(STEPS):
        match = seen.match(source, T, distance)
        if len(match.rays) < MIN_POINTS:
            break
        centre = match.points.mean(axis=1)
        step = newton_step(*normal_equations(match, tukey(match.distance / distance), centre))
        if np.sum(step * before) < 0:
            step = step / 2  # points between two partners send the pose back and forth; halving ends that
        T, before = moved(T, step, centre), step
        if np.abs(step).max() < stop:
            break
    return T
