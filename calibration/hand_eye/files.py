"""Read what hand-eye calibration is fed with: files of pairs, and files of poses, in the forms of other programs.

Pairs: JSON, YAML (MoveIt's samples and alike), NPZ, or a table of two poses a line. Poses: a table with or without times (CSV,
TUM), JSON, YAML, NPY or NPZ. A pose is a matrix, a translation with a quaternion in either order, a rotation vector or roll pitch
yaw under a header, or a dictionary. What a file does not say is left open: :class:`Readings` holds every reading, and
:func:`most_consistent` takes the pair of readings under which hand and target move rigidly together.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from calibration.hand_eye.closed_form import invert_all
from calibration.hand_eye.refine import refined_from_consensus
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.poses import Float64

UNIT_LENGTH = 0.01  # a quaternion's length may be off one by this: printed with three digits
FARTHEST = 20.0  # m; no arm and no board is farther, so larger numbers are millimetres
CLEARER = 3.0  # log-likelihood per pair by which a reading must beat the usual one
USUAL = "xyzw"
HAND = (
    "effector_wrt_world", "hand", "robot", "gripper2base", "t_gripper2base", "t_base_flange", "t_base_hand", "flange", "arm", "a",
)  # fmt: skip
TARGET = (
    "object_wrt_sensor", "target", "optical", "camera", "target2cam", "t_target2cam", "t_camera_target", "board", "marker", "b",
)  # fmt: skip
LISTS = ("samples", "pairs", "poses", "data", "transforms")
SECONDS = ("seconds", "t", "time", "stamps")
WRAPPED = ("transform", "pose", "matrix", "t_matrix", "homogeneous")
TRANSLATION = ("translation", "position", "trans", "t", "xyz")
ROTATION = ("rotation", "orientation", "quaternion", "rot", "q", "quat")
HEADERS = {
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
    """Poses as a file may mean them."""

    #: What the quaternions are taken for -> (N, 4, 4), metres. One entry where the file leaves nothing open
    poses: Mapping[str, Float64]
    seconds: Float64 | None = None  #: (N,)
    millimetres: bool = False  #: Whether lengths were millimetres

    def __len__(self) -> int:
        return len(self.usual)

    @property
    def usual(self) -> Float64:
        """(N, 4, 4) of the usual reading."""
        return next(iter(self.poses.values()))


def read_pairs(path: Path) -> tuple[Float64, Float64, dict[str, str]]:
    """Read pairs of poses of hand and target from one file.

    Returns hand and target, (N, 4, 4) float64, metres, not yet checked to be rigid, and what had to be found out: the order of
    quaternions, millimetres.

    :class:`DataError` or :class:`FormatError` for no such file, or another layout.
    """
    return most_consistent(*_two(path, _content(path)))


def read_poses(path: Path) -> Readings:
    """Read one file of poses, with times or without.

    :class:`DataError` or :class:`FormatError` for no such file, another number of columns, words, or quaternions that are not of
    length 1.
    """
    content = _content(path)
    if isinstance(content, str):
        return _by_columns(*_table(content, str(path)), str(path))
    if not isinstance(content, Mapping):
        return readings_of(list(content), str(path))
    held = _lower(content)
    seconds, poses = _first(held, SECONDS), _first(held, LISTS)
    if poses is None:
        raise FormatError(f"{path}: expected poses under one of {', '.join(LISTS)}, got {', '.join(held)}")
    found = readings_of(list(poses), str(path))
    return found if seconds is None else replace(found, seconds=np.asarray(seconds, float))


def readings_of(values: Sequence[Any], where: str) -> Readings:
    """Read a list of poses: nested 4x4 or 3x4, flat 16, 12 or 7 numbers, or dictionaries of a translation and a rotation.

    :class:`DataError` or :class:`FormatError` names the first pose that is none.
    """
    rows = [_flat(v, f"{where}: pose {i}") for i, v in enumerate(values)]
    orders, widths = {order for order, _ in rows}, {len(row) for _, row in rows}
    if not rows:
        raise DataError(f"{where}: expected poses, got none", hint="were the target's views empty?")
    if len(orders) > 1 or len(widths) > 1:
        raise FormatError(f"{where}: expected poses of one form, got rows of {sorted(widths)} numbers")
    return _of_rows(np.array([row for _, row in rows]), where, orders.pop())


def most_consistent(hand: Readings, target: Readings) -> tuple[Float64, Float64, dict[str, str]]:
    """Choose the readings of quaternions under which hand and target move rigidly together.

    Returns hand and target, (N, 4, 4), metres, and in words what was decided or converted; empty where files were in metres and the
    usual order.
    """
    both = list(product(hand.poses, target.poses))
    names = both[0]
    if len(both) > 1 and len(hand) >= 3:
        likely = {n: _agreement(hand.poses[n[0]], target.poses[n[1]]) for n in both}
        best = max(likely, key=lambda n: likely[n])
        names = best if likely[best] > likely[names] + CLEARER * len(hand) else names
    said = {}
    for who, readings, name in (("hand", hand, names[0]), ("target", target, names[1])):
        words = [f"quaternions {name}"] if len(readings.poses) > 1 and name != USUAL else []
        words += ["millimetres"] if readings.millimetres else []
        if words:
            said[who] = ", ".join(words)
    return hand.poses[names[0]], target.poses[names[1]], said


def _agreement(hand: Float64, target: Float64) -> float:
    """Log-likelihood of the better mount and sense of the target; -inf where no solution exists."""
    found = [-np.inf]
    for A, B in product((hand, invert_all(hand)), (target, invert_all(target))):
        try:
            found.append(refined_from_consensus(A, B).log_likelihood)
        except (DataError, np.linalg.LinAlgError, ValueError):
            continue
    return float(max(found))


def _lower(held: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(k).lower(): v for k, v in held.items()}


def _first(held: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((held[k] for k in names if k in held), None)


def _two(path: Path, content: Any) -> tuple[Readings, Readings]:
    if isinstance(content, str):
        return _two_of_table(path, content)
    if isinstance(content, Mapping):
        held = _lower(content)
        if (inner := _first(held, LISTS)) is not None:
            return _two(path, inner)
        hands, targets = _hand_and_target(held, path, "pairs")
        if len(hands) != len(targets):
            raise DataError(
                f"{path}: expected as many target poses as hand poses, got {len(targets)} and {len(hands)}"
            )
    elif not isinstance(content, list):
        got = type(content).__name__
        raise FormatError(f"{path}: expected a list of pairs [hand 4x4, target 4x4], got {got}")
    elif not content:
        raise DataError(f"{path}: expected pairs, got an empty list", hint="were the target's views empty?")
    else:
        hands, targets = zip(*(_pair(p, f"{path}: pair {i}") for i, p in enumerate(content)), strict=True)
    return readings_of(hands, f"{path}: hand"), readings_of(targets, f"{path}: target")


def _pair(pair: Any, where: str) -> tuple[Any, Any]:
    if isinstance(pair, Mapping):
        return _hand_and_target(_lower(pair), where, "a pair")
    if not isinstance(pair, list) or len(pair) != 2:
        raise FormatError(f"{where}: expected [hand, target], got {str(pair)[:60]!r}")
    return pair[0], pair[1]


def _hand_and_target(held: Mapping[str, Any], where: object, what: str) -> tuple[Any, Any]:
    hand, target = _first(held, HAND), _first(held, TARGET)
    if hand is None or target is None:
        raise FormatError(
            f"{where}: expected {what} under names such as hand and target, got {', '.join(held) or 'nothing'}",
            hint="known names: " + ", ".join((*HAND[:-1], *TARGET[:-1])),
        )
    return hand, target


def _two_of_table(path: Path, text: str) -> tuple[Readings, Readings]:
    table, _ = _table(text, str(path))
    width = table.shape[1]
    half = {14: 7, 15: 7, 24: 12, 25: 12, 32: 16, 33: 16}.get(width)  # odd: a time or a number before them
    if half is None:
        raise FormatError(
            f"{path}: expected JSON, YAML, NPZ, or lines of two poses (14, 24 or 32 numbers), got {width} columns",
            hint="one pose a line is a stream: give two files, hand and target",
        )
    hand, target = table[:, width - 2 * half : width - half], table[:, width - half :]
    return _of_rows(hand, f"{path}: hand"), _of_rows(target, f"{path}: target")


def _flat(value: Any, where: str) -> tuple[str, list[float]]:
    """Row of numbers of one pose, and its quaternion's order where a dictionary told it."""
    if not isinstance(value, Mapping):
        return "", _array(value, "a pose in numbers", where).ravel().tolist()
    known = _lower(value)
    if (inner := _first(known, WRAPPED)) is not None:
        return _flat(inner, where)
    move, turn = _first(known, TRANSLATION), _first(known, ROTATION)
    if move is None or turn is None:
        got = ", ".join(known) or "nothing"
        raise FormatError(f"{where}: expected a translation and a rotation, got {got}")
    xyz, rest = _array(move, "x, y, z", where), _array(turn, "a rotation: x, y, z, w", where)
    order = USUAL if isinstance(turn, Mapping) else ""
    return order, (np.c_[rest, xyz] if rest.shape == (3, 3) else np.r_[xyz, rest]).ravel().tolist()


