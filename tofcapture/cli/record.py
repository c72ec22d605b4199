"""``tofcapture record``: take the views of a scene, or of the calibration board.

A running daemon that keeps the recording gets the work; otherwise the recorder runs here.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.config import station_path
from tofcapture.command import Command, Outcome
from tofcapture.errors import MotionRefused

if TYPE_CHECKING:
    from tofcapture.devices.station import Station
    from tofcapture.record.plan import Plan
    from tofcapture.record.recorder import RecordResult

_SCENE_VIEWS, _BOARD_VIEWS = 25, 12


def _configure(parser: argparse.ArgumentParser) -> None:
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--scene", metavar="NAME", help="what stands on the table; names its folder in the recording"
    )
    what.add_argument("--calibration", action="store_true", help="views of the calibration board, for align")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="RECORDING",
        help="folder to record into; resumed when it exists",
    )
    parser.add_argument(
        "--views",
        type=int,
        help=f"number of views (default {_SCENE_VIEWS}, {_BOARD_VIEWS} for --calibration)",
    )
    parser.add_argument("--frames", type=int, default=10, help="ToF frames of each burst (default 10)")
    parser.add_argument(
        "--station", type=Path, metavar="TOML", help="devices to use (default: all simulated)"
    )
    parser.add_argument("--seed", type=int, help="seed of the simulated world and of the view plan")
    parser.add_argument(
        "--turns",
        type=int,
        default=1,
        metavar="N",
        help="have the object turned by hand between views, N ways in all (default 1: it stays)",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="print the plan and draw it; nothing moves, nothing is recorded",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="SVG", help="where --dry-run draws it (default: beside RECORDING)"
    )
    parser.add_argument(
        "--allow-motion",
        action="store_true",
        help="let a real arm move in this run (rehearse the plan first); simulated arms need no leave",
    )
    parser.add_argument(
        "--foreground", action="store_true", help="record here, also when a daemon keeps this recording"
    )


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.devices.station import open_station
    from tofcapture.frames import CALIBRATION
    from tofcapture.record.plan import plan_scene
    from tofcapture.record.recorder import record

    scene = CALIBRATION if args.calibration else args.scene
    args.station = station_path(args.station)[0]
    views = args.views if args.views is not None else _BOARD_VIEWS if args.calibration else _SCENE_VIEWS
    if (handed := _handed_over(args, scene, views)) is not None:
        return handed
    with open_station(args.station, args.seed, allow_motion=args.allow_motion) as station:
        if args.dry_run:
            return _planned(args, scene, station, plan_scene(station, scene, views, args.turns))
        _check_motion(station, allowed=args.allow_motion)
        with progress_line(f"record {scene}") as progress:
            show = progress
            if args.calibration:
                show = _metered(progress, station, args.out, plan_scene(station, scene, views))
            result = record(
                station, scene, args.out, views=views, frames=args.frames, progress=show, turns=args.turns
            )
    return _recorded(args.out, result)


def _metered(
    progress: Callable[[int, int], None], station: Station, recording: Path, plan: Plan
) -> Callable[[int, int], None]:
    """Print what the board views cover after each one."""
    from tofcapture.devices.clearance import stage_of
    from tofcapture.frames import CALIBRATION
    from tofcapture.record.board_meter import meter, taken

    stage, rig, said = stage_of(station.config), station.rig, [-1]

    def show(done: int, total: int) -> None:
        progress(done, total)
        flanges = taken(plan, recording, CALIBRATION)
        if len(flanges) not in {said[0], 0}:
            said[0] = len(flanges)
            poses = [T @ rig.T_flange_tof for T in flanges]
            print(meter(poses, stage.board, stage.board_normal, rig.tof), file=sys.stderr, flush=True)

    return show


def _check_motion(station: Station, *, allowed: bool) -> None:
    """Ask for consent before a real arm moves."""
    if not (station.simulated or allowed):
        raise MotionRefused(
            f"the arm {station.arm.describe().model} is real and --allow-motion was not given",
            hint="look at --dry-run, clear the workspace, then add --allow-motion",
        )


def _handed_over(args: argparse.Namespace, scene: str, views: int) -> Outcome | None:
    """Give the work to a daemon; ``None`` when there is none for it, or something was asked for that only works here."""
    if args.dry_run or args.foreground or args.station is not None or args.turns != 1:
        return None
    from tofcapture.record.daemon.client import hand_over

    wish = {"scene": scene, "views": views, "frames": args.frames}
    if args.seed is not None:
        wish["seed"] = args.seed
    job = hand_over(args.out, wish)
    if job is None:
        return None
    text = f"job {job['id']} of the daemon that keeps {args.out}: {job['state']}. tofcapture status shows how it goes."
    return Outcome(data={"ok": True, "recording": str(args.out), "scene": scene, "job": job}, text=text)


def _planned(args: argparse.Namespace, scene: str, station: Station, plan: Plan) -> Outcome:
    """Print the plan, draw it."""
    from tofcapture.devices.clearance import stage_of
    from tofcapture.viz.plan import write_plan

    stage = stage_of(station.config)
    picture = args.picture or args.out.parent / f"{args.out.name}-{scene}-plan.svg"
    target = stage.board if args.calibration else stage.target
    title = f"{scene}: {len(plan.views)} views, {station.arm.describe().model}"
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_plan(plan, stage, station.rig, target, title, picture)
    return Outcome(
        data={"ok": True, "scene": scene, "plan": plan.as_json(), "picture": str(picture)},
        text="\n".join([plan.summary(), *_plan_rows(plan), *plan.shortfall(), f"drawn in {picture}"]),
    )


def _plan_rows(plan: Plan) -> list[str]:
    """One line for each view, in the order of travel."""
    import math

    rows = ["view   turn  distance   tilt   from    joints (deg)"]
    for v in plan.views:
        x, y, z = (float(c) for c in v.direction)
        tilt, side = math.degrees(math.acos(min(1.0, z))), math.degrees(math.atan2(y, x))
        joints = " ".join(f"{math.degrees(q):+7.1f}" for q in v.joints)
        turn = math.degrees(v.turn)
        rows.append(f"{v.index:4d}  {turn:5.0f}  {v.distance:6.3f} m  {tilt:5.0f}  {side:+5.0f}   {joints}")
    return rows


def _recorded(recording: Path, result: RecordResult) -> Outcome:
    taken, kept = len(result.recorded), len(result.kept)
    lines = [*result.repaired, *result.reasons, *result.notes]
    if not taken and not result.failed:
        lines.append(f"nothing to record: {kept} views of {result.scene!r} are there")
    else:
        lines.append(
            f"{taken} views of {result.scene!r} recorded, {kept} were there, {len(result.failed)} failed: {recording}"
        )
    lines += result.plan.shortfall()
    data: dict[str, Any] = {
        "ok": not result.failed,
        "recording": str(recording),
        "scene": result.scene,
        "recorded": list(result.recorded),
        "kept": list(result.kept),
        "failed": list(result.failed),
        "reasons": list(result.reasons),
        "notes": list(result.notes),
        "repaired": list(result.repaired),
        "plan": {"digest": result.plan.digest, "views": len(result.plan.views), "wanted": result.plan.wanted},
    }
    return Outcome(data=data, text="\n".join(lines), exit_code=4 if result.failed else 0)


@contextmanager
def progress_line(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress on stderr: a bar with ETA on a terminal, otherwise a line for every tenth of the way.

    Yields
    ------
    function of (done, total)
    """
    if sys.stderr.isatty():
        yield from _bar(title)
    else:
        yield _lines(title)


def _bar(title: str) -> Iterator[Callable[[int, int], None]]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=None)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield show


def _lines(title: str) -> Callable[[int, int], None]:
    start = time.monotonic()
    first: list[int] = []
    said = [-1]

    def show(done: int, total: int) -> None:
        first[:] = first or [done]
        tenth = 10 * done // max(total, 1)
        if tenth == said[0]:
            return
        said[0] = tenth
        gone = time.monotonic() - start
        eta = f", ETA {gone / (done - first[0]) * (total - done):.0f} s" if first[0] < done < total else ""
        print(f"{title}: {done}/{total}{eta}", file=sys.stderr, flush=True)

    return show


COMMAND = Command(
    help="capture the views of a scene or of the calibration board; resumable",
    example="tofcapture record --scene mug --out recordings/mug",
    configure=_configure,
    run=_run,
)
