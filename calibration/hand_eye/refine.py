"""Maximum-likelihood hand-eye over all poses: robust, weighted by the noise it finds, with covariance.

The residual of a pair is the displacement and the rotation between predicted and seen board, in the camera frame. It is
taken as multivariate Student-t. Its scatter is the camera's own, 6 x 6 and the same in every view, plus the arm's, which acts at
the flange and reaches the board over a lever that differs from pose to pose. Both come out of the data by
expectation-maximisation, and with them the weights of rotation against translation and of near against far poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.hand_eye.closed_form import consensus, hats, moved, residuals
from tofcapture.poses import Float64

FREEDOM = 8.0  # degrees of freedom of Student's t: efficient on Gaussian noise, and outliers lose their vote
PRIOR = 12.0  # pairs' worth of belief that the camera's scatter is isotropic in each half
FLOOR = (1e-7, 1e-7)  # m, rad; keeps noise-free data solvable
ITERATIONS = 60
STOP = 1e-8  # m, rad
LEAST_LEFT = 0.02  # of a direction that only one group determines: its own residual tells nothing there
SHARED = 2.5  # standard deviations by which an autocorrelation counts
SMALL = 3  # pairs that determine a calibration
SANDWICH = 12  # pairs from which on their own scatter is believed more than the model


@dataclass(frozen=True)
class Refined:
    """A refined solution of N pairs."""

    X: Float64  #: (4, 4)
    Z: Float64  #: (4, 4)
    residual: Float64  #: (N, 6) metres and radians, camera frame
    scatter: Float64  #: (N, 6, 6) covariance of each pair's noise
    #: (12, 12) of (t_X, phi_X, t_Z, phi_Z): metres, radians, rotations in the left tangent space.
    #: (13, 13) with the logarithm of ``scale`` at the end where that was free
    covariance: Float64
    left_out: Float64  #: (N, 6) residual of each pair under the solution without it; NaN where the rest determines nothing
    scale: float = 1.0  #: Factor by which the target's distances must be multiplied

    @property
    def noise(self) -> tuple[float, float]:
        """Standard deviation per axis of one pair: metres, radians."""
        d = np.einsum("nii->i", self.scatter) / len(self.scatter)
        return float(np.sqrt(d[:3].mean())), float(np.sqrt(d[3:].mean()))

    @property
    def distance(self) -> Float64:
        """(N,) Mahalanobis distance of each pair."""
        return np.asarray(np.sqrt(_mahalanobis2(self.residual, _inverse(self.scatter))))

    @property
    def weight(self) -> Float64:
        """(N,) votes of the pairs: about one, near zero for outliers."""
        return _weights(self.residual, _inverse(self.scatter))

    @property
    def log_likelihood(self) -> float:
        """Of the pairs under the fitted Student-t, up to a constant."""
        logdet = np.linalg.slogdet(self.scatter)[1].sum()
        return float(-0.5 * logdet - 0.5 * (FREEDOM + 6) * np.log1p(self.distance**2 / FREEDOM).sum())


def refine(
    P: Float64,
    B: Float64,
    X: Float64,
    Z: Float64,
    noise: tuple[float, float],
    *,
    eye_to_hand: bool = False,
    free_scale: bool = False,
) -> Refined:
    """Refine X and Z, and with ``free_scale`` the target's size, by Gauss-Newton inside expectation-maximisation.

    P and B are (N, 4, 4) pairs, N >= 3; P is T_flange_base, not T_base_flange, where ``eye_to_hand``. X and Z are the start,
    (4, 4), ``noise`` is a first guess of the noise per axis, metres and radians.
    """
    whole = np.repeat(np.square(np.maximum(noise, FLOOR)), 3)
    camera, arm = np.diag(whole / 2), whole / 2
    scale = 1.0
    r, J = _linearised(P, B, X, Z, scale, free=free_scale)
    for _ in range(ITERATIONS):
        lever = _lever(P, X, Z, eye_to_hand=eye_to_hand)
        information = _inverse(_total(camera, arm, lever))
        weight = _weights(r, information)
        step = _solve(J, r, weight, information)
        X, Z, scale = moved(X, step[:6]), moved(Z, step[6:12]), scale * float(np.exp(step[12:].sum()))
        r, J = _linearised(P, B, X, Z, scale, free=free_scale)
        camera, arm = _sources(r, weight, camera, arm, lever, information)
        if np.abs(step).max() < STOP:
            break
    scatter = _total(camera, arm, _lever(P, X, Z, eye_to_hand=eye_to_hand))
    weight = _weights(r, _inverse(scatter))
    return Refined(X, Z, r, scatter, *_uncertainty(J, r, weight, scatter), scale)


def _linearised(
    P: Float64, B: Float64, X: Float64, Z: Float64, scale: float, *, free: bool
) -> tuple[Float64, Float64]:
    """Residuals (N, 6) and their derivative (N, 6, 12), or (N, 6, 13) with the logarithm of the scale.

    The prediction is divided by the scale: noise is the camera's first of all, and a regressor with noise would shrink.
    """
    r, J = residuals(P, B, X, Z), jacobian(P, X, Z)
    if not free:
        return r, J
    predicted = (r[:, :3] + B[:, :3, 3]) / scale
    r[:, :3] = predicted - B[:, :3, 3]
    J[:, :3] /= scale
    by_scale = np.concatenate([-predicted, np.zeros_like(predicted)], axis=1)
    return r, np.concatenate([J, by_scale[..., None]], axis=2)


def _lever(P: Float64, X: Float64, Z: Float64, *, eye_to_hand: bool) -> Float64:
    """(N, 6, 6) derivative of the residual by the arm's own error at the flange, up to its sign."""
    if eye_to_hand:
        turn = np.swapaxes(P[:, :3, :3] @ X[:3, :3], 1, 2)
        board = np.broadcast_to(Z[:3, 3], (len(P), 3))
    else:
        turn = np.broadcast_to(X[:3, :3].T, (len(P), 3, 3))
        board = np.einsum("nji,nj->ni", P[:, :3, :3], Z[:3, 3] - P[:, :3, 3])
    out = np.zeros((len(P), 6, 6))
    out[:, :3, :3], out[:, 3:, 3:] = -turn, -turn
    out[:, :3, 3:] = turn @ hats(board)
    return out


