"""Read what hand-eye calibration is fed with: files of pairs, and files of poses, in the forms of other programs.

Pairs: JSON, YAML (MoveIt's samples and alike), OpenCV's FileStorage, NPZ, MAT, or a table of two poses a line. Poses: a table with
or without times (CSV, TUM, ``rostopic echo -p``, UR's and KUKA's arrays), or any of the former. A pose is a matrix, or a translation
with a rotation in any numbers. What a file does not say is left open: :mod:`calibration.hand_eye.readings` decides it.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence, Sized
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET
from zipfile import BadZipFile

import numpy as np

from calibration.hand_eye.readings import UNITS, Readings, angle_names
from tofcapture.errors import DataError, FormatError
from tofcapture.importing.cameras.trees import decoded, parsed_xml, yaml_tree
from tofcapture.poses import Float64

UNIT_LENGTH = 0.01  # a quaternion's length may be off one by this: printed with three digits
ORTHOGONAL = 1e-2  # by which rows of a printed rotation may be off
HAND = (
    "effector_wrt_world", "hand", "robot", "gripper2base", "t_gripper2base", "t_base_flange", "t_base_hand", "flange", "arm", "a",
)  # fmt: skip
TARGET = (
    "object_wrt_sensor", "target", "optical", "camera", "target2cam", "t_target2cam", "t_camera_target", "board", "marker", "b",
)  # fmt: skip
LISTS = ("samples", "pairs", "poses", "data", "transforms")
SECONDS = ("seconds", "t", "time", "stamps")
WRAPPED = ("transform", "pose", "matrix", "t_matrix", "homogeneous", "o_t_ee")
TRANSLATION = ("translation", "position", "trans", "t", "xyz", "tvec")
ROTATION = ("rotation", "orientation", "quaternion", "rot", "q", "quat", "r", "rvec", "rmat")
HEADERS = {  # what three angles or a quaternion are called -> the usual reading of them in that order
    ("qx", "qy", "qz", "qw"): "xyzw",
    ("rx", "ry", "rz"): "rotvec",
    ("roll", "pitch", "yaw"): "xyz",
    ("a", "b", "c"): "ZYX",  # KUKA: A about z
    ("w", "p", "r"): "xyz",  # Fanuc
}
ALIASES = {
    "px": "x", "py": "y", "pz": "z", "tx": "x", "ty": "y", "tz": "z", "q_x": "qx", "q_y": "qy", "q_z": "qz", "q_w": "qw",
    "time": "t", "timestamp": "t", "stamp": "t", "seconds": "t", "sec": "t", "rz_yaw": "yaw", "ox": "qx", "oy": "qy", "oz": "qz", "ow": "qw",
    "pos_x": "x", "pos_y": "y", "pos_z": "z", "quat_x": "qx", "quat_y": "qy", "quat_z": "qz", "quat_w": "qw", "i": "qx", "j": "qy",
    "k": "qz", "rot_x": "qx", "rot_y": "qy", "rot_z": "qz", "rot_w": "qw",
}  # fmt: skip
FRAMES = {  # OpenCV's and others' words for the four frames; its calibrateRobotWorldHandEye calls the target world
    "hand": "gripper|hand|flange|tool|tool0|tcp|ee|eef|end_?effector",
    "base": "base|robot_?base|robot",
    "target": "target|board|marker|pattern|object|obj|tag|world|chessboard",
    "camera": "camera|cam|sensor|eye|optical",
}
REMEDIES = {
    ".bag": "rostopic echo -b FILE.bag -p /TOPIC > poses.csv, one file per topic",
    ".mcap": "write the poses as CSV: t,x,y,z,qx,qy,qz,qw",
    ".db3": "write the poses as CSV: t,x,y,z,qx,qy,qz,qw",
    ".xlsx": "save the sheet as CSV",
    ".xls": "save the sheet as CSV",
    ".mod": "write each robtarget's numbers as x,y,z,qw,qx,qy,qz under that header line",
    ".pkl": "numpy.savez('poses.npz', hand=..., target=...) with (N, 4, 4) arrays",
    ".h5": "numpy.savez('poses.npz', hand=..., target=...) with (N, 4, 4) arrays",
    ".png": "hand-eye takes poses: detect the target first, or give a calibration recording",
    ".jpg": "hand-eye takes poses: detect the target first, or give a calibration recording",
}


def read_pairs(path: Path) -> tuple[Readings, Readings]:
    """Read pairs of poses of hand and target from one file, in all their readings.

    :class:`DataError` or :class:`FormatError` for no such file, or another layout.
    """
    hand, target = _two(path, _content(path))
    _as_many(hand, target, path)
    return hand, target


def _as_many(hand: Sized, target: Sized, path: Path) -> None:
    if len(hand) != len(target):
        raise DataError(
            f"{path}: expected as many target poses as hand poses, got {len(target)} and {len(hand)}"
        )


def read_poses(path: Path) -> Readings:
    """Read one file of poses, with times or without.

    :class:`DataError` or :class:`FormatError` for no such file, another number of columns, words, or quaternions that are not of
    length 1.
    """
    content = _content(path)
    if isinstance(content, str):
        return _by_columns(*_table(content, str(path)), str(path))
    if not isinstance(content, Mapping):
        return replace(readings_of(list(content), str(path)), seconds=_stamps(content))
    held = _lower(content)
    seconds, poses = _first(held, SECONDS), _first(held, LISTS)
    sides = {} if poses is not None else _sides(held, str(path))
    if poses is None and len(sides) != 1:
        raise FormatError(f"{path}: expected poses under one of {', '.join(LISTS)}, got {', '.join(held)}")
    found = readings_of(list(poses), str(path)) if poses is not None else next(iter(sides.values()))
    return found if seconds is None else replace(found, seconds=np.asarray(seconds, float).ravel())


def _stamps(messages: Sequence[Any]) -> Float64 | None:
    """Seconds of the headers of messages that ROS printed; ``None`` for other poses."""
    try:
        stamps = [m["header"]["stamp"] for m in messages]
        return np.array(
            [
                float(s.get("sec", s.get("secs"))) + 1e-9 * float(s.get("nanosec", s.get("nsecs")))
                for s in stamps
            ]
        )
    except (KeyError, TypeError, AttributeError):
        return None


def readings_of(values: Sequence[Any], where: str) -> Readings:
    """Read a list of poses: nested 4x4 or 3x4, flat 16, 12, 7 or 6 numbers, or dictionaries of a translation and a rotation.

    :class:`DataError` or :class:`FormatError` names the first pose that is none.
    """
    rows = [_flat(v, f"{where}: pose {i}") for i, v in enumerate(values)]
    orders, widths = {order for order, _ in rows}, {len(row) for _, row in rows}
    if not rows:
        raise DataError(f"{where}: expected poses, got none", hint="were the target's views empty?")
    if len(orders) > 1 or len(widths) > 1:
        raise FormatError(f"{where}: expected poses of one form, got rows of {sorted(widths)} numbers")
    return _of_rows(np.array([row for _, row in rows]), where, orders.pop())


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
        sides = _sides(held, str(path))
        if len(sides) == 2:
            return sides["hand"], sides["target"]
        hands, targets = _hand_and_target(held, path, "pairs")
        _as_many(hands, targets, path)
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
            hint="known names: "
            + ", ".join((*HAND[:-1], *TARGET[:-1]))
            + ", R_gripper2base with t_gripper2base",
        )
    return hand, target


def _sides(held: Mapping[str, Any], where: str) -> dict[str, Readings]:
    """Sides whose names tell two frames: ``R_gripper2base`` with ``t_gripper2base``, numbered or whole; ``rvecs`` with ``tvecs``."""
    parts: dict[tuple[str, bool], dict[str, list[Any]]] = {}
    for key, value in held.items():
        if (found := _frames(re.sub(r"[_\s]*\d+$", "", key))) is not None:
            kind, side, inverted = found
            parts.setdefault((side, inverted), {}).setdefault(kind, []).append(value)
    out = {}
    for (side, inverted), part in parts.items():
        if "r" in part and "t" in part:
            found_side = _of_parts(part["r"], part["t"], f"{where}: {side}")
        elif "" in part:
            values = part[""][0] if len(part[""]) == 1 else part[""]
            found_side = readings_of(_poses_of(values), f"{where}: {side}")
        else:
            continue
        out[side] = replace(found_side, inverted=inverted)
    return out


def _frames(key: str) -> tuple[str, str, bool] | None:
    """Kind (``r``, ``t`` or empty for whole poses), side, and whether it is the inverse, of a name such as ``R_gripper2base``."""
    if key in {"rvecs", "tvecs", "rvec", "tvec"}:
        return key[0], "target", False
    kind, rest = "", key
    if prefix := re.match(r"(r|rot\w*?|rvecs?|t|trans|translations?|tvecs?|h|pose|transform)[_ ]+(?=.)", key):
        rest = key[prefix.end() :]
        kind = {"r": "r", "t": "t"}.get(prefix[1][0], "") if not prefix[1].startswith("transform") else ""
    between = re.fullmatch(r"(\w+?)_?(?:2|to|in|wrt)_?(\w+?)(?:_?(?:list|all|poses|s))?", rest)
    pair = (between[1], between[2]) if between else tuple(reversed(rest.split("_", 1)))
    if len(pair) != 2:
        return None
    is_frame = [{f for f, words in FRAMES.items() if re.fullmatch(words, word)} for word in pair]
    if not between:
        kind = ""  # T_base_flange is a whole pose
    for side, inner, outer in (("hand", "hand", "base"), ("target", "target", "camera")):
        if inner in is_frame[0] and (outer in is_frame[1] or (side == "hand" and pair[1] == "world")):
            return kind, side, False
        if inner in is_frame[1] and (outer in is_frame[0] or (side == "hand" and pair[0] == "world")):
            return kind, side, True
    return None


def _poses_of(values: Any) -> list[Any]:
    array = _array(values, "poses", "file")
    return list(array.reshape(-1, 4, 4)) if array.ndim == 2 and array.shape[1] == 4 else list(array)


def _of_parts(rotations: list[Any], translations: list[Any], where: str) -> Readings:
    """Read rotations and translations that are kept apart: lists, stacks, columns of (3, 1), matrices of rows."""
    R, t = (_array(v[0] if len(v) == 1 else v, "numbers", where).squeeze() for v in (rotations, translations))
    t = t.reshape(1, 3) if t.size == 3 else t
    if t.ndim != 2 or 3 not in t.shape:
        raise FormatError(f"{where}: expected translations (N, 3) or (N, 3, 1), got {t.shape}")
    t = t if t.shape[1] == 3 else t.T
    n = len(t)
    if R.size == 9 * n:
        return _of_rows(np.c_[R.reshape(n, 9), t], where)
    if R.size not in {3 * n, 4 * n}:
        raise DataError(f"{where}: expected as many rotations as the {n} translations, got {R.shape}")
    turn = R if R.shape == (n, R.size // n) else R.T
    return _of_rows(np.c_[t, turn], where)


def _two_of_table(path: Path, text: str) -> tuple[Readings, Readings]:
    table, names = _table(text, str(path))
    width = table.shape[1]
    # Odd: a time or a number before
    half = {12: 6, 13: 6, 14: 7, 15: 7, 24: 12, 25: 12, 32: 16, 33: 16}.get(width)
    if half is None or {"x", "y", "z"} <= set(names):
        raise FormatError(
            f"{path}: expected JSON, YAML, NPZ, or lines of two poses (12, 14, 24 or 32 numbers), got {width} columns",
            hint="one pose a line is a stream: give two files, hand and target",
        )
    hand, target = table[:, width - 2 * half : width - half], table[:, width - half :]
    return _of_rows(hand, f"{path}: hand"), _of_rows(target, f"{path}: target")


def _flat(value: Any, where: str) -> tuple[str, list[float]]:
    """Row of numbers of one pose, and what a dictionary told of its rotation: the name of its usual reading."""
    if not isinstance(value, Mapping):
        return "", _array(value, "a pose in numbers", where).ravel().tolist()
    known = _lower(value)
    if (inner := _first(known, WRAPPED)) is not None and not isinstance(inner, str):
        return _flat(inner, where)
    if {"rows", "cols", "data"} <= known.keys():
        return "", _array(value, "a matrix", where).ravel().tolist()
    named = {ALIASES.get(k, k): v for k, v in known.items()}
    header = next((h for h in HEADERS if {"x", "y", "z", *h} <= named.keys()), None)
    if header is not None:
        return HEADERS[header], _array(
            [named[k] for k in ("x", "y", "z", *header)], "numbers", where
        ).tolist()
    move, turn = _first(known, TRANSLATION), _first(known, ROTATION)
    if move is None or turn is None:
        got = ", ".join(known) or "nothing"
        raise FormatError(f"{where}: expected a translation and a rotation, got {got}")
    xyz, rest = _array(move, "x, y, z", where).ravel(), _array(turn, "a rotation: x, y, z, w", where)
    order = "xyzw" if isinstance(turn, Mapping) and rest.size == 4 else ""
    return order, (np.r_[rest.ravel(), xyz] if rest.size == 9 else np.r_[xyz, rest.ravel()]).tolist()


def _array(value: Any, what: str, where: str) -> Float64:
    """Numbers, those of OpenCV's matrices, or those of a dictionary of x, y, z and maybe w."""

    def plain(v: Any) -> Any:
        if isinstance(v, Mapping):
            if {"rows", "cols", "data"} <= v.keys():
                return np.reshape(np.asarray(v["data"], float), (int(v["rows"]), -1)).tolist()
            return [v[n] for n in ("xyzw" if "w" in v else "xyz")]
        return [plain(one) for one in v] if isinstance(v, list | tuple) else v

    try:
        return np.asarray(plain(value), dtype=np.float64)
    except (KeyError, ValueError, TypeError) as err:
        raise FormatError(f"{where}: expected {what}, got {str(value)[:60]!r}") from err


