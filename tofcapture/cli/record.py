"""``tofcapture record``: take the views of a scene, or of the calibration board.

A running daemon that keeps the recording gets the work; otherwise the recorder runs here.
"""

from __future__ import annotations

import argparse
import math
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.kit import Command, Outcome, counted, progress, table
from tofcapture.cli.setup import station_path
from tofcapture.record.observer import Observer

if TYPE_CHECKING:
    from tofcapture.devices.station import Station
    from tofcapture.frames import View
    from tofcapture.record.plan import Plan
    from tofcapture.record.recorder import RecordResult

_SCENE_VIEWS, _BOARD_VIEWS = 25, 12


def _configure(parser: argparse.ArgumentParser) -> None:
    add, what = parser.add_argument, parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--scene", metavar="NAME", help="what stands on the table; names its folder")
    what.add_argument("--calibration", action="store_true", help="views of the calibration board, for align")
    into = "folder to record into; resumed when it exists"
    add("--out", type=Path, required=True, metavar="RECORDING", help=into)
    number = f"number of views (default: {_SCENE_VIEWS}, {_BOARD_VIEWS} for --calibration)"
    add("--views", type=int, metavar="N", help=number)
    add("--frames", type=int, default=10, metavar="N", help="ToF frames of each burst (default: 10)")
    add("--station", type=Path, metavar="STATION.toml", help="devices to use (default: all simulated)")
    add("--seed", type=int, metavar="N", help="seed of the simulated world and of the view plan")
    turned = "have the object turned by hand between views, N ways in all (default: 1, it stays)"
    add("--turns", type=int, default=1, metavar="N", help=turned)
    add("--dry-run", action="store_true", help="print the plan and draw it; nothing moves or is recorded")
    again = "take view N again, and no other; the one before is kept beside it"
    add("--retake", type=int, metavar="N", help=again)
    drawn = "where --dry-run draws it (default: beside RECORDING)"
    add("--picture", type=Path, metavar="FILE.svg", help=drawn)
    leave = "let a real arm move in this run (rehearse the plan first); simulated arms need no leave"
    add("--allow-motion", action="store_true", help=leave)
    add("--foreground", action="store_true", help="record here, also when a daemon keeps this recording")


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.devices.station import open_station
    from tofcapture.frames import CALIBRATION
    from tofcapture.record.plan import plan_scene
    from tofcapture.record.recorder import record
    from tofcapture.record.resources import check_motion_allowed
    from tofcapture.record.stopping import stoppable

    scene = CALIBRATION if args.calibration else args.scene
    station_file = station_path(args.station)[0]
    views = args.views if args.views is not None else _BOARD_VIEWS if args.calibration else _SCENE_VIEWS
    here = args.dry_run or args.foreground or station_file is not None or args.turns != 1
    if not here and (handed := _handed_over(args, scene, views)):
        return handed
    with (
        stoppable(f"{scene} into {args.out.absolute()}") as stop,
        open_station(station_file, args.seed, allow_motion=args.allow_motion) as station,
    ):
        stop.check()
        if args.dry_run:
            return _planned(args, scene, station, plan_scene(station, scene, views, args.turns))
        hint = "look at --dry-run, clear the workspace, then add --allow-motion"
        check_motion_allowed(station, args.allow_motion, hint)
        meter = _BoardMeter(station) if args.calibration and not station.arm.by_hand else None
        with progress() as report:
            tell = partial(report, f"record {scene}")
            result = record(
                station, scene, args.out, views, args.frames, tell, meter, args.turns, args.retake
            )
    return _recorded(args.out, result)


