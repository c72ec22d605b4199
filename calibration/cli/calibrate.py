"""``tofcapture calibrate``: hand-eye, bundle, lens, range, phase order, board, coverage."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from tofcapture.command import Command, Outcome


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
    from calibration.board.drawing import run_board

    return run_board(args)


def _configure_coverage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    parser.add_argument("--board", default="default", help="packaged board or a TOML file")


def _run_coverage(args: argparse.Namespace) -> Outcome:
    from calibration.board.coverage import run_coverage

    return run_coverage(args)


Configure = Callable[[argparse.ArgumentParser], None]
Run = Callable[[argparse.Namespace], Outcome]


def _own(module: str) -> tuple[Configure, Run]:
    """``configure`` and ``run`` of a module that is loaded when asked for."""
    return (
        lambda parser: import_module(f"calibration.{module}").configure(parser),
        lambda args: import_module(f"calibration.{module}").run(args),
    )


_PARTS: dict[str, tuple[str, Configure, Run]] = {
    "hand-eye": (
        "where a camera sits on the hand, or beside the arm, from pairs of poses",
        *_own("cli.hand_eye"),
    ),
    "phase-order": (
        "which frequency and phase each channel of unknown raw frames has",
        *_own("cli.phase_order"),
    ),
    "bundle": (
        "where both cameras sit on the flange, from the arm's poses and the board in all calibration views",
        *_own("cli.bundle"),
    ),
    "lens": (
        "the ToF camera's intrinsics and distortion from the board's edges in its own images",
        *_own("cli.lens"),
    ),
    "range": (
        "what the ToF camera measures too long, per frequency, from board views at many distances",
        *_own("cli.range"),
    ),
    "board": ("draw the board to print or cut it", _configure_board, _run_board),
    "coverage": (
        "what the board views of a recording cover, and what is missing",
        _configure_coverage,
        _run_coverage,
    ),
}

COMMAND = Command(
    help="calibrate one part: hand-eye, bundle, lens, range, phase-order, board, coverage",
    example="tofcapture calibrate hand-eye pose_samples.json --eye-to-hand --out hand-eye.json",
    configure=_configure,
    run=_run,
)
