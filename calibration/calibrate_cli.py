"""``tofcapture calibrate``: hand-eye, phase order, board, coverage."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.command import Command, Outcome
from tofcapture.errors import DataError, FormatError, UsageError

if TYPE_CHECKING:
    from calibration.hand_eye import HandEye
    from calibration.phase_order import PhaseOrder
    from tofcapture.poses import Float64

STREAM_BLOCKS = 20  # stretches of a stream whose errors are taken as independent


def _configure(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="what", metavar="WHAT", required=True, parser_class=type(parser))
    for name, (text, configure, run) in _PARTS.items():
        part = kinds.add_parser(name, help=text, description=text)
        configure(part)
        part.add_argument("--json", action="store_true", help="print the result as one JSON object")
        part.set_defaults(part=run)


def _run(args: argparse.Namespace) -> Outcome:
    outcome: Outcome = args.part(args)
    return outcome


def _configure_hand_eye(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="PAIRS.json | HAND.csv TARGET.csv | RECORDING",
        help="JSON list of [hand 4x4, target 4x4]; or two CSV files t,x,y,z,qx,qy,qz,qw; or a calibration recording",
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


def run_hand_eye(args: argparse.Namespace) -> Outcome:
    """Calibrate from a file of pairs, two streams, or a recording."""
    from calibration.hand_eye import solve_hand_eye, to_dict

    hand, target, extra, blocks = _pairs(args)
    if args.inverted_target and not extra.get("stream"):
        target = _inverted(target)
    result = solve_hand_eye(hand, target, eye_to_hand=args.eye_to_hand, blocks=blocks)
    data = {**to_dict(result), **extra}
    return _written(data, _hand_eye_table(result, data), args.out)


def _inverted(poses: Float64) -> Float64:
    from calibration.hand_eye_checks import clean
    from calibration.hand_eye_closed import invert_all

    return invert_all(clean(poses, "target poses"))


def _pairs(args: argparse.Namespace) -> tuple[Float64, Float64, dict[str, Any], int | None]:
    from calibration.hand_eye_files import read_csv, read_pairs

    paths = args.inputs
    if len(paths) == 1 and paths[0].is_dir():
        from calibration.hand_eye_recording import recording_pairs

        return *recording_pairs(paths[0]), {"camera": "stereo"}, None
    if len(paths) == 1:
        return *read_pairs(paths[0]), {}, None
    if len(paths) != 2:
        raise UsageError(f"expected one JSON file, one recording, or two CSV files, got {len(paths)} paths")
    (t_hand, hand), (t_target, target) = (read_csv(p) for p in paths)
    if t_hand.shape == t_target.shape and (t_hand == t_target).all() and args.time_offset is None:
        return hand, target, {}, None  # the same times in both: pairs already
    target = _inverted(target) if args.inverted_target else target
    return _stream_pairs((t_hand, hand), (t_target, target), args.time_offset)


def _stream_pairs(
    hand: tuple[Float64, Float64], target: tuple[Float64, Float64], given: float | None
) -> tuple[Float64, Float64, dict[str, Any], int]:
    from calibration.hand_eye import refine_from_consensus
    from calibration.hand_eye_closed import invert_all
    from calibration.time_offset import coarse_offset, make_stream, pairs_at, refine_offset

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
        found |= {"time_offset_s": offset, "time_offset_sigma_s": _number(sigma), "correlation": correlation}
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
    if "time_offset_s" in data:
        lines.append(f"  time offset           {1e3 * data['time_offset_s']:.1f} ms")
    return "\n".join([*lines, *(f"  look: {text}" for text in data["warnings"])])


def _number(value: float) -> float | None:
    return value if value == value else None  # noqa: PLR0124  NaN is not JSON


def _configure_phase_order(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "raw", type=Path, metavar="RAW.npy", help="(frames, K, H, W) or (K, H, W), K = 4 per frequency"
    )
    parser.add_argument(
        "--mhz", default="20,100", metavar="F[,F]", help="modulation frequencies in MHz (default 20,100)"
    )
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="RADIAL.npy",
        help="(H, W) known distances along the rays, metres, NaN unknown",
    )
    parser.add_argument("--out", type=Path, metavar="RESULT.json", help="write the result here")


def run_phase_order(args: argparse.Namespace) -> Outcome:
    """Find frequency, order, sign and start of the phases of raw frames."""
    from calibration.phase_order import find_phase_order

    try:
        hz = [1e6 * float(f) for f in args.mhz.split(",")]
    except ValueError as err:
        raise UsageError(f"--mhz: expected numbers such as 20,100, got {args.mhz!r}") from err
    reference = None if args.reference is None else _array(args.reference)
    order = find_phase_order(_array(args.raw), hz, reference)
    data = {"format": "tofcapture-phase-order", "version": 1, **_order_dict(order)}
    return _written(data, _order_table(order), args.out)


def _order_dict(order: PhaseOrder) -> dict[str, Any]:
    from dataclasses import asdict

    data = asdict(order)
    data["offset_rad"] = [_number(x) for x in order.offset_rad]
    return data


def _order_table(order: PhaseOrder) -> str:
    import math

    lines = ["channel   MHz   phase deg"]
    lines += [
        f"{k:7d}{f / 1e6:6g}{math.degrees(p):12.0f}"
        for k, (f, p) in enumerate(zip(order.modulation_hz, order.phase_rad, strict=True))
    ]
    lines.append(f"sign from {order.sign_from}, confidence {order.confidence:.2f}")
    lines.append(f"second harmonic {order.second_harmonic:.3f}, concentration {order.concentration:.3f}")
    if not order.start_known:
        lines.append(
            "look: the start tap is assumed; ranges hold up to a quarter period, pass --reference to settle it"
        )
    return "\n".join(lines)


def _array(path: Path) -> Any:
    import numpy as np

    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (ValueError, EOFError, OSError) as err:
        raise FormatError(f"{path}: expected an array in .npy format, got {err}") from err


def _written(data: dict[str, Any], text: str, out: Path | None) -> Outcome:
    if out is not None:
        from calibration.evidence import write_atomically

        write_atomically(out, json.dumps(data, indent=1, allow_nan=False) + "\n")
        data, text = {**data, "out": str(out)}, f"{text}\n{out}"
    return Outcome(data=data, text=text)


def _configure_board(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--board",
        default="default",
        help="packaged board (default, second) or a TOML file; see docs/board.md",
    )
    for kind, words in (("svg", "to print"), ("dxf", "to cut, R12"), ("stl", "to print in 3-D")):
        parser.add_argument(
            f"--{kind}", type=Path, metavar="OUT", help=f"write the drawing {words}, true scale"
        )


def _run_board(args: argparse.Namespace) -> Outcome:
    from calibration.board_drawing import run_board

    return run_board(args)


def _configure_coverage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    parser.add_argument("--board", default="default", help="packaged board or a TOML file")


def _run_coverage(args: argparse.Namespace) -> Outcome:
    from calibration.coverage import run_coverage

    return run_coverage(args)


Part = tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], Outcome]]

_PARTS: dict[str, Part] = {
    "hand-eye": (
        "where a camera sits on the hand, or beside the arm, from pairs of poses",
        _configure_hand_eye,
        run_hand_eye,
    ),
    "phase-order": (
        "which frequency and phase each channel of unknown raw frames has",
        _configure_phase_order,
        run_phase_order,
    ),
    "board": ("draw the board to print or cut it", _configure_board, _run_board),
    "coverage": (
        "what the board views of a recording cover, and what is missing",
        _configure_coverage,
        _run_coverage,
    ),
}

COMMAND = Command(
    help="calibrate one part: hand-eye, phase-order, board, coverage",
    example="tofcapture calibrate hand-eye pose_samples.json --eye-to-hand --out hand-eye.json",
    configure=_configure,
    run=_run,
)