def _total(camera: Float64, arm: Float64, lever: Float64) -> Float64:
    out: Float64 = camera + (lever * arm) @ np.swapaxes(lever, 1, 2)
    return out


def _sources(
    r: Float64, weight: Float64, camera: Float64, arm: Float64, lever: Float64, information: Float64
) -> tuple[Float64, Float64]:
    """Share the residuals between camera and arm: one step of expectation-maximisation.

    The camera's scatter is drawn towards isotropy; the arm's is isotropic in each half. Twelve parameters cost two pairs.
    """
    n = len(r)
    root = np.sqrt(weight * n / max(n - 2, 1))[:, None] * np.einsum("nij,nj->ni", information, r)
    seen = root @ camera
    S = (seen.T @ seen) / n + camera - camera @ information.mean(axis=0) @ camera
    d = np.diag(S)
    isotropic = np.repeat([max(d[:3].mean(), FLOOR[0] ** 2), max(d[3:].mean(), FLOOR[1] ** 2)], 3)
    felt = np.einsum("nji,nj->ni", lever, root) * arm
    kept = np.einsum("nji,njk,nki->i", lever, information, lever) / n
    e = np.square(felt).mean(axis=0) + arm - arm**2 * kept
    return (n * S + PRIOR * np.diag(isotropic)) / (n + PRIOR), np.repeat([e[:3].mean(), e[3:].mean()], 3)


def jacobian(P: Float64, X: Float64, Z: Float64) -> Float64:
    """Derivative (N, 6, 12) of :func:`calibration.hand_eye.closed_form.residuals` by (t_X, phi_X, t_Z, phi_Z)."""
    back = X[:3, :3].T
    R_Pt = np.swapaxes(P[:, :3, :3], 1, 2)
    y = np.einsum("nij,nj->ni", R_Pt, Z[:3, 3] - P[:, :3, 3]) - X[:3, 3]
    J = np.zeros((len(P), 6, 12))
    J[:, :3, 0:3] = -back
    J[:, :3, 3:6] = back @ hats(y)
    J[:, :3, 6:9] = back @ R_Pt
    J[:, 3:, 3:6] = -back
    J[:, 3:, 9:12] = back @ R_Pt
    return J


def _mahalanobis2(r: Float64, information: Float64) -> Float64:
    return np.asarray(np.einsum("ni,nij,nj->n", r, information, r))


