"""Read what hand-eye calibration is fed with: files of pairs, and files of poses.

Pairs: JSON, YAML (MoveIt's samples and alike), NPZ, or a table of 14 columns. Poses: a table with or without times (CSV, TUM),
JSON, YAML, NPY or NPZ. :mod:`calibration.hand_eye.forms` knows the forms of a single pose.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.hand_eye.forms import (
    Readings,
    most_consistent,
    readings_of,
    readings_of_table,
    readings_of_text,
)
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.poses import Float64

COLUMNS = "t,x,y,z,qx,qy,qz,qw"
HAND = (
    "effector_wrt_world",
    "hand",
    "robot",
    "gripper2base",
    "t_gripper2base",
    "t_base_flange",
    "t_base_hand",
    "flange",
    "arm",
    "a",
)
TARGET = (
    "object_wrt_sensor",
    "target",
    "optical",
    "camera",
    "target2cam",
    "t_target2cam",
    "t_camera_target",
    "board",
    "marker",
    "b",
)
LISTS = ("samples", "pairs", "poses", "data", "transforms")


def read_pairs(path: Path) -> tuple[Float64, Float64]:
    """Read pairs of poses of hand and target from one file; see :func:`read_pairs_said`."""
    hand, target, _ = read_pairs_said(path)
    return hand, target


def read_pairs_said(path: Path) -> tuple[Float64, Float64, dict[str, str]]:
    """Read pairs of poses of hand and target from one file.

    Returns
    -------
    hand, target
        (N, 4, 4) float64, metres; not yet checked to be rigid.
    read_as
        What had to be found out: the order of quaternions, millimetres.

    Raises
    ------
    DataError, FormatError
        No such file, or another layout.
    """
    hand, target = _two(path, _content(path))
    return most_consistent(hand, target)


def read_poses(path: Path) -> Readings:
    """Read one file of poses, with times or without.

    Raises
    ------
    DataError, FormatError
        No such file, another number of columns, words, or quaternions that are not of length 1.
    """
    content = _content(path)
    if isinstance(content, str):
        return readings_of_text(content, str(path))
    if isinstance(content, Mapping):
        held = {str(k).lower(): v for k, v in content.items()}
        seconds = next((held[k] for k in ("seconds", "t", "time", "stamps") if k in held), None)
        poses = next((held[k] for k in LISTS if k in held), None)
        if poses is None:
            raise FormatError(
                f"{path}: expected poses under one of {', '.join(LISTS)}, got {', '.join(held)}"
            )
        found = readings_of(list(poses), str(path))
        return (
            found if seconds is None else Readings(found.poses, np.asarray(seconds, float), found.millimetres)
        )
    return readings_of(list(content), str(path))


def read_csv(path: Path) -> tuple[Float64, Float64]:
    """Read a stream ``t,x,y,z,qx,qy,qz,qw``: seconds, metres, Hamilton quaternion with the scalar last unless a header differs.

    Returns
    -------
    seconds
        (N,).
    poses
        (N, 4, 4).

    Raises
    ------
    DataError, FormatError
        As :func:`read_poses`, or poses without times.
    """
    found = read_poses(path)
    if found.seconds is None:
        raise FormatError(f"{path}: expected times before the poses, {COLUMNS}, got none")
    return found.seconds, next(iter(found.poses.values()))


def _two(path: Path, content: Any) -> tuple[Readings, Readings]:
    if isinstance(content, str):
        return _two_of_table(path, content)
    if isinstance(content, Mapping):
        held = {str(k).lower(): v for k, v in content.items()}
        inner = next((held[k] for k in LISTS if k in held), None)
        if inner is not None:
            return _two(path, inner)
        hand, target = _named(held, path, "pairs")
        return _as_long(
            path, readings_of(list(hand), f"{path}: hand"), readings_of(list(target), f"{path}: target")
        )
    if not isinstance(content, list):
        raise FormatError(
            f"{path}: expected a list of pairs [hand 4x4, target 4x4], got {type(content).__name__}"
        )
    if not content:
        raise DataError(f"{path}: expected pairs, got an empty list", hint="were the target's views empty?")
    pairs = [_pair(p, f"{path}: pair {i}") for i, p in enumerate(content)]
    hands, targets = zip(*pairs, strict=True)
    return readings_of(hands, f"{path}: hand"), readings_of(targets, f"{path}: target")


def _pair(pair: Any, where: str) -> tuple[Any, Any]:
    if isinstance(pair, Mapping):
        return _named({str(k).lower(): v for k, v in pair.items()}, where, "a pair")
    if not isinstance(pair, list) or len(pair) != 2:
        raise FormatError(f"{where}: expected [hand, target], got {str(pair)[:60]!r}")
    return pair[0], pair[1]


def _named(held: Mapping[str, Any], where: object, what: str) -> tuple[Any, Any]:
    found = [next((held[k] for k in names if k in held), None) for names in (HAND, TARGET)]
    if found[0] is None or found[1] is None:
        raise FormatError(
            f"{where}: expected {what} under names such as hand and target, got {', '.join(held) or 'nothing'}",
            hint="known names: " + ", ".join((*HAND[:-1], *TARGET[:-1])),
        )
    return found[0], found[1]


def _as_long(path: Path, hand: Readings, target: Readings) -> tuple[Readings, Readings]:
    n, m = (len(next(iter(r.poses.values()))) for r in (hand, target))
    if n != m:
        raise DataError(f"{path}: expected as many target poses as hand poses, got {m} and {n}")
    return hand, target


def _two_of_table(path: Path, text: str) -> tuple[Readings, Readings]:
    rows = [line.replace(",", " ").replace(";", " ").split() for line in text.splitlines()]
    numbers = []
    for i, row in enumerate(rows):
        try:
            numbers.append([float(x) for x in row])
        except ValueError as err:
            if numbers or row[0].startswith("#"):
                if row[0].startswith("#"):
                    continue
                raise FormatError(f"{path}:{i + 1}: expected numbers, got {' '.join(row)[:60]!r}") from err
    table = [row for row in numbers if row]
    widths = {len(row) for row in table}
    width = widths.pop() if len(widths) == 1 else 0
    half = {14: 7, 15: 7, 24: 12, 25: 12, 32: 16, 33: 16}.get(width)
    if half is None:
        raise FormatError(
            f"{path}: expected JSON, YAML, NPZ, or lines of two poses (14, 24 or 32 numbers), got {width or 'uneven'} columns",
            hint="one pose a line is a stream: give two files, hand and target",
        )
    both = np.array(table)[:, width - 2 * half :]
    return readings_of_table(both[:, :half], f"{path}: hand"), readings_of_table(
        both[:, half:], f"{path}: target"
    )


def _content(path: Path) -> Any:
    """What a file holds: lists and dictionaries, or the text of a table."""
    suffix = path.suffix.lower()
    if suffix in {".npz", ".npy"}:
        return _arrays(path)
    text = _text(path)
    if suffix in {".yaml", ".yml"}:
        return _yaml(text, path)
    if suffix == ".json":
        try:
            return json.loads(text)
        except ValueError as err:
            raise FormatError(f"{path}: expected JSON, got {err}") from err
    return text


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


def _arrays(path: Path) -> Any:
    try:
        held = np.load(path, allow_pickle=False)
        return held.tolist() if isinstance(held, np.ndarray) else {k: held[k].tolist() for k in held.files}
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (ValueError, OSError, EOFError) as err:
        raise FormatError(f"{path}: expected arrays of numbers, got {err}") from err


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (UnicodeDecodeError, IsADirectoryError) as err:
        raise FormatError(f"{path}: expected a text file, got {type(err).__name__}") from err