def _array(value: Any, what: str, where: str) -> Float64:
    """Numbers, or those of a dictionary of x, y, z and maybe w."""
    try:
        row = [value[n] for n in ("xyzw" if "w" in value else "xyz")] if isinstance(value, Mapping) else value
        return np.asarray(row, dtype=np.float64)
    except (KeyError, ValueError, TypeError) as err:
        raise FormatError(f"{where}: expected {what}, got {str(value)[:60]!r}") from err


def _of_rows(rows: Float64, where: str, order: str = "") -> Readings:
    """Read rows of 7, 12 or 16 numbers; ``order`` of the quaternion where it is known."""
    if not np.isfinite(rows).all():
        bad = int(np.argmax(~np.isfinite(rows).all(axis=1)))
        raise DataError(f"{where}: expected finite numbers, got NaN or infinity in pose {bad}")
    width = rows.shape[1]
    if width in {12, 16}:
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, : width // 4] = rows.reshape(len(rows), width // 4, 4)
        return _in_metres({"matrix": poses})
    if width != 7:
        hint = "rotation vectors and roll, pitch, yaw need a header line that says which: x,y,z,rx,ry,rz or x,y,z,roll,pitch,yaw"
        raise FormatError(
            f"{where}: expected 7 numbers (translation, quaternion), 12 or 16 (matrix by rows) per pose, got {width}",
            hint=hint if width == 6 else "see docs/calibrate.md",
        )
    off = np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1)
    if off.max() > UNIT_LENGTH:
        bad = int(np.argmax(off))
        raise DataError(
            f"{where}: expected unit quaternions, got length {np.linalg.norm(rows[bad, 3:]):.3f} in pose {bad}",
            hint="the columns must be x,y,z,qx,qy,qz,qw, with a time before them or not; a header line may say otherwise",
        )
    last = {USUAL: rows[:, 3:], "wxyz": np.roll(rows[:, 3:], -1, axis=1)}  # the scalar
    orders = (order,) if order else tuple(last)
    return _in_metres({o: _transforms(rows[:, :3], "quaternion", last[o]) for o in orders})


