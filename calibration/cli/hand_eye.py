"""``tofcapture calibrate hand-eye``: where a camera sits on the hand or beside the arm, from files of poses or a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.kit import written
from tofcapture.command import Outcome
from tofcapture.errors import DataError, UsageError

if TYPE_CHECKING:
    from calibration.hand_eye.solve import HandEye
    from tofcapture.poses import Float64

STREAM_BLOCKS = 20  # stretches of a stream whose errors are taken as independent


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="PAIRS | HAND TARGET | RECORDING",
        help="one file of pairs (JSON, YAML such as MoveIt's, NPZ, 14 columns); two files of poses (CSV, TUM, JSON, NPY) with times "
        "or pose by pose; or a calibration recording",
    )
    parser.add_argument(
        "--eye-to-hand",
        action="store_true",
        help="the camera stands beside the arm, the target is on the flange",
    )
    parser.add_argument(
        "--inverted-target",
        action="store_true",
        help="the target poses are T_target_camera, not T_camera_target",
    )
    parser.add_argument(
        "--time-offset",
        type=float,
        metavar="S",
        help="of CSV streams: hand at t + S belongs to target at t (found when not given)",
    )
    parser.add_argument("--out", type=Path, metavar="RESULT.json", help="write the result here")


def run(args: argparse.Namespace) -> Outcome:
    """Calibrate from a file of pairs, two streams, or a recording."""
    from calibration.hand_eye.solve import solve_hand_eye, to_dict

    hand, target, extra, blocks = _pairs(args)
    if args.inverted_target and not extra.get("stream"):
        target = _inverted(target)
    result = solve_hand_eye(hand, target, eye_to_hand=args.eye_to_hand, blocks=blocks)
    data = {**to_dict(result), **extra}
    return written(data, _hand_eye_table(result, data), args.out)


def _inverted(poses: Float64) -> Float64:
    from calibration.hand_eye.checks import clean
    from calibration.hand_eye.closed_form import invert_all

    return invert_all(clean(poses, "target poses"))


def _pairs(args: argparse.Namespace) -> tuple[Float64, Float64, dict[str, Any], int | None]:
    from calibration.hand_eye.files import read_pairs_said, read_poses
    from calibration.hand_eye.forms import most_consistent

    paths = args.inputs
    if len(paths) == 1 and paths[0].is_dir():
        from calibration.hand_eye.recording import recording_pairs

        return *recording_pairs(paths[0]), {"camera": "stereo"}, None
    if len(paths) == 1:
        hand, target, said = read_pairs_said(paths[0])
        return hand, target, {"read_as": said} if said else {}, None
    if len(paths) != 2:
        raise UsageError(
            f"expected one file of pairs, one recording, or two files of poses, got {len(paths)} paths"
        )
    one, two = (read_poses(p) for p in paths)
    n, m = (len(next(iter(r.poses.values()))) for r in (one, two))
    t_hand, t_target = one.seconds, two.seconds
    if n == m and args.time_offset is None and _together(t_hand, t_target):
        hand, target, said = most_consistent(
            one, two
        )  # pose by pose, or the same times in both: pairs already
        return hand, target, {"read_as": said} if said else {}, None
    if t_hand is None or t_target is None:
        raise DataError(f"expected as many poses in both files, or times before them, got {n} and {m} poses")
    hand, target = (next(iter(r.poses.values())) for r in (one, two))
    target = _inverted(target) if args.inverted_target else target
    return _stream_pairs((t_hand, hand), (t_target, target), args.time_offset)


def _together(t_hand: Float64 | None, t_target: Float64 | None) -> bool:
    """Whether poses belong together one by one: no times, or the same ones."""
    if t_hand is None or t_target is None:
        return True
    return bool((t_hand == t_target).all())


def _stream_pairs(
    hand: tuple[Float64, Float64], target: tuple[Float64, Float64], given: float | None
) -> tuple[Float64, Float64, dict[str, Any], int]:
    from calibration.hand_eye.closed_form import invert_all
    from calibration.hand_eye.solve import refine_from_consensus
    from calibration.hand_eye.time_offset import coarse_offset, make_stream, pairs_at, refine_offset

    one, two = make_stream(*hand, "hand poses"), make_stream(*target, "target poses")
    found: dict[str, Any] = {"stream": True, "time_offset_s": given}
    if given is None:
        start, correlation = coarse_offset(one, two)
        A, B = pairs_at(one, two, start)
        # The mount and the sense of the target may be wrong here; the gate says so once the clocks are right.
        inverted = (
            refine_from_consensus(invert_all(A), B).log_likelihood
            > refine_from_consensus(A, B).log_likelihood
        )

        def cost(A: Float64, B: Float64) -> float:
            return -refine_from_consensus(invert_all(A) if inverted else A, B).log_likelihood

        offset, sigma = refine_offset(one, two, start, cost)
        found |= {"time_offset_s": offset, "time_offset_sigma_s": number(sigma), "correlation": correlation}
    A, B = pairs_at(one, two, float(found["time_offset_s"]))
    return A, B, found, min(STREAM_BLOCKS, len(A) // 5)


def _hand_eye_table(result: HandEye, data: dict[str, Any]) -> str:
    import numpy as np

    from tofcapture.poses import rotation_log

    name = "T_base_camera" if result.eye_to_hand else "T_flange_camera"
    t, phi = 1e3 * result.X[:3, 3], np.degrees(rotation_log(result.X[:3, :3]))
    lines = [
        f"{name}  {data['mount']}, {data['pairs']} pairs, {len(data['outliers'])} outliers",
        f"  translation mm        {t[0]:10.2f} {t[1]:10.2f} {t[2]:10.2f}",
        f"  rotation vector deg   {phi[0]:10.3f} {phi[1]:10.3f} {phi[2]:10.3f}",
        "                        translation mm   rotation deg",
    ]
    rows = {
        "standard error": data["standard_error"],
        "noise per axis": data["noise"],
        "median residual": data["residual"]["median"],
        "largest residual": data["residual"]["max"],
        "leave one out": data["leave_one_out"],
    }
    for label, value in rows.items():
        shown = "-" if value is None else f"{value['translation_mm']:14.3f} {value['rotation_deg']:14.4f}"
        lines.append(f"  {label:22}{shown}")
    scale = data["target_scale"]
    lines.append(f"  target scale          {scale['factor']:.4f} +- {scale['standard_error']:.4f}")
    lines.append(
        "  rotation of the hand  " + ", ".join(f"{a:.0f}" for a in data["motion_deg"]) + " deg RMS by axis"
    )
    for who, words in data.get("read_as", {}).items():
        lines.append(f"  {who} read as          {words}")
    if "time_offset_s" in data:
        lines.append(f"  time offset           {1e3 * data['time_offset_s']:.1f} ms")
    return "\n".join([*lines, *(f"  look: {text}" for text in data["warnings"])])


def number(value: float) -> float | None:
    """Return the value, or None for NaN, which JSON does not have."""
    return value if value == value else None  # noqa: PLR0124  NaN
