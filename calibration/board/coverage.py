"""How well calibration views are spread: over tilts, over the image, over distances; and what is still missing."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.board.geometry import inside, load_board
from calibration.limits import LIMITS
from calibration.registration.pairs import calibration_views
from tofcapture.camera import Camera
from tofcapture.cli.kit import Outcome
from tofcapture.devices.clearance import stage_of
from tofcapture.errors import DataError
from tofcapture.files.view import read_view
from tofcapture.poses import Float64, invert, transform, transform_points
from tofcapture.record.quality import CELLS, SECTORS, TILTED, TILTS


def coverage(poses: Sequence[Float64], camera: Camera, outline: Float64) -> dict[str, Any]:
    """Say what the views so far cover.

    The poses (4, 4) are ``T_tof_board``: the board's origin and, along its z, the normal of its front. The outline is (M, 2), metres,
    or (N, M, 2), one for each view.

    The answer is JSON: ``views``; ``tilt_deg``, ``lean_deg`` and ``distance_m`` of each view; ``tilt_histogram`` (counts between
    ``tilt_edges_deg``); ``sectors`` (counts by the direction in which the front leans in the image); ``image`` (9 x 12 counts),
    ``image_share``; ``missing`` (what to record next, in words; empty when nothing is).
    """
    tilts, leans, grid = [], [], np.zeros(CELLS, dtype=int)
    sectors = dict.fromkeys(SECTORS, 0)
    outlines = np.broadcast_to(outline, (len(poses), *np.shape(outline)[-2:]))
    for T, shape in zip(poses, outlines, strict=True):
        tilt, lean = _tilt(T)
        tilts.append(tilt)
        leans.append(lean)
        if tilt >= TILTED:
            sectors[SECTORS[round(lean / 45.0) % 8]] += 1
        grid += _seen(T, camera, shape)
    out: dict[str, Any] = {
        "views": len(tilts),
        "tilt_deg": tilts,
        "lean_deg": leans,
        "distance_m": [float(np.linalg.norm(T[:3, 3])) for T in poses],
        "tilt_edges_deg": list(TILTS),
        "tilt_histogram": np.histogram(tilts, TILTS)[0].tolist(),
        "sectors": sectors,
        "image": grid.tolist(),
        "image_share": float((grid > 0).mean()),
    }
    return {**out, "missing": _missing(out, grid)}


def _tilt(T_tof_board: Float64) -> tuple[float, float]:
    """Angle between the board's normal and the line of sight, and where the normal leans to in the image (x right, y down), degrees."""
    normal, sight = T_tof_board[:3, 2], -T_tof_board[:3, 3]
    sight = sight / max(float(np.linalg.norm(sight)), 1e-12)
    tilt = float(np.degrees(np.arccos(np.clip(normal @ sight, -1.0, 1.0))))
    lean = normal - (normal @ sight) * sight
    return tilt, float(np.degrees(np.arctan2(lean[1], lean[0])))


def _seen(T_tof_board: Float64, camera: Camera, outline: Float64) -> Any:
    """Which cells of the image (9, 12) have their centre on the board, as 0 and 1."""
    corners = np.column_stack([outline, np.zeros(len(outline))])
    pixels, depth = camera.project(transform_points(T_tof_board, corners))
    if not (depth > 0).all():
        return np.zeros(CELLS, dtype=int)
    v = (np.arange(CELLS[0]) + 0.5) * camera.height / CELLS[0] - 0.5
    u = (np.arange(CELLS[1]) + 0.5) * camera.width / CELLS[1] - 0.5
    return inside(pixels, np.stack(np.meshgrid(u, v), axis=-1)).astype(int)


def _missing(found: dict[str, Any], grid: Any) -> list[str]:
    if not found["views"]:
        return ["any board view"]
    out = []
    if (short := int(LIMITS["used"].good) - found["views"]) > 0:
        out.append(f"{short} more views")
    if np.median(found["tilt_deg"]) < LIMITS["tilt"].good:
        out.append(f"stronger tilts: half of the views are below {np.median(found['tilt_deg']):.0f} deg")
    empty = [name for name, count in found["sectors"].items() if count == 0]
    if len(SECTORS) - len(empty) < LIMITS["sectors"].good:
        out.append(f"a board that faces {', '.join(empty)} in the image")
    if found["image_share"] < LIMITS["image"].good:
        rows, columns = CELLS[0] // 2, CELLS[1] // 2
        quarters = {
            "upper left": grid[:rows, :columns],
            "upper right": grid[:rows, -columns:],
            "lower left": grid[-rows:, :columns],
            "lower right": grid[-rows:, -columns:],
        }
        emptiest = min(quarters, key=lambda name: float((quarters[name] > 0).mean()))
        out.append(f"the board in the image's {emptiest}")
    near, far = min(found["distance_m"]), max(found["distance_m"])
    if far / near < LIMITS["distances"].good:
        out.append(f"other distances: all views are {near:.2f} to {far:.2f} m away")
    return out


def recorded_poses(recording: Path) -> tuple[list[Float64], Camera]:
    """Read poses ``T_tof_board`` of a recording's calibration views off the arm and the station's ``[plan]``; nothing is decoded.

    The turn of the board in its plane is taken as that of the horizontal: it does not matter for a tilt, and little for the image.

    :class:`DataError` where there are no views, or no station.
    """
    path = Path(recording) / "station.toml"
    try:
        stage = stage_of(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError) as err:
        raise DataError(
            f"{path}: cannot read where the board stands: {err}", hint="record writes it beside the views"
        ) from err
    z = stage.board_normal / np.linalg.norm(stage.board_normal)
    y = np.cross(z, [1.0, 0.0, 0.0])
    y = y / np.linalg.norm(y) if np.linalg.norm(y) > 1e-6 else np.array([0.0, 1.0, 0.0])
    T_base_board = transform(np.stack([np.cross(y, z), y, z], axis=1), stage.board)
    poses = []
    for view in map(read_view, calibration_views(recording)):
        poses.append(invert(view.arm_before.T_base_flange @ view.rig.T_flange_tof) @ T_base_board)
        camera = view.tof.info.camera
    return poses, camera


def run_coverage(args: argparse.Namespace) -> Outcome:
    """Print what the calibration views of a recording cover, and what is missing."""
    poses, camera = recorded_poses(args.recording)
    found = coverage(poses, camera, load_board(args.board).outline)
    return Outcome(found, meter(found))


def meter(found: dict[str, Any]) -> str:
    """Lay a coverage out for a person, in a few lines."""
    edges = found["tilt_edges_deg"]
    tilts = zip(edges, edges[1:], found["tilt_histogram"], strict=False)
    marks = " .:+*#"
    lines = [
        f"{found['views']} views",
        f"tilts      {'  '.join(f'{low:g}-{high:g} deg {n}' for low, high, n in tilts)}",
        f"faces      {'  '.join(f'{name} {n}' for name, n in found['sectors'].items())}",
    ]
    if found["distance_m"]:
        lines.append(f"distance   {min(found['distance_m']):.2f} to {max(found['distance_m']):.2f} m")
    lines.append(f"image      {100 * found['image_share']:.0f} % covered")
    lines += ["  " + "".join(marks[min(n, len(marks) - 1)] * 2 for n in row) for row in found["image"]]
    return "\n".join([*lines, f"missing    {'; '.join(found['missing']) or 'nothing'}"])
