"""A coarse model of where the arm and the rig may be, stricter than needed, behind the controller's own safety limits.

The arm is the capsules of its model, where its metal is; the rig a capsule about each camera and one from the flange to it.
None may come near the table, into the keep-out cylinder about the object, to the arm's own base, or to the arm itself.
Plans are made with it, and drivers of real arms check every motion with it. It does not replace safety planes in the
controller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.kinematics import HOME, ArmModel, check_joints, joint_frames
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import Float64, check_transform
from tofcapture.rig import Rig

_BRACKET = 0.04  # m; radius of what holds a camera
_TABLE_MARGIN = 0.04  # m; air above the table, beyond the radii
COLUMN = 0.20  # m; the flange and the rig keep this far from the base's axis
_STEP = np.radians(3.0)  # largest joint step between checks on a path
_MOST = np.radians(149.0)  # largest turn of a joint in one motion: a change of the kinematic branch is larger
WRIST = 3  # last pieces of the arm, on which the rig is mounted; as many next to each other cannot meet

_SHAPES = {
    "target": (3,), "board": (3,), "board_normal": (3,), "tof_box": (2, 3), "stereo_box": (2, 3),
}  # fmt: skip  # the others are numbers

REASONS = ("table", "object", "base", "self")
Check = Callable[[Float64, Float64], None]


def _box(*corners: tuple[float, float, float]) -> Callable[[], Float64]:
    return lambda: np.array(corners)


@dataclass(frozen=True)
class Workcell:
    """Places of table, object and board, in the base frame, metres."""

    table: float  # height of the table top
    target: Float64  # (3,) what object views look at
    board: Float64  # (3,) what calibration views look at
    board_normal: Float64  # (3,) the direction that the board's front faces
    keep_out_radius: float = 0.30  # of an upright cylinder about the target
    keep_out_height: float = 0.30  # of it, above the table
    home: Float64 = field(default_factory=HOME.copy)  # (J,) rad; from there every view is reached
    # (2, 3) corners of each camera's housing in its own frame; the stereo one's is that of an Ensenso N35, left eye in front
    tof_box: Float64 = field(default_factory=_box((-0.05, -0.05, -0.06), (0.05, 0.05, 0.01)))
    stereo_box: Float64 = field(default_factory=_box((-0.04, -0.03, -0.05), (0.14, 0.03, 0.01)))


def workcell_of(config: Mapping[str, Any]) -> Workcell:
    """Read the ``[plan]`` table of a station; raises ConfigError unless all of it are finite numbers of known names."""
    table = config.get("plan")
    if table is None:
        raise ConfigError("station: expected a table [plan] that says where the table and the object stand")
    try:
        values = {key: np.asarray(value, dtype=np.float64) for key, value in table.items()}
        workcell = Workcell(**{key: v if v.ndim else float(v) for key, v in values.items()})  # type: ignore[arg-type]
    except (TypeError, ValueError) as err:
        raise ConfigError(
            f"station: [plan]: {err}", hint="see the comments of the embedded station.toml"
        ) from err
    for key, v in values.items():
        shape = (max(v.size, 6),) if key == "home" else _SHAPES.get(key, ())
        if v.shape != shape or not np.isfinite(v).all():
            wanted = f"{' x '.join(map(str, shape))} finite numbers" if shape else "a finite number"
            raise ConfigError(f"station: [plan] {key}: expected {wanted}, got {v.tolist()}")
        if shape == (2, 3) and (v[0] >= v[1]).any():
            raise ConfigError(f"station: [plan] {key}: expected the lower corner first, got {v.tolist()}")
    return workcell


@dataclass(frozen=True)
class Body:
    """Capsules of an arm and of what it carries, base frame, metres."""

    arm: Float64  # (..., S, 2, 3) ends of the arm's pieces, from the base to the flange
    rig: Float64  # (..., 4, 2, 3) ToF camera, stereo camera, what holds each
    radii: tuple[Float64, Float64]  # (S,) and (4,)

    @property
    def flange(self) -> Float64:
        """(..., 3) its centre."""
        return self.arm[..., -1, 1, :]

    @property
    def cameras(self) -> Float64:
        """(..., 5, 3) the flange's centre, and the ends of both cameras' capsules."""
        ends = self.rig[..., :2, :, :]
        return np.concatenate([self.flange[..., None, :], ends.reshape(*ends.shape[:-3], 4, 3)], axis=-2)


def body_of(model: ArmModel, rig: Rig, workcell: Workcell, joints: NDArray[np.floating]) -> Body:
    """Find where arm and rig are at joint angles (..., J), radians."""
    frames = joint_frames(model, joints)
    arm = _placed(frames[..., model.frames, :, :], model.metal)
    flange = frames[..., -1, :, :] @ model.fixed[-1]
    mounts = [check_transform(T) for T in (rig.T_flange_tof, rig.T_flange_stereo)]
    boxes = [_capsule(box) for box in (workcell.tof_box, workcell.stereo_box)]
    pieces = [_placed(T[None], ends[None])[0] for T, (ends, _) in zip(mounts, boxes, strict=True)]
    pieces += [np.stack([np.zeros(3), T[:3, 3]]) for T in mounts]
    held = _placed(flange[..., None, :, :], np.stack(pieces))
    return Body(arm, held, (model.radii, np.array([*(r for _, r in boxes), _BRACKET, _BRACKET])))


def _placed(T: Float64, ends: Float64) -> Float64:
    """(..., S, 2, 3) ends (S, 2, 3), each pair moved by its transform (..., S, 4, 4)."""
    return ends @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def _capsule(box: Float64) -> tuple[Float64, float]:
    """Ends (2, 3) and radius of a capsule along the longest side of a box (2, 3) that holds all of it."""
    middle, half = box.mean(axis=0), (box[1] - box[0]) / 2
    long = int(half.argmax())
    around = float(np.linalg.norm(np.delete(half, long)))
    radius = 1.15 * around
    reach = max(0.0, half[long] - np.sqrt(radius**2 - around**2))
    return middle + np.array([[-1.0], [1.0]]) * reach * np.eye(3)[long], radius


def obstacles(
    model: ArmModel, rig: Rig, workcell: Workcell, joints: NDArray[np.floating], air: float = 0.0
) -> NDArray[np.bool_]:
    """Say what is in the way at joint angles (..., J), radians, with ``air`` metres more room.

    Returns (..., 4), one per entry of :data:`REASONS`. What the table, the object or the base are in the way of is not looked at
    for itself.
    """
    flat = np.asarray(joints, dtype=np.float64).reshape(-1, model.joints)
    body = body_of(model, rig, workcell, flat)
    moving = np.concatenate([body.arm[:, 1:], body.rig], axis=1)
    thick = np.append(body.radii[0][1:], body.radii[1]) + air
    out = np.zeros((len(flat), len(REASONS)), dtype=bool)
    # The shoulder stands on the base, as high above the table as the base stands.
    out[:, 0] = (moving[:, 1:, :, 2].min(axis=2) < workcell.table + thick[1:] + _TABLE_MARGIN).any(axis=1)
    out[:, 1] = _in_cylinder(moving, thick, workcell).any(axis=1)
    out[:, 2] = (np.linalg.norm(body.cameras[..., :2], axis=-1) < COLUMN + air).any(axis=1)
    rest = np.flatnonzero(~out.any(axis=1))
    out[rest, 3] = _meets_itself(body.arm[rest], body.rig[rest], body.radii, air)
    return out.reshape(*np.shape(joints)[:-1], len(REASONS))


def _in_cylinder(pieces: Float64, radii: Float64, workcell: Workcell) -> NDArray[np.bool_]:
    """Which capsules (N, S, 2, 3) reach into the keep-out cylinder: their axes, where low enough, come too near to its axis."""
    a, way = pieces[:, :, 0], pieces[:, :, 1] - pieces[:, :, 0]
    top = workcell.table + workcell.keep_out_height + radii
    rise = np.where(np.abs(way[..., 2]) < 1e-9, 1e-9, way[..., 2])
    crossing = np.clip((top - a[..., 2]) / rise, 0.0, 1.0)
    first, last = np.where(rise > 0, 0.0, crossing), np.where(rise > 0, crossing, 1.0)
    offset, plane = workcell.target[:2] - a[..., :2], way[..., :2]
    t = (offset * plane).sum(axis=-1) / np.maximum((plane**2).sum(axis=-1), 1e-12)
    t = np.clip(t, first, last)
    gap = np.linalg.norm(offset - t[..., None] * plane, axis=-1)
    low = pieces[..., 2].min(axis=-1) < top
    out: NDArray[np.bool_] = low & (gap < workcell.keep_out_radius + radii)
    return out


def _meets_itself(
    arm: Float64, held: Float64, radii: tuple[Float64, Float64], air: float
) -> NDArray[np.bool_]:
    """Tell where pieces (N, S, 2, 3) of the arm come near others that are not their neighbours, or the rig near the arm."""
    wrist = arm.shape[1] - WRIST  # the first of the last pieces, on which the rig is mounted
    real = np.flatnonzero(
        np.linalg.norm(np.diff(arm[:1], axis=2), axis=-1).max(initial=0.0, axis=(0, 2)) > 1e-6
    )
    # The flange comes to the forearm only as the rig does that it carries.
    pairs = [(i, j) for i in real for j in real if j >= i + WRIST and (i < 2 or j >= wrist) and i < wrist - 1]
    out = np.zeros(len(arm), dtype=bool)
    for i, j in pairs:
        out |= segment_gap(arm[:, i], arm[:, j]) < radii[0][i] + radii[0][j] + air
    for i in real[real < wrist]:
        gap = segment_gap(arm[:, i, None], held)
        out |= (gap < radii[0][i] + radii[1] + air).any(axis=1)
    return out


def segment_gap(first: Float64, second: Float64) -> Float64:
    """(...,) least distance between segments (..., 2, 3) and (..., 2, 3): Ericson, Real-Time Collision Detection, 5.1.9."""
    p, d = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    q, e = second[..., 0, :], second[..., 1, :] - second[..., 0, :]
    r = p - q
    a, b, c = ((x * y).sum(axis=-1) for x, y in ((d, d), (d, e), (d, r)))
    f, g = (e * r).sum(axis=-1), np.maximum((e * e).sum(axis=-1), 1e-300)
    a, across = np.maximum(a, 1e-300), a * g - b * b
    skew = across > 1e-12 * a * g  # parallel ones, to a micrometre: any s does
    s = np.clip(np.where(skew, b * f - c * g, 0.0) / np.where(skew, across, 1.0), 0.0, 1.0)
    t = (b * s + f) / g
    s = np.where(t <= 0, np.clip(-c / a, 0.0, 1.0), np.where(t >= 1, np.clip((b - c) / a, 0.0, 1.0), s))
    t = np.clip(t, 0.0, 1.0)
    out: Float64 = np.linalg.norm(r + s[..., None] * d - t[..., None] * e, axis=-1)
    return out


def segment_in_box(segments: Float64, low: Float64, high: Float64) -> NDArray[np.bool_]:
    """Tell which segments (..., S, 2, 3) have a point in their boxes (S, 3) to (S, 3): the slab method."""
    a, way = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    one, other = (low - a) / way, (high - a) / way
    enters, leaves = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    out: NDArray[np.bool_] = (enters <= leaves) & (leaves >= 0) & (enters <= 1)
    return out


def straight_way(start: Float64, goal: Float64, step: float) -> Float64:
    """Joint angles (N, J) along the straight way in joint space, ``step`` radians apart at most, both ends included."""
    count = max(2, int(np.ceil(np.abs(goal - start).max() / step)) + 1)
    way: Float64 = start + (goal - start) * np.linspace(0, 1, count)[:, None]
    return way


def is_clear(
    model: ArmModel, rig: Rig, workcell: Workcell, start: Float64, goal: Float64, air: float = 0.0
) -> bool:
    """Tell whether the straight way in joint space from (J,) to (J,) is allowed.

    It meets nothing, ends within the joint limits, and turns no joint by more than 149 deg.
    """
    if np.abs(goal - start).max() > _MOST or ((goal < model.low) | (goal > model.high)).any():
        return False
    return not obstacles(model, rig, workcell, straight_way(start, goal, _STEP), air).any()


def route(
    model: ArmModel, rig: Rig, workcell: Workcell, start: Float64, goal: Float64, check: Check | None = None
) -> list[Float64]:
    """Goals (J,) to visit one after the other: straight if nothing is in the way, else by way of home.

    ``check`` is the arm's own, as :meth:`tofcapture.devices.Arm.check_move`. Raises MotionRefused when neither way is clear.
    """
    check_joints(model, goal)
    refused = ""
    for way in ([goal], [workcell.home, goal]):
        legs = list(zip([start, *way], way, strict=False))
        if not all(is_clear(model, rig, workcell, a, b) for a, b in legs):
            continue
        try:
            if check is not None:
                for a, b in legs:
                    check(a, b)
        except MotionRefused as err:
            refused = f": {err.message}"
            continue
        return way
    turn = np.degrees(start - workcell.home)
    worst = int(np.abs(turn).argmax())
    raise MotionRefused(
        f"no clear way to the next view, straight or by way of home{refused}",
        hint=f"move the arm by hand to its home pose (joint {worst + 1} is {turn[worst]:+.0f} deg from it); "
        "check table, target and keep_out of [plan]",
    )
