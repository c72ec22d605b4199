"""``tofcapture view``, ``figure`` and ``stats``: look at what was recorded, built, predicted or calibrated."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from tofcapture.cli.kit import Command, Outcome, counted, progress, table
from tofcapture.errors import UsageError

if TYPE_CHECKING:
    from tofcapture.viz.shots import Source

KINDS = ("acquisition", "preprocessing", "depth", "normals")
_ONLY = {"prediction": ("depth", "normals"), "rows": ("depth", "normals"), "rig": ("preprocessing",)}
_SHEET, _RERUN = 12, 100  # shots


def _configure_view(parser: argparse.ArgumentParser) -> None:
    add, how = parser.add_argument, parser.add_mutually_exclusive_group()
    path = "recording, view file, dataset, shard, folder of predict, rig.toml or evidence.json"
    add("path", type=Path, metavar="PATH", help=path)
    sheet = "write a contact sheet; needs no screen and no Rerun"
    how.add_argument("--png", type=Path, metavar="FILE.png", help=sheet)
    how.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a Rerun file and show nothing")
    how.add_argument("--web", action="store_true", help="show in a browser of this machine, not in a window")
    most = f"show N views at most, spread evenly (default: {_SHEET} for --png, else {_RERUN})"
    add("--views", type=int, metavar="N", help=most)


def _view(args: argparse.Namespace) -> Outcome:
    from tofcapture.viz import open_source
    from tofcapture.viz.web import show_page, show_window

    if args.views is not None and args.views < 1:
        raise UsageError(f"--views: expected 1 or more, got {args.views}")
    for option, path, ending in (("--png", args.png, ".png"), ("--save", args.save, ".rrd")):
        if path and path.suffix != ending:
            said = f"{option}: expected a name that ends in {ending}, got {path}"
            raise UsageError(said, hint=f"{option} {path.with_suffix(ending)}")
    source = open_source(args.path)
    if args.png:
        return _written(source, args.png, args.views or _SHEET, as_sheet=True)
    if args.save:
        return _written(source, args.save, args.views or _RERUN)
    with tempfile.TemporaryDirectory(prefix="tofcapture-view-") as folder:
        path = Path(folder) / "view.rrd"
        outcome = _written(source, path, args.views or _RERUN)
        (show_page if args.web else show_window)(path)
    return Outcome({key: value for key, value in outcome.data.items() if key != "file"})


def _written(source: Source, path: Path, most: int, *, as_sheet: bool = False) -> Outcome:
    from tofcapture.viz.rerun_file import write_rrd
    from tofcapture.viz.sheet import write_sheet

    with progress() as report:
        write = write_sheet if as_sheet else write_rrd
        shots = write(source, path, most, lambda done, total: report("views", done, total))
    views = len(source.names)
    data = {"title": source.title, "views": views, "shown": shots, "file": str(path)}
    shown = f", {shots} of {counted(views, 'view')}" if views else ""
    return Outcome(data, f"{path}: {source.title}{shown}")


def _configure_figure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("kind", choices=KINDS, metavar="KIND", help=", ".join(KINDS))
    path = "acquisition: a recording; preprocessing: a view file or a recording; depth, normals: a dataset or a shard"
    add("path", type=Path, metavar="PATH", help=path)
    add("--out", type=Path, required=True, metavar="FILE", help="of the figure: .png, .pdf or .svg")
    add("--scene", metavar="NAME", help="this scene (default: the first, or one a row)")
    view = "view N of a recording's scene or of a shard (default: the first)"
    add("--view", type=int, metavar="N", help=view)
    add("--rows", type=int, metavar="N", help="depth, normals: N scenes at most (default: 4)")
    folder = "depth, normals: folder that predict wrote, or one with SCENE-000/ of each scene"
    add("--prediction", type=Path, metavar="DIR", help=folder)
    add("--rig", type=Path, metavar="RIG.toml", help="preprocessing: rig.toml (default: the recording's)")


def _figure(args: argparse.Namespace) -> Outcome:
    for name, kinds in _ONLY.items():
        if getattr(args, name) is not None and args.kind not in kinds:
            raise UsageError(f"--{name}: only for {' and '.join(kinds)}, not for {args.kind}")
    if args.rows is not None and args.rows < 1:
        raise UsageError(f"--rows: expected 1 or more, got {args.rows}")
    if args.view is not None and args.view < 0:
        raise UsageError(f"--view: expected 0 or more, got {args.view}")
    from tofcapture.viz.figures import Choice, write_figure

    choice = Choice(args.scene, args.view, args.rows or 4, args.prediction, args.rig)
    words = write_figure(args.kind, args.path, args.out, choice)
    return Outcome({"kind": args.kind, "file": str(args.out), "shows": words}, f"{args.out}: {words}")


def _configure_stats(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="folder that build-dataset filled")
    page, text = Path("stats.html"), "write one self-contained page with pictures (default: stats.html)"
    add("--html", type=Path, nargs="?", const=page, metavar="FILE.html", help=text)


def _stats(args: argparse.Namespace) -> Outcome:
    from tofcapture.dataset.stats import dataset_stats
    from tofcapture.viz.stats import TABLES, bit_rows, outlier_rows, quantity_rows, write_stats_page

    with progress() as report:
        stats = dataset_stats(args.dataset, lambda done, total: report("views", done, total))
    data = stats.table()
    tables = (
        (TABLES["quantities"], quantity_rows(stats)),
        (["share of pixels", *stats.splits], bit_rows(stats)),
        (TABLES["outliers"], outlier_rows(stats, 10)),
    )
    text = "\n\n".join(table(header, rows) for header, rows in tables if rows)
    text += (
        f"\n\n{args.dataset}: {counted(len(stats.views), 'view')}, {len(stats.outliers)} numbers stand out"
    )
    if args.html is not None:
        data["page"] = str(write_stats_page(stats, args.html))
        text += f"\n{args.html}: {args.html.stat().st_size / 1e6:.2f} MB"
    return Outcome(data, text)


VIEW = Command(
    help="look at a recording, a view, a dataset, a shard, a prediction or a calibration",
    example="tofcapture view recordings/mug --png sheet.png",
    configure=_configure_view,
    run=_view,
)
FIGURE = Command(
    help="draw a figure for a paper from a recording or a dataset",
    example="tofcapture figure depth datasets/first --prediction predictions --out depth.pdf",
    configure=_configure_figure,
    run=_figure,
)
STATS = Command(
    help="distributions, mask bits and outliers of a dataset",
    example="tofcapture stats datasets/first --html stats.html",
    configure=_configure_stats,
    run=_stats,
)
