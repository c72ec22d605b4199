"""``tofcapture calibrate hand-eye | bundle | board | coverage``: where the cameras sit on the arm, and the board that tells it."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.cli.sensor import add_recording, believed_rig, read_views, saved
from tofcapture.cli import kit
from tofcapture.cli.kit import Outcome
from tofcapture.errors import DataError, QualityError, UsageError
from tofcapture.poses import Float64, invert_all, rotation_log

if TYPE_CHECKING:
    from calibration.board.geometry import Board
    from calibration.bundle import BoardFit
    from calibration.hand_eye.solve import HandEye
    from tofcapture.frames import View


def configure_hand_eye(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="PAIRS | HAND TARGET | RECORDING",
        help="one file of pairs (JSON, YAML such as MoveIt's, NPZ, 14 columns); two files of poses (CSV, TUM, JSON, NPY) with times "
        "or pose by pose; or a calibration recording",
    )
    for flag, words in (
        ("--eye-to-hand", "the camera stands beside the arm, the target is on the flange"),
        ("--inverted-target", "the target poses are T_target_camera, not T_camera_target"),
    ):
        parser.add_argument(flag, action="store_true", help=words)
    parser.add_argument(
        "--time-offset",
        type=float,
        metavar="S",
        help="of CSV streams: hand at t + S belongs to target at t (found when not given)",
    )
    parser.add_argument(
        "--target-scale",
        metavar="free|FACTOR",
        help="the target's distances times FACTOR are believed (1: as given), or whatever fits (free); else a size that the pairs "
        "contradict by 3 sigma and 1 percent is solved for and fails",
    )
    parser.add_argument(
        "--read-as",
        action="append",
        default=[],
        metavar="SIDE=WORDS",
        help="how numbers are meant, where files do not say: hand=ZYX,deg or target=wxyz,mm or both=cm",
    )
    parser.add_argument(
        "--board",
        metavar="BOARD",
        help="of a recording: the ToF camera's poses of this board, packaged or a TOML file (default: the stereo camera's clouds)",
    )
    parser.add_argument("--out", type=Path, metavar="RESULT.json", help="write the result here")


def run_hand_eye(args: argparse.Namespace) -> Outcome:
    """Calibrate from a file of pairs, two streams, or a recording."""
    from calibration.hand_eye.solve import solve_hand_eye, to_dict

    hand, target, extra = _pairs(args)
    free = args.target_scale == "free"
    result = solve_hand_eye(
        hand,
        target,
        eye_to_hand=args.eye_to_hand,
        free_scale=free,
        target_scale=None if free else _factor(args.target_scale),
    )
    data = {**to_dict(result), **extra}
    if extra.get("rivals") and data["verdict"] == "PASS":
        data["verdict"] = "WARN"
    outcome = kit.written(data, _hand_eye_table(result, data), args.out)
    return replace(outcome, exit_code=QualityError.exit_code if result.failures else 0)


def _factor(text: str | None) -> float | None:
    try:
        factor = None if text is None else float(text)
    except ValueError:
        factor = -1.0
    if factor is not None and not 0 < factor < np.inf:
        raise UsageError(f"--target-scale: expected free or a factor above 0 such as 1, got {text!r}")
    return factor


def _pairs(args: argparse.Namespace) -> tuple[Float64, Float64, dict[str, Any]]:
    """Hand and target poses, and what is said of them."""
    from calibration.hand_eye.files import read_pairs, read_poses
    from calibration.hand_eye.pairs import decided, recording_pairs
    from calibration.hand_eye.readings import agreed

    paths = args.inputs
    if len(paths) == 1 and paths[0].is_dir() and args.board:
        hand, target, refused = _board_pairs(paths[0], args.board)
        return hand, _turned(target, args), {"camera": "tof", "refused": refused}
    if len(paths) == 1 and paths[0].is_dir():
        with kit.progress() as progress:
            hand, target = recording_pairs(paths[0], progress)
        return hand, _turned(target, args), {"camera": "stereo"}
    if len(paths) > 2:
        raise UsageError(
            f"expected one file of pairs, one recording, or two files of poses, got {len(paths)} paths"
        )
    one, two = read_pairs(paths[0]) if len(paths) == 1 else (read_poses(p) for p in paths)
    one, two = one.narrowed(_read_as(args, "hand")), two.narrowed(_read_as(args, "target"))
    timed = one.seconds is not None and two.seconds is not None
    # Pose by pose, or the same times in both: pairs already.
    together = not timed or bool(np.array_equal(one.seconds, two.seconds))  # type: ignore[arg-type]
    if len(one) == len(two) and args.time_offset is None and together:
        hand, target, meant = agreed(one, two)
        return hand, _turned(target, args), meant.report()
    if one.seconds is None or two.seconds is None:
        raise DataError(
            f"expected as many poses in both files, or times before them, got {len(one)} and {len(two)} poses"
        )
    hand, target, found = decided(
        one, replace(two, inverted=two.inverted ^ args.inverted_target), args.time_offset
    )
    return hand, target, {"stream": True, **found}


def _read_as(args: argparse.Namespace, side: str) -> list[str]:
    """Words that ``--read-as hand=ZYX,deg`` says of a side."""
    words: list[str] = []
    for given in args.read_as:
        who, _, what = given.partition("=")
        if who not in {"hand", "target", "both"} or not what:
            raise UsageError(f"--read-as: expected hand=..., target=... or both=..., got {given!r}")
        words += what.split(",") if who in {side, "both"} else []
    return words


def _board_pairs(recording: Path, name: str) -> tuple[Float64, Float64, list[str]]:
    """Poses of the hand, and of a board in the ToF camera, of a recording's views; and why others have none."""
    from calibration.board.geometry import load_board
    from calibration.board.seen import must_be_unique, seen_by_tof

    board = load_board(name)
    must_be_unique(board)
    hand, target, refused = [], [], []
    for path, view in read_views(recording, "board"):
        try:
            target.append(seen_by_tof(view.tof, board, view.tof.info.camera).fit.T)
            hand.append(view.arm_before.T_base_flange)
        except QualityError as err:
            refused.append(f"{path.stem} {err}")
    if len(hand) < 3:
        raise QualityError(
            f"{recording}: expected the board in at least 3 views, got {len(hand)}: {'; '.join(refused)}"
        )
    return np.stack(hand), np.stack(target), refused


