"""Registration of ToF rays into an organised stereo image: projective association, point-to-plane, a noise model along the ray.

What a ToF camera measures is a length along a known ray. So every ray is intersected with the stereo surface (its last
predicted end is projected into the stereo image, the ray is cut with the tangent plane there, and so on with the next
iteration), and the residual is what it measured minus what it should have measured. The association depends on the pose
alone, never on the range noise, which neither shrinks holes nor drags points along slopes, as it does to nearest
neighbours.

The distance to the tangent plane is ``e = (n . d) (measured - predicted)``, with variance
``(n . d)^2 sigma^2 + sigma_stereo^2``: oblique surfaces say as much as facing ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.projective.grid import GRAZING, SurfaceGrid
from calibration.projective.newton import (
    Match,
    moved,
    newton_step,
    normal_equations,
    robust_scale,
    tukey,
)
from calibration.registration import INLIER_DISTANCE, MIN_POINTS, Registration
from tofcapture.errors import DataError
from tofcapture.poses import Float64, transform
from tofcapture.rig import SPEED_OF_LIGHT

COARSE = (0.080, 0.040, 0.020)  # m, kernel scales from a guess that is off by centimetres
COARSE_POINTS = 6000  # rays of the coarse stages, evenly picked
COARSE_STEPS, FINE_STEPS = 15, 20  # most Newton steps of a stage
COARSE_STOP, FEW_STOP, FINE_STOP = (
    5e-4,
    1e-4,
    1e-5,
)  # m and rad; a stage ends when its step is shorter in both
SCAN = (
    -0.08,
    -0.04,
    0.0,
    0.04,
    0.08,
)  # m, shifts across the view that are tried once the large planes coincide
SCAN_POINTS = 1500
SCAN_GATE = 0.040  # m, kernel scale of the trial
SCAN_GAIN = 0.95  # a shift must leave so much less unexplained
FINE_GATE = 0.020  # m; residuals beyond it take no part in the last stage, whatever its scale
TUKEY = (
    4.685  # kernel scale in standard deviations: 95 % efficient on Gaussian noise (Holland and Welsch 1977)
)
STEREO_SIGMA = 0.0005  # m, of a tangent plane: stereo noise and what the quadratic leaves out
RELATIVE_SIGMA = 0.004  # range noise over range, where the caller knows no better


@dataclass(frozen=True)
class _Rays:
    """Measured rays: unit directions (3, N) in the ToF frame, lengths (N,) and their standard deviations (N,), metres."""

    directions: Float64
    lengths: Float64
    sigma: Float64

    def some(self, count: int) -> _Rays:
        """Evenly picked rays, about ``count`` of them."""
        step = max(len(self.lengths) // count, 1)
        return _Rays(
            np.ascontiguousarray(self.directions[:, ::step]), self.lengths[::step], self.sigma[::step]
        )


def range_sigma_of(amplitude: ArrayLike, modulation_hz: float, noise: float) -> Float64:
    """Range noise ``c sigma_phi / (4 pi f)`` with ``sigma_phi = noise / amplitude`` (method.md 4.2), metres.

    Parameters
    ----------
    amplitude
        Any shape, raw units, positive.
    modulation_hz
        Frequency that the range was decoded at.
    noise
        Standard deviation of the phasor's real part, raw units.
    """
    sigma_phi = noise / np.asarray(amplitude, dtype=np.float64)
    return np.asarray(SPEED_OF_LIGHT / (4 * np.pi * modulation_hz) * sigma_phi)


def register_projective(
    source: NDArray[np.floating],
    grid: SurfaceGrid,
    initial: Float64,
    sigma: ArrayLike | None = None,
    distances: Sequence[float] = COARSE,
) -> Registration:
    """Register ToF points into a stereo surface.

    Parameters
    ----------
    source
        (N, 3) finite points in the frame of the ToF camera, whose centre is the origin, metres. Flying pixels need not be
        removed: the kernel refuses them.
    grid
        From :func:`calibration.projective.grid.surface_grid`.
    initial
        (4, 4) ``T_stereo_tof`` to start from; 3 degrees and 3 cm are near enough on scenes with relief.
    sigma
        (N,) or a number: standard deviation of the range noise, metres; a common factor is measured on the residuals. By
        default 0.4 % of the range.
    distances
        Kernel scales of the coarse stages, metres, descending; empty from a guess that is good to millimetres.

    Returns
    -------
    Registration
        ``inliers`` and ``fitness`` count rays that end within ``INLIER_DISTANCE`` of the surface; ``information`` is that of
        the robust estimate under independent range noise, its scale measured on the residuals. Where too few rays meet the
        surface it stays at the last transform at which enough did, at first ``initial``.

    Raises
    ------
    DataError
        When source is not (N, 3) finite, or sigma is not positive.
    """
    rays = _rays(source, sigma)
    T = np.asarray(initial, dtype=np.float64)
    if min(len(rays.lengths), int(grid.smooth.sum())) < MIN_POINTS:
        return _nothing(T, 0, 0.0)
    few = rays.some(COARSE_POINTS)
    for distance in distances[:1]:
        T = _coarse_stage(few, grid, T, distance)
        T = _shifted(rays.some(SCAN_POINTS), grid, T)
    for distance in distances:
        T = _coarse_stage(few, grid, T, distance)
    T, _ = _fine_stage(few, grid, T, FEW_STOP)
    T, match = _fine_stage(rays, grid, T, FINE_STOP)
    return _measured(rays, match, T)


def _rays(source: NDArray[np.floating], sigma: ArrayLike | None) -> _Rays:
    if source.ndim != 2 or source.shape[1] != 3 or not np.isfinite(source).all():
        raise DataError(f"source points: expected finite (N, 3), got shape {source.shape}")
    points = np.ascontiguousarray(source.T, dtype=np.float64)
    lengths = np.sqrt(points[0] ** 2 + points[1] ** 2 + points[2] ** 2)
    if not (lengths > 0).all():
        raise DataError(
            "source points: expected none at the camera's centre",
            hint="mark missing pixels by NaN and drop them",
        )
    spread = RELATIVE_SIGMA * lengths if sigma is None else np.asarray(sigma, dtype=np.float64)
    if spread.shape not in {(), lengths.shape} or not (np.isfinite(spread) & (spread > 0)).all():
        raise DataError(
            f"sigma: expected a positive number or {lengths.shape} of them, got shape {spread.shape}"
        )
    return _Rays(points / lengths, lengths, np.broadcast_to(spread, lengths.shape))


def _match(rays: _Rays, grid: SurfaceGrid, T: Float64, reach: Float64, gate: float) -> Match:
    """Cut the rays with the tangent planes at their predicted ends (N,) and keep residuals within the gate."""
    o = T[:3, 3]
    d = np.einsum("ij,jn->in", T[:3, :3], rays.directions)
    planes = grid.planes_at(o[:, None] + reach * d)
    n = planes.normals
    cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    steep = cosine < GRAZING
    predicted = (planes.offsets - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])) / np.where(steep, 1.0, cosine)
    distance = cosine * (rays.lengths - predicted)
    met = np.flatnonzero(planes.found & ~steep & (np.abs(distance) < gate))
    predicted, cosine = predicted[met], cosine[met]
    return Match(
        rays=met,
        points=o[:, None] + predicted * d[:, met],
        normals=n[:, met],
        distance=distance[met],
        variance=(cosine * rays.sigma[met]) ** 2 + STEREO_SIGMA**2,
        reach=predicted,
    )


def _predicted(match: Match, otherwise: Float64) -> Float64:
    """Where to look next: the predicted end of each ray, ``otherwise`` (N,) where nothing was met."""
    reach = otherwise.copy()
    reach[match.rays] = match.reach
    return reach


def _coarse_stage(rays: _Rays, grid: SurfaceGrid, T: Float64, distance: float) -> Float64:
    reach = rays.lengths
    for _ in range(COARSE_STEPS):
        match = _match(rays, grid, T, reach, distance)
        if len(match.rays) < MIN_POINTS:
            break
        step, centre = _step(match, tukey(match.distance / distance) / match.variance)
        T = moved(T, step, centre)
        if np.abs(step).max() < COARSE_STOP:
            break
        reach = _predicted(match, rays.lengths)
    return T


def _shifted(rays: _Rays, grid: SurfaceGrid, T: Float64) -> Float64:
    """Move the transform across the view to where the surface explains clearly more rays, if there is such a place.

    Once the large planes coincide, sliding along them is the one local minimum that coarse to fine does not leave.
    """

    def cost(x: float, y: float) -> tuple[float, Float64]:
        there = transform(np.eye(3), [x, y, 0.0]) @ T
        match = _match(rays, grid, there, rays.lengths, SCAN_GATE)
        explained = np.sum(tukey(match.distance / SCAN_GATE))
        return 1 - float(explained) / len(rays.lengths), there

    here = cost(0.0, 0.0)[0]
    best, there = min((cost(x, y) for x in SCAN for y in SCAN), key=lambda found: found[0])
    return there if best < SCAN_GAIN * here else T


def _fine_stage(rays: _Rays, grid: SurfaceGrid, T: Float64, stop: float) -> tuple[Float64, Match]:
    """Iterate to the end; a ray that meets nothing looks again where it looked last, and comes back if the pose does."""
    reach, before = rays.lengths, np.zeros(6)
    match = _match(rays, grid, T, reach, FINE_GATE)
    for _ in range(FINE_STEPS):
        if len(match.rays) < MIN_POINTS:
            break
        step, centre = _step(match, _weights(match))
        if np.sum(step * before) < 0:
            step = step / 2  # rays at edges come and go and send the pose back and forth; halving ends that
        T, before = moved(T, step, centre), step
        reach = _predicted(match, reach)
        match = _match(rays, grid, T, reach, FINE_GATE)
        if np.abs(step).max() < stop:
            break
    return T, match


def _weights(match: Match) -> Float64:
    sigma = np.sqrt(match.variance)
    return tukey(match.distance / (TUKEY * _scale(match) * sigma)) / match.variance


def _scale(match: Match) -> float:
    return max(robust_scale(match.distance / np.sqrt(match.variance)), 1e-9)


def _step(match: Match, weights: Float64) -> tuple[Float64, Float64]:
    centre = match.points.mean(axis=1)
    return newton_step(*normal_equations(match, weights, centre)), centre


def _measured(rays: _Rays, match: Match, T: Float64) -> Registration:
    """State what the last transform achieves, as :func:`calibration.registration.measure_registration` does."""
    near = np.abs(match.distance) < INLIER_DISTANCE
    inliers = int(near.sum())
    fitness = inliers / len(rays.lengths)
    if inliers < MIN_POINTS:
        return _nothing(T, inliers, fitness)
    centre = match.points[:, near].mean(axis=1)
    H, g = normal_equations(match, _weights(match), centre)
    return Registration(
        T_target_source=T,
        inliers=inliers,
        rmse=float(np.sqrt(np.mean(np.square(match.distance[near])))),
        fitness=fitness,
        information=_information(match, centre),
        condition=_condition(match, near, centre),
        centre=centre,
        step=newton_step(H, g),
    )


def _nothing(T: Float64, inliers: int, fitness: float) -> Registration:
    return Registration(T, inliers, np.nan, fitness, np.zeros((6, 6)), np.inf, T[:3, 3].copy(), np.zeros(6))


def _information(match: Match, centre: Float64) -> Float64:
    """Inverse covariance of an M-estimate: ``mean(psi')^2 / mean(psi^2) J^T V^-1 J`` (Huber 1981, 7.6)."""
    u = match.distance / (TUKEY * _scale(match) * np.sqrt(match.variance))
    inside = np.maximum(1 - u**2, 0)
    psi = u * inside**2 * TUKEY * _scale(match)
    slope = np.where(np.abs(u) < 1, inside * (1 - 5 * u**2), 0.0)
    kept = np.abs(u) < 1
    efficiency = float(np.mean(slope[kept]) ** 2 / np.mean(np.square(psi[kept])))
    H, _ = normal_equations(match, kept / match.variance, centre)
    return efficiency * H


def _condition(match: Match, near: NDArray[np.bool_], centre: Float64) -> float:
    """Condition number of the unweighted normal matrix, rotations as motion at the mean radius; as of any backend."""
    H, _ = normal_equations(match, near / 1.0, centre)
    radius = np.sqrt(np.mean(np.square(match.points[:, near] - centre[:, None]).sum(axis=0)))
    even = np.repeat([1, 1 / radius], 3)
    values = np.linalg.eigvalsh(H * even * even[:, None] / near.sum())
    return float(values[-1] / values[0]) if values[0] > 1e-15 else np.inf
