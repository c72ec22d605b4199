"""Kinematics of Universal Robots e-series arms: forward, and inverse in closed form with all branches.

Standard Denavit-Hartenberg: ``T_{i-1,i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`` with alpha = 90, 0, 0, 90, -90, 0 deg. The
constants are the manufacturer's nominal ones (support article "DH parameters for calculations of kinematics and
dynamics"); a real arm's calibrated ones differ by 1-2 mm, which is why a real driver reports measured poses.

The inverse follows Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms" (2013), with sines and
cosines taken from the same matrix entries, so that it stays exact next to the wrist singularity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import Float64

_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
_EDGE = 1e-10  # how far a cosine may stand outside [-1, 1] by rounding, at the border of the workspace
HOME = np.radians(
    [180.0, -100.0, 110.0, -100.0, -90.0, 0.0]
)  # elbow up, flange above +x of the base, pointing down
_WRIST = 1e-12  # sin q5 below which q6 is free and set to zero


@dataclass(frozen=True)
class ArmModel:
    """Nominal geometry of an arm with a UR's wrist of three offset axes."""

    name: str  # ur5e or ur10e
    d: tuple[float, float, float, float]  # d1, d4, d5, d6, metres
    a: tuple[float, float]  # a2, a3, metres, both negative
    limit: float = 2 * np.pi  # largest joint angle to either side, radians
    speed: float = 0.5  # of joints while capturing, rad/s; far below the arm's limit

    @property
    def dh(self) -> Float64:
        """(6, 3) rows of a, d (metres) and alpha (radians)."""
        d1, d4, d5, d6 = self.d
        a2, a3 = self.a
        return np.stack([[0, a2, a3, 0, 0, 0], [d1, 0, 0, d4, d5, d6], _ALPHA], axis=1)


MODELS = {
    "ur5e": ArmModel("ur5e", d=(0.1625, 0.1333, 0.0997, 0.0996), a=(-0.425, -0.3922)),
    "ur10e": ArmModel("ur10e", d=(0.1807, 0.17415, 0.11985, 0.11655), a=(-0.6127, -0.57155)),
}


def arm_model(name: str) -> ArmModel:
    """Look up a model by name; raises ConfigError for an unknown one."""
    if name not in MODELS:
        raise ConfigError(f"arm model: expected one of {', '.join(MODELS)}, got {name!r}")
    return MODELS[name]


def check_joints(model: ArmModel, joints: ArrayLike) -> Float64:
    """Check a goal (6,) in radians; returns a copy, float64.

    Raises
    ------
    MotionRefused
        Not six finite angles, or one beyond the model's limit.
    """
    goal = np.array(joints, dtype=np.float64)
    if goal.shape != (6,) or not np.isfinite(goal).all():
        raise MotionRefused(f"move: expected 6 finite joint angles, got {goal.tolist()}")
    worst = int(np.abs(goal).argmax())
    if abs(goal[worst]) > model.limit:
        raise MotionRefused(
            f"move: joint {worst + 1} at {goal[worst]:.3f} rad is outside +-{model.limit:.3f} rad"
        )
    return goal


def wrap(angle: ArrayLike) -> Float64:
    """Wrap angles into [-pi, pi]."""
    out: Float64 = np.mod(np.asarray(angle, dtype=np.float64) + np.pi, 2 * np.pi) - np.pi
    return out


def _link(row: Float64, q: NDArray[np.floating]) -> Float64:
    """(..., 4, 4) of one Denavit-Hartenberg row at joint angles (...,)."""
    a, d, alpha = row
    c, s = np.cos(q), np.sin(q)
    ca, sa = np.cos(alpha), np.sin(alpha)
    T = np.zeros((*np.shape(q), 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2], T[..., 0, 3] = c, -s * ca, s * sa, a * c
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2], T[..., 1, 3] = s, c * ca, -c * sa, a * s
    T[..., 2, 1], T[..., 2, 2], T[..., 2, 3], T[..., 3, 3] = sa, ca, d, 1.0
    return T


def link_frames(model: ArmModel, q: ArrayLike) -> Float64:
    """Frames of all links, ``T_base_link`` (..., 6, 4, 4), metres, of joint angles (..., 6), radians.

    The last one is the flange.
    """
    q = np.asarray(q, dtype=np.float64)
    if q.shape[-1:] != (6,):
        raise ConfigError(f"joints: expected shape (..., 6), got {q.shape}")
    out = np.empty((*q.shape, 4, 4))
    T = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    for i, row in enumerate(model.dh):
        T = T @ _link(row, q[..., i])
        out[..., i, :, :] = T
    return out


