"""``tofcapture figure``: figures for papers and slides, drawn from data."""

from __future__ import annotations

import argparse
from pathlib import Path

from tofcapture.command import Command, Outcome
from tofcapture.errors import UsageError

KINDS = ("acquisition", "preprocessing", "depth", "normals")
_ONLY = {
    "prediction": ("depth", "normals"),
    "rows": ("depth", "normals"),
    "rig": ("preprocessing",),
}


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", choices=KINDS, metavar="KIND", help=", ".join(KINDS))
    parser.add_argument(
        "path",
        type=Path,
        metavar="PATH",
        help="acquisition: a recording; preprocessing: a view file or a recording; depth, normals: a dataset or a shard",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="of the figure: .png, .pdf or .svg"
    )
    parser.add_argument("--scene", metavar="NAME", help="this scene (default: the first, or one a row)")
    parser.add_argument(
        "--view",
        type=int,
        metavar="N",
        help="view N of a recording's scene or of a shard (default: the first)",
    )
    parser.add_argument("--rows", type=int, metavar="N", help="depth, normals: N scenes at most (default 4)")
    parser.add_argument(
        "--prediction",
        type=Path,
        metavar="DIR",
        help="depth, normals: folder that predict wrote, or one with SCENE-000/ of each scene",
    )
    parser.add_argument(
        "--rig", type=Path, metavar="FILE", help="preprocessing: rig.toml (default: the recording's)"
    )


def _run(args: argparse.Namespace) -> Outcome:
    for name, kinds in _ONLY.items():
        if getattr(args, name) is not None and args.kind not in kinds:
            raise UsageError(f"--{name}: only for {' and '.join(kinds)}, not for {args.kind}")
    if args.rows is not None and args.rows < 1:
        raise UsageError(f"--rows: expected 1 or more, got {args.rows}")
    if args.view is not None and args.view < 0:
        raise UsageError(f"--view: expected 0 or more, got {args.view}")
    from tofcapture.viz.figures.write import Choice, write_figure

    choice = Choice(args.scene, args.view, args.rows or 4, args.prediction, args.rig)
    words = write_figure(args.kind, args.path, args.out, choice)
    return Outcome({"kind": args.kind, "file": str(args.out), "shows": words}, f"{args.out}: {words}")


COMMAND = Command(
    help="draw a figure for a paper from a recording or a dataset",
    example="tofcapture figure depth datasets/first --prediction predictions --out depth.pdf",
    configure=_configure,
    run=_run,
)