def _of_rows(rows: Float64, where: str, usual: str = "", unit: str = "", angles: str = "") -> Readings:
    """Read rows of 6, 7, 12 or 16 numbers; ``usual`` names their rotation's reading where a header or a dictionary told it."""
    if not np.isfinite(rows).all():
        bad = int(np.argmax(~np.isfinite(rows).all(axis=1)))
        raise DataError(
            f"{where}: expected finite numbers, got NaN, infinity or a word in pose {bad}",
            hint="leave out poses in which the target was not seen; a line holds numbers alone: t,x,y,z,qx,qy,qz,qw",
        )
    width = rows.shape[1]
    if width in {12, 16}:
        return _of_matrices(rows, where, unit)
    xyz, turn = rows[:, :3], rows[:, 3:]
    if width == 6:
        names = angle_names(turn, usual or "rotvec")
        names = tuple(n for n in names if n.endswith(angles)) or names
        return Readings(xyz, turn, names, unit=unit, told=bool(usual))
    if width != 7:
        raise FormatError(
            f"{where}: expected 6 numbers (translation, angles), 7 (translation, quaternion), 12 or 16 (matrix by rows) per pose, got {width}",
            hint="see docs/calibrate.md",
        )
    if not usual and _unit(rows[:, :4]) and not _unit(turn):
        return Readings(rows[:, 4:], rows[:, :4], ("wxyz", "xyzw"), unit=unit, notes=("quaternion first",))
    off = np.abs(np.linalg.norm(turn, axis=1) - 1)
    if off.max() > UNIT_LENGTH:
        bad = int(np.argmax(off))
        raise DataError(
            f"{where}: expected unit quaternions, got length {np.linalg.norm(turn[bad]):.3f} in pose {bad}",
            hint="the columns must be x,y,z,qx,qy,qz,qw, with a time before them or not; a header line may say otherwise",
        )
    return Readings(xyz, turn, (usual,) if usual else ("xyzw", "wxyz"), unit=unit)