def _turned(target: Float64, args: argparse.Namespace) -> Float64:
    from calibration.hand_eye.checks import clean

    return invert_all(clean(target, "target poses")) if args.inverted_target else target


def _hand_eye_table(result: HandEye, data: dict[str, Any]) -> str:
    name = "T_base_camera" if result.eye_to_hand else "T_flange_camera"
    t, phi = 1e3 * result.X[:3, 3], np.degrees(rotation_log(result.X[:3, :3]))
    values = {
        "standard error": data["standard_error"],
        "noise per axis": data["noise"],
        "median residual": data["residual"]["median"],
        "largest residual": data["residual"]["max"],
        "leave one out": data["leave_one_out"],
    }
    rows = [
        (label, f"{v['translation_mm']:.3f}", f"{v['rotation_deg']:.4f}") if v else (label, "-", "-")
        for label, v in values.items()
    ]
    scale, best = data["target_scale"], data["optimum"]
    lines = [
        f"{name}  {data['mount']}, {data['pairs']} pairs, {len(data['outliers'])} outliers",
        f"  translation mm        {_numbers(t, 10, 2)}",
        f"  rotation vector deg   {_numbers(phi, 10, 3)}",
        kit.table(("", "translation mm", "rotation deg"), rows, "  "),
        f"  target scale          {scale['factor']:.4f} +- {scale['standard_error']:.4f}, solved with {scale['used']:.4f}",
        (
            f"  optimum               best of {best['starts']} starts, {best['ended_here']} ended there; no rotation farther than "
            f"{best['certified_rotation_deg']:.2f} deg fits as well"
        ),
        "  rotation of the hand  " + ", ".join(f"{a:.0f}" for a in data["motion_deg"]) + " deg RMS by axis",
    ]
    lines += [f"  {who} read as          {words}" for who, words in data.get("read_as", {}).items()]
    if "time_offset_s" in data:
        lines.append(f"  time offset           {1e3 * data['time_offset_s']:.1f} ms")
        lines += [f"  {who + ' clock':22}{'; '.join(words)}" for who, words in data["clocks"].items()]
    lines += [f"  rival reading         {words}" for words in data.get("rivals", ())]
    lines += [f"  FAIL: {text}" for text in data["failures"]]
    if result.failures:
        lines.append("        (--target-scale free uses the size that fits, --target-scale 1 the given one)")
    return "\n".join(
        [*lines, *(f"  look: {text}" for text in data["warnings"]), f"verdict: {data['verdict']}"]
    )


