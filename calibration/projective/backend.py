"""The backend ``projective``: our registration on what every backend gets, and on the stereo image where there is one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.clouds import Cloud
from calibration.projective.cloud_map import cloud_map, is_rim
from calibration.projective.grid import grid_of_depth
from calibration.projective.newton import Match, jacobian, moved, newton_step, normal_equations, tukey
from calibration.projective.organised import OrganisedCloud
from calibration.projective.rays import Rays, match_rays, rays_of
from calibration.registration import MIN_POINTS, Registration, check_clouds, measure_registration, runs
from tofcapture.poses import Float64

FINE_DISTANCE = 0.020  # m
STEPS = 50
COARSE_STOP, FINE_STOP = 1e-4, 5e-6  # m and rad; a stage ends when its step is shorter in both

NOISE, OFFSET = 0.001, 0.010  # m: of a surface point, and of the range offset that all of a view's share


@dataclass(frozen=True)
class _Found:
    """Matches, and by how much (M,) their distances change per metre of range offset."""

    match: Match
    lever: Float64


_Matcher = Callable[[Float64, float, float], _Found]


def register_projective_clouds(
    source: Float64, target: Cloud, initial: Float64, distances: Sequence[float]
) -> Registration:
    """Register by our point-to-plane Gauss-Newton with projective association and Tukey's kernel, coarse to fine.

    Clouds carry no noise model, so every point weighs the same and repeated ones as often as they are repeated. But where rims
    come with a stereo image, the ranges of the surface may share an offset, which rims, being angles, tell: of a board view its
    bias is what is wrong, not its noise. The result is measured with the offset taken off.
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
    T, offset = np.asarray(initial, dtype=np.float64), 0.0
    for distance in distances:
        T, offset = _stage(match, weights, T, offset, distance)
    return measure_registration(T, _without(source, offset, starts[count == 1]), target)


def _without(source: Float64, offset: float, single: NDArray[np.intp]) -> Float64:
    """Points whose single ones, which are ranges, are freed of their offset."""
    out = source.copy()
    out[single] *= 1 - offset / np.sqrt(np.square(source[single]).sum(axis=1, keepdims=True))
    return out


def _cloud_matcher(points: Float64, target: Cloud) -> _Matcher:
    seen = cloud_map(target)

    def match(T: Float64, distance: float, _offset: float) -> _Found:
        found = seen.match(points, T, distance)
        return _Found(found, np.zeros(len(found.rays)))

    return match


def _image_matcher(points: Float64, repeated: NDArray[np.bool_], target: OrganisedCloud) -> _Matcher:
    """Pair rays with the surface of the image, and rims with rims."""
    grid, rim = grid_of_depth(target.depth, target.camera), is_rim(target)
    seen = cloud_map(Cloud(target.points[rim], target.normals[rim]))
    rays, rims = rays_of(points[~repeated], None), points[repeated]
    surface, held = np.flatnonzero(~repeated), np.flatnonzero(repeated)

    def match(T: Float64, distance: float, offset: float) -> _Found:
        there: Rays = replace(rays, lengths=rays.lengths - offset)
        one, two = match_rays(there, grid, T, there.lengths, distance), seen.match(rims, T, distance)
        found = Match(
            np.concatenate([surface[one.rays], held[two.rays]]),
            np.concatenate([one.points, two.points], axis=1),
            np.concatenate([one.normals, two.normals], axis=1),
            np.concatenate([one.distance, two.distance]),
            np.concatenate([one.variance, two.variance]),
            np.concatenate([one.reach, two.reach]),
        )
        cosine = (one.normals * (one.points - T[:3, 3:])).sum(axis=0) / one.reach
        return _Found(found, np.concatenate([-cosine, np.zeros(len(two.rays))]) * bool(len(rims)))

    return match


def _stage(
    match: _Matcher, weights: Float64, T: Float64, offset: float, distance: float
) -> tuple[Float64, float]:
    stop = COARSE_STOP if distance > FINE_DISTANCE else FINE_STOP
    before = np.zeros(6)
    for _ in range(STEPS):
        found = match(T, distance, offset)
        if len(found.match.rays) < MIN_POINTS:
            break
        centre = found.match.points.mean(axis=1)
        kernel = weights[found.match.rays] * tukey(found.match.distance / distance)
        step, more = _solved(found, kernel, centre, offset)
        if np.sum(step * before) < 0:
            step, more = (
                step / 2,
                more / 2,
            )  # points between two partners send the pose back and forth; halving ends that
        T, before, offset = moved(T, step, centre), step, offset + more
        if np.abs(step).max() < stop:
            break
    return T, offset


def _solved(found: _Found, weights: Float64, centre: Float64, offset: float) -> tuple[Float64, float]:
    """Newton step of the pose and of the offset, which is eliminated from the normal equations."""
    H, g = normal_equations(found.match, weights, centre)
    prior = (NOISE / OFFSET) ** 2
    pull = weights * found.lever
    own, force = (
        float(np.sum(pull * found.lever)) + prior,
        float(np.sum(pull * found.match.distance)) + prior * offset,
    )
    mixed = np.sum(jacobian(found.match, centre) * pull, axis=1)
    step = newton_step(H - np.outer(mixed, mixed) / own, g - mixed * force / own)
    return step, -(force + float(np.sum(mixed * step))) / own
