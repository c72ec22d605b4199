"""``tofcapture calibrate bundle``: where both cameras sit on the flange, from the board views of a recording."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcapture.command import Outcome
from tofcapture.errors import QualityError
from tofcapture.poses import Float64, invert, rotation_log

if TYPE_CHECKING:
    from calibration.board.geometry import Board
    from calibration.bundle import BoardFit, Bundle
    from tofcapture.frames import View
    from tofcapture.rig import Rig

AGREES = 3.0  # standard deviations per degree of freedom between the two rig transforms


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    parser.add_argument("--board", default="default", help="packaged board or a TOML file")
    parser.add_argument(
        "--arm-sigma",
        type=float,
        nargs=2,
        metavar=("M", "RAD"),
        help="standard deviation of an arm pose per axis, metres and radians (default 0.0002 0.00017)",
    )
    parser.add_argument("--dry-run", action="store_true", help="print the result, write nothing")


def run(args: argparse.Namespace) -> Outcome:
    """Detect the board in every view, solve the bundle, write ``T_flange_tof`` into ``rig.toml`` and ``bundle.json``."""
    from calibration.bundle import ARM_SIGMA, solve_bundle
    from tofcapture.files.seal import write_text
    from tofcapture.rig import dumps_rig

    recording = Path(args.recording)
    arm, fits, refused, rig = board_fits(recording, args.board)
    bundle = solve_bundle(arm, fits, tuple(args.arm_sigma or ARM_SIGMA))
    data = {**report(bundle, fits, rig), "refused": refused}
    if not args.dry_run:
        write_text(recording / "bundle.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
        write_text(recording / "rig.toml", dumps_rig(replace(rig, T_flange_tof=bundle.T_flange_tof)))
        data |= {"rig": str(recording / "rig.toml")}
    return Outcome(data=data, text=table(data))


def board_fits(
    recording: Path,
    board: str | Path,
    progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None,
) -> tuple[Float64, list[BoardFit], list[str], Rig]:
    """Fit the board in every calibration view of a recording.

    Returns
    -------
    arm
        (N, 4, 4) T_base_flange.
    fits
        Of both cameras, where the board was found.
    refused
        Why it was not, where it was not.
    rig
        ``rig.toml`` of the recording, or the rig that the first view carries.

    Raises
    ------
    DataError
        No or unreadable views.
    """
    from calibration.board.geometry import load_board
    from calibration.registration.pairs import calibration_views
    from tofcapture.files.view import read_view
    from tofcapture.rig import load_rig

    shape = load_board(board)
    arm, fits, refused = [], [], []
    paths = calibration_views(recording)
    known = recording / "rig.toml"
    rig = load_rig(known) if known.exists() else read_view(paths[0]).rig
    for i, path in enumerate(paths):
        progress("board", i, len(paths))
        view = read_view(path)
        arm.append(view.arm_before.T_base_flange)
        own, why = _fits_of(view, i, shape)
        fits += own
        refused += [f"{path.stem} {text}" for text in why]
    return np.stack(arm), fits, refused, rig


def _fits_of(view: View, index: int, board: Board) -> tuple[list[BoardFit], list[str]]:
    from calibration.board.detector import detect, stereo_sight, tof_sight
    from calibration.bundle import CAMERAS, BoardFit

    fits, refused = [], []
    for camera in CAMERAS:
        try:
            if camera == "tof":
                found = detect(tof_sight(view.tof), board, view.tof.info.camera).fit
            else:
                found = detect(stereo_sight(view.stereo), board, view.stereo.info.camera).fit
        except QualityError as err:
            refused.append(f"{camera}: {err}")
        else:
            fits.append(BoardFit(index, camera, found.T, found.covariance))
    return fits, refused


def report(bundle: Bundle, fits: list[BoardFit], rig: Rig) -> dict[str, Any]:
    """Lay a bundle out as JSON types, with its consistency with the rig's ``T_tof_stereo``."""
    places = {
        "T_flange_tof": bundle.T_flange_tof,
        "T_flange_stereo": bundle.T_flange_stereo,
        "T_base_board": bundle.T_base_board,
    }
    arm = np.sqrt(np.square(bundle.arm.reshape(-1, 2, 3)).mean(axis=(0, 2)))
    return {
        "format": "tofcapture-bundle",
        "version": 1,
        "units": "m",
        **{name: T.tolist() for name, T in places.items()},
        "standard_error": {name: _stated(bundle.sigma(i)) for i, name in enumerate(places)},
        "covariance": bundle.covariance.tolist(),
        "variance_factor": bundle.variance,
        "views": len(bundle.arm),
        "fits": {c: sum(f.camera == c for f in fits) for c in ("tof", "stereo")},
        "outliers": [
            f"view {f.view} {f.camera}" for f, bad in zip(fits, bundle.outliers, strict=True) if bad
        ],
        "arm_rms": {"translation_mm": 1e3 * float(arm[0]), "rotation_deg": float(np.degrees(arm[1]))},
        "motion_deg": np.degrees(bundle.motion).tolist(),
        "rig_check": consistency(bundle, rig.T_tof_stereo),
        "moved": _difference(bundle.T_flange_tof, rig.T_flange_tof),
    }


