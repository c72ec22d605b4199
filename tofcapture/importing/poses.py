"""Read where the camera stood: lines of TUM, KITTI, EuRoC and CSV, matrices, nerfstudio's ``transforms.json``, COLMAP's ``images.txt``."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import DataError
from tofcapture.importing.cameras.trees import decoded
from tofcapture.importing.readers.arrays import SUFFIXES, arrays_of
from tofcapture.importing.said import Said
from tofcapture.importing.source import natural
from tofcapture.meshes import UNITS
from tofcapture.poses import Float64, check_transform, exp, invert, log, printed, transform

_APART = 0.1  # s that a pose may be away from the frame that it is taken for
_UNITS_OF_TIME = (1.0, 1e-3, 1e-6, 1e-9)  # s, ms, us, ns; the one in which poses and frames meet is taken
_WIDE = 100.0  # m between two poses of a camera that measures some metres
_PLACES = ("x", "y", "z", "qx", "qy", "qz", "qw")
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # nerfstudio's cameras look along -z, y up
_FORMS = "lines of x y z qx qy qz qw, or of a matrix by rows, with a stamp before them or not; or (N, 4, 4) as .npy"
_COUNTS = {7, 8, 12, 13, 16, 17}
Rows = list[list[float]]


def read_poses(path: Path, said: Said) -> tuple[Float64 | None, Float64]:
    """Read stamps (n,) in the file's unit, or ``None``, and poses (n, 4, 4) of the camera in the world, metres.

    A line has x y z qx qy qz qw, or the 12 or 16 numbers of a matrix, row by row; before them a stamp, or none. A header that names
    these columns may have them in another order, with others between them, and their unit. A folder has a matrix in each file.
    :class:`DataError` names the first line that is none of these.
    """
    rows, unit = _rows(path)
    counts = {len(row) for row in rows}
    if len(counts) != 1 or not counts <= _COUNTS:
        raise DataError(
            f"{path}: expected lines of 7, 12 or 16 numbers, or one more with a stamp, got {sorted(counts) or 'none'}",
            hint="TUM: stamp x y z qx qy qz qw, one pose a line",
        )
    table = np.array(rows)
    if not np.isfinite(table).all():
        bad = int(np.argmax(~np.isfinite(table).all(axis=1)))
        raise DataError(
            f"{path}: pose {bad + 1}: expected finite numbers, got NaN or infinity",
            hint="was the camera lost there? leave this view and its pose out",
        )
    stamped = counts <= {8, 13, 17}
    scale = UNITS[str(said.poses.get("unit", unit or "m"))]
    poses = np.stack(
        [_pose(row, scale, f"{path}: pose {i + 1}") for i, row in enumerate(table[:, int(stamped) :])]
    )
    if said.poses.get("maps", "world_camera") == "camera_world":
        poses = np.stack([invert(T) for T in poses])
    if (wide := float(np.ptp(poses[:, :3, 3], axis=0).max())) > _WIDE:
        raise DataError(
            f"{path}: expected poses in metres, they lie {wide:.0f} m apart",
            hint='[poses] unit = "mm" in import.toml',
        )
    return (table[:, 0] if stamped else None), poses


def _rows(path: Path) -> tuple[Rows, str]:
    """Rows of numbers in our order, and the unit of the places where a header says it."""
    if not path.exists():
        raise DataError(
            f"{path}: no such file of poses", hint="[poses] file is looked for in SOURCE, or beside it"
        )
    try:
        model = next(
            (path / n for n in ("images.txt", "images.bin") if path.is_dir() and (path / n).is_file()), path
        )
        if model.suffix.lower() == ".bin":
            return _of_colmap([*_colmap_lines(model.read_bytes())]) or [], ""
        if model != path:
            return _rows(model)
        if path.is_dir():
            files = sorted((p for p in path.iterdir() if p.is_file()), key=lambda p: natural(p.name))
            return [[x for row in _rows(f)[0] for x in row] for f in files if f.name[0] != "."], ""
        if path.suffix.lower() in SUFFIXES:
            return _of_arrays(arrays_of(path)), ""
        text = decoded(path.read_bytes())
        if text.lstrip()[:1] in {"{", "["}:
            return _of_json(json.loads(text)), ""
    except (OSError, ValueError, KeyError, TypeError, struct.error) as err:
        raise DataError(f"{path}: cannot read the poses: {err}", hint=_FORMS) from err
    lines = [line.strip() for line in text.splitlines()]
    if (colmap := _of_colmap(lines)) is not None:
        return colmap, ""
    return _of_lines(lines, path)


def _of_lines(lines: Sequence[str], path: Path) -> tuple[Rows, str]:
    apart = next((c for c in ";,\t" if any(c in line for line in lines)), None)
    rows, columns, unit = Rows(), list[int](), ""
    for number, line in enumerate(lines, start=1):
        commas = apart in {";", "\t"} and re.search(r"\d,\d", line)  # decimal commas
        words = [
            w.strip(" \"'") for w in (line.replace(",", ".") if commas else line).strip("#% ").split(apart)
        ]
        words = words if len(words) > 1 or not apart else line.split()
        if columns and len(words) > max(columns) and line[0] != "#":
            words = [words[i] for i in columns]
        elif not any(words) or line.startswith("#") or not _is_number(words[0]):
            if not columns and (named := _columns(words, path)):
                columns, unit = named
            elif rows and any(words) and not line.startswith("#"):
                raise DataError(f"{path}: line {number}: expected numbers, got {line[:60]!r}", hint=_FORMS)
            continue
        try:
            rows.append([float(w) for w in words if w])
        except ValueError as err:
            raise DataError(
                f"{path}: line {number}: expected numbers, got {line[:60]!r}", hint=_FORMS
            ) from err
    return _joined(rows), unit


def _joined(rows: Rows) -> Rows:
    """Join the lines of matrices that stand below each other, 3 or 4 of 4 numbers, with or without a line of 3 before them."""
    rows = (
        [r for r in rows if len(r) != 3]
        if len(rows) % 5 == 0 and all(len(r) == 3 for r in rows[::5])
        else rows
    )
    if {len(r) for r in rows} != {4}:
        return rows
    of = 4 if len(rows) % 4 == 0 and all(r == [0, 0, 0, 1] for r in rows[3::4]) else 3
    return [[x for row in rows[i : i + of] for x in row] for i in range(0, len(rows), of)]


def _columns(words: Sequence[str], path: Path) -> tuple[list[int], str] | None:
    """Find the columns of stamp and pose that a header names, in our order, and their unit; ``None`` when it is none."""
    found, unit = dict[str, int](), ""
    for i, word in enumerate(words):
        parts = [p for p in re.split(r"[^a-z0-9]+", word.lower()) if p]
        unit = next((p for p in parts if p in {"mm", "cm"}), unit)
        parts = [p for p in parts if p not in {"m", "mm", "cm", "s", "ns", "ms"}]
        name = parts[-1] if parts else ""
        turn = any(p[0] == "q" or p.startswith(("quat", "orient", "rot")) for p in parts)
        if match := re.fullmatch(r"(?:q|quat|quaternion|orientation)?([xyzw])", name) if turn else None:
            found.setdefault(f"q{match[1]}", i)
        elif match := re.fullmatch(r"(?:pos|position|p|t|trans|translation)?([xyz])", name):
            found.setdefault(match[1], i)
        elif re.match(r"time|stamp|t$|sec", name):
            found.setdefault("time", i)
    if not {"x", "y", "z"} <= found.keys() or len(words) < len(_PLACES) - 1:
        return None
    if not set(_PLACES) <= found.keys():
        raise DataError(
            f"{path}: expected columns {' '.join(_PLACES)}, got {', '.join(words)[:120]}",
            hint="angles: scipy's Rotation.from_euler(...).as_quat() gives qx qy qz qw",
        )
    return [*([found["time"]] if "time" in found else []), *(found[n] for n in _PLACES)], unit


def _of_arrays(held: Mapping[str, Any]) -> Rows:
    """Rows of the one array of poses: (N, 4, 4), (N, 3, 4), MATLAB's (4, 4, N), or a table."""
    arrays = [np.asarray(a, np.float64) for a in held.values() if a.dtype.kind in "iuf" and a.ndim in (2, 3)]
    arrays += [np.moveaxis(a, -1, 0) for a in arrays if a.ndim == 3]
    rigid = [a for a in arrays if a.shape[-2:] in {(4, 4), (3, 4)}]
    rigid.sort(key=lambda a: not (a[..., 3:, :] == [0, 0, 0, 1]).all())
    found = next(iter(rigid), next((a for a in arrays if a.ndim == 2 and a.shape[1] in _COUNTS), None))
    if found is None:
        raise ValueError(
            f"no array (N, 4, 4), got {', '.join(str(a.shape) for a in held.values()) or 'none'}"
        )
    return [row.ravel().tolist() for row in (found if found.ndim == 3 or not rigid else [found])]


