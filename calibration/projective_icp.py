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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.clouds import WORKING_DEPTH
from calibration.projective.coarse import coarse
from calibration.projective.edges import StereoEdges, TofEdges, match_edges, tof_edges
from calibration.projective.grid import SurfaceGrid
from calibration.projective.newton import (
    Match,
    moved,
    newton_step,
    normal_equations,
    robust_scale,
    tukey,
)
from calibration.projective.rays import Rays, match_rays, predicted_reach, rays_of
from calibration.projective.weak import along_weak_motions, weak_motions
from calibration.registration import INLIER_DISTANCE, MIN_POINTS, Registration
from tofcapture.errors import DataError
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT

COARSE = (0.080, 0.040, 0.020)  # m, kernel scales from a guess that is off by centimetres
COARSE_POINTS = 6000  # rays of the coarse stages, evenly picked
FINE_STEPS = 20  # most Newton steps of a stage
WALK_POINTS = 15000  # rays of the walk along weak motions
WALK_STEPS = 4  # the same, from a place along a weak motion
FEW_STOP, FINE_STOP = 1e-4, 1e-5  # m and rad; a stage ends when its step is shorter in both
FINE_GATE = 0.020  # m; residuals beyond it take no part in the last stage, whatever its scale
TUKEY = (
    4.685  # kernel scale in standard deviations: 95 % efficient on Gaussian noise (Holland and Welsch 1977)
)
MIN_SCALE = (
    0.1  # of the noise model; a kernel that shrinks with exact data would hold on to wherever it starts
)
EDGE_KERNELS = (0.004, 0.001)  # m, Tukey's scale on depth edges: while the pose settles, and at the end


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
    edges: StereoEdges | None = None,
) -> Registration:
    """Register ToF points into a stereo surface.

    Parameters
    ----------
    source
        (N, 3) finite points in the frame of the ToF camera, whose centre is the origin, metres; or its image (H, W, 3) with NaN
        where nothing was measured. Flying pixels need not be removed: the kernel refuses them.
    grid
        From :func:`calibration.projective.grid.surface_grid`.
    initial
        (4, 4) ``T_stereo_tof`` to start from; 3 degrees and 3 cm are near enough on scenes with relief.
    sigma
        (N,), (H, W) or a number: standard deviation of the range noise, metres; a common factor is measured on the residuals. By
        default 0.4 % of the range.
    distances
        Kernel scales of the coarse stages, metres, descending; empty from a guess that is good to millimetres.
    edges
        From :func:`calibration.projective.edges.stereo_edges`; they need the ToF points as an image, and hold the pose across the
        view where surfaces hold little.

    Returns
    -------
    Registration
        ``inliers`` and ``fitness`` count rays that end within ``INLIER_DISTANCE`` of the surface; ``information`` is that of
        the robust estimate under independent range noise, its scale measured on the residuals. Where too few rays meet the
        surface it stays at the last transform at which enough did, at first ``initial``.

    Raises
    ------
    DataError
        When source is neither (N, 3) finite nor an image, sigma is not positive, or edges come with points that are no image.
    """
    held = _edges_of(source, edges)
    rays = rays_of(*_flat(source, sigma))
    T = np.asarray(initial, dtype=np.float64)
    if min(len(rays.lengths), int(grid.smooth.sum())) < MIN_POINTS:
        return _nothing(T, 0, 0.0)
    few = rays.nearer(WORKING_DEPTH[1]).some(COARSE_POINTS)
    if distances:
        T = coarse(few, grid, T, distances)
    T, _ = _fine_stage(few, grid, T, FEW_STOP, held, EDGE_KERNELS[0])
    if distances:
        T = _walked(rays, grid, T, held)
    T, match = _fine_stage(rays, grid, T, FINE_STOP, held, EDGE_KERNELS[1])
    return _measured(rays, match, T, held)


_Edges = tuple[TofEdges, StereoEdges] | None


def _edges_of(source: NDArray[np.floating], edges: StereoEdges | None) -> _Edges:
    if edges is None:
        return None
    if source.ndim != 3:
        raise DataError(
            f"source points: expected an image (H, W, 3) to find edges in, got shape {source.shape}",
            hint="leave edges out, or keep the missing pixels as NaN",
        )
    return tof_edges(source), edges


def _flat(
    source: NDArray[np.floating], sigma: ArrayLike | None
) -> tuple[NDArray[np.floating], ArrayLike | None]:
    """Points (N, 3) and their noise of an image; what is no image stays as it is."""
    if source.ndim != 3 or source.shape[2] != 3:
        return source, sigma
    seen = np.isfinite(source).all(axis=-1)
    return source[seen], sigma if sigma is None or np.ndim(sigma) == 0 else np.broadcast_to(
        sigma, seen.shape
    )[seen]


def _fine_stage(
    rays: Rays,
    grid: SurfaceGrid,
    T: Float64,
    stop: float,
    held: _Edges,
    kernel: float,
    steps: int = FINE_STEPS,
) -> tuple[Float64, Match]:
    """Iterate to the end; a ray that meets nothing looks again where it looked last, and comes back if the pose does."""
    reach, before = rays.lengths, np.zeros(6)
    match = match_rays(rays, grid, T, reach, FINE_GATE)
    for _ in range(steps):
        if len(match.rays) < MIN_POINTS:
            break
        H, g, centre = _equations(match, T, held, kernel)
        step = newton_step(H, g)
        if np.sum(step * before) < 0:
            step = step / 2  # rays at edges come and go and send the pose back and forth; halving ends that
        T, before = moved(T, step, centre), step
        reach = predicted_reach(match, reach)
        match = match_rays(rays, grid, T, reach, FINE_GATE)
        if np.abs(step).max() < stop:
            break
    return T, match