class _BoardMeter(Observer):
    """Prints what the board views cover after each one."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._there: list[int] = []

    def planned(self, plan: Plan, kept: set[int], repaired: list[str]) -> None:
        """Note where the views are taken from."""
        del repaired
        T_flange_tof = self._station.rig.T_flange_tof
        self._poses = {view.index: view.T_base_flange @ T_flange_tof for view in plan.views}
        self._there = sorted(kept)

    def sealed(self, view: View, sha256: str) -> None:
        """Print the meter."""
        from tofcapture.devices.clearance import workcell_of
        from tofcapture.poses import invert
        from tofcapture.record.quality import board_pose, coverage, meter

        del sha256
        self._there.append(view.index)
        workcell, camera = workcell_of(self._station.config), self._station.rig.tof
        T_base_board = board_pose(workcell.board, workcell.board_normal)
        found = coverage([invert(self._poses[i]) @ T_base_board for i in self._there], camera)
        print(meter(found), file=sys.stderr, flush=True)


def _handed_over(args: argparse.Namespace, scene: str, views: int) -> Outcome | None:
    """Give the work to the daemon that keeps this recording; ``None`` when there is none."""
    from tofcapture.record.daemon.client import hand_over

    request = {"scene": scene, "views": views, "frames": args.frames, "clear": args.allow_motion}
    request |= {key: n for key in ("seed", "retake") if (n := getattr(args, key)) is not None}
    job = hand_over(args.out, request)
    if job is None:
        return None
    text = f"job {job['id']} of the daemon that keeps {args.out}: {job['state']}. tofcapture status shows how it goes."
    return Outcome(data={"ok": True, "recording": str(args.out), "scene": scene, "job": job}, text=text)


def _planned(args: argparse.Namespace, scene: str, station: Station, plan: Plan) -> Outcome:
    """Print the plan, draw it."""
    if station.arm.by_hand:
        text = f"{counted(len(plan.views), 'view')}: a person brings the rig to each; nothing moves by itself"
        data = {"ok": True, "scene": scene, "plan": plan.as_json()}
        return Outcome(data, "\n".join([text, *plan.shortfall()]))
    from tofcapture.devices.clearance import workcell_of
    from tofcapture.viz.plan import write_plan

    workcell = workcell_of(station.config)
    picture = args.picture or args.out.parent / f"{args.out.name}-{scene}-plan.svg"
    target = workcell.board if args.calibration else workcell.target
    title = f"{scene}, {station.arm.describe().model}"
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_plan(plan, workcell, station.rig, target, title, picture)
    proof = _proof(station, plan)
    lines = [plan.summary(), _plan_table(plan), *plan.shortfall(), proof["text"], f"drawn in {picture}"]
    data = {
        "ok": proof["ok"],
        "scene": scene,
        "plan": plan.as_json(),
        "proof": proof,
        "picture": str(picture),
    }
    return Outcome(data=data, text="\n".join(lines), exit_code=0 if proof["ok"] else 4)


def _proof(station: Station, plan: Plan) -> dict[str, Any]:
    """Check every motion of a plan, from where the arm stands, as the arm will before it moves."""
    from tofcapture.errors import MotionRefused
    from tofcapture.record.plan import prove

    try:
        ways = prove(station, plan)
    except MotionRefused as err:
        return {"ok": False, "text": f"NOT to be recorded: {err.message}\n  try: {err.hint}"}
    motions, by_home = sum(map(len, ways)), sum(len(way) > 1 for way in ways)
    text = f"{motions} motions, {by_home} views by way of home, all allowed by the checks of the arm's driver"
    return {"ok": True, "text": text, "motions": motions, "by_home": by_home}


def _plan_table(plan: Plan) -> str:
    """Lay out one line for each view, in the order of travel."""
    rows = []
    for v in plan.views:
        x, y, z = (float(c) for c in v.direction)
        tilt, side = math.degrees(math.acos(min(1.0, z))), math.degrees(math.atan2(y, x))
        joints = " ".join(f"{math.degrees(q):+7.1f}" for q in v.joints)
        angles = f"{math.degrees(v.turn):.0f}", f"{v.distance:.3f} m", f"{tilt:.0f}", f"{side:+.0f}"
        seen = "-" if math.isnan(v.coverage) else f"{v.coverage:.0%}"
        rows.append([v.index, *angles, seen, joints])
    return table(["view", "turn", "distance", "tilt", "from", "covered", "joints (deg)"], rows)


def _recorded(recording: Path, result: RecordResult) -> Outcome:
    from tofcapture.frames import CALIBRATION

    taken, kept, plan = len(result.recorded), len(result.kept), result.plan
    lines = [*result.repaired, *result.reasons, *result.notes]
    if taken or result.failed:
        failed = f"{len(result.failed)} failed: {recording}"
        lines.append(f"{counted(taken, 'view')} of {result.scene!r} recorded, {kept} there before, {failed}")
    else:
        lines.append(f"nothing to record: all {counted(kept, 'view')} of {result.scene!r} are there")
    lines += plan.shortfall()
    data = {key: value for key, value in vars(result).items() if key != "plan"}
    planned = {"digest": plan.digest, "views": len(plan.views), "wanted": plan.wanted}
    data |= {"ok": not result.failed, "recording": str(recording), "plan": planned}
    board = result.scene == CALIBRATION
    following = (
        f"tofcapture align {recording}" if board else f"tofcapture build-dataset {recording} --out dataset"
    )
    return Outcome(data, "\n".join(lines), 4 if result.failed else 0, following)


COMMAND = Command(
    help="capture the views of a scene or of the calibration board; resumable",
    example="tofcapture record --scene mug --out recordings/mug",
    configure=_configure,
    run=_run,
)