def _of_json(held: Any) -> Rows:
    """Rows of matrices of a list or by name, or of nerfstudio's frames in the order of their files."""
    if isinstance(held, dict) and "frames" in held:
        frames = sorted(held["frames"], key=lambda f: natural(str(f["file_path"])))
        held = [np.asarray(f["transform_matrix"], np.float64).reshape(4, 4) @ _OPENGL for f in frames]
    elif isinstance(held, dict):
        held = [held[name] for name in sorted(held, key=natural)]
    held = [next(v for v in m.values() if np.size(v) in (12, 16)) if isinstance(m, dict) else m for m in held]
    return [np.asarray(m, dtype=np.float64).ravel().tolist() for m in held]


def _of_colmap(lines: Sequence[str]) -> Rows | None:
    """Rows of matrices of ``images.txt`` in the order of the pictures' names; ``None`` for anything else."""
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    rows = [r for r in rows if len(r) == 10 and r[0].isdecimal() and re.search("[A-Za-z]", r[-1])]
    if not rows:
        return None
    out = Rows()
    for row in sorted(rows, key=lambda r: natural(r[-1])):
        w, x, y, z, *t = (float(v) for v in row[1:8])
        out.append(invert(_pose(np.array([*t, x, y, z, w]), 1.0, row[-1])).ravel().tolist())
    return out


