"""``tofcapture import``: data that others took, to a recording. ``tofcapture rig``: constants of a rig."""

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
    add("--dry-run", action="store_true", help="write nothing: say how each array is read, with a picture")
    add("--picture", type=Path, metavar="FILE.png", help="of --dry-run (default: import.png)")
    add(
        "--guess",
        action="store_true",
        help="write a first import.toml into SOURCE from what is seen, no more",
    )
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


def _guess(sources: list[Path]) -> Outcome:
    """Write a first ``import.toml`` beside or into every source."""
    from tofcapture.files.seal import write_text
    from tofcapture.importing.look import guess
    from tofcapture.importing.said import NAME

    written = [(s if s.is_dir() else s.parent) / NAME for s in sources]
    if there := [path for path in written if path.exists()]:
        raise ConfigError(f"{there[0]}: is there already", hint="edit it, or move it away")
    texts = [guess(source) for source in sources]
    for path, text in zip(written, texts, strict=True):
        write_text(path, text)
    names = [str(path) for path in written]
    told = "\n".join(f"{path}\n{text}" for path, text in zip(names, texts, strict=True))
    return Outcome({"written": names}, told, following=f"tofcapture import {sources[0]} --dry-run")


def _dry_run(args: argparse.Namespace) -> Outcome:
    """Say how each array is read, and draw amplitude, depth and the overlap of the ground truth."""
    from tofcapture.channels import channels_in_words
    from tofcapture.importing.look import look
    from tofcapture.viz.sheet import write_sheet
    from tofcapture.viz.shots import Panel, Shot, Source

    found = [one for source in args.sources for one in look(source, _said(args, source))]
    for text in dict.fromkeys(w for one in found for w in one.overlap.warnings):
        print(f"tofcapture: {text}", file=sys.stderr)

    def shot(i: int) -> Shot:
        over = found[i].overlap
        panels = (
            Panel("amplitude", "amplitude", over.amplitude),
            Panel("ToF depth", "depth", over.tof),
            Panel("ground truth", "depth", over.truth),
            Panel("truth less ToF", "error", 1e3 * (over.truth - over.tof)),
        )
        return Shot(found[i].row()[0], panels)

    picture = args.picture or Path("import.png")
    rows = [one.row() for one in found]
    write_sheet(
        Source(args.sources[0].name, [r[0] for r in rows], shot), picture, 6, lambda _done, _total: None
    )
    info = found[0].view.tof.info
    head = ("view", "raw", "read as", "ground truth", "as", "overlap", "truth less ToF mm")
    lines = [
        table(head, rows),
        f"channels: {channels_in_words(info.modulation_hz, info.phase_rad)}",
        str(picture),
    ]
    data = {"views": [dict(zip(head, r, strict=True)) for r in rows], "picture": str(picture)}
    return Outcome(data, "\n".join(lines), following=f"tofcapture import {args.sources[0]} --out recording")


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.importing.views import Imported, import_data

    if args.guess:
        return _guess(args.sources)
    if args.dry_run:
        return _dry_run(args)
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
            result.placed &= one.placed
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
    built, aligned = f"build-dataset {args.out} --out dataset", f"align {args.out} --initial none"
    following = f"tofcapture {built if result.placed else aligned}"
    return Outcome(data, "\n".join(lines), following=following)


_CAMERA = "fx,fy,cx,cy[,k1,k2,p1,p2,k3], or a file of Kalibr, ROS, OpenCV or COLMAP"


def _configure_rig(parser: argparse.ArgumentParser) -> None:
    subs = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    out: dict[str, Any] = {
        "type": Path,
        "default": Path("rig.toml"),
        "metavar": "RIG.toml",
        "help": "file to write (default: rig.toml)",
    }
    size: dict[str, Any] = {"metavar": "H,W", "help": "image size, where the camera does not say it"}
    for name, text in (
        ("init", "write the rig of a ToF camera"),
        ("convert", "write a rig from another tool's camera"),
    ):
        sub = subs.add_parser(name, help=text, description=text)
        if name == "init":
            sub.add_argument("--camera", required=True, metavar="CAMERA", help=_CAMERA)
        else:
            sub.add_argument("camera", metavar="CAMERA", help=_CAMERA)
        sub.add_argument("--size", **size)
        sub.add_argument("--out", **out)
    show = subs.add_parser("show", help="say what a rig holds", description="say what a rig holds")
    show.add_argument("camera", metavar="CAMERA", help=f"rig.toml, {_CAMERA}")
    show.add_argument("--size", **size)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    try:
        height, width = (int(n) for n in text.split(","))
    except ValueError as err:
        raise ConfigError(f"--size: expected H,W such as 180,240, got {text!r}") from err
    return height, width


def _run_rig(args: argparse.Namespace) -> Outcome:
    import numpy as np

    from tofcapture.files.seal import write_text
    from tofcapture.importing.rigs import tof_rig
    from tofcapture.rig import dumps_rig, rig_to_dict

    rig = tof_rig(args.camera, _size(args.size))
    if args.what != "show":
        if args.out.exists():
            raise ConfigError(f"{args.out}: is there already", hint="name another file: --out")
        write_text(args.out, dumps_rig(rig))
    rows = []
    for name, c in (("tof", rig.tof), ("stereo", rig.stereo)):
        angles = [2 * np.degrees(np.arctan(n / 2 / f)) for n, f in ((c.width, c.fx), (c.height, c.fy))]
        numbers = [f"{x:.2f}" for x in (c.fx, c.fy, c.cx, c.cy)]
        rows.append(
            (
                name,
                f"{c.width} x {c.height}",
                *numbers,
                f"{angles[0]:.1f} x {angles[1]:.1f}",
                len(c.distortion),
            )
        )
    head = ("camera", "pixels", "fx", "fy", "cx", "cy", "view deg", "lens terms")
    lines = [table(head, rows)]
    for name, T in (("T_tof_stereo", rig.T_tof_stereo), ("T_flange_tof", rig.T_flange_tof)):
        place = " ".join(f"{1e3 * x:.1f}" for x in T[:3, 3])
        lines.append(f"{name}: identity" if np.array_equal(T, np.eye(4)) else f"{name}: at {place} mm")
    lines += [
        f"range error at {e.modulation_hz / 1e6:g} MHz: offset {1e3 * e.offset:.1f} mm"
        for e in rig.range_errors
    ]
    if args.what != "show":
        lines.append(str(args.out))
    return Outcome(rig_to_dict(rig), "\n".join(lines))


IMPORT = Command(
    help="turn data that others took into a recording",
    example="tofcapture import mydata --camera 190.6,200.8,116.8,101.5 --out recordings/mine",
    configure=_configure,
    run=_run,
)

RIG = Command(
    help="write, show and convert the constants of a rig",
    example="tofcapture rig init --camera 190.6,200.8,116.8,101.5 --size 180,240",
    configure=_configure_rig,
    run=_run_rig,
)
