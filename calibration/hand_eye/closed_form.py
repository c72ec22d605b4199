"""Closed forms of the hand-eye equations, each for one set of pairs or for many at once.

All speak one language: ``P_i X B_i = Z`` with ``B_i = T_camera_board``. Camera in the hand: ``P_i = T_base_flange``,
``X = T_flange_camera``, ``Z = T_base_board``. Camera beside the arm: ``P_i = T_flange_base``, ``X = T_base_camera``,
``Z = T_flange_board``. With ``A_ij = P_j^-1 P_i`` and ``B_ij = B_j B_i^-1`` it reads ``A_ij X = X B_ij``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.poses import Float64, transform

NEAR_PI = np.radians(170)  # beyond it the sign of a rotation vector is noise


def invert_all(T: Float64) -> Float64:
    """Invert rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3] = -(out[..., :3, :3] @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def rotation_vectors(R: Float64) -> Float64:
    """Rotation vectors (..., 3), radians, of rotations (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(flat.reshape(R.shape[:-1]), dtype=np.float64)


def relative_motions(P: Float64, B: Float64) -> tuple[Float64, Float64]:
    """Motions ``A_ij`` and ``B_ij`` (M, 4, 4) of all M = N (N - 1) / 2 couples of pairs."""
    i, j = np.triu_indices(len(P), 1)
    return invert_all(P[j]) @ P[i], B[j] @ invert_all(B[i])


def screws(T: Float64) -> tuple[Float64, Float64]:
    """Rotation angle (N,) and translation along the axis (N,) of motions, which hand and eye must share."""
    phi = rotation_vectors(T[:, :3, :3])
    angle = np.linalg.norm(phi, axis=1)
    axis = phi / np.maximum(angle, 1e-12)[:, None]
    return angle, np.einsum("ni,ni->n", axis, T[:, :3, 3])


def nearest_rotation(M: Float64) -> Float64:
    """Rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    handed = np.ones(M.shape[:-1])
    handed[..., 2] = np.linalg.det(U @ Vt)
    out: Float64 = (U * handed[..., None, :]) @ Vt
    return out


def park_martin(P: Float64, B: Float64) -> Float64:
    """Solve AX = XB after Park and Martin (IEEE T-RA 10(5), 1994) over all couples of pairs.

    Parameters
    ----------
    P, B
        (N, 4, 4), N >= 3.

    Returns
    -------
    X, (4, 4) float64
    """
    A_ij, B_ij = relative_motions(P, B)
    alpha, beta = rotation_vectors(A_ij[:, :3, :3]), rotation_vectors(B_ij[:, :3, :3])
    safe = np.linalg.norm(alpha, axis=1) < NEAR_PI
    rotation = nearest_rotation(alpha[safe].T @ beta[safe])
    return transform(rotation, _translation(A_ij, B_ij, rotation))


def _translation(A: Float64, B: Float64, rotation: Float64) -> Float64:
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ rotation.T - A[:, :3, 3]).reshape(-1)
    return np.asarray(np.linalg.lstsq(left, right, rcond=None)[0], dtype=np.float64)


def daniilidis(P: Float64, B: Float64) -> Float64:
    """Solve AX = XB with dual quaternions (Daniilidis, IJRR 18(3), 1999) over all couples of pairs.

    A quaternion and its negative are one rotation; both sides of a couple get the same sign here, without which the method
    fails on half of all data. Couples turned by nearly pi, where that sign is noise, are left out.

    Parameters
    ----------
    P, B
        (N, 4, 4), N >= 3.

    Returns
    -------
    X, (4, 4) float64
    """
    A_ij, B_ij = relative_motions(P, B)
    safe = np.linalg.norm(rotation_vectors(A_ij[:, :3, :3]), axis=1) < NEAR_PI
    (a, a_dual), (b, b_dual) = _dual(A_ij[safe]), _dual(B_ij[safe])
    zero = np.zeros((len(a), 3, 4))
    upper, lower = _commutator(a, b), _commutator(a_dual, b_dual)
    T = np.concatenate(
        [np.concatenate([upper, zero], axis=2), np.concatenate([lower, upper], axis=2)], axis=1
    )
    _, _, Vt = np.linalg.svd(T.reshape(-1, 8), full_matrices=False)
    return _from_null_space(Vt[6], Vt[7])


