"""The forms in which other programs write poses: matrices, quaternions in either order, rotation vectors, roll pitch yaw, dictionaries.

What a file does not say is left open: :class:`Readings` holds every reading, and :func:`most_consistent` takes the pair of readings
under which hand and target move rigidly together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from tofcapture.errors import DataError, FormatError
from tofcapture.poses import Float64

UNIT_LENGTH = 0.01  # a quaternion's length may be off one by this: printed with three digits
FARTHEST = 20.0  # m; no arm and no board is farther, so larger numbers are millimetres
CLEARER = 3.0  # log-likelihood per pair by which a reading must beat the usual one
USUAL = "xyzw"
ROTATIONS = {
    ("qx", "qy", "qz", "qw"): "quaternion",
    ("rx", "ry", "rz"): "vector",
    ("roll", "pitch", "yaw"): "rpy",
}
ALIASES = {
    "w": "qw", "px": "x", "py": "y", "pz": "z", "tx": "x", "ty": "y", "tz": "z", "q_x": "qx", "q_y": "qy", "q_z": "qz", "q_w": "qw",
    "time": "t", "timestamp": "t", "stamp": "t", "seconds": "t", "sec": "t", "rz_yaw": "yaw", "ox": "qx", "oy": "qy", "oz": "qz", "ow": "qw",
    "pos_x": "x", "pos_y": "y", "pos_z": "z", "quat_x": "qx", "quat_y": "qy", "quat_z": "qz", "quat_w": "qw", "i": "qx", "j": "qy",
    "k": "qz", "rot_x": "qx", "rot_y": "qy", "rot_z": "qz", "rot_w": "qw",
}  # fmt: skip


@dataclass(frozen=True)
class Readings:
    """Poses as a file may mean them.

    Attributes
    ----------
    poses
        What the quaternions are taken for -> (N, 4, 4), metres. One entry where the file leaves nothing open.
    seconds
        (N,), or None.
    millimetres
        Whether lengths were millimetres.
    """

    poses: Mapping[str, Float64]
    seconds: Float64 | None = None
    millimetres: bool = False


def readings_of(values: Any, where: str) -> Readings:
    """Read a list of poses: nested 4x4 or 3x4, flat 16, 12 or 7 numbers, or dictionaries of a translation and a rotation.

    Raises
    ------
    DataError, FormatError
        Naming the first pose that is none.
    """
    flat = [_flat(v, f"{where}: pose {i}") for i, v in enumerate(values)]
    orders = {order for order, _ in flat}
    widths = {len(row) for _, row in flat}
    if not flat:
        raise DataError(f"{where}: expected poses, got none", hint="were the target's views empty?")
    if len(orders) > 1 or len(widths) > 1:
        raise FormatError(f"{where}: expected poses of one form, got rows of {sorted(widths)} numbers")
    return readings_of_table(np.array([row for _, row in flat]), where, orders.pop())


def _flat(value: Any, where: str) -> tuple[str, list[float]]:
    """Row of numbers of one pose, and its quaternion's order where a dictionary told it."""
    if isinstance(value, Mapping):
        return _of_mapping(value, where)
    try:
        row = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError) as err:
        raise FormatError(f"{where}: expected a pose in numbers, got {str(value)[:60]!r}") from err
    return "", row.ravel().tolist()


def _of_mapping(value: Mapping[str, Any], where: str) -> tuple[str, list[float]]:
    known = {str(k).lower(): v for k, v in value.items()}
    for outer in ("transform", "pose", "matrix", "t_matrix", "homogeneous"):
        if outer in known:
            return _flat(known[outer], where)
    move = next((known[k] for k in ("translation", "position", "trans", "t", "xyz") if k in known), None)
    turn = next(
        (known[k] for k in ("rotation", "orientation", "quaternion", "rot", "q", "quat") if k in known), None
    )
    if move is None or turn is None:
        raise FormatError(
            f"{where}: expected a translation and a rotation, got {', '.join(known) or 'nothing'}"
        )
    xyz = _named(move, ("x", "y", "z"), where)
    if isinstance(turn, Mapping):
        return "xyzw", [*xyz, *_named(turn, ("x", "y", "z", "w"), where)]
    rest = np.asarray(turn, dtype=np.float64)
    if rest.shape == (3, 3):
        return "", np.c_[rest, xyz].ravel().tolist()
    return "", [*xyz, *rest.ravel().tolist()]


