"""``tofcapture view``: look at whatever was recorded, built, predicted or calibrated."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.command import Command, Outcome
from tofcapture.errors import UsageError

if TYPE_CHECKING:
    from tofcapture.viz.shots import Source

_EVERY = 2.0  # s between lines of progress
_SHEET, _RERUN = 12, 100  # shots


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "path",
        type=Path,
        metavar="PATH",
        help="recording, view file, dataset, shard, folder of predict, rig.toml or evidence.json",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--png", type=Path, metavar="FILE", help="write a contact sheet; needs no screen and no Rerun"
    )
    how.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a Rerun file and show nothing")
    how.add_argument("--web", action="store_true", help="show in a browser of this machine, not in a window")
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help=f"show N views at most, spread evenly (default {_SHEET} for --png, else {_RERUN})",
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.viz import open_source

    if args.views is not None and args.views < 1:
        raise UsageError(f"--views: expected 1 or more, got {args.views}")
    source = open_source(args.path)
    if args.png:
        return _sheet(source, args.png, args.views or _SHEET)
    if args.save:
        return _saved(source, args.save, args.views or _RERUN)
    return _shown(source, args.views or _RERUN, web=args.web)


def _sheet(source: Source, path: Path, most: int) -> Outcome:
    from tofcapture.viz.sheet import write_sheet

    shots = write_sheet(source, path, most, _progress("read"))
    return _written(source, path, shots)


def _saved(source: Source, path: Path, most: int) -> Outcome:
    from tofcapture.viz.rerun_file import write_rrd

    shots = write_rrd(source, path, most, _progress("written"))
    return _written(source, path, shots)


def _shown(source: Source, most: int, *, web: bool) -> Outcome:
    from tofcapture.viz.rerun_file import write_rrd
    from tofcapture.viz.web import show_page, show_window

    with tempfile.TemporaryDirectory(prefix="tofcapture-view-") as folder:
        path = Path(folder) / "view.rrd"
        shots = write_rrd(source, path, most, _progress("read"))
        (show_page if web else show_window)(path)
    return Outcome({"title": source.title, "views": len(source.names), "shown": shots})


def _written(source: Source, path: Path, shots: int) -> Outcome:
    data: dict[str, Any] = {
        "title": source.title,
        "views": len(source.names),
        "shown": shots,
        "file": str(path),
    }
    return Outcome(data, f"{path}: {source.title}, {shots} of {len(source.names)} views")


def _progress(done_word: str) -> Callable[[int, int], None]:
    start = last = time.monotonic()

    def tell(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > _EVERY:
            last = now
            left = (now - start) / done * (total - done)
            print(f"{done} of {total} views {done_word}, {left:.0f} s left", file=sys.stderr, flush=True)

    return tell


COMMAND = Command(
    help="look at a recording, a view, a dataset, a shard, a prediction or a calibration",
    example="tofcapture view recordings/mug --png sheet.png",
    configure=_configure,
    run=_run,
)