def _unit(turn: Float64) -> bool:
    return bool(np.abs(np.linalg.norm(turn, axis=1) - 1).max() <= UNIT_LENGTH)


def _of_matrices(rows: Float64, where: str, unit: str) -> Readings:
    """Read matrices (N, 12) or (N, 16) by rows or by columns, or rotations before or after translations (N, 12)."""
    n, width = rows.shape
    forms = {"": rows.reshape(n, -1, 4)}
    if width == 12:
        parts = ((rows[:, :9], rows[:, 9:]), (rows[:, 3:], rows[:, :3]))
        forms |= {f"parts {i}": np.dstack([R.reshape(n, 3, 3), t]) for i, (R, t) in enumerate(parts)}
    forms["by columns"] = rows.reshape(n, 4, -1).swapaxes(1, 2)
    fits = [
        k for k, T in forms.items() if np.abs(T[:, 3:] - [0, 0, 0, 1]).max(initial=0) < 1e-6 and _turns(T)
    ]
    name = next(iter(fits), "")
    T, last = forms[name], np.abs(forms[name][:, 3:] - [0, 0, 0, 1]).max(axis=(1, 2), initial=0)
    if last.max() > 1e-6:
        raise DataError(
            f"{where}: expected rigid transforms, got a last row other than 0 0 0 1 in pose {int(np.argmax(last))}",
            "the matrix may hold a scale, or not be a pose",
        )
    notes = ("matrices by columns",) if name == "by columns" else ()
    return Readings(T[:, :3, 3], T[:, :3, :3], ("matrix",), unit=unit, notes=notes)


