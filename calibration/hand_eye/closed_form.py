"""Closed forms of the hand-eye equations, and the robust start from them: the solution on which most pairs agree.

All speak one language: ``P_i X B_i = Z`` with ``B_i = T_camera_board``. Camera in the hand: ``P_i = T_base_flange``,
``X = T_flange_camera``, ``Z = T_base_board``. Camera beside the arm: ``P_i = T_flange_base``, ``X = T_base_camera``,
``Z = T_flange_board``. With ``A_ij = P_j^-1 P_i`` and ``B_ij = B_j B_i^-1`` it reads ``A_ij X = X B_ij``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.poses import Float64, invert_all, rotation_exp, transform

NEAR_PI = np.radians(170)  # beyond it the sign of a rotation vector is noise
# m, rad: the noise of a fair station; weighs the halves until their noise is known
SCALE = (0.005, np.radians(0.5))
SAMPLES, SAMPLE = 200, 4  # with 60 % good pairs 99.9999 % of draws hold a clean sample
QUANTILE = 0.4  # of the pairs must agree; a second board may hold the rest
QUANTILE_SIGMA = 1.37  # 40 % of 3-D Gaussian vectors are shorter than this many sigma
INLIER = 5.0  # sigma per axis; a 3-D Gaussian vector is longer in 1 of 60,000
FLOOR = 0.02  # of SCALE: what no pair is called an outlier for
POLISH = 4
SMALLER = 0.9  # of the noise is left where another size of the target is believed
SIZINGS = 3
UNSIZED = 5.0  # factor; farther off it is a mistake of units


def hats(v: Float64) -> Float64:
    """Cross-product matrices (N, 3, 3) of vectors (N, 3)."""
    return np.cross(v[:, None], np.eye(3)).swapaxes(1, 2)


def moved(T: Float64, step: Float64) -> Float64:
    """Transform (4, 4) after a step (6,): displacement of its origin, rotation vector in the left tangent space."""
    return transform(rotation_exp(step[3:]) @ T[:3, :3], T[:3, 3] + step[:3])


def rotation_vectors(R: Float64) -> Float64:
    """Rotation vectors (..., 3), radians, of rotations (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(flat.reshape(R.shape[:-1]), dtype=np.float64)


def relative_motions(P: Float64, B: Float64) -> tuple[Float64, Float64]:
    """Motions ``A_ij`` and ``B_ij`` (M, 4, 4) of all M = N (N - 1) / 2 couples of pairs."""
    i, j = np.triu_indices(len(P), 1)
    return invert_all(P[j]) @ P[i], B[j] @ invert_all(B[i])


def nearest_rotation(M: Float64) -> Float64:
    """Rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    handed = np.ones(M.shape[:-1])
    handed[..., 2] = np.linalg.det(U @ Vt)
    out: Float64 = (U * handed[..., None, :]) @ Vt
    return out


def park_martin(P: Float64, B: Float64) -> Float64:
    """Solve AX = XB after Park and Martin (IEEE T-RA 10(5), 1994) over all couples of pairs (N, 4, 4); returns X (4, 4)."""
    A_ij, B_ij = relative_motions(P, B)
    alpha, beta = rotation_vectors(A_ij[:, :3, :3]), rotation_vectors(B_ij[:, :3, :3])
    safe = np.linalg.norm(alpha, axis=1) < NEAR_PI
    rotation = nearest_rotation(alpha[safe].T @ beta[safe])
    return transform(rotation, _translation(A_ij, B_ij, rotation))


def _translation(A: Float64, B: Float64, rotation: Float64) -> Float64:
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ rotation.T - A[:, :3, 3]).reshape(-1)
    return np.asarray(np.linalg.lstsq(left, right, rcond=None)[0], dtype=np.float64)


def shah(P: Float64, B: Float64) -> tuple[Float64, Float64]:
    """Solve AX = ZB with the Kronecker product (Shah, J. Mechanisms Robotics 5(3), 2013): X and Z (..., 4, 4).

    The rotations are the dominant singular pair of ``sum_i R_P (x) R_B``, the translations linear least squares. Pairs are
    (..., N, 4, 4), N >= 3; leading axes are separate problems.
    """
    R_P, R_B = P[..., :3, :3], B[..., :3, :3]
    K = np.einsum("...nac,...ndb->...abcd", R_P, R_B).reshape(*P.shape[:-3], 9, 9)
    U, _, Vt = np.linalg.svd(K)
    z, x = U[..., :, 0].reshape(*P.shape[:-3], 3, 3), Vt[..., 0, :].reshape(*P.shape[:-3], 3, 3)
    sign = np.sign(np.linalg.det(x))[..., None, None]
    R_X, R_Z = nearest_rotation(sign * x), nearest_rotation(sign * z)
    X, Z = np.zeros((*P.shape[:-3], 4, 4)), np.zeros((*P.shape[:-3], 4, 4))
    X[..., :3, :3], Z[..., :3, :3], X[..., 3, 3], Z[..., 3, 3] = R_X, R_Z, 1, 1
    X[..., :3, 3], Z[..., :3, 3] = _two_translations(P, B, R_X)
    return X, Z


def _two_translations(P: Float64, B: Float64, R_X: Float64) -> tuple[Float64, Float64]:
    """Solve ``R_P t_X - t_Z = -t_P - R_P R_X t_B`` by normal equations, which batch."""
    R_P = P[..., :3, :3]
    right = -P[..., :3, 3] - np.einsum("...nij,...jk,...nk->...ni", R_P, R_X, B[..., :3, 3])
    mean_R, mean_right = R_P.mean(axis=-3), right.mean(axis=-2)
    left = R_P - mean_R[..., None, :, :]  # t_Z eliminated
    normal = np.einsum("...nji,...njk->...ik", left, left) + 1e-12 * np.eye(3)
    t_X = np.linalg.solve(normal, np.einsum("...nji,...nj->...i", left, right)[..., None])[..., 0]
    return t_X, np.einsum("...ij,...j->...i", mean_R, t_X) - mean_right


def residuals(P: Float64, B: Float64, X: Float64, Z: Float64) -> Float64:
    """Return what the camera should have seen minus what it saw, in the camera frame.

    Pairs (..., N, 4, 4), X and Z (..., 4, 4) give (..., N, 6) float64: displacement of the board's origin in metres, then rotation
    vector in radians.
    """
    seen = invert_all(P @ X[..., None, :, :]) @ Z[..., None, :, :]
    turned = rotation_vectors(seen[..., :3, :3] @ np.swapaxes(B[..., :3, :3], -1, -2))
    return np.concatenate([seen[..., :3, 3] - B[..., :3, 3], turned], axis=-1)


def rotation_bound(P: Float64, B: Float64, X: Float64, Z: Float64, weight: Float64) -> float:
    """Certify rotations as the best of all: no others farther from these than this angle (radians) fit the pairs as well.

    The chordal fit ``sum_i w_i tr(R_Z^T R_P R_X R_B)`` is bilinear in X and Z, so the singular values of its matrix (9, 9) bound it
    over everything, rotation or not: the relaxation behind :func:`shah`. A fit c between the two largest, s1 and s2, keeps an
    overlap of (c - s2) / (s1 - s2) with the best pair. Pairs (N, 4, 4), weights (N,); pi where nothing is certified.
    """
    K = np.einsum("n,nac,ndb->abcd", weight, P[:, :3, :3], B[:, :3, :3]).reshape(9, 9)
    s = np.linalg.svd(K, compute_uv=False)
    fit = float(Z[:3, :3].ravel() @ K @ X[:3, :3].ravel()) / 3
    lost = max(s[0] - fit, 0.0) / max(s[0] - s[1], 1e-12)
    return float(2 * np.arcsin(min(1.0, np.sqrt(3 * lost))))


def distances(residual: Float64) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lengths (metres, radians) of the two halves of residuals (..., 6)."""
    return np.linalg.norm(residual[..., :3], axis=-1), np.linalg.norm(residual[..., 3:], axis=-1)


@dataclass(frozen=True)
class Consensus:
    """A solution and who agrees with it."""

    X: Float64  #: (4, 4)
    Z: Float64  #: (4, 4)
    noise: tuple[float, float]  #: Standard deviation per axis over the agreeing pairs: metres, radians
    inliers: NDArray[np.bool_]  #: (N,)

    @property
    def score(self) -> float:
        """Noise in units of a fair station's; infinite where the algebra failed."""
        total = self.noise[0] / SCALE[0] + self.noise[1] / SCALE[1]
        return total if np.isfinite(total) else np.inf

    @property
    def penalty(self) -> float:
        """Score over the share that agrees: what solutions of different readings are compared by."""
        return self.score / max(float(self.inliers.mean()), 1e-9)


def consensus(P: Float64, B: Float64) -> Consensus:
    """Find the largest agreement among pairs (N, 4, 4) by samples of four, then solve with everyone who agrees.

    All pairs are solved at once when N is below 8, where sampling has nothing to choose from.
    """
    best = _agreement(P, B, *shah(P, B))
    if len(P) < 2 * SAMPLE:
        return best
    candidate = _agreement(P, B, *_best_sample(P, B))
    for _ in range(POLISH):
        candidate = _agreement(P, B, *shah(P[candidate.inliers], B[candidate.inliers]))
    return min(best, candidate, key=lambda c: c.penalty)


def _best_sample(P: Float64, B: Float64) -> tuple[Float64, Float64]:
    # A fixed seed: the same pairs give the same answer.
    rng = np.random.default_rng(0)
    chosen = np.argsort(rng.random((SAMPLES, len(P))), axis=1)[:, :SAMPLE]
    X, Z = shah(P[chosen], B[chosen])
    moved, turned = distances(residuals(P, B, X, Z))
    cost = np.hypot(moved / SCALE[0], turned / SCALE[1])
    np.put_along_axis(cost, chosen, np.inf, axis=1)  # a sample always agrees with itself
    rank = int(np.ceil(QUANTILE * (len(P) - SAMPLE)))
    winner = int(np.argmin(np.partition(cost, rank - 1, axis=1)[:, rank - 1]))
    return X[winner], Z[winner]


def _agreement(P: Float64, B: Float64, X: Float64, Z: Float64) -> Consensus:
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


def scaled_consensus(P: Float64, B: Float64) -> tuple[Consensus, float]:
    """Find the consensus of pairs (N, 4, 4), and the factor of the target's distances that it needs.

    The factor is one unless another, no farther than ``UNSIZED``, leaves clearly less noise: it is a start, and a diagnosis of other
    mistakes is not to take it for noise.
    """
    found, scale = consensus(P, B), 1.0
    for _ in range(SIZINGS):
        kept = found.inliers
        factor = scale * linear_scale(P[kept], scaled(B[kept], scale), found.X[:3, :3])
        if not 1 / UNSIZED < factor < UNSIZED:
            break
        other = consensus(P, scaled(B, factor))
        if other.penalty > SMALLER * found.penalty:
            break
        found, scale = other, factor
    return found, scale


def linear_scale(P: Float64, B: Float64, rotation: Float64) -> float:
    """Find the factor of the target's distances by least squares in (t_X, t_Z, s) of ``R_P t_X - t_Z + s R_P R_X t_B = -t_P``."""
    n = len(P)
    left = np.zeros((n, 3, 7))
    left[:, :, :3], left[:, :, 3:6] = P[:, :3, :3], -np.eye(3)
    left[:, :, 6] = np.einsum("nij,jk,nk->ni", P[:, :3, :3], rotation, B[:, :3, 3])
    return float(np.linalg.lstsq(left.reshape(-1, 7), -P[:, :3, 3].reshape(-1), rcond=None)[0][6])


def scaled(T: Float64, factor: float | Float64) -> Float64:
    """Multiply the translations of poses (N, 4, 4), each axis by its own factor where there are three."""
    out = T.copy()
    out[:, :3, 3] *= factor
    return out