def _colmap_lines(data: bytes) -> Iterator[str]:
    """List the lines of pictures that ``images.txt`` would have, from ``images.bin``."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        yield " ".join(map(str, (number, *pose, camera, data[at + 64 : end].decode())))
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points


def _is_number(word: str) -> bool:
    return bool(re.fullmatch(r"[-+]?(\d.*|\.\d.*|nan|inf(inity)?)", word.lower()))


def _pose(row: Float64, scale: float, where: str) -> Float64:
    if len(row) == 7:
        x, y, z, w = row[3:]
        if abs(np.linalg.norm(row[3:]) - 1) > 1e-2:
            raise DataError(
                f"{where}: expected a unit quaternion qx qy qz qw, got length {np.linalg.norm(row[3:]):.3g}",
                hint="are the columns in another order? a header that names them is read: x y z qw qx qy qz",
            )
        x, y, z, w = row[3:] / np.linalg.norm(row[3:])
        R = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        return transform(R, row[:3] * scale)
    T = np.eye(4)
    T[:3] = row[:12].reshape(3, 4)
    T[:3, 3] *= scale
    return check_transform(printed(T), where)


def poses_of(
    views: Sequence[tuple[int, ...]], stamps: Float64 | None, poses: Float64, said: Said, where: str
) -> list[Float64]:
    """Find the pose of each view: by the stamps of its frames, nanoseconds, where both have them; else by order.

    :class:`DataError`: another number of poses than views, or no pose within a tenth of a second of a view.
    """
    if stamps is None or not all(views):
        if len(poses) != len(views):
            raise DataError(
                f"{where}: expected a pose for each of {len(views)} views, got {len(poses)}",
                hint="one line a view, in the order of the views; or stamps in both",
            )
        return list(poses)
    times = np.array([np.mean(v) for v in views]) * 1e-9 - float(said.poses.get("time_offset_s", 0.0))
    order = np.argsort(stamps, kind="stable")
    stamps, poses = stamps[order], poses[order]
    away = {unit: np.abs(times[:, None] - unit * stamps[None]).min(axis=1) for unit in _UNITS_OF_TIME}
    unit = min(away, key=lambda u: float(away[u].max()))
    stamps, late = unit * stamps, away[unit]
    if late.max() > _APART:
        raise DataError(
            f"{where}: expected a pose within {_APART:g} s of every view, the worst is {late.max():.3g} s away",
            hint="two clocks? [poses] time_offset_s is added to the poses' stamps; or lines without stamps, one a view",
        )
    return [pose_at(stamps, poses, time) for time in times]


def pose_at(
    stamps: Sequence[float] | Float64,
    poses: Sequence[Float64] | Float64,
    time: float,
    within: float = 2 * _APART,
) -> Float64:
    """Interpolate between poses at ascending stamps; at the ends, and where two lie more than ``within`` apart, the nearer holds."""
    i = int(np.searchsorted(stamps, time))
    if i in {0, len(poses)}:
        return poses[min(i, len(poses) - 1)]
    s0, s1 = stamps[i - 1], stamps[i]
    share = (time - s0) / (s1 - s0)
    if s1 - s0 > within:
        return poses[i - 1] if share < 0.5 else poses[i]
    return poses[i - 1] @ exp(share * log(invert(poses[i - 1]) @ poses[i]))
