"""``tofcapture pack``: one split of a dataset as flat files that training maps into memory."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tofcapture.command import Command, Outcome

_EVERY = 5.0  # s between lines of progress


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder that build-dataset filled")
    parser.add_argument("--split", default="train", help="train, val or test (default train)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="CACHE", help="the cache's folder; completed if it exists"
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.files.cache import pack
    from tofcapture.files.manifest import load_manifest

    total = sum(entry.views for entry in load_manifest(args.dataset).split(args.split).values())
    start = last = time.monotonic()
    done = 0

    def progress(scene: str, view: int, views: int) -> None:
        nonlocal done, last
        done += 1
        now = time.monotonic()
        if now - last > _EVERY:
            last = now
            left = (now - start) / done * (total - done)
            print(f"{scene}: view {view} of {views}, {left:.0f} s left", file=sys.stderr, flush=True)

    scenes = pack(args.dataset, args.split, args.out, progress)
    size = sum(scene.path.stat().st_size for scene in scenes.values())
    data = {"cache": str(args.out), "scenes": len(scenes), "views": total, "packed": done, "bytes": size}
    text = f"{args.out}: {total} views of {len(scenes)} scenes, {size / 1e9:.2f} GB, {done} views packed now"
    return Outcome(data, text)


COMMAND = Command(
    help="pack one split of a dataset into flat files that training maps into memory",
    example="tofcapture pack datasets/first --split train --out cache",
    configure=_configure,
    run=_run,
)
