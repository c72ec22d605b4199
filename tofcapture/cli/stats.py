"""``tofcapture stats``: distributions, mask bits and outliers of a dataset, as text, JSON or a page."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tofcapture.command import Command, Outcome

_EVERY = 5.0  # s between lines of progress


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder that build-dataset filled")
    parser.add_argument(
        "--html",
        type=Path,
        nargs="?",
        const=Path("stats.html"),
        metavar="FILE",
        help="write one self-contained page with pictures (default stats.html)",
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.dataset.stats import dataset_stats
    from tofcapture.dataset.stats_page import bit_rows, outlier_rows, quantity_rows, write_stats_page

    start = last = time.monotonic()

    def progress(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > _EVERY:
            last = now
            left = (now - start) / done * (total - done)
            print(f"{done} of {total} views, {left:.0f} s left", file=sys.stderr, flush=True)

    stats = dataset_stats(args.dataset, progress)
    data = stats.table()
    tables = (
        [["quantity", "split", "values", "min", "1 %", "median", "99 %", "max"], *quantity_rows(stats)],
        [["share of pixels", *stats.splits], *(bit_rows(stats) if stats.splits else [])],
        [["view that stands out", "number", "value", "median", "deviations"], *outlier_rows(stats, 10)],
    )
    text = "\n\n".join(_aligned(rows) for rows in tables if len(rows) > 1)
    text += f"\n\n{args.dataset}: {len(stats.views)} views, {len(stats.outliers)} numbers stand out"
    if args.html is not None:
        data["page"] = str(write_stats_page(stats, args.html))
        text += f"\n{args.html}: {args.html.stat().st_size / 1e6:.2f} MB"
    return Outcome(data, text)


def _aligned(rows: list[list[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if i == 0 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


COMMAND = Command(
    help="distributions, mask bits and outliers of a dataset",
    example="tofcapture stats datasets/first --html stats.html",
    configure=_configure,
    run=_run,
)