def _numbers(values: Any, width: int, digits: int) -> str:
    return " ".join(f"{x:{width}.{digits}f}" for x in values)


def configure_bundle(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_recording(parser, board=True)
    parser.add_argument(
        "--arm-sigma",
        type=float,
        nargs=2,
        metavar=("M", "RAD"),
        help="standard deviation of an arm pose per axis, metres and radians (default: 0.0002 0.00017)",
    )


def run_bundle(args: argparse.Namespace) -> Outcome:
    """Detect the board in every view, solve the bundle, write ``T_flange_tof`` into ``rig.toml`` and ``bundle.json``."""
    from calibration.board.geometry import load_board
    from calibration.bundle import ARM_SIGMA, bundle_report, solve_bundle

    board, rig = load_board(args.board), believed_rig(args.recording)
    arm, fits, refused = [], [], []
    for i, (path, view) in enumerate(read_views(args.recording, "board")):
        arm.append(view.arm_before.T_base_flange)
        own, why = _fits_of(view, i, board)
        fits += own
        refused += [f"{path.stem} {text}" for text in why]
    bundle = solve_bundle(np.stack(arm), fits, tuple(args.arm_sigma or ARM_SIGMA))
    data = {**bundle_report(bundle, fits, rig), "refused": refused}
    found = replace(rig, T_flange_tof=bundle.T_flange_tof)
    return saved(args, "bundle.json", data, found, bundle_table(data))


def _fits_of(view: View, index: int, board: Board) -> tuple[list[BoardFit], list[str]]:
    """Board fits of both cameras in a view, and why a camera has none."""
    from calibration.board.seen import must_be_unique, seen_by_stereo, seen_by_tof
    from calibration.bundle import CAMERAS, BoardFit

    must_be_unique(board)
    fits, refused, start = [], [], None
    for camera in CAMERAS:
        try:
            if camera == "tof":
                found = seen_by_tof(view.tof, board, view.tof.info.camera).fit
                start = view.rig.T_stereo_tof @ found.T
            else:
                found = seen_by_stereo(view.stereo, board, start)
        except QualityError as err:
            refused.append(f"{camera}: {err}")
        else:
            fits.append(BoardFit(index, camera, found.T, found.covariance))
    return fits, refused


def bundle_table(data: dict[str, Any]) -> str:
    """Lay the report out for a person."""
    rows = [
        (
            name,
            _numbers(1e3 * np.array(data[name])[:3, 3], 9, 2),
            _numbers(data["standard_error"][name]["translation_mm"], 7, 3),
            _numbers(data["standard_error"][name]["rotation_deg"], 8, 4),
        )
        for name in ("T_flange_tof", "T_flange_stereo", "T_base_board")
    ]
    check, moved, fits = data["rig_check"], data["moved"], data["fits"]
    verdict = "agrees" if check["agrees"] else "DISAGREES: align again, or look for a loose camera"
    lines = [
        kit.table(("", "translation mm", "+- mm", "+- deg"), rows),
        f"fits               {fits['tof']} ToF, {fits['stereo']} stereo of {data['views']} views",
        f"outliers           {', '.join(data['outliers']) or 'none'}; covariances scaled by {data['variance_factor']:.1f}",
        f"T_flange_tof       moved by {_gap(moved)}",
        f"rig transform      {_gap(check)} from the rig's, {check['sigmas']:.1f} sigma: {verdict}",
    ]
    return "\n".join([*lines, *(f"refused            {text}" for text in data["refused"])])


def _gap(found: dict[str, Any]) -> str:
    return f"{found['translation_mm']:.2f} mm, {found['rotation_deg']:.3f} deg"
