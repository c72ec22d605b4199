"""``tofcapture calibrate coverage``: what the calibration views of a recording cover, and what is still missing."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.board.geometry import load_board
from calibration.limits import LIMITS
from calibration.registration.pairs import calibration_views
from tofcapture.camera import Camera
from tofcapture.cli.kit import Outcome
from tofcapture.devices.clearance import workcell_of
from tofcapture.errors import DataError
from tofcapture.files.view import open_view
from tofcapture.poses import Float64, invert
from tofcapture.record.quality import SECTORS, board_pose, coverage, meter

SHADES = " .:+*#"  # of cells that no, one, two ... views have seen


def configure_coverage(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    parser.add_argument(
        "--board", default="default", metavar="BOARD", help="packaged board or a TOML file (default: default)"
    )


def run_coverage(args: argparse.Namespace) -> Outcome:
    """Print what the calibration views of a recording cover, and what is missing."""
    poses, camera = recorded_poses(args.recording)
    found = coverage(poses, camera, load_board(args.board).outline)
    lacking = missing(found)
    image = ["  " + "".join(SHADES[min(n, len(SHADES) - 1)] * 2 for n in row) for row in found["image"]]
    text = "\n".join([meter(found), *image, f"missing    {'; '.join(lacking) or 'nothing'}"])
    return Outcome({**found, "missing": lacking}, text)


def missing(found: Mapping[str, Any]) -> list[str]:
    """Say in words what to record next after such a coverage; empty when nothing is missing."""
    if not found["views"]:
        return ["any board view"]
    out = []
    if (short := int(LIMITS["used"].good) - found["views"]) > 0:
        out.append(f"{short} more views")
    if (tilt := float(np.median(found["tilt_deg"]))) < LIMITS["tilt"].good:
        out.append(f"stronger tilts: half of the views are below {tilt:.0f} deg")
    empty = [name for name, count in found["sectors"].items() if count == 0]
    if len(SECTORS) - len(empty) < LIMITS["sectors"].good:
        out.append(f"a board that faces {', '.join(empty)} in the image")
    if found["image_share"] < LIMITS["image"].good:
        grid = np.array(found["image"]) > 0
        quarters = {
            f"{row} {column}": float(part.mean())
            for row, half in zip(("upper", "lower"), np.array_split(grid, 2), strict=True)
            for column, part in zip(("left", "right"), np.array_split(half, 2, axis=1), strict=True)
        }
        out.append(f"the board in the image's {min(quarters, key=lambda name: quarters[name])}")
    near, far = min(found["distance_m"]), max(found["distance_m"])
    if far / near < LIMITS["distances"].good:
        out.append(f"other distances: all views are {near:.2f} to {far:.2f} m away")
    return out


def recorded_poses(recording: Path) -> tuple[list[Float64], Camera]:
    """Read poses ``T_tof_board`` of a recording's calibration views off the arm and the station's ``[plan]``; nothing is decoded.

    :class:`DataError` where there are no views, or no station.
    """
    path, views = Path(recording) / "station.toml", calibration_views(recording)
    try:
        workcell = workcell_of(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError) as err:
        raise DataError(
            f"{path}: cannot read where the board stands: {err}", hint="record writes it beside the views"
        ) from err
    T_base_board, poses = board_pose(workcell.board, workcell.board_normal), []
    for view in map(open_view, views):
        poses.append(invert(view.arm_before.T_base_flange @ view.rig.T_flange_tof) @ T_base_board)
        camera = view.tof.info.camera
    return poses, camera
