"""Kinematics of arms of six turning joints or more: forward for any, inverse in closed form for those of Universal Robots, by iteration for others.

Standard Denavit-Hartenberg: ``T_{i-1,i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i)``; UR arms have alpha = 90, 0, 0, 90, -90, 0 deg. Their
constants are the manufacturer's nominal ones (support article "DH parameters for calculations of kinematics and
dynamics"); a real arm's calibrated ones differ by 1-2 mm, which is why a real driver reports measured poses. Where the metal
stands beside the frames is in the manufacturer's ``ur_description`` (``offsets`` in the physical parameters of each model).

The closed form follows Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms" (2013), with sines and
cosines taken from the same matrix entries, so that it stays exact next to the wrist singularity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import Float64, invert_all, rotation_angle

_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
_EDGE = 1e-10  # how far a cosine may stand outside [-1, 1] by rounding, at the border of the workspace
# Elbow up, flange above +x of the base, pointing down
HOME = np.radians([180.0, -100.0, 110.0, -100.0, -90.0, 0.0])
_WRIST = 1e-12  # sin q5 below which q6 is free and set to zero
_ELBOW = np.radians(160.0)  # of a UR, to either side; beyond it the forearm's end meets the shoulder
_MODEL_ERROR = (0.01, np.radians(1.5))  # m, rad; an arm that is farther off is another one
# Of the iteration: starts for each pose, steps, and the error (m, rad) at its end
_STARTS, _ROUNDS, _FOUND = 4, 40, 1e-9
_TURN = 2 * np.pi  # unless a joint's limits are known
_LEAST = 6  # joints that hold any pose


class Offsets(NamedTuple):
    """Closed form of a UR, metres: Denavit-Hartenberg constants."""

    d: tuple[float, float, float, float]  # d1, d4, d5, d6
    a: tuple[float, float]  # a2, a3, both negative


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Nominal geometry of an arm of J revolute joints, six or more."""

    name: str
    fixed: Float64  # (J + 1, 4, 4) ``T_base_joint1``, then from each joint's turned frame to the next; the last gives the flange
    low: Float64  # (J,) joint limits, radians
    high: Float64
    frames: NDArray[np.intp]  # (S,) to which joint's frame a piece of metal belongs; 0 is the base
    metal: Float64  # (S, 2, 3) its axis in that frame, metres
    radii: Float64  # (S,) of each piece, metres, larger than the real ones
    closed: Offsets | None = None  # a UR's constants
    speed: float = 0.5  # of joints while capturing, rad/s; far below the arm's limit

    @property
    def joints(self) -> int:
        """Count the joints."""
        return len(self.low)


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


def dh_model(
    name: str, rows: ArrayLike, low: ArrayLike = -_TURN, high: ArrayLike = _TURN, radius: float = 0.08
) -> ArmModel:
    """Make the model of an arm from its standard Denavit-Hartenberg table.

    Its rows (J, 4) are a, d in metres, alpha, theta in radians; theta is added to the joint's angle. See :func:`chain_model`.
    """
    table = _numbers(rows, (-_LEAST, 4), f"{name}: Denavit-Hartenberg rows of a, d, alpha, theta")
    turns = [*(_link(np.zeros(3), theta) for theta in table[:, 3]), np.eye(4)]
    links = [np.eye(4), *(_link(row, np.zeros(())) for row in table[:, :3])]
    return chain_model(name, [a @ b for a, b in zip(links, turns, strict=True)], low, high, radius)


def chain_model(
    name: str, fixed: ArrayLike, low: ArrayLike = -_TURN, high: ArrayLike = _TURN, radius: float = 0.08
) -> ArmModel:
    """Make a model from transforms (J + 1, 4, 4): base to first joint, from each turned joint to the next, last joint to flange.

    Its metal goes straight from joint to joint, ``radius`` metres thick. ``low`` and ``high`` are joint limits, (J,) or one for all, radians.
    Raises ConfigError: another shape, or values that make no sense.
    """
    links = _numbers(fixed, (-_LEAST - 1, 4, 4), f"{name}: transforms from joint to joint")
    low, high = (np.full(len(links) - 1, a) if np.ndim(a) == 0 else a for a in (low, high))
    low, high = (_numbers(a, (len(links) - 1,), f"{name}: joint limits") for a in (low, high))
    if not ((low < high).all() and 0 < radius < 1):
        raise ConfigError(f"{name}: expected lower joint limits below upper ones and a radius of 0 to 1 m")
    metal = np.stack([np.zeros((len(links), 3)), links[:, :3, 3]], axis=1)
    return ArmModel(name, links, low, high, np.arange(len(links)), metal, np.full(len(links), radius))