def forward(model: ArmModel, q: ArrayLike) -> Float64:
    """Flange pose ``T_base_flange`` (..., 4, 4), metres, of joint angles (..., 6), radians."""
    out: Float64 = link_frames(model, q)[..., -1, :, :]
    return out


def _shoulder(model: ArmModel, T: Float64) -> Float64:
    """(..., 2) q1 to the left and to the right; NaN when the wrist is inside the shoulder's cylinder."""
    d4, d6 = model.d[1], model.d[3]
    wrist = T[..., :2, 3] - d6 * T[..., :2, 2]
    ratio = d4 / np.maximum(np.linalg.norm(wrist, axis=-1), 1e-12)
    swing = np.arccos(np.where(ratio <= 1 + _EDGE, np.minimum(ratio, 1.0), np.nan))
    bearing = np.arctan2(wrist[..., 1], wrist[..., 0]) + np.pi / 2
    return np.stack([bearing - swing, bearing + swing], axis=-1)


def _wrist(T: Float64, q1: Float64) -> tuple[Float64, Float64]:
    """(..., 2) q5 and q6 for both signs of sin q5; T is (..., 4, 4) and q1 (...,)."""
    s1, c1 = np.sin(q1)[..., None], np.cos(q1)[..., None]
    # The shoulder's lateral axis seen from the flange: (s5 c6, -s5 s6, c5).
    lateral = s1 * T[..., 0, :3] - c1 * T[..., 1, :3]
    sine = np.hypot(lateral[..., 0], lateral[..., 1])
    q5 = np.arctan2(sine, lateral[..., 2])
    q6 = np.where(sine > _WRIST, np.arctan2(-lateral[..., 1], lateral[..., 0]), 0.0)
    return np.stack([q5, -q5], axis=-1), np.stack([q6, np.where(sine > _WRIST, q6 + np.pi, 0.0)], axis=-1)


def _elbow(model: ArmModel, T_1_4: Float64) -> tuple[Float64, Float64, Float64]:
    """(..., 2) q2, q3, q4 for elbow up and down; NaN out of reach."""
    a2, a3 = model.a
    d4 = model.d[1]
    x, y = (T_1_4[..., i, 3] - d4 * T_1_4[..., i, 1] for i in range(2))
    cosine = (x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3)
    bend = np.arccos(np.where(np.abs(cosine) <= 1 + _EDGE, np.clip(cosine, -1, 1), np.nan))
    q3 = np.stack([bend, -bend], axis=-1)
    q2 = np.arctan2(y, x)[..., None] - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
    total = np.arctan2(T_1_4[..., 1, 0], T_1_4[..., 0, 0])[..., None]
    return q2, q3, total - q2 - q3


def inverse_all(model: ArmModel, T_base_flange: ArrayLike) -> Float64:
    """All branches of the inverse kinematics of many poses (..., 4, 4), metres.

    Returns
    -------
    (..., 8, 6) float64 radians in [-pi, pi]: shoulder left/right x wrist flip x elbow; NaN rows where a branch cannot
    reach. At the wrist singularity (q5 = 0 or pi) q6 is set to zero and both wrist branches coincide.
    """
    T = np.asarray(T_base_flange, dtype=np.float64)
    q1 = _shoulder(model, T)
    T1 = np.broadcast_to(T[..., None, :, :], (*q1.shape, 4, 4))
    q5, q6 = _wrist(T1, q1)
    T2 = np.broadcast_to(T1[..., None, :, :], (*q5.shape, 4, 4))
    q1 = np.broadcast_to(q1[..., None], q5.shape)
    dh = model.dh
    tail = _inverses(_link(dh[4], q5) @ _link(dh[5], q6))
    q2, q3, q4 = _elbow(model, _inverses(_link(dh[0], q1)) @ T2 @ tail)
    columns = [np.broadcast_to(q[..., None], q3.shape) for q in (q1, q5, q6)]
    q = np.stack([columns[0], q2, q3, q4, columns[1], columns[2]], axis=-1)
    q = wrap(q).reshape(*T.shape[:-2], 8, 6)
    return np.where(np.isfinite(q).all(axis=-1, keepdims=True), q, np.nan)


def _inverses(T: Float64) -> Float64:
    """Invert rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def inverse(model: ArmModel, T_base_flange: ArrayLike) -> Float64:
    """All joint angles (S, 6) that put the flange at one pose (4, 4); S = 0 when it cannot be reached."""
    q = inverse_all(model, T_base_flange)
    q = q[np.isfinite(q).all(axis=-1)]
    _, first = np.unique(np.round(q, 9), axis=0, return_index=True)
    return q[np.sort(first)]
