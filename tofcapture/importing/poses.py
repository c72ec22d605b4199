"""Read where the camera stood: TUM and CSV lines of numbers, matrices of NumPy, nerfstudio's ``transforms.json``."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import DataError
from tofcapture.importing.said import Said
from tofcapture.meshes import UNITS
from tofcapture.poses import Float64, check_transform, exp, invert, log, transform

_APART = 0.1  # s that a pose may be away from the frame that it is taken for
_UNITS_OF_TIME = (1.0, 1e-3, 1e-6, 1e-9)  # s, ms, us, ns; the one in which poses and frames meet is taken
_WIDE = 100.0  # m between two poses of a camera that measures some metres
_NAMES = {"qx": 3, "qy": 4, "qz": 5, "qw": 6, "x": 0, "y": 1, "z": 2}
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # nerfstudio's cameras look along -z, y up
_FORMS = "lines of x y z qx qy qz qw, or of a matrix by rows, with a stamp before them or not; or (N, 4, 4) as .npy"


def read_poses(path: Path, said: Said) -> tuple[Float64 | None, Float64]:
    """Read stamps (n,) in the file's unit, or ``None``, and poses (n, 4, 4) of the camera in the world, metres.

    A line has x y z qx qy qz qw, or the 12 or 16 numbers of a matrix, row by row; before them a stamp, or none. A header that names
    these columns may have them in another order. :class:`DataError` names the first line that is none of these.
    """
    rows = _rows(path)
    counts = {len(row) for row in rows}
    if len(counts) != 1 or not counts <= {7, 8, 12, 13, 16, 17}:
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
    scale = UNITS[str(said.poses.get("unit", "m"))]
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


def _rows(path: Path) -> list[list[float]]:
    """Rows of numbers of a file, those of a header in our order."""
    try:
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False).astype(np.float64).reshape(-1, 16).tolist()  # type: ignore[no-any-return]
        text = path.read_text(encoding="utf-8-sig")
        if text.lstrip()[:1] in {"{", "["}:
            return _of_json(json.loads(text))
    except (OSError, ValueError, KeyError, TypeError) as err:
        raise DataError(f"{path}: cannot read the poses: {err}", hint=_FORMS) from err
    rows, order = list[list[float]](), list[int]()
    for number, line in enumerate(text.splitlines(), start=1):
        words = [w.strip("\"'") for w in re.split(r"[,;\s]+", line.strip(" \t#,;")) if w]
        if not words or line.lstrip().startswith("#") or not _is_number(words[0]):
            order = order or _order(words)
            continue
        try:
            row = [float(w) for w in words]
        except ValueError as err:
            raise DataError(
                f"{path}: line {number}: expected numbers, got {line[:60]!r}", hint=_FORMS
            ) from err
        rows.append([row[i] for i in order] if order and len(row) > max(order) else row)
    return rows


def _of_json(held: Any) -> list[list[float]]:
    """Rows of matrices of a list, or of nerfstudio's frames in the order of their files."""
    if isinstance(held, dict):
        frames = sorted(held["frames"], key=lambda f: str(f["file_path"]))
        held = [np.asarray(f["transform_matrix"], np.float64).reshape(4, 4) @ _OPENGL for f in frames]
    return np.asarray(held, dtype=np.float64).reshape(-1, 16).tolist()


def _is_number(word: str) -> bool:
    return bool(re.fullmatch(r"[-+]?(\d.*|\.\d.*|nan|inf(inity)?)", word.lower()))


def _order(words: Sequence[str]) -> list[int]:
    """Columns of stamp and pose in our order, where a header names them; empty when it is none."""
    names = [re.sub(r"^(?:pos_?|p_?|t_?)(?=[xyz]$)|^.*[./](?=\w+$)|_", "", w.lower()) for w in words]
    if not _NAMES.keys() <= set(names) or len(names) not in {7, 8}:
        return []
    pose = [names.index(n) for n in sorted(_NAMES, key=_NAMES.__getitem__)]
    return [i for i in range(len(names)) if i not in pose] + pose


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
    U, _, V = np.linalg.svd(T[:3, :3])
    if np.abs(U @ V - T[:3, :3]).max() < 1e-3:  # what is left of printing a few digits
        T[:3, :3] = U @ V
    T[:3, 3] *= scale
    return check_transform(T, where)


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