def _transforms(xyz: Float64, kind: str, turn: Float64) -> Float64:
    from scipy.spatial.transform import Rotation

    if kind == "quaternion":
        R = Rotation.from_quat(turn)
    else:
        # No angle in radians is as large as that: they are degrees.
        turn = np.radians(turn) if np.abs(turn).max() > 2 * np.pi + 0.01 else turn
        # ROS: roll, pitch and yaw are about fixed axes.
        R = Rotation.from_rotvec(turn) if kind == "vector" else Rotation.from_euler("xyz", turn)
    poses = np.tile(np.eye(4), (len(xyz), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R.as_matrix(), xyz
    return poses


def _in_metres(poses: Mapping[str, Float64]) -> Readings:
    far = max(float(np.median(np.linalg.norm(p[:, :3, 3], axis=1))) for p in poses.values())
    if far <= FARTHEST:
        return Readings(poses)
    for p in poses.values():
        p[:, :3, 3] *= 1e-3
    return Readings(poses, millimetres=True)


def _table(text: str, where: str) -> tuple[Float64, list[str]]:
    """Lines of numbers (N, C), and the columns' names where a header has them; TUM trajectories are such."""
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        comment = line.lstrip().startswith("#")
        fields = [f for f in re.split(r"[,;\s]+", line.strip().strip("#").strip()) if f]
        values = _numbers(fields)
        if not fields or (comment and (rows or not _columns(fields))):
            continue
        if values is None and not rows:
            names = _columns(fields) or names
            continue
        if values is None or comment or (rows and len(values) != len(rows[0])):
            expected = f"{len(rows[0])} numbers" if rows else "numbers"
            raise FormatError(f"{where}:{number}: expected {expected}, got {line.strip()[:60]!r}")
        rows.append(values)
    if not rows:
        raise DataError(f"{where}: expected poses, one a line, got none")
    return np.array(rows), names


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
    if not names or len(names) != table.shape[1]:
        timed = table.shape[1] in {8, 13, 17}
        found = _of_rows(table[:, 1:] if timed else table, where)
        return replace(found, seconds=table[:, 0] if timed else None)
    at = {n: i for i, n in enumerate(names)}
    header, kind = next(((h, k) for h, k in HEADERS.items() if set(h) <= at.keys()), ((), ""))
    if not kind:
        raise FormatError(
            f"{where}: the header names no rotation: {', '.join(names)}",
            hint="expected qx,qy,qz,qw, or rx,ry,rz (rotation vector), or roll,pitch,yaw beside x,y,z",
        )
    xyz, turn = (table[:, [at[c] for c in part]] for part in (("x", "y", "z"), header))
    if kind == "quaternion":
        found = _of_rows(np.c_[xyz, turn], where, USUAL)
    elif np.isfinite(table).all():
        found = _in_metres({kind: _transforms(xyz, kind, turn)})
    else:
        raise DataError(f"{where}: expected finite numbers, got NaN or infinity")
    return replace(found, seconds=table[:, at["t"]] if "t" in at else None)


def _content(path: Path) -> Any:
    """Tell what a file holds: lists and dictionaries, or the text of a table."""
    suffix = path.suffix.lower()
    try:
        if suffix in {".npz", ".npy"}:
            held = np.load(path, allow_pickle=False)
            return held.tolist() if isinstance(held, np.ndarray) else {k: held[k].tolist() for k in held}
        text = path.read_text(encoding="utf-8-sig")
        if suffix in {".yaml", ".yml"}:
            return _yaml(text, path)
        return json.loads(text) if suffix == ".json" else text
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (ValueError, OSError, EOFError, BadZipFile) as err:
        kind = {".npz": "arrays of numbers", ".npy": "an array of numbers", ".json": "JSON"}.get(
            suffix, "text"
        )
        raise FormatError(f"{path}: expected {kind}, got {err or type(err).__name__}") from err


def _yaml(text: str, path: Path) -> Any:
    try:
        import yaml
    except ImportError as err:
        raise ConfigError(
            f"{path}: reading YAML needs PyYAML", hint="pip install pyyaml, or convert to JSON"
        ) from err
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as err:
        raise FormatError(f"{path}: expected YAML, got {str(err)[:200]}") from err