def _turns(T: Float64) -> bool:
    R = T[:, :3, :3]
    return bool(np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max() < ORTHOGONAL)


def _table(text: str, where: str) -> tuple[Float64, list[str]]:
    """Lines of numbers (N, C), and the columns' names where a header has them; columns of words are left out."""
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line, fields in _fields(text):
        comment = line.lstrip().startswith("#")
        values = _numbers(fields)
        if not fields or (comment and (rows or not _columns(fields))):
            continue
        if values is None and (labelled := _labelled(line)):
            names, values = [k for k, _ in labelled], [v for _, v in labelled]
        if values is None and not rows:
            names = _columns(fields) or names
            continue
        if values is None or comment or (rows and len(values) != len(rows[0])):
            expected = f"{len(rows[0])} numbers" if rows else "numbers"
            raise FormatError(
                f"{where}:{number}: expected {expected}, got {line.strip()[:60]!r}",
                hint="one pose a line: t,x,y,z,qx,qy,qz,qw; rostopic echo -p and ros2 topic echo --csv print such lines",
            )
        rows.append(values)
    if not rows:
        raise DataError(
            f"{where}: expected poses, one a line, got none",
            hint="numbers alone, one pose a line: x,y,z,qx,qy,qz,qw, with a time before them or not",
        )
    table = np.array(rows)
    if not names and len(rows) > 1:  # columns of words
        table = table[:, ~np.isnan(table).all(axis=0)]
    if table.shape[1] == 4 and len(table) % 4 == 0 and np.all(table[3::4] == [0, 0, 0, 1]):
        return table.reshape(-1, 16), []  # a matrix every four lines
    return table, names


