"""Rigid motions as plain (4, 4) float64 arrays.

``T_a_b`` maps points of frame b into frame a, so that subscripts cancel: ``T_base_tof = T_base_flange @ T_flange_tof``.
A twist is ``(rho, phi)``: translation part first, rotation vector second, both in the left tangent space of
``exp`` (``exp(xi) @ T`` moves T by xi seen from frame a).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.errors import ConfigError

Float64 = NDArray[np.float64]

_SMALL = 1e-6  # rad; below this the Taylor series of the rotation formulas is exact to double precision


def check_transform(T: ArrayLike, name: str = "transform") -> Float64:
    """Coerce to a rigid (4, 4) float64 transform, or say what is wrong with it; ``name`` is what to call it then.

    Raises :class:`ConfigError`: wrong shape, not finite, not orthonormal to 1e-6, left-handed, or last row not 0 0 0 1.
    """
    out = np.asarray(T, dtype=np.float64)
    if out.shape != (4, 4):
        raise ConfigError(f"{name}: expected a (4, 4) rigid transform, got shape {out.shape}")
    if not np.isfinite(out).all():
        raise ConfigError(f"{name}: expected finite numbers, got NaN or infinity")
    rotation = out[:3, :3]
    defect = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if defect > 1e-6 or np.linalg.det(rotation) < 0:
        raise ConfigError(
            f"{name}: expected a right-handed rotation, got R R^T off by {defect:.2g}, det {np.linalg.det(rotation):.3g}",
            hint="translations are in metres; the rotation must not hold a scale",
        )
    if np.abs(out[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ConfigError(
            f"{name}: expected last row 0 0 0 1, got {out[3].tolist()}",
            hint="the last column has the translation: is it transposed?",
        )
    return out


def printed(T: ArrayLike) -> Float64:
    """Give a (4, 4), or its 16 numbers by rows, back the rotation that a few printed digits took; what is off by more stays."""
    out = np.array(T, dtype=np.float64)
    out = out.reshape(4, 4) if out.size == 16 else out
    if out.shape == (4, 4) and np.isfinite(out).all():
        U, _, V = np.linalg.svd(out[:3, :3])
        if np.abs(U @ V - out[:3, :3]).max() < 1e-3:
            out[:3, :3] = U @ V
    return out


def transform(rotation: ArrayLike, translation: ArrayLike) -> Float64:
    """Assemble (4, 4) from a (3, 3) rotation and a (3,) translation in metres."""
    T = np.eye(4)
    T[:3, :3] = np.asarray(rotation, dtype=np.float64)
    T[:3, 3] = np.asarray(translation, dtype=np.float64)
    return T


def invert(T: Float64) -> Float64:
    """Invert a rigid transform: ``invert(T_a_b)`` is ``T_b_a``."""
    rotation = T[:3, :3].T
    return transform(rotation, -rotation @ T[:3, 3])


def invert_all(T: Float64) -> Float64:
    """Invert rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3] = -(out[..., :3, :3] @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def transform_points(T: Float64, points: NDArray[np.floating]) -> Float64:
    """Map points (..., 3) by ``T``; NaN stays NaN."""
    moved: Float64 = rotate_vectors(T, points) + T[:3, 3]
    return moved


def rotate_vectors(T: Float64, vectors: NDArray[np.floating]) -> Float64:
    """Rotate directions (..., 3) by the rotation of ``T``."""
    given: Float64 = np.asarray(vectors, dtype=np.float64)
    # Flat and contiguous: one product that BLAS takes, instead of one per image row.
    flat: Float64 = given.reshape(-1, 3) @ np.ascontiguousarray(T[:3, :3].T)
    return flat.reshape(given.shape)


def hat(v: ArrayLike) -> Float64:
    """Return the cross-product matrix of a (3,) vector."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(phi: ArrayLike) -> Float64:
    """Turn a rotation vector (3,), radians, into a (3, 3) rotation by Rodrigues' formula."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    K = hat(phi)
    if angle < _SMALL:
        return np.eye(3) + K + 0.5 * K @ K
    out: Float64 = np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K
    return out


def rotation_log(R: Float64) -> Float64:
    """Invert :func:`rotation_exp`: angle in [0, pi], exact near 0 and near pi."""
    w = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = float(np.linalg.norm(w))
    cosine = float((np.trace(R) - 1) / 2)
    angle = float(np.arctan2(sine, cosine))
    if angle < _SMALL:
        return w
    if np.pi - angle > 1e-4:
        out: Float64 = w * (angle / sine)
        return out
    # Near pi the antisymmetric part vanishes; the axis is the dominant column of (R + I) / 2.
    S = (R + R.T) / 2 + np.eye(3)
    axis = S[:, int(np.argmax(np.diag(S)))]
    axis = axis / np.linalg.norm(axis)
    return angle * (axis if w @ axis >= 0 else -axis)


def rotation_angle(R: Float64) -> float:
    """Measure the angle of a rotation (3, 3) or of a transform's rotation, radians."""
    return float(np.linalg.norm(rotation_log(R[:3, :3])))


def exp(xi: ArrayLike) -> Float64:
    """Turn a twist (6,), metres, then radians, into a transform."""
    xi = np.asarray(xi, dtype=np.float64)
    rho, phi = xi[:3], xi[3:]
    angle = float(np.linalg.norm(phi))
    K = hat(phi)
    if angle < _SMALL:
        V = np.eye(3) + 0.5 * K + K @ K / 6
    else:
        V = np.eye(3) + (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K
    return transform(rotation_exp(phi), V @ rho)


def adjoint(T: Float64) -> Float64:
    """Return (6, 6) what takes twists (6,) of a frame to that which ``T`` maps it to: ``T exp(xi) = exp(adjoint(T) xi) T``."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = T[:3, :3]
    out[:3, 3:] = hat(T[:3, 3]) @ T[:3, :3]
    return out


def log(T: Float64) -> Float64:
    """Invert :func:`exp`: transform to twist (6,)."""
    phi = rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(phi))
    K = hat(phi)
    if angle < _SMALL:
        V_inv = np.eye(3) - 0.5 * K + K @ K / 12
    else:
        half = angle / 2
        V_inv = np.eye(3) - 0.5 * K + (1 - half / np.tan(half)) / angle**2 * K @ K
    return np.concatenate([V_inv @ T[:3, 3], phi])


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0), roll: float = 0.0) -> Float64:
    """Pose a camera (x right, y down, z forward) so that it looks at a point: ``T_world_camera`` (4, 4).

    Raises :class:`ConfigError` when eye and target coincide.

    Parameters
    ----------
    eye, target
        Points (3,) of the world, metres.
    up
        World direction that should appear upwards; replaced by world x when the view is parallel to it.
    roll
        Rotation about the optical axis, radians.
    """
    eye = np.asarray(eye, dtype=np.float64)
    z = np.asarray(target, dtype=np.float64) - eye
    if np.linalg.norm(z) < 1e-12:
        raise ConfigError(f"look_at: eye and target coincide at {eye.tolist()}")
    z = z / np.linalg.norm(z)
    x = np.cross(z, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, [1.0, 0.0, 0.0])
        if np.linalg.norm(x) < 1e-6:
            x = np.cross(z, [0.0, 1.0, 0.0])
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return transform(R @ rotation_exp([0.0, 0.0, roll]), eye)
