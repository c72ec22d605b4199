"""``tofcapture calibrate lens``: the ToF camera's intrinsics and distortion from the board views of a recording."""

from __future__ import annotations

import argparse
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcapture.command import Outcome
from tofcapture.errors import ConfigError, QualityError

if TYPE_CHECKING:
    from calibration.board.geometry import Board
    from calibration.lens.board import BoardLens, BoardSeen
    from tofcapture.frames import View
    from tofcapture.rig import Rig

GOOD = {"rms": 0.4, "left_out": 0.5, "pixel_sigma": 0.3, "coverage": 0.75}
BEARABLE = {"rms": 0.8, "left_out": 1.0, "pixel_sigma": 1.0, "coverage": 0.5}
WORSE = 1.2  # times the first look's error: one of the boards found in addition is another one
CAUSES = {
    "rms": "a bent board, another board's file, or a camera that moved during the exposure",
    "left_out": "too few views for this lens, or one bad view",
    "pixel_sigma": "more views, tilted 20 to 40 degrees in all directions, at several distances",
    "coverage": "views with the board's edge in every corner of the image",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    parser.add_argument("--board", default="default", help="packaged board or a TOML file")
    parser.add_argument("--dry-run", action="store_true", help="print the result, write nothing")


def run(args: argparse.Namespace) -> Outcome:
    """Fit the lens, write it into ``rig.toml`` and ``lens.json``."""
    from calibration.board.fit import Model
    from calibration.board.geometry import load_board
    from calibration.lens.board import fit_lens_to_board
    from tofcapture.files.seal import write_text
    from tofcapture.rig import dumps_rig

    recording, board = Path(args.recording), load_board(args.board)
    rig = believed_rig(recording)
    views, refused = seen_boards(recording, board, rig)
    fit = fit_lens_to_board(Model(board), views, rig.tof)
    if refused:  # with a wrong lens a board may look like another one: once more with the one that was found
        again, still = seen_boards(recording, board, replace(rig, tof=fit.camera))
        if len(again) > len(views):
            with suppress(ConfigError, QualityError):  # the first fit stands
                second = fit_lens_to_board(Model(board), again, rig.tof)
                refused, fit = (still, second) if second.rms < WORSE * fit.rms else (refused, fit)
    data = {**report(fit, rig), "refused": refused}
    if not args.dry_run:
        write_text(recording / "lens.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
        write_text(recording / "rig.toml", dumps_rig(replace(rig, tof=fit.camera)))
        data |= {"rig": str(recording / "rig.toml")}
    return Outcome(data=data, text=table(data))


def believed_rig(recording: Path) -> Rig:
    """Rig to start from: what was aligned or calibrated before, else what the first view says."""
    from calibration.registration.pairs import calibration_views
    from tofcapture.files.view import read_view
    from tofcapture.rig import load_rig

    path = recording / "rig.toml"
    return load_rig(path) if path.exists() else read_view(calibration_views(recording)[0]).rig


def seen_boards(recording: Path, board: Board, rig: Rig) -> tuple[list[BoardSeen], list[str]]:
    """Rims of every view whose board is found, and why it was not elsewhere."""
    from calibration.cli.align import _progress
    from calibration.registration.pairs import calibration_views
    from tofcapture.files.view import read_view

    paths, found, refused = calibration_views(recording), [], []
    with _progress() as progress:
        for i, path in enumerate(paths):
            progress("board", i, len(paths))
            try:
                found.append(board_seen(read_view(path), rig, board, path.stem))
            except QualityError as err:
                refused.append(f"{path.stem} {err}")
    return found, refused


def board_seen(view: View, rig: Rig, board: Board, name: str) -> BoardSeen:
    """Find the board with the believed lens; keep its rims as pixels, which no lens has touched.

    Raises
    ------
    QualityError
        The board is not found.
    """
    from calibration.board.detector import NEAR_PLANE, detect, tof_sight
    from calibration.lens.board import BoardSeen

    burst = replace(view.tof, info=replace(view.tof.info, camera=rig.tof))
    sight = tof_sight(burst)
    T = detect(sight, board, rig.tof).T_camera_board
    height = (sight.rims - T[:3, 3]) @ T[:3, 2]
    rims = sight.rims[np.abs(height) < NEAR_PLANE]
    return BoardSeen(name, rig.tof.project(rims)[0], T)


def report(fit: BoardLens, rig: Rig) -> dict[str, Any]:
    """Lay a fit out as JSON types."""
    from calibration.lens.board import NAMES, _values
    from calibration.limits import Limit

    judged = {
        "rms": fit.rms,
        "left_out": float(np.sqrt(np.mean(np.square(fit.left_out)))),
        "pixel_sigma": fit.pixel_sigma,
        "coverage": float(fit.coverage.min()),
    }
    verdicts = {k: Limit(k, GOOD[k], BEARABLE[k], "px", CAUSES[k]).verdict(v) for k, v in judged.items()}
    return {
        "format": "tofcapture-lens-calibration",
        "version": 1,
        "views": len(fit.left_out),
        "model": fit.model,
        "lens": {
            name: {"value": float(v), "sigma": float(s), "before": float(b)}
            for name, v, s, b in zip(NAMES, _values(fit.camera), fit.sigma, _values(rig.tof), strict=True)
        },
        **judged,
        "left_out_px": fit.left_out.tolist(),
        "growth_px": fit.growth,
        "verdicts": verdicts,
        "verdict": next(v for v in ("FAIL", "WARN", "PASS") if v in verdicts.values()),
        "look": [f"{k} {v}: {CAUSES[k]}" for k, v in verdicts.items() if v != "PASS"]
        + ["the rig transform was aligned with the lens before: run tofcapture align again"],
    }


def table(data: dict[str, Any]) -> str:
    """Lay a report out for a person."""
    held = data["model"] == "pinhole" and any(
        data["lens"][k]["value"] for k in ("k1", "k2", "p1", "p2", "k3")
    )
    model = "distortion as before" if held else data["model"]
    lines = [f"{data['views']} views, {len(data['refused'])} refused; lens: {model}"]
    lines += [
        f"  {name:4}{v['value']:12.5g} +- {v['sigma']:<10.2g} before {v['before']:.5g}"
        for name, v in data["lens"].items()
        if v["sigma"] or v["value"]
    ]
    lines.append(
        f"rims lie {data['rms']:.2f} px off the edges, {data['left_out']:.2f} at views left out; a ray is known to "
        f"{data['pixel_sigma']:.2f} px; {100 * data['coverage']:.0f} % of the image covered"
    )
    return "\n".join(
        [*lines, *data["refused"], *(f"look: {t}" for t in data["look"]), f"verdict: {data['verdict']}"]
    )