def consistency(bundle: Bundle, T_tof_stereo: Float64) -> dict[str, Any]:
    """Compare ``X_tof^-1 X_stereo`` with the rig transform that registration found, in the bundle's own standard deviations."""
    D = T_tof_stereo @ invert(bundle.T_tof_stereo)
    off = np.concatenate([T_tof_stereo[:3, 3] - bundle.T_tof_stereo[:3, 3], rotation_log(D[:3, :3])])
    distance = float(np.sqrt(off @ np.linalg.solve(bundle.rig_covariance(), off) / 6))
    return {
        **_difference(bundle.T_tof_stereo, T_tof_stereo),
        "standard_error": _stated(np.sqrt(np.diag(bundle.rig_covariance()))),
        "sigmas": distance,
        "agrees": distance < AGREES,
    }


def _difference(one: Float64, other: Float64) -> dict[str, float]:
    turned = rotation_log(one[:3, :3].T @ other[:3, :3])
    return {
        "translation_mm": 1e3 * float(np.linalg.norm(one[:3, 3] - other[:3, 3])),
        "rotation_deg": float(np.degrees(np.linalg.norm(turned))),
    }


def _stated(sigma: Float64) -> dict[str, list[float]]:
    return {
        "translation_mm": (1e3 * sigma[:3]).tolist(),
        "rotation_deg": np.degrees(sigma[3:]).tolist(),
    }


def table(data: dict[str, Any]) -> str:
    """Lay the report out for a person."""
    lines = [f"{'':18}{'translation mm':>28}{'+- mm':>22}{'+- deg':>24}"]
    for name in ("T_flange_tof", "T_flange_stereo", "T_base_board"):
        t, sigma = 1e3 * np.array(data[name])[:3, 3], data["standard_error"][name]
        lines.append(
            f"{name:18}{_row(t, 9, 2)}{_row(sigma['translation_mm'], 7, 3)}{_row(sigma['rotation_deg'], 8, 4)}"
        )
    check, moved, fits = data["rig_check"], data["moved"], data["fits"]
    outliers = ", ".join(data["outliers"]) or "none"
    verdict = "agrees" if check["agrees"] else "DISAGREES: align again, or look for a loose camera"
    lines.append(f"fits               {fits['tof']} ToF, {fits['stereo']} stereo of {data['views']} views")
    lines.append(f"outliers           {outliers}; covariances scaled by {data['variance_factor']:.1f}")
    lines.append(f"T_flange_tof       moved by {_gap(moved)}")
    lines.append(f"rig transform      {_gap(check)} from the rig's, {check['sigmas']:.1f} sigma: {verdict}")
    return "\n".join([*lines, *(f"refused            {text}" for text in data["refused"])])


def _gap(found: dict[str, Any]) -> str:
    return f"{found['translation_mm']:.2f} mm, {found['rotation_deg']:.3f} deg"


def _row(values: Any, width: int, digits: int) -> str:
    return "  " + " ".join(f"{x:{width}.{digits}f}" for x in values)