def _dual(T: Float64) -> tuple[Float64, Float64]:
    """Unit dual quaternions (scalar first, scalar not negative) of motions."""
    from scipy.spatial.transform import Rotation

    q = np.roll(Rotation.from_matrix(T[:, :3, :3]).as_quat(), 1, axis=1)
    q *= np.where(q[:, :1] < 0, -1.0, 1.0)
    t, w, v = T[:, :3, 3], q[:, :1], q[:, 1:]
    dual = 0.5 * np.concatenate([-np.sum(t * v, axis=1, keepdims=True), w * t + np.cross(t, v)], axis=1)
    return q, dual


def _commutator(a: Float64, b: Float64) -> Float64:
    """(N, 3, 4) matrices of the vector part of ``a q - q b``."""
    total = a[:, 1:] + b[:, 1:]
    x, y, z = total.T
    o = np.zeros_like(x)
    cross = np.stack([np.stack([o, -z, y], 1), np.stack([z, o, -x], 1), np.stack([-y, x, o], 1)], axis=1)
    return np.concatenate([(a[:, 1:] - b[:, 1:])[:, :, None], cross], axis=2)


def _from_null_space(v1: Float64, v2: Float64) -> Float64:
    """The combination of two null vectors that is a unit dual quaternion."""
    from scipy.spatial.transform import Rotation

    (u1, w1), (u2, w2) = (v1[:4], v1[4:]), (v2[:4], v2[4:])
    best, norm = np.zeros(8), -1.0
    # (s v1 + v2) must have orthogonal halves; s = infinity stands for v1 alone.
    roots = np.roots([u1 @ w1, u1 @ w2 + u2 @ w1, u2 @ w2])
    for s in np.real(roots) if len(roots) else [0.0]:
        candidate = s * v1 + v2
        size = float(candidate[:4] @ candidate[:4]) / float(candidate @ candidate)
        if size > norm:
            best, norm = candidate / np.linalg.norm(candidate[:4]), size
    q, dual = best[:4], best[4:]
    t = 2 * (q[0] * dual[1:] - dual[0] * q[1:] + np.cross(q[1:], dual[1:]))
    return transform(Rotation.from_quat(np.roll(q, -1)).as_matrix(), t)


def shah(P: Float64, B: Float64) -> tuple[Float64, Float64]:
    """Solve AX = ZB with the Kronecker product (Shah, J. Mechanisms Robotics 5(3), 2013).

    The rotations are the dominant singular pair of ``sum_i R_P (x) R_B``, the translations linear least squares.

    Parameters
    ----------
    P, B
        (..., N, 4, 4), N >= 3; leading axes are separate problems.

    Returns
    -------
    X, Z
        (..., 4, 4) float64.
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


def board_of(P: Float64, B: Float64, X: Float64) -> Float64:
    """Z (4, 4) that goes with X: mean of ``P_i X B_i``."""
    each = P @ X @ B
    return transform(nearest_rotation(each[:, :3, :3].mean(axis=0)), each[:, :3, 3].mean(axis=0))


def residuals(P: Float64, B: Float64, X: Float64, Z: Float64) -> Float64:
    """What the camera should have seen minus what it saw, in the camera frame.

    Parameters
    ----------
    P, B
        (..., N, 4, 4).
    X, Z
        (..., 4, 4).

    Returns
    -------
    (..., N, 6) float64: displacement of the board's origin in metres, then rotation vector in radians.
    """
    seen = invert_all(P @ X[..., None, :, :]) @ Z[..., None, :, :]
    turned = rotation_vectors(seen[..., :3, :3] @ np.swapaxes(B[..., :3, :3], -1, -2))
    return np.concatenate([seen[..., :3, 3] - B[..., :3, 3], turned], axis=-1)


def distances(residual: Float64) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lengths (metres, radians) of the two halves of residuals (..., 6)."""
    return np.linalg.norm(residual[..., :3], axis=-1), np.linalg.norm(residual[..., 3:], axis=-1)
