"""From a guess that is off by centimetres to one that is good to millimetres: by what share of the rays a surface explains."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calibration.projective.grid import GRAZING, SurfaceGrid
from calibration.projective.newton import Match, moved, newton_step, normal_equations, tukey
from calibration.projective.rays import Rays, match_rays, predicted_reach
from calibration.registration import MIN_POINTS
from tofcapture.poses import Float64, transform

COARSE_STEPS, COARSE_STOP = (
    15,
    5e-4,
)  # most steps of a stage; m and rad: it ends when its step is shorter in both
DAMPING = 1e-3  # of the trace, added to its normal matrix at the start of a coarse stage
SHIFT_DAMPING = 1e-2  # the same, at least, while nothing turns yet
SCAN = np.linspace(
    -0.08, 0.08, 9
)  # m, slides along the dominant plane that are tried once the large planes coincide
SCAN_POINTS = 1500
SCAN_GATE = 0.020  # m, kernel scale of the trial
SCAN_GAIN = 0.99  # a shift must leave so much less unexplained

_Step = Callable[[Match, Float64, float], tuple[Float64, Float64]]


def coarse(few: Rays, grid: SurfaceGrid, T: Float64, distances: Sequence[float]) -> Float64:
    """Shift, turn, slide along the dominant plane, and close in, with kernels of these scales (metres, descending)."""
    # A guess is better in rotation than along the view; turning first, half a scene is taken for the whole.
    T = _coarse_stage(few, grid, T, distances[0], _shift_step)
    T = _coarse_stage(few, grid, T, distances[0], _damped_step)
    T = _shifted(few.some(SCAN_POINTS), grid, T)
    for distance in distances[1:]:
        T = _coarse_stage(few, grid, T, distance, _damped_step)
    return T


def _coarse_stage(rays: Rays, grid: SurfaceGrid, T: Float64, distance: float, take: _Step) -> Float64:
    """Levenberg-Marquardt on the share of unexplained rays.

    A ray that meets no surface any more must cost what it is worth, or a scene of little relief slides out of sight.
    """
    damping, best = DAMPING, T
    match = match_rays(rays, grid, T, rays.lengths, distance)
    cost = _left(match, distance)
    for _ in range(COARSE_STEPS):
        if len(match.rays) < MIN_POINTS:
            break
        step, centre = take(match, tukey(match.distance / distance) / match.variance, damping)
        T = moved(best, step, centre)
        tried = match_rays(rays, grid, T, predicted_reach(match, rays.lengths), distance)
        left = _left(tried, distance)
        if left < cost:
            best, match, cost, damping = T, tried, left, damping / 5
        else:
            damping *= 10
        if np.abs(step).max() < COARSE_STOP:
            break
    return best


def _damped_step(match: Match, weights: Float64, damping: float) -> tuple[Float64, Float64]:
    centre = match.points.mean(axis=1)
    H, g = normal_equations(match, weights, centre)
    return newton_step(
        H + damping * np.diag(np.repeat([np.trace(H[:3, :3]), np.trace(H[3:, 3:])], 3)), g
    ), centre


def _shift_step(match: Match, weights: Float64, damping: float) -> tuple[Float64, Float64]:
    """Step without a turn."""
    centre = match.points.mean(axis=1)
    H, g = normal_equations(match, weights, centre)
    size = float(np.trace(H[:3, :3]))
    alone = np.diag(np.repeat([max(damping, SHIFT_DAMPING) * size, size], 3))
    alone[:3, :3] += H[:3, :3]
    return newton_step(alone, np.concatenate([g[:3], np.zeros(3)])), centre


def _shifted(rays: Rays, grid: SurfaceGrid, T: Float64) -> Float64:
    """Slide the transform along the dominant plane to where the surface explains more rays, if there is such a place.

    Once the large planes coincide, sliding along them is the one local minimum that coarse to fine does not leave.
    """
    match = match_rays(rays, grid, T, rays.lengths, SCAN_GATE)
    if len(match.rays) < MIN_POINTS:
        return T
    x, y = _slides(match)
    costs = np.array([[_slid(rays, grid, T, a * x + np.outer(SCAN, y))] for a in SCAN]).ravel()
    best = int(np.argmin(costs))
    if costs[best] >= SCAN_GAIN * _left(match, SCAN_GATE):
        return T
    a, b = SCAN[best // len(SCAN)], SCAN[best % len(SCAN)]
    return transform(np.eye(3), a * x + b * y) @ T


def _slid(rays: Rays, grid: SurfaceGrid, T: Float64, shifts: Float64) -> Float64:
    """Shares (K,) of the rays left unexplained after each of the shifts (K, 3)."""
    d = np.einsum("ij,jn->in", T[:3, :3], rays.directions)
    ends = (T[:3, 3:] + rays.lengths * d)[:, None, :] + shifts.T[:, :, None]
    planes = grid.planes_at(ends.reshape(3, -1))
    n = planes.normals.reshape(ends.shape)
    distance = n[0] * ends[0] + n[1] * ends[1] + n[2] * ends[2] - planes.offsets.reshape(ends.shape[1:])
    cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    met = planes.found.reshape(cosine.shape) & (cosine >= GRAZING)
    explained = np.where(met, tukey(distance / SCAN_GATE), 0.0).sum(axis=1)
    seen = np.count_nonzero(planes.inside.reshape(cosine.shape), axis=1)
    out: Float64 = 1 - explained / np.maximum(seen, MIN_POINTS)
    return out


def _slides(match: Match) -> tuple[Float64, Float64]:
    """Return two directions along the plane that most normals share."""
    n = match.normals
    spread = np.array([[np.sum(n[i] * n[j]) for j in range(3)] for i in range(3)])
    weak = np.linalg.eigh(spread)[1][:, :2]
    return weak[:, 0], weak[:, 1]


def _left(match: Match, distance: float) -> float:
    """Share of the rays in the stereo camera's view that are left without a surface, by Tukey's kernel of that scale."""
    return 1 - float(np.sum(tukey(match.distance / distance))) / max(match.seen, MIN_POINTS)