def _fields(text: str) -> Iterator[tuple[int, str, list[str]]]:
    """Lines that are not empty with their fields; brackets of arrays fall away, decimal commas become points."""
    lines = text.splitlines()
    sample = "\n".join(lines[:50])
    separator = next(
        (s for s in ";\t" if sample.count(s) >= 2), "," if re.search(r",\s|,-?\d+\.|[a-z],", sample) else None
    )
    if separator is None and not re.search(r"\d,\d+[ ]+-?\d+,\d", sample):
        separator = ","
    for number, line in enumerate(lines, 1):
        bare = (
            re.sub(r"^\s*(?:\w+\s*:?=\s*)?p?[\[({]+|[\])}]+\s*,?\s*$", "", line.strip()).lstrip("#").strip()
        )
        if separator is None or (separator == "," and "," not in bare):
            fields = bare.split()
        else:
            fields = [
                f.strip()
                for f in next(csv.reader(io.StringIO(bare), delimiter=separator, skipinitialspace=True), [])
            ]
        if separator != "," or '"' in bare:
            fields = [re.sub(r"^(-?\d+),(\d+(?:[eE][-+]?\d+)?)$", r"\1.\2", f) for f in fields]
        while fields and not fields[-1]:
            fields.pop()
        if fields:
            yield number, line, fields


