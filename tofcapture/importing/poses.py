"""Read where the camera stood: TUM and CSV lines of numbers, one pose a line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofcapture.errors import DataError
from tofcapture.importing.said import Said
from tofcapture.meshes import UNITS
from tofcapture.poses import Float64, check_transform, invert, transform

_APART = 0.1  # s that a pose may be away from the frame that it is taken for
_EARLY = 1e12  # stamps below are no nanoseconds since 1970


def read_poses(path: Path, said: Said) -> tuple[Float64 | None, Float64]:
    """Read stamps (n,) in seconds, or ``None``, and poses (n, 4, 4) of the camera in the world, metres.

    A line has x y z qx qy qz qw, or the 12 or 16 numbers of a matrix, row by row; before them a stamp, or none. Lines that begin
    with letters or # are passed over. :class:`DataError` names the first line that is none of these.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as err:
        raise DataError(f"{path}: cannot read the poses: {err}") from err
    rows = list[list[float]]()
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or re.match(r"\s*[#A-Za-z\"']", line):
            continue
        try:
            rows.append([float(w) for w in re.split(r"[,;\s]+", line.strip()) if w])
        except ValueError as err:
            raise DataError(f"{path}: line {number}: expected numbers, got {line[:60]!r}") from err
    counts = {len(row) for row in rows}
    if len(counts) != 1 or not counts <= {7, 8, 12, 13, 16, 17}:
        raise DataError(
            f"{path}: expected lines of 7, 12 or 16 numbers, or one more with a stamp, got {sorted(counts) or 'none'}",
            hint="TUM: stamp x y z qx qy qz qw, one pose a line",
        )
    table = np.array(rows)
    stamped = counts <= {8, 13, 17}
    scale = UNITS[str(said.poses.get("unit", "m"))]
    poses = np.stack(
        [_pose(row, scale, f"{path}: pose {i + 1}") for i, row in enumerate(table[:, int(stamped) :])]
    )
    if said.poses.get("maps", "world_camera") == "camera_world":
        poses = np.stack([invert(T) for T in poses])
    stamps = table[:, 0] * (1e-9 if stamped and abs(table[0, 0]) > _EARLY else 1) if stamped else None
    return stamps, poses


def _pose(row: Float64, scale: float, where: str) -> Float64:
    if len(row) == 7:
        x, y, z, w = row[3:]
        if abs(np.linalg.norm(row[3:]) - 1) > 1e-2:
            raise DataError(
                f"{where}: expected a unit quaternion qx qy qz qw, got length {np.linalg.norm(row[3:]):.3g}",
                hint="are the columns in another order?",
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
    times = np.array([np.mean(v) for v in views]) * 1e-9 + float(said.poses.get("time_offset_s", 0.0))
    near = np.abs(times[:, None] - stamps[None]).argmin(axis=1)
    late = np.abs(times - stamps[near])
    if late.max() > _APART:
        raise DataError(
            f"{where}: expected a pose within {_APART:g} s of every view, the worst is {late.max():.3g} s away",
            hint="two clocks? [poses] time_offset_s is added to the frames' stamps",
        )
    return list(poses[near])