def _numbers(values: ArrayLike, shape: tuple[int, ...], what: str) -> Float64:
    """Take finite numbers of a shape; a negative length stands for that many or more."""
    try:
        out = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        out = np.empty(0)
    fits = out.ndim == len(shape) and all(
        n >= -s if s < 0 else n == s for n, s in zip(out.shape, shape, strict=True)
    )
    if not fits or not np.isfinite(out).all():
        wanted = " x ".join(f"{-s} or more" if s < 0 else str(s) for s in shape)
        raise ConfigError(f"{what}: expected {wanted} finite numbers, got {values!r}")
    return out


def _universal(
    name: str, d: Sequence[float], a: Sequence[float], beside: Sequence[float], thick: Sequence[float]
) -> ArmModel:
    """A UR arm: upper arm and forearm stand ``beside`` the line of the frames, along the shoulder's axis.

    ``thick`` are the radii of shoulder, upper arm, elbow, forearm and wrist.
    """
    (d1, d4, d5, d6), (a2, a3), (s, e) = d, a, beside
    rows = np.stack([[0, a2, a3, 0, 0, 0], [d1, 0, 0, d4, d5, d6], _ALPHA, np.zeros(6)], axis=1)
    limit = np.array([1, 1, _ELBOW / (2 * np.pi), 1, 1, 1]) * 2 * np.pi
    # Frame 2 turns with the upper arm, 3 with the forearm, 5 and 6 with the wrist; each begins at its joint.
    frames = np.array([0, 2, 2, 2, 3, 3, 5, 6])
    metal = [
        [(0, 0, 0), (0, 0, d1)], [(0, 0, 0), (0, 0, s)], [(0, 0, s), (a2, 0, s)], [(a2, 0, s), (a2, 0, e)],
        [(0, 0, e), (a3, 0, e)], [(a3, 0, e), (a3, 0, d4)], [(0, 0, 0), (0, 0, d5)], [(0, 0, 0), (0, 0, d6)],
    ]  # fmt: skip
    radii, closed = np.array(thick)[[0, 0, 1, 2, 3, 4, 4, 4]], Offsets((d1, d4, d5, d6), (a2, a3))
    return replace(
        dh_model(name, rows, -limit, limit),
        frames=frames,
        metal=np.array(metal, dtype=np.float64),
        radii=radii,
        closed=closed,
    )


# Lengths and offsets are published. Radii hold the collision shapes that are published for the UR5e and the UR10e with 2 cm
# around them; those of the others go with the diameters of their bases.
MODELS = {
    name: _universal(name, d, a, beside, thick)
    for name, d, a, beside, thick in (
        ("ur3e", (0.15185, 0.13105, 0.08535, 0.0921), (-0.24355, -0.2132), (0.120, 0.027), (0.075, 0.065, 0.07, 0.055, 0.055)),
        ("ur5e", (0.1625, 0.1333, 0.0997, 0.0996), (-0.425, -0.3922), (0.138, 0.007), (0.08, 0.07, 0.08, 0.06, 0.06)),
        ("ur10e", (0.1807, 0.17415, 0.11985, 0.11655), (-0.6127, -0.57155), (0.1762, 0.0393), (0.1, 0.08, 0.1, 0.08, 0.07)),
        ("ur16e", (0.1807, 0.17415, 0.11985, 0.11655), (-0.4784, -0.36), (0.176, 0.039), (0.1, 0.08, 0.1, 0.08, 0.07)),
        ("ur20", (0.2363, 0.2010, 0.1593, 0.1543), (-0.8620, -0.7287), (0.260, 0.043), (0.13, 0.11, 0.12, 0.09, 0.08)),
    )
}  # fmt: skip


def arm_model(name: str) -> ArmModel:
    """Look up a model by name; raises ConfigError for an unknown one."""
    if name not in MODELS:
        raise ConfigError(
            f"arm model: expected one of {', '.join(MODELS)}, got {name!r}",
            hint="another arm's driver returns its own from kinematics(), or its station has a table [arm.kinematics]",
        )
    return MODELS[name]


