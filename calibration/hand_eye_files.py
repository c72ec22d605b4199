"""Read what hand-eye calibration is fed with: JSON pairs, and CSV streams."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tofcapture.errors import DataError, FormatError
from tofcapture.poses import Float64

COLUMNS = "t,x,y,z,qx,qy,qz,qw"


def read_pairs(path: Path) -> tuple[Float64, Float64]:
    """Read a JSON list of ``[hand 4x4, target 4x4]``.

    Returns
    -------
    hand, target
        (N, 4, 4) float64; not yet checked to be rigid.

    Raises
    ------
    DataError, FormatError
        No such file, no JSON, or another layout.
    """
    try:
        content = json.loads(_text(path))
    except ValueError as err:
        raise FormatError(f"{path}: expected JSON, got {err}") from err
    if not isinstance(content, list):
        raise FormatError(
            f"{path}: expected a list of pairs [hand 4x4, target 4x4], got {type(content).__name__}"
        )
    if not content:
        raise DataError(f"{path}: expected pairs, got an empty list", hint="were the target's views empty?")
    for i, pair in enumerate(content):
        if _shape(pair) != (2, 4, 4):
            raise FormatError(f"{path}: expected pair {i} to be [4x4, 4x4], got shape {_shape(pair)}")
    both = np.array(content, dtype=np.float64)
    return both[:, 0], both[:, 1]


def _shape(pair: object) -> tuple[int, ...] | None:
    try:
        return np.asarray(pair, dtype=np.float64).shape
    except (ValueError, TypeError):
        return None


def read_csv(path: Path) -> tuple[Float64, Float64]:
    """Read poses ``t,x,y,z,qx,qy,qz,qw``: seconds, metres, Hamilton quaternion with the scalar last.

    A header line and lines that start with ``#`` are skipped; commas, semicolons or blanks separate.

    Returns
    -------
    seconds
        (N,).
    poses
        (N, 4, 4).

    Raises
    ------
    DataError, FormatError
        No such file, another number of columns, words, or quaternions that are not of length 1.
    """
    from scipy.spatial.transform import Rotation

    rows: list[list[float]] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        fields = line.replace(",", " ").replace(";", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        values = _numbers(fields)
        if values is None and not rows:
            continue  # a header
        if values is None or len(values) != 8:
            raise FormatError(f"{path}:{number}: expected 8 numbers {COLUMNS}, got {line.strip()[:60]!r}")
        rows.append(values)
    if not rows:
        raise DataError(f"{path}: expected poses {COLUMNS}, got none")
    table = np.array(rows)
    if not np.isfinite(table).all():
        bad = int(np.argmax(~np.isfinite(table).all(axis=1)))
        raise DataError(f"{path}: expected finite numbers, got NaN or infinity in pose {bad}")
    length = np.linalg.norm(table[:, 4:], axis=1)
    if np.abs(length - 1).max() > 0.01:
        bad = int(np.argmax(np.abs(length - 1)))
        raise DataError(
            f"{path}: expected unit quaternions, got length {length[bad]:.3f} in pose {bad}",
            hint=f"the columns must be {COLUMNS}",
        )
    poses = np.zeros((len(table), 4, 4))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3], poses[:, 3, 3] = table[:, 1:4], 1
    return table[:, 0], poses


def _numbers(fields: list[str]) -> list[float] | None:
    try:
        return [float(f) for f in fields]
    except ValueError:
        return None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (UnicodeDecodeError, IsADirectoryError) as err:
        raise FormatError(f"{path}: expected a text file, got {type(err).__name__}") from err