def _walked(rays: Rays, grid: SurfaceGrid, T: Float64, held: _Edges) -> Float64:
    """Leave hollows of the noise along motions that the scene hardly holds."""
    match = match_rays(rays, grid, T, rays.lengths, FINE_GATE)
    if len(match.rays) < MIN_POINTS:
        return T
    some, centre = rays.nearer(WORKING_DEPTH[1]).some(WALK_POINTS), match.points.mean(axis=1)
    even = normal_equations(match, np.ones(len(match.rays)), centre)[0] + _held_evenly(T, held, centre)
    ways = weak_motions(even, _radius(match.points, centre))

    def refine(start: Float64) -> tuple[Float64, Match]:
        return _fine_stage(some, grid, start, FEW_STOP, held, EDGE_KERNELS[0], WALK_STEPS)

    return along_weak_motions(T, ways, centre, refine, TUKEY) if ways else T


def _held_evenly(T: Float64, held: _Edges, centre: Float64) -> Float64:
    """Unweighted normal matrix (6, 6) of the edges."""
    if held is None:
        return np.zeros((6, 6))
    found, _ = match_edges(*held, T, EDGE_KERNELS[1])
    return normal_equations(found, np.ones(len(found.rays)), centre)[0]


def _equations(match: Match, T: Float64, held: _Edges, kernel: float) -> tuple[Float64, Float64, Float64]:
    """Normal equations of surfaces and edges, and the point that they turn about."""
    centre = match.points.mean(axis=1)
    H, g = normal_equations(match, _weights(match), centre)
    if held is None:
        return H, g, centre
    H_edge, g_edge = normal_equations(*match_edges(*held, T, kernel), centre)
    return H + H_edge, g + g_edge, centre


def _weights(match: Match) -> Float64:
    """Tukey's weights over the variance at its measured scale."""
    sigma = np.sqrt(match.variance)
    normalised = match.distance / sigma
    sigma *= max(robust_scale(normalised), MIN_SCALE)
    out: Float64 = tukey(match.distance / (TUKEY * sigma)) / np.square(sigma)
    return out


def _measured(rays: Rays, match: Match, T: Float64, held: _Edges) -> Registration:
    """State what the last transform achieves, as :func:`calibration.registration.measure_registration` does."""
    near = np.abs(match.distance) < INLIER_DISTANCE
    inliers = int(near.sum())
    fitness = inliers / len(rays.lengths)
    if inliers < MIN_POINTS:
        return _nothing(T, inliers, fitness)
    centre = match.points[:, near].mean(axis=1)
    H, g = normal_equations(match, _weights(match), centre)
    information, even = _information(match, centre), normal_equations(match, near / 1.0, centre)[0]
    if held is not None:
        found, weights = match_edges(*held, T, EDGE_KERNELS[1])
        H_edge, g_edge = normal_equations(found, weights, centre)
        H, g, information = H + H_edge, g + g_edge, information + H_edge
        even = even + normal_equations(found, np.ones(len(found.rays)), centre)[0]
    return Registration(
        T_target_source=T,
        inliers=inliers,
        rmse=float(np.sqrt(np.mean(np.square(match.distance[near])))),
        fitness=fitness,
        information=information,
        condition=_condition(even / inliers, match.points[:, near], centre),
        centre=centre,
        step=newton_step(H, g),
    )


def _nothing(T: Float64, inliers: int, fitness: float) -> Registration:
    return Registration(T, inliers, np.nan, fitness, np.zeros((6, 6)), np.inf, T[:3, 3].copy(), np.zeros(6))


def _information(match: Match, centre: Float64) -> Float64:
    """Inverse covariance of an M-estimate: ``mean(psi')^2 / mean(psi^2) J^T V^-1 J`` (Huber 1981, 7.6)."""
    sigma = np.sqrt(match.variance)
    scale = max(robust_scale(match.distance / sigma), MIN_SCALE)
    u = match.distance / (TUKEY * scale * sigma)
    inside = np.maximum(1 - u**2, 0)
    psi = u * inside**2 * TUKEY * scale
    slope = np.where(np.abs(u) < 1, inside * (1 - 5 * u**2), 0.0)
    kept = np.abs(u) < 1
    efficiency = float(np.mean(slope[kept]) ** 2 / np.mean(np.square(psi[kept])))
    H, _ = normal_equations(match, kept / match.variance, centre)
    return efficiency * H


def _condition(H: Float64, points: Float64, centre: Float64) -> float:
    """Condition number of the unweighted normal matrix, rotations as motion at the mean radius; as of any backend."""
    even = np.repeat([1, 1 / _radius(points, centre)], 3)
    values = np.linalg.eigvalsh(H * even * even[:, None])
    return float(values[-1] / values[0]) if values[0] > 1e-15 else np.inf


def _radius(points: Float64, centre: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(points - centre[:, None]).sum(axis=0))))
