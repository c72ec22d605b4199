"""``tofcapture import``: data that others took, to a recording."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.kit import Command, Outcome, counted, progress, table
from tofcapture.errors import ConfigError

if TYPE_CHECKING:
    from tofcapture.importing.said import Said


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "sources",
        nargs="+",
        type=Path,
        metavar="SOURCE",
        help="files or folders: arrays, images, raw words, bags",
    )
    add("--out", type=Path, metavar="RECORDING", help="folder of the recording")
    camera = "ToF intrinsics: fx,fy,cx,cy[,k1,k2,p1,p2,k3], or a file (rig.toml, OpenCV, ROS)"
    add("--camera", metavar="CAMERA", help=camera)
    add("--scene", metavar="NAME", help="name of the scene (default: as the files are called)")
    said = "what the files do not say (default: import.toml in SOURCE)"
    add("--config", type=Path, metavar="FILE.toml", help=said)
    add(
        "--saturation",
        type=float,
        metavar="COUNTS",
        help="at which the sensor saturates (default: 4095, 12 bits)",
    )
    add(
        "--unit",
        choices=("m", "cm", "mm"),
        metavar="UNIT",
        help="of the ground truth: m, cm or mm (default: m)",
    )
    add("--layout", metavar="NAME", help="of a camera's raw bytes; an unknown one lists all")
    add("--shape", metavar="H,W", help="image size of .raw files, rows of metadata included")


def _said(args: argparse.Namespace, source: Path) -> Said:
    """Lay the options over what ``import.toml`` says."""
    from tofcapture.importing.views import said_of

    said = said_of(source, args.config)
    tof: dict[str, Any] = {} if args.saturation is None else {"saturation": args.saturation}
    raw: dict[str, Any] = {} if args.layout is None else {"layout": args.layout}
    if args.shape:
        try:
            raw["shape"] = [int(n) for n in args.shape.split(",")]
        except ValueError as err:
            raise ConfigError(f"--shape: expected H,W such as 180,240, got {args.shape!r}") from err
    if args.camera:
        from tofcapture.importing.cameras import camera_keys

        tof |= camera_keys(args.camera)
    truth = {"unit": args.unit} if args.unit else {}
    return replace(
        said,
        scene=args.scene or said.scene,
        tof={**said.tof, **tof},
        raw={**said.raw, **raw},
        truth={**said.truth, **truth},
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.importing.views import Imported, import_data

    if args.out is None:
        raise ConfigError(
            "expected --out RECORDING", hint=f"tofcapture import {args.sources[0]} --out recordings/mine"
        )
    result = Imported(args.out)
    with progress() as report:
        for source in args.sources:
            one = import_data(
                [source],
                args.out,
                _said(args, source),
                lambda s, done, total: report("import", done, total, s),
            )
            result.scenes |= one.scenes
            result.skipped += one.skipped
            result.warnings += one.warnings
    for text in result.warnings:
        print(f"tofcapture: {text}", file=sys.stderr)
    data = {
        "recording": str(args.out),
        "scenes": result.scenes,
        "skipped": result.skipped,
        "warnings": result.warnings,
    }
    views = sum(result.scenes.values())
    lines = [table(("scene", "views"), sorted(result.scenes.items()))]
    lines += [f"{args.out}: {counted(len(result.scenes), 'scene')}, {counted(views, 'view')}"]
    if result.skipped:
        lines.append(f"{counted(len(result.skipped), 'scene')} already imported")
    return Outcome(data, "\n".join(lines), following=f"tofcapture build-dataset {args.out} --out dataset")


COMMAND = Command(
    help="turn data that others took into a recording",
    example="tofcapture import mydata --camera 190.6,200.8,116.8,101.5 --out recordings/mine",
    configure=_configure,
    run=_run,
)