def _named(value: Any, names: Sequence[str], where: str) -> list[float]:
    try:
        row = [value[n] for n in names] if isinstance(value, Mapping) else list(value)
        return [float(x) for x in row]
    except (KeyError, TypeError, ValueError) as err:
        raise FormatError(f"{where}: expected {', '.join(names)}, got {str(value)[:60]!r}") from err


def readings_of_table(table: Float64, where: str, order: str = "") -> Readings:
    """Read rows of 7, 12 or 16 numbers; ``order`` of the quaternion where it is known."""
    if not np.isfinite(table).all():
        bad = int(np.argmax(~np.isfinite(table).all(axis=1)))
        raise DataError(f"{where}: expected finite numbers, got NaN or infinity in pose {bad}")
    width = table.shape[1]
    if width in {12, 16}:
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, : width // 4] = table.reshape(len(table), width // 4, 4)
        return _in_metres({"matrix": poses})
    if width == 7:
        return _in_metres(_by_quaternion(table, where, order))
    hint = "rotation vectors and roll, pitch, yaw need a header line that says which: x,y,z,rx,ry,rz or x,y,z,roll,pitch,yaw"
    raise FormatError(
        f"{where}: expected 7 numbers (translation, quaternion), 12 or 16 (matrix by rows) per pose, got {width}",
        hint=hint if width == 6 else "see docs/calibrate.md",
    )


def _by_quaternion(table: Float64, where: str, order: str) -> dict[str, Float64]:
    length = np.linalg.norm(table[:, 3:], axis=1)
    if np.abs(length - 1).max() > UNIT_LENGTH:
        bad = int(np.argmax(np.abs(length - 1)))
        raise DataError(
            f"{where}: expected unit quaternions, got length {length[bad]:.3f} in pose {bad}",
            hint="the columns must be x,y,z,qx,qy,qz,qw, with a time before them or not; a header line may say otherwise",
        )
    orders = (order,) if order else (USUAL, "wxyz")
    return {o: _placed(table[:, :3], _turned("quaternion", _scalar_last(table[:, 3:], o))) for o in orders}


def _scalar_last(q: Float64, order: str) -> Float64:
    return q if order == "xyzw" else np.roll(q, -1, axis=1)