def _labelled(line: str) -> list[tuple[str, float]]:
    """Pairs of name and number of KUKA's ``{X 10.0, Y 5.0, Z 0, A 90, B 0, C 180}``; empty where it is none."""
    found = re.findall(r"\b([A-Za-z]\w*)\s*[:= ]\s*(-?\d[\d.]*(?:[eE][-+]?\d+)?)", line)
    pairs = [(ALIASES.get(k.lower(), k.lower()), float(v)) for k, v in found]
    names = {k for k, _ in pairs}
    if {"a", "b", "c"} <= names:  # KUKA's S and T say how the joints stand
        pairs = [(k, v) for k, v in pairs if k not in {"s", "t"}]
    return pairs if {"x", "y", "z"} <= names else []


def _numbers(fields: Sequence[str]) -> list[float] | None:
    """Numbers of a line, NaN for a word or two among more of them; None where it holds none."""
    words = [
        bool(re.search(r"[A-DF-Za-df-z_/]", f)) and f.lower().strip("+-") not in {"nan", "inf"}
        for f in fields
    ]
    if not fields or sum(words) > min(2, (len(fields) - 1) / 2):
        return None
    try:
        return [np.nan if word else float(f or "nan") for f, word in zip(fields, words, strict=True)]
    except ValueError:
        return None


def _columns(fields: Sequence[str]) -> list[str]:
    """Column names of a header line; empty when it is none."""
    found = [_column(f) for f in fields]
    return found if {"x", "y", "z"} <= {f.split(" ")[0] for f in found} else []


def _column(field: str) -> str:
    """Name of a column, with its unit after it: ``x mm``, ``roll deg``."""
    whole = re.sub(r"['\"%]", "", field).strip().lower()
    unit = re.search(r"[(\[_ ](mm|cm|m|in|deg|rad|degrees|radians|ns|us|ms|s)[)\]]?$", whole)
    name = re.sub(r"\(.*?\)|\[.*?\]", "", whole).strip() if not unit else whole[: unit.start()].strip(" _")
    last = name.split(".")[-1].split("/")[-1]
    if re.search(r"orientation|rotation|quat", name) and last in {"x", "y", "z", "w"}:
        last = f"q{last}"
    return f"{ALIASES.get(last, last)} {unit[1][:3]}" if unit else ALIASES.get(last, last)


