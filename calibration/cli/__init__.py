"""``tofcapture calibrate``: one part of a station at a time. Each part is loaded when it is asked for."""

from __future__ import annotations

import argparse
from importlib import import_module

from tofcapture.cli.kit import Command, Outcome

# Where each part's ``configure_*`` and ``run_*`` are, and what it does.
_PARTS = {
    "hand-eye": ("cli.hand_eye", "where a camera sits on the hand, or beside the arm, from pairs of poses"),
    "phase-order": ("cli.sensor", "which frequency and phase each channel of unknown raw frames has"),
    "bundle": (
        "cli.hand_eye",
        "where both cameras sit on the flange, from the arm's poses and the board in all calibration views",
    ),
    "lens": (
        "cli.sensor",
        "the ToF camera's intrinsics and distortion from the board's edges in its own images",
    ),
    "range": (
        "cli.sensor",
        "what the ToF camera measures too long, per frequency, from board views at many distances",
    ),
    "board": ("board.drawing", "draw the board to print or cut it"),
    "coverage": ("board.coverage", "what the board views of a recording cover, and what is missing"),
}


def _configure(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="what", metavar="WHAT", required=True, parser_class=type(parser))
    for name, (module, text) in _PARTS.items():
        part = kinds.add_parser(name, help=text, description=text)
        held, word = import_module(f"calibration.{module}"), name.replace("-", "_")
        getattr(held, f"configure_{word}")(part)
        part.set_defaults(part=getattr(held, f"run_{word}"))


def _run(args: argparse.Namespace) -> Outcome:
    outcome: Outcome = args.part(args)
    return outcome


CALIBRATE = Command(
    help="calibrate one part: hand-eye, bundle, lens, range, phase-order, board, coverage",
    example="tofcapture calibrate hand-eye pose_samples.json --eye-to-hand --out hand-eye.json",
    configure=_configure,
    run=_run,
)