def _turned(kind: str, values: Float64) -> Float64:
    """Rotations (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    if kind == "quaternion":
        return np.asarray(Rotation.from_quat(values).as_matrix())
    # No angle in radians is as large as that: they are degrees.
    values = np.radians(values) if np.abs(values).max() > 2 * np.pi + 0.01 else values
    if kind == "vector":
        return np.asarray(Rotation.from_rotvec(values).as_matrix())
    return np.asarray(Rotation.from_euler("xyz", values).as_matrix())  # ROS: about fixed axes


def _placed(xyz: Float64, R: Float64) -> Float64:
    poses = np.tile(np.eye(4), (len(xyz), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, xyz
    return poses


def _in_metres(poses: Mapping[str, Float64]) -> Readings:
    far = max(float(np.median(np.linalg.norm(p[:, :3, 3], axis=1))) for p in poses.values())
    if far <= FARTHEST:
        return Readings(poses)
    out = {}
    for name, p in poses.items():
        scaled = p.copy()
        scaled[:, :3, 3] *= 1e-3
        out[name] = scaled
    return Readings(out, millimetres=True)


def readings_of_text(text: str, where: str) -> Readings:
    """Read lines of numbers, with or without a header, times and comments; TUM trajectories are such.

    Raises
    ------
    DataError, FormatError
        Naming the line.
    """
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        fields = re.split(r"[,;\s]+", line.strip().strip("#").strip())
        values = _numbers(fields)
        if not line.strip() or (line.lstrip().startswith("#") and (rows or not _columns(fields))):
            continue
        if values is None and not rows:
            names = _columns(fields) or names
            continue
        if values is None or line.lstrip().startswith("#") or (rows and len(values) != len(rows[0])):
            expected = f"{len(rows[0])} numbers" if rows else "numbers"
            raise FormatError(f"{where}:{number}: expected {expected}, got {line.strip()[:60]!r}")
        rows.append(values)
    if not rows:
        raise DataError(f"{where}: expected poses, one a line, got none")
    return _by_columns(np.array(rows), names, where)


def _numbers(fields: Sequence[str]) -> list[float] | None:
    try:
        return [float(f) for f in fields]
    except ValueError:
        return None


def _columns(fields: Sequence[str]) -> list[str]:
    """Column names of a header line; empty when it is none."""
    cleaned = [re.sub(r"\(.*?\)|\[.*?\]|['\"]", "", f).strip().lower().split(".")[-1] for f in fields]
    found = [ALIASES.get(f, f) for f in cleaned if f]
    return found if {"x", "y", "z"} <= set(found) else []


def _by_columns(table: Float64, names: list[str], where: str) -> Readings:
    if names and len(names) == table.shape[1]:
        return _by_names(table, names, where)
    timed = table.shape[1] in {8, 13, 17}
    found = readings_of_table(table[:, 1:] if timed else table, where)
    return replace(found, seconds=table[:, 0] if timed else None)


def _by_names(table: Float64, names: list[str], where: str) -> Readings:
    at = {n: i for i, n in enumerate(names)}
    for columns, kind in ROTATIONS.items():
        if set(columns) <= at.keys():
            xyz, turn = (table[:, [at[c] for c in part]] for part in (("x", "y", "z"), columns))
            seconds = table[:, at["t"]] if "t" in at else None
            if kind == "quaternion":
                found = readings_of_table(np.c_[xyz, turn], where, "xyzw")
            else:
                if not np.isfinite(table).all():
                    raise DataError(f"{where}: expected finite numbers, got NaN or infinity")
                found = _in_metres({kind: _placed(xyz, _turned(kind, turn))})
            return replace(found, seconds=seconds)
    raise FormatError(
        f"{where}: the header names no rotation: {', '.join(names)}",
        hint="expected qx,qy,qz,qw, or rx,ry,rz (rotation vector), or roll,pitch,yaw beside x,y,z",
    )


def most_consistent(hand: Readings, target: Readings) -> tuple[Float64, Float64, dict[str, str]]:
    """Choose the readings of quaternions under which hand and target move rigidly together.

    Returns
    -------
    hand, target
        (N, 4, 4), metres.
    read_as
        What was decided or converted, in words; empty where files were in metres and the usual order.
    """
    both = list(product(hand.poses, target.poses))
    names = both[0]
    if len(both) > 1 and len(next(iter(hand.poses.values()))) >= 3:
        likely = {n: _agreement(hand.poses[n[0]], target.poses[n[1]]) for n in both}
        best = max(likely, key=lambda n: likely[n])
        pairs = len(hand.poses[names[0]])
        names = best if likely[best] > likely[names] + CLEARER * pairs else names
    said = {}
    for who, readings, name in (("hand", hand, names[0]), ("target", target, names[1])):
        words = [f"quaternions {name}"] if len(readings.poses) > 1 and name != USUAL else []
        words += ["millimetres"] if readings.millimetres else []
        if words:
            said[who] = ", ".join(words)
    return hand.poses[names[0]], target.poses[names[1]], said


def _agreement(hand: Float64, target: Float64) -> float:
    """Log-likelihood of the better mount and sense of the target; -inf where no solution exists."""
    from calibration.hand_eye.closed_form import invert_all
    from calibration.hand_eye.solve import refine_from_consensus

    found = [-np.inf]
    for A in (hand, invert_all(hand)):
        for B in (target, invert_all(target)):
            try:
                found.append(refine_from_consensus(A, B).log_likelihood)
            except (DataError, np.linalg.LinAlgError, ValueError):
                continue
    return float(max(found))
