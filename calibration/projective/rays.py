"""Measured rays, and where they meet a stereo surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.projective.grid import GRAZING, SurfaceGrid
from calibration.projective.newton import Match
from tofcapture.errors import DataError
from tofcapture.poses import Float64

STEREO_SIGMA = 0.0005  # m, of a tangent plane: stereo noise and what the quadratic leaves out
RELATIVE_SIGMA = 0.004  # range noise over range, where the caller knows no better


@dataclass(frozen=True)
class Rays:
    """Measured rays: unit directions (3, N) in the ToF frame, lengths (N,) and their standard deviations (N,), metres."""

    directions: Float64
    lengths: Float64
    sigma: Float64

    def nearer(self, depth: float) -> Rays:
        """Rays that end before a depth of the ToF camera."""
        near = self.directions[2] * self.lengths < depth
        return Rays(self.directions[:, near], self.lengths[near], self.sigma[near])

    def some(self, count: int) -> Rays:
        """Evenly picked rays, about ``count`` of them."""
        step = max(len(self.lengths) // count, 1)
        return Rays(
            np.ascontiguousarray(self.directions[:, ::step]), self.lengths[::step], self.sigma[::step]
        )


def rays_of(source: NDArray[np.floating], sigma: ArrayLike | None) -> Rays:
    """Check points (N, 3) and their range noise, a number or (N,); see :func:`calibration.projective_icp.register_projective`."""
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
    return Rays(points / lengths, lengths, np.broadcast_to(spread, lengths.shape))


def match_rays(rays: Rays, grid: SurfaceGrid, T: Float64, reach: Float64, gate: float) -> Match:
    """Cut the rays with the tangent planes at their predicted ends (N,) and keep residuals within the gate."""
    o = T[:3, 3]
    d = np.einsum("ij,jn->in", T[:3, :3], rays.directions)
    planes = grid.planes_at(o[:, None] + reach * d)
    n = planes.normals
    cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    beyond = planes.offsets - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])  # predicted length times cosine
    distance = cosine * rays.lengths - beyond
    met = np.flatnonzero(planes.found & (cosine >= GRAZING) & (np.abs(distance) < gate))
    cosine = cosine.take(met)
    predicted = beyond.take(met) / cosine
    return Match(
        rays=met,
        points=o[:, None] + predicted * d.take(met, axis=1),
        normals=n.take(met, axis=1),
        distance=distance.take(met),
        variance=(cosine * rays.sigma.take(met)) ** 2 + STEREO_SIGMA**2,
        reach=predicted,
        seen=int(np.count_nonzero(planes.inside)),
    )


def predicted_reach(match: Match, otherwise: Float64) -> Float64:
    """Where to look next: the predicted end of each ray, ``otherwise`` (N,) where nothing was met."""
    reach = otherwise.copy()
    reach[match.rays] = match.reach
    return reach
