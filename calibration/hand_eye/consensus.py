"""Robust start of hand-eye: the solution on which most pairs agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.closed_form import distances, residuals, shah
from tofcapture.poses import Float64

SCALE = (
    0.005,
    np.radians(0.5),
)  # m, rad: the noise of a fair station; weighs the halves until their noise is known
SAMPLES, SAMPLE = 200, 4  # with 60 % good pairs 99.9999 % of draws hold a clean sample
QUANTILE = 0.4  # of the pairs must agree; a second board may hold the rest
QUANTILE_SIGMA = 1.37  # 40 % of 3-D Gaussian vectors are shorter than this many sigma
INLIER = 5.0  # sigma per axis; a 3-D Gaussian vector is longer in 1 of 60,000
FLOOR = 0.02  # of SCALE: what no pair is called an outlier for
POLISH = 4


@dataclass(frozen=True)
class Consensus:
    """A solution and who agrees with it.

    Attributes
    ----------
    X, Z
        (4, 4).
    noise
        Standard deviation per axis over the agreeing pairs: metres, radians.
    inliers
        (N,) bool.
    """

    X: Float64
    Z: Float64
    noise: tuple[float, float]
    inliers: NDArray[np.bool_]

    @property
    def score(self) -> float:
        """Noise in units of a fair station's; infinite where the algebra failed."""
        total = self.noise[0] / SCALE[0] + self.noise[1] / SCALE[1]
        return total if np.isfinite(total) else np.inf


def consensus(P: Float64, B: Float64) -> Consensus:
    """Find the largest agreement among pairs by samples of four, then solve with everyone who agrees.

    Parameters
    ----------
    P, B
        (N, 4, 4), N >= 3; all pairs are solved at once when N is below 8, where sampling has nothing to choose from.

    Returns
    -------
    Consensus
    """
    best = _judged(P, B, *shah(P, B))
    if len(P) < 2 * SAMPLE:
        return best
    X, Z = _best_sample(P, B)
    candidate = _judged(P, B, X, Z)
    for _ in range(POLISH):
        candidate = _judged(P, B, *shah(P[candidate.inliers], B[candidate.inliers]))
    return min(best, candidate, key=lambda c: c.score / max(c.inliers.mean(), 1e-9))


def _best_sample(P: Float64, B: Float64) -> tuple[Float64, Float64]:
    # A fixed seed: the same pairs give the same answer.
    rng = np.random.default_rng(0)
    chosen = np.argsort(rng.random((SAMPLES, len(P))), axis=1)[:, :SAMPLE]
    X, Z = shah(P[chosen], B[chosen])
    cost = _cost(residuals(P, B, X, Z))
    np.put_along_axis(cost, chosen, np.inf, axis=1)  # a sample always agrees with itself
    rank = int(np.ceil(QUANTILE * (len(P) - SAMPLE)))
    winner = int(np.argmin(np.partition(cost, rank - 1, axis=1)[:, rank - 1]))
    return X[winner], Z[winner]


def _cost(residual: Float64) -> Float64:
    moved, turned = distances(residual)
    return np.asarray(np.hypot(moved / SCALE[0], turned / SCALE[1]))


def _judged(P: Float64, B: Float64, X: Float64, Z: Float64) -> Consensus:
    halves = distances(residuals(P, B, X, Z))
    sigma = [
        max(float(np.quantile(h, QUANTILE)) / QUANTILE_SIGMA, FLOOR * s)
        for h, s in zip(halves, SCALE, strict=True)
    ]
    inliers = (halves[0] <= INLIER * sigma[0]) & (halves[1] <= INLIER * sigma[1])
    if inliers.sum() < 3:
        inliers = np.ones(len(P), dtype=bool)
    rms = [float(np.sqrt(np.mean(np.square(h[inliers])) / 3)) for h in halves]
    return Consensus(X, Z, (rms[0], rms[1]), inliers)