def _by_columns(table: Float64, names: list[str], where: str) -> Readings:
    if not names or len(names) != table.shape[1]:
        if (
            table.shape[1] == 9 and _unit(table[:, 5:]) and (table[:, :2] % 1 == 0).all()
        ):  # seconds and nanoseconds
            table = np.c_[table[:, 0] + 1e-9 * table[:, 1], table[:, 2:]]
        width = table.shape[1]
        timed = width in {8, 13, 17} or (
            width == 7 and not _unit(table[:, 3:]) and bool((np.diff(table[:, 0]) > 0).all())
        )
        timed &= not (width == 7 and _unit(table[:, :4]))
        found = _of_rows(table[:, 1:] if timed else table, where)
        return replace(found, seconds=table[:, 0] if timed else None)
    units = {n.split(" ")[0]: n.split(" ")[1] for n in names if " " in n}
    # Of two times the last: a header's stamp, not when it arrived
    at = {n.split(" ")[0]: i for i, n in enumerate(names)}
    if "qx" in at and "w" in at:
        at.setdefault("qw", at["w"])
    header = next((h for h in HEADERS if set(h) <= at.keys()), None)
    if header is None:
        raise FormatError(
            f"{where}: the header names no rotation: {', '.join(names)}",
            hint="expected qx,qy,qz,qw, or rx,ry,rz (rotation vector), or roll,pitch,yaw, or a,b,c (KUKA) beside x,y,z",
        )
    rows = table[:, [at[c] for c in ("x", "y", "z", *header)]]
    length, angles = units.get("x", ""), units.get(header[0], "")
    found = _of_rows(rows, where, HEADERS[header], length if length in UNITS else "", angles)
    seconds = table[:, at["t"]] if "t" in at else None
    if "secs" in at and "nsecs" in at:
        seconds = table[:, at["secs"]] + 1e-9 * table[:, at["nsecs"]]
    return replace(found, seconds=seconds)


def _content(path: Path) -> Any:
    """Tell what a file holds: lists and dictionaries, or the text of a table."""
    suffix = path.suffix.lower()
    if suffix in REMEDIES and path.exists():
        raise FormatError(
            f"{path}: expected poses as text, JSON, YAML, XML, NPZ or MAT, got {suffix}", REMEDIES[suffix]
        )
    try:
        if suffix in {".npz", ".npy"}:
            held = np.load(path, allow_pickle=False)
            return held.tolist() if isinstance(held, np.ndarray) else {k: held[k].tolist() for k in held}
        if suffix == ".mat":
            from scipy.io import loadmat

            return {k: v.tolist() for k, v in loadmat(path).items() if not k.startswith("__")}
        return _of_text(decoded(path.read_bytes()), suffix, path)
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file", hint="look at the path and its folder") from err
    except (ValueError, OSError, EOFError, BadZipFile, NotImplementedError, ET.ParseError) as err:
        kinds = {".npz": "arrays of numbers", ".npy": "an array of numbers", ".json": "JSON", ".xml": "XML"}
        remedy = "arrays of (3, 1) or (N, 4, 4) numbers, no objects: np.savez(name, hand=np.array(hands, float), ...)"
        raise FormatError(
            f"{path}: expected {kinds.get(suffix, 'text')}, got {err or type(err).__name__}",
            remedy if suffix in {".npz", ".npy"} else "save as MATLAB 5 (-v7)" if suffix == ".mat" else "",
        ) from err


def _of_text(text: str, suffix: str, path: Path) -> Any:
    begins = text.lstrip()[:5]
    if suffix == ".json":
        return json.loads(text)
    if begins[:1] in {"[", "{"} and suffix not in {".yaml", ".yml"}:
        try:
            return json.loads(text)
        except ValueError:
            return text  # arrays line by line, or KUKA's braces
    if begins.startswith("<"):
        return parsed_xml(text, path)
    if (
        suffix in {".yaml", ".yml"}
        or begins == "%YAML"
        or re.match(r"(header|pose|transform\w*):\s", text.lstrip())
    ):
        return yaml_tree(text, path)
    return text
