"""``tofcapture export-dataset``: point clouds, 16-bit PNG depth or MCAP from a dataset or a shard."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tofcapture.command import Command, Outcome


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, metavar="PATH", help="dataset or shard")
    parser.add_argument("--format", required=True, choices=("ply", "png16", "mcap"), dest="kind")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder; completed if it was begun"
    )
    parser.add_argument(
        "--unit",
        type=float,
        default=1 / 8000,
        metavar="METRES",
        help="step of PNG depth (default 0.000125: up to 8.19 m; 0.0001 holds 6.55 m)",
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.dataset.export import export

    start = time.monotonic()

    def progress(scene: str, done: int, total: int) -> None:
        left = (time.monotonic() - start) / done * (total - done)
        print(f"{scene}: {done} of {total} scenes, {left:.0f} s left", file=sys.stderr, flush=True)

    result = export(args.path, args.kind, args.out, unit=args.unit, progress=progress)
    seconds = time.monotonic() - start
    data = {
        "out": str(args.out),
        "format": args.kind,
        "scenes": list(result.scenes),
        "written": list(result.written),
        "files": result.files,
        "bytes": result.size,
        "seconds": round(seconds, 2),
    }
    text = (
        f"{args.out}: {result.files} files of {len(result.scenes)} scenes, {result.size / 1e6:.2f} MB; "
        f"{len(result.written)} scenes written in {seconds:.1f} s"
    )
    return Outcome(data, text)


COMMAND = Command(
    help="export a dataset or a shard as point clouds, 16-bit PNG depth or MCAP",
    example="tofcapture export-dataset datasets/first --format ply --out clouds",
    configure=_configure,
    run=_run,
)