def check_joints(model: ArmModel, joints: ArrayLike) -> Float64:
    """Check a goal (J,) in radians; returns a copy, float64.

    Raises :class:`MotionRefused`: not J finite angles, or one beyond the model's limit.
    """
    goal = np.array(joints, dtype=np.float64)
    if goal.shape != (model.joints,) or not np.isfinite(goal).all():
        raise MotionRefused(f"move: expected {model.joints} finite joint angles, got {goal.tolist()}")
    beyond = np.maximum(model.low - goal, goal - model.high)
    worst = int(beyond.argmax())
    if beyond[worst] > 0:
        at, low, high = np.degrees([goal[worst], model.low[worst], model.high[worst]])
        raise MotionRefused(f"move: joint {worst + 1} at {at:.0f} deg is outside {low:.0f} to {high:.0f} deg")
    return goal


def pose_error(model: ArmModel, joints: ArrayLike, T_base_flange: ArrayLike) -> str:
    """Compare a measured flange with where the model has it; says how far apart they are, empty within 10 mm and 1.5 deg.

    Calibrated arms differ from nominal ones by 1 to 2 mm.
    """
    off = invert_all(forward(model, joints)) @ np.asarray(T_base_flange, dtype=np.float64)
    shift, turn = float(np.linalg.norm(off[:3, 3])), rotation_angle(off[:3, :3])
    if shift <= _MODEL_ERROR[0] and turn <= _MODEL_ERROR[1]:
        return ""
    return f"the flange is {shift * 1e3:.0f} mm, {np.degrees(turn):.1f} deg from where the model {model.name} has it"


def joint_frames(model: ArmModel, q: ArrayLike) -> Float64:
    """Frames ``T_base_joint`` (..., J + 1, 4, 4), metres, of joint angles (..., J), radians: the base, then each joint's after its turn."""
    q = np.asarray(q, dtype=np.float64)
    if q.shape[-1:] != (model.joints,):
        raise ConfigError(f"joints: expected shape (..., {model.joints}) of the {model.name}, got {q.shape}")
    out = np.empty((*q.shape[:-1], model.joints + 1, 4, 4))
    out[..., 0, :, :] = np.eye(4)
    for i in range(model.joints):
        T = out[..., i, :, :] @ model.fixed[i]
        c, s = np.cos(q[..., i, None]), np.sin(q[..., i, None])
        out[..., i + 1, :, 0], out[..., i + 1, :, 1] = (
            T[..., 0] * c + T[..., 1] * s,
            T[..., 1] * c - T[..., 0] * s,
        )
        out[..., i + 1, :, 2:] = T[..., 2:]
    return out


def link_frames(model: ArmModel, q: ArrayLike) -> Float64:
    """Frames of all links, ``T_base_link`` (..., J, 4, 4), metres, of joint angles (..., J), radians.

    The last one is the flange.
    """
    out: Float64 = joint_frames(model, q)[..., 1:, :, :] @ model.fixed[1:]
    return out


def forward(model: ArmModel, q: ArrayLike) -> Float64:
    """Flange pose ``T_base_flange`` (..., 4, 4), metres, of joint angles (..., J), radians."""
    out: Float64 = link_frames(model, q)[..., -1, :, :]
    return out


def _shoulder(ur: Offsets, T: Float64) -> Float64:
    """(..., 2) q1 to the left and to the right; NaN when the wrist is inside the shoulder's cylinder."""
    d4, d6 = ur.d[1], ur.d[3]
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


def _elbow(ur: Offsets, T_1_4: Float64) -> tuple[Float64, Float64, Float64]:
    """(..., 2) q2, q3, q4 for elbow up and down; NaN out of reach."""
    a2, a3 = ur.a
    d4 = ur.d[1]
    x, y = (T_1_4[..., i, 3] - d4 * T_1_4[..., i, 1] for i in range(2))
    cosine = (x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3)
    bend = np.arccos(np.where(np.abs(cosine) <= 1 + _EDGE, np.clip(cosine, -1, 1), np.nan))
    q3 = np.stack([bend, -bend], axis=-1)
    q2 = np.arctan2(y, x)[..., None] - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
    total = np.arctan2(T_1_4[..., 1, 0], T_1_4[..., 0, 0])[..., None]
    return q2, q3, total - q2 - q3


