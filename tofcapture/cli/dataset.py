"""``tofcapture check``, ``pack`` and ``export-dataset``: what is done with a dataset besides training."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from tofcapture.cli.kit import Command, Outcome, counted, progress
from tofcapture.errors import DataError


def _configure_check(parser: argparse.ArgumentParser) -> None:
    what = "view file, shard, recording, dataset or cache"
    parser.add_argument("path", type=Path, metavar="PATH", help=what)


def _check(args: argparse.Namespace) -> Outcome:
    from tofcapture.files.check import check

    path: Path = args.path
    if not path.exists():
        raise DataError(f"{path}: expected a file or folder, got nothing", hint="tofcapture check PATH")
    total = sum(1 for _ in path.rglob("*.h5")) or 1
    files: list[Path] = []
    with progress() as report:

        def tell(file: Path) -> None:
            report("check", len(files), total, str(file))
            files.append(file)

        problems = check(path, tell)
    rows = [{"path": str(p.path), "where": p.where, "message": p.message, "hint": p.hint} for p in problems]
    lines = [line for p in problems for line in (str(p), f"  try: {p.hint}" if p.hint else "") if line]
    lines.append(
        f"{path}: {counted(len(files), 'file')}, {counted(len(problems), 'problem') if problems else 'ok'}"
    )
    data = {"path": str(path), "ok": not problems, "files": len(files), "problems": rows}
    return Outcome(data, "\n".join(lines), exit_code=5 if problems else 0)


def _configure_pack(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="folder that build-dataset filled")
    add("--split", default="train", metavar="SPLIT", help="train, val or test (default: train)")
    folder = "the cache's folder; completed if it exists"
    add("--out", type=Path, required=True, metavar="DIR", help=folder)


def _pack(args: argparse.Namespace) -> Outcome:
    from tofcapture.files.cache import pack
    from tofcapture.files.manifest import load_manifest

    total = sum(entry.views for entry in load_manifest(args.dataset).split(args.split).values())
    done = 0
    with progress() as report:

        def tell(scene: str, view: int, views: int) -> None:
            nonlocal done
            done += 1
            report("pack", done, total, f"{scene}: view {view} of {views}")

        scenes = pack(args.dataset, args.split, args.out, tell)
    size = sum(scene.path.stat().st_size for scene in scenes.values())
    data = {"cache": str(args.out), "scenes": len(scenes), "views": total, "packed": done, "bytes": size}
    text = f"{args.out}: {counted(total, 'view')} of {counted(len(scenes), 'scene')}, {size / 1e9:.2f} GB, {done} packed now"
    return Outcome(data, text, following=f"tofcapture train {args.dataset} --cache {args.out} --out run")


def _configure_export(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("path", type=Path, metavar="PATH", help="dataset or shard")
    add(
        "--format",
        required=True,
        choices=("ply", "png16", "mcap", "bop", "nerfstudio", "lerobot", "huggingface"),
        dest="kind",
        metavar="FORMAT",
        help="ply, png16, mcap, bop, nerfstudio, lerobot or huggingface",
    )
    add("--out", type=Path, required=True, metavar="DIR", help="folder; completed if it was begun")
    step = "step of PNG depth up to 8.19 m (default: 0.000125)"
    add("--unit", type=float, default=1 / 8000, metavar="M", help=step)


def _export(args: argparse.Namespace) -> Outcome:
    from tofcapture.dataset.export import export

    start = time.monotonic()
    with progress() as report:

        def tell(scene: str, done: int, total: int) -> None:
            report("export", done, total, scene)

        result = export(args.path, args.kind, args.out, unit=args.unit, progress=tell)
    seconds = round(time.monotonic() - start, 2)
    data = {
        "out": str(args.out),
        "format": args.kind,
        "scenes": list(result.scenes),
        "written": list(result.written),
        "files": result.files,
        "bytes": result.size,
        "seconds": seconds,
    }
    text = (
        f"{args.out}: {counted(result.files, 'file')} of {counted(len(result.scenes), 'scene')}, {result.size / 1e6:.2f} MB; "
        f"{len(result.written)} written in {seconds:.1f} s"
    )
    return Outcome(data, text)


CHECK = Command(
    help="list every problem of a view, a shard, a recording, a dataset or a cache",
    example="tofcapture check datasets/first",
    configure=_configure_check,
    run=_check,
)
PACK = Command(
    help="pack one split of a dataset into flat files that training maps into memory",
    example="tofcapture pack datasets/first --split train --out cache",
    configure=_configure_pack,
    run=_pack,
)
EXPORT = Command(
    help="export a dataset or a shard as point clouds, PNG depth, MCAP, or for BOP, nerfstudio, LeRobot, Hugging Face",
    example="tofcapture export-dataset datasets/first --format ply --out clouds",
    configure=_configure_export,
    run=_export,
)
