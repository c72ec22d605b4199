"""``tofcapture check``: list every problem of a view, a shard, a recording, a dataset or a cache."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tofcapture.command import Command, Outcome
from tofcapture.errors import ConfigError

_EVERY = 5.0  # s between lines of progress


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "path", type=Path, metavar="PATH", help="view file, shard, recording, dataset or cache"
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.files.check import check

    path: Path = args.path
    if not path.exists():
        raise ConfigError(
            f"{path}: expected a file or folder, found nothing there", hint="tofcapture check PATH"
        )
    counted: list[Path] = []
    last = time.monotonic()

    def progress(file: Path) -> None:
        nonlocal last
        counted.append(file)
        if time.monotonic() - last > _EVERY:
            last = time.monotonic()
            print(f"checking {file} ({len(counted)} files so far)", file=sys.stderr, flush=True)

    problems = check(path, progress)
    rows = [{"path": str(p.path), "where": p.where, "message": p.message, "hint": p.hint} for p in problems]
    lines = [line for p in problems for line in (str(p), f"  try: {p.hint}" if p.hint else "") if line]
    lines.append(
        f"{path}: {len(counted)} files, {len(problems)} problems"
        if problems
        else f"{path}: {len(counted)} files, ok"
    )
    data = {"path": str(path), "ok": not problems, "files": len(counted), "problems": rows}
    return Outcome(data, "\n".join(lines), exit_code=5 if problems else 0)


COMMAND = Command(
    help="list every problem of a view, a shard, a recording, a dataset or a cache",
    example="tofcapture check datasets/first",
    configure=_configure,
    run=_run,
)