def _inverse(S: Float64) -> Float64:
    return np.asarray(np.linalg.inv(S), dtype=np.float64)


def _weights(r: Float64, information: Float64) -> Float64:
    return np.asarray((FREEDOM + 6) / (FREEDOM + _mahalanobis2(r, information)))


def _solve(J: Float64, r: Float64, weight: Float64, information: Float64) -> Float64:
    L = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    root = np.sqrt(weight)[:, None]
    left = (root[:, :, None] * (L @ J)).reshape(-1, J.shape[2])
    right = (root * np.einsum("nij,nj->ni", L, r)).reshape(-1)
    return np.asarray(-np.linalg.lstsq(left, right, rcond=None)[0], dtype=np.float64)


def _uncertainty(J: Float64, r: Float64, weight: Float64, scatter: Float64) -> tuple[Float64, Float64]:
    """Covariance and left-out residuals.

    A left-out solution is one Newton step away from the full one, since the problem is nearly linear there. The covariance is the
    scatter of the pairs' scores, each divided by the root of what it did not pull towards itself (CR2 of Bell and
    McCaffrey, 2002): it holds when the noise model does not. Few scores are themselves noisy, so the model of independent pairs
    counts as a dozen of them, and what is left is widened as Student's t is. Below a dozen pairs the model is believed.
    """
    pull = weight[:, None, None] * np.linalg.inv(scatter)
    each = np.einsum("nia,nij,njb->nab", J, pull, J)
    H, score = each.sum(axis=0), np.einsum("nia,nij,nj->na", J, pull, r)
    left_out = np.full_like(r, np.nan)
    for i in range(len(r)):
        rest = H - each[i]
        if np.linalg.cond(rest) < 1e14:
            left_out[i] = r[i] + J[i] @ np.linalg.solve(rest, score[i])
    inverse = np.linalg.pinv(H) / _curvature(weight)
    n = len(r)
    wider = (n - 2) / (n - 4) if n > 2 * SMALL else 2.0
    wider *= _shared(r, weight, scatter, len(H))
    if n < SANDWICH:
        return inverse * wider, left_out
    freed = _freed(H, each, score)
    sandwich = inverse @ (freed.T @ freed) @ inverse
    return (n * sandwich + SANDWICH * inverse) / (n + SANDWICH) * wider, left_out


def _shared(r: Float64, weight: Float64, scatter: Float64, unknowns: int) -> float:
    """Factor by which pairs that share errors with those before them tell less: one and twice the sum of their autocorrelations.

    Only lags up to the first that is not significant count, so single shots in any order give one. A fit lowers each by its unknowns.
    """
    white = np.linalg.solve(np.linalg.cholesky(scatter), r[..., None])[..., 0] * np.sqrt(weight)[:, None]
    total, power = 1.0, float(np.square(white).mean())
    for lag in range(1, len(r) // 4 + 1):
        rho = float((white[lag:] * white[:-lag]).mean()) / max(power, 1e-300) + unknowns / r.size
        if rho < SHARED / np.sqrt(r.size):
            break
        total += 2 * min(rho, 1.0)
    return total


def _curvature(weight: Float64) -> float:
    """Share of the weighted normal equations that is curvature of the likelihood: an outlier's pull grows less than its distance."""
    far = 1 - FREEDOM * weight / (FREEDOM + 6)  # distance^2 / (FREEDOM + distance^2)
    return float(1 - (2 / 6) * (weight * far).sum() / weight.sum())


def _freed(H: Float64, shares: Float64, scores: Float64) -> Float64:
    """Scores (N, p) divided by the root of one minus the pair's share of the normal equations (N, p, p)."""
    value, vector = np.linalg.eigh(H)
    value = np.maximum(value, 1e-12 * value.max())
    root, back = vector * np.sqrt(value), (vector / np.sqrt(value)).T
    share, axes = np.linalg.eigh(back @ shares @ back.T)
    left = 1 / np.sqrt(np.clip(1 - share, LEAST_LEFT, 1))
    turned = np.einsum("nij,ni->nj", axes, scores @ back.T) * left
    out: Float64 = np.einsum("nij,nj->ni", axes, turned) @ root.T
    return out


def refined_from_consensus(P: Float64, B: Float64) -> Refined:
    """Solve without any gate: the consensus start, refined; for searches that solve many times."""
    start = consensus(P, B)
    return refine(P, B, start.X, start.Z, start.noise)
