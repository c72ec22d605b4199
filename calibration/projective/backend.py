"""The backend ``projective``: our registration on what every backend gets, and on the stereo image where there is one."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.clouds import Cloud
from calibration.projective.cloud_map import cloud_map, is_rim
from calibration.projective.grid import grid_of_depth
from calibration.projective.newton import Match, moved, newton_step, normal_equations, tukey
from calibration.projective.organised import OrganisedCloud
from calibration.projective.rays import match_rays, rays_of
from calibration.registration import MIN_POINTS, Registration, check_clouds, measure_registration, runs
from tofcapture.poses import Float64

FINE_DISTANCE = 0.020  # m
STEPS = 50
COARSE_STOP, FINE_STOP = 1e-4, 5e-6  # m and rad; a stage ends when its step is shorter in both

_Matcher = Callable[[Float64, float], Match]


def register_projective_clouds(
    source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]
) -> Registration:
    """Register by our point-to-plane Gauss-Newton with projective association and Tukey's kernel, coarse to fine.

    Clouds carry no noise model, so every point weighs the same and repeated ones as often as they are repeated.
    :func:`calibration.projective_icp.register_projective` is the full method, for ToF images with their noise.

    Parameters
    ----------
    source
        (N, 3) finite, source frame, metres; runs of equal points are one point with their number as its weight.
    target
        Dense cloud with normals, seen from the origin of its frame. Of an
        :class:`~calibration.projective.organised.OrganisedCloud` the surface is taken from the image at its full resolution: the
        source's single points are then rays from the origin of its frame, its repeated points are rims.
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
    starts, count = runs(source)
    points, weights = source[starts], count.astype(np.float64)
    if isinstance(target, OrganisedCloud):
        match = _image_matcher(points, count > 1, target)
    else:
        match = _cloud_matcher(points, target)
    T = np.asarray(initial, dtype=np.float64)
    for distance in distances:
        T = _stage(match, weights, T, distance)
    return measure_registration(T, source, target)


def _cloud_matcher(points: Float64, target: Cloud) -> _Matcher:
    seen = cloud_map(target)
    return lambda T, distance: seen.match(points, T, distance)


def _image_matcher(points: Float64, repeated: NDArray[np.bool_], target: OrganisedCloud) -> _Matcher:
    """Pair rays with the surface of the image, and rims with rims."""
    grid, rim = grid_of_depth(target.depth, target.camera), is_rim(target)
    seen = cloud_map(Cloud(target.points[rim], target.normals[rim]))
    rays, rims = rays_of(points[~repeated], None), points[repeated]
    surface, held = np.flatnonzero(~repeated), np.flatnonzero(repeated)

    def match(T: Float64, distance: float) -> Match:
        one, two = match_rays(rays, grid, T, rays.lengths, distance), seen.match(rims, T, distance)
        return Match(
            np.concatenate([surface[one.rays], held[two.rays]]),
            np.concatenate([one.points, two.points], axis=1),
            np.concatenate([one.normals, two.normals], axis=1),
            np.concatenate([one.distance, two.distance]),
            np.concatenate([one.variance, two.variance]),
            np.concatenate([one.reach, two.reach]),
        )

    return match


def _stage(match: _Matcher, weights: Float64, T: Float64, distance: float) -> Float64:
    stop = COARSE_STOP if distance > FINE_DISTANCE else FINE_STOP
    before = np.zeros(6)
    for _ in range(STEPS):
        found = match(T, distance)
        if len(found.rays) < MIN_POINTS:
            break
        centre = found.points.mean(axis=1)
        kernel = weights[found.rays] * tukey(found.distance / distance)
        step = newton_step(*normal_equations(found, kernel, centre))
        if np.sum(step * before) < 0:
            step = step / 2  # points between two partners send the pose back and forth; halving ends that
        T, before = moved(T, step, centre), step
        if np.abs(step).max() < stop:
            break
    return T