def inverse_all(model: ArmModel, T_base_flange: ArrayLike, near: ArrayLike = HOME) -> Float64:
    """Branches of the inverse kinematics of many poses (..., 4, 4), metres.

    Returns (..., S, J) float64 radians in [-pi, pi]; NaN rows where a branch cannot reach. For a UR the 8 of
    the closed form: shoulder left/right x wrist flip x elbow; at the wrist singularity (q5 = 0 or pi) q6 is
    set to zero and both wrist branches coincide. For any other arm what is found from starts ``near`` (J,)
    and elsewhere: maybe not all there are.
    """
    T = np.asarray(T_base_flange, dtype=np.float64)
    if model.closed is None:
        return _iterated(model, T, np.asarray(near, dtype=np.float64))
    q1 = _shoulder(model.closed, T)
    T1 = np.broadcast_to(T[..., None, :, :], (*q1.shape, 4, 4))
    q5, q6 = _wrist(T1, q1)
    T2 = np.broadcast_to(T1[..., None, :, :], (*q5.shape, 4, 4))
    q1 = np.broadcast_to(q1[..., None], q5.shape)
    turned = [_link(np.zeros(3), q) for q in (q1, q5, q6)]
    tail = turned[1] @ model.fixed[5] @ turned[2] @ model.fixed[6]
    q2, q3, q4 = _elbow(model.closed, invert_all(turned[0] @ model.fixed[1]) @ T2 @ invert_all(tail))
    columns = [np.broadcast_to(q[..., None], q3.shape) for q in (q1, q5, q6)]
    q = np.stack([columns[0], q2, q3, q4, columns[1], columns[2]], axis=-1)
    q = wrap(q).reshape(*T.shape[:-2], 8, 6)
    return np.where(np.isfinite(q).all(axis=-1, keepdims=True), q, np.nan)


def _iterated(model: ArmModel, T: Float64, near: Float64) -> Float64:
    """(..., S, J) by damped least squares (Levenberg) on the pose's error, from ``near`` and from random angles."""
    middle, half = (model.low + model.high) / 2, np.minimum((model.high - model.low) / 2, np.pi)
    starts = np.random.default_rng(0).uniform(middle - half, middle + half, (_STARTS - 1, model.joints))
    goals = np.repeat(T.reshape(-1, 1, 4, 4), _STARTS, axis=1).reshape(-1, 4, 4)
    q = np.tile(np.vstack([near, starts]), (len(goals) // _STARTS, 1))
    reach = np.linalg.norm(model.fixed[:, :3, 3], axis=1).sum()
    left = np.flatnonzero(np.linalg.norm(goals[:, :3, 3], axis=1) <= reach)
    found = np.zeros(len(q), dtype=bool)
    for _ in range(_ROUNDS):
        frames = joint_frames(model, q[left])
        now = frames[:, -1] @ model.fixed[-1]
        error = _pose_error(now, goals[left])
        size = np.linalg.norm(error, axis=1)
        found[left[size < _FOUND]] = True
        rest = size >= _FOUND
        left, frames, now, error = left[rest], frames[rest], now[rest], error[rest]
        if not len(left):
            break
        axes, places = frames[:, 1:, :3, 2], frames[:, 1:, :3, 3]
        J = np.concatenate([np.cross(axes, now[:, None, :3, 3] - places), axes], axis=2)  # rows are joints
        damping = 0.1 * np.minimum((error**2).sum(axis=1), 1.0)[:, None, None] * np.eye(6)
        square = np.swapaxes(J, 1, 2) @ J + damping + 1e-14 * np.eye(6)
        step = (J @ np.linalg.solve(square, error[..., None]))[..., 0]
        q[left] += np.clip(step, -0.5, 0.5)
    q = wrap(q)
    q[~found] = np.nan
    return q.reshape(*T.shape[:-2], _STARTS, model.joints)


def _pose_error(now: Float64, goal: Float64) -> Float64:
    """(N, 6) way and turn, base frame, from poses (N, 4, 4) to goals; the turn's size is 2 sin(angle / 2) at most."""
    R = goal[:, :3, :3] @ np.swapaxes(now[:, :3, :3], 1, 2)
    skew = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    cosine = (np.trace(R, axis1=1, axis2=2) - 1) / 2
    turn = skew / np.sqrt(np.maximum(2 + 2 * cosine, 1e-3))[:, None]
    return np.concatenate([goal[:, :3, 3] - now[:, :3, 3], turn], axis=1)
