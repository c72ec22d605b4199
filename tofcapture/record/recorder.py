"""The one capture loop: :func:`record` takes every view of a scene that a recording does not have yet."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from tofcapture import __version__
from tofcapture.devices.clearance import route, workcell_of
from tofcapture.devices.contract import check_burst, check_points, check_state, check_tof_info
from tofcapture.devices.faults import ArmFault
from tofcapture.devices.station import Station, open_station
from tofcapture.errors import ConfigError, DeviceError, MotionRefused, MotionStopped
from tofcapture.files.seal import write_text
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import CALIBRATION, ArmState, StereoFrame, TofBurst, View
from tofcapture.record.journal import JobRefused, Journal, keep_copy, reconcile, utc_now
from tofcapture.record.observer import Observer, Stopped
from tofcapture.record.plan import Plan, PlannedView, plan_scene
from tofcapture.record.quality import (
    ELSEWHERE,
    REFUSE,
    RETAKE,
    broken_limits,
    measure,
    quality_table,
)
from tofcapture.record.resources import HeldFolders, check_space, full_disk_named, hold_arm, hold_file
from tofcapture.record.stopping import Stop, stoppable

ATTEMPTS = 3  # at one view
FAILURES_IN_A_ROW = 2  # that end the run: that is no bad pose, that is a broken device

Progress = Callable[[int, int], None]


class Refused(DeviceError):  # noqa: N818  the devices work
    """What the devices handed over is of no use."""


@dataclass(frozen=True)
class RecordResult:
    """Hold what a run of the recorder did: numbers of views, and sentences."""

    scene: str
    recorded: tuple[int, ...]  # taken now
    kept: tuple[int, ...]  # there already
    failed: tuple[int, ...]  # given up
    reasons: tuple[str, ...]  # one for each failed view
    repaired: tuple[str, ...]  # what was put right in the recording
    plan: Plan
    notes: tuple[str, ...] = ()  # what is not as it should be in views taken now (record.quality)


def record(
    station: Station | str | Path | None,
    scene: str,
    recording: str | Path,
    views: int = 25,
    frames: int = 10,
    progress: Progress | None = None,
    observer: Observer | None = None,
    turns: int = 1,
    retake: int | None = None,
) -> RecordResult:
    """Take every missing view of one scene: move, expose, judge, seal.

    It can be killed at any moment and run again: views that are sealed stay, the others are taken. On the simulated station
    the arrays are those of a run that was never killed.

    Raises :class:`ConfigError`: the recording was begun with other cameras, frames or poses, the operator cannot turn objects,
    there is no such view, a driver breaks its promises, or a folder is another one now; :class:`DiskFull`; :class:`BusyError`:
    another recorder works on this recording, or moves this arm; :class:`DeviceError`: two views in a row failed three times each,
    or the last one for the first time, or a device needs a person; :class:`Stopped`: the observer, ``tofcapture stop``, or a stop
    of the arm.

    Parameters
    ----------
    station, scene, recording
        Open devices, or their ``station.toml``, or ``None``: the simulated ones; a name, ``calibration`` for views of the board; a
        folder, made when missing. Only a station that was opened with leave moves a real arm.
    views, frames, turns
        Views of the scene, ToF frames of each burst, ways in which the operator is asked to put the object.
    progress
        Called with (views there, views planned) before the first and after each view.
    observer
        Looks on; may make the recorder wait between views, or end it.
    retake
        Number of a view to take again, and no other. The one before is set aside when the new one is there.
    """
    if station is None or isinstance(station, str | Path):
        with open_station(None if station is None else Path(station)) as opened:
            return record(opened, scene, recording, views, frames, progress, observer, turns, retake)
    plan = plan_scene(station, scene, views, turns)
    _check_request(station, plan, frames, retake)
    with _begun(station, scene, Path(recording), frames, plan, observer or Observer()) as run:
        for planned in run.missing(retake, progress or (lambda _there, _planned: None)):
            run.place_object(planned)
            run.take(planned)
        run.judge_the_last()
    return run.result()


def _check_request(station: Station, plan: Plan, frames: int, retake: int | None) -> None:
    if frames < 1:
        raise ConfigError(f"frames: expected at least 1, got {frames}")
    if any(view.turn for view in plan.views) and not station.operator.can_turn:
        raise ConfigError(
            "turns: this station's operator cannot turn the object",
            hint='a person can: [operator] driver = "console", in a terminal; or record without --turns',
        )
    if retake is not None and retake not in {view.index for view in plan.views}:
        raise JobRefused(f"retake: expected a view from 0 to {len(plan.views) - 1}, got {retake}")


@contextmanager
def _begun(
    station: Station, scene: str, recording: Path, frames: int, plan: Plan, observer: Observer
) -> Iterator[_Run]:
    """Hold the recording and the arm, bring the journal up to date; stops and full disks end the run by name."""
    with (
        full_disk_named(recording),
        stoppable(f"{scene} into {recording.absolute()}", station.arm.stop) as stop,
    ):
        scene_folder = view_path(recording, scene, 0).parent
        scene_folder.mkdir(parents=True, exist_ok=True)
        folders = HeldFolders(recording.parent, recording, scene_folder.parent, scene_folder)
        if not (copy := recording / "station.toml").exists():
            write_text(copy, tomli_w.dumps(station.config))
        busy = f"{recording}: another recorder is at work"
        # Not the journal itself: closing any handle of it would drop SQLite's own locks.
        lock = hold_file(recording / ".lock", busy, "wait for it to end")
        with lock, hold_arm(station.arm), closing(Journal(recording)) as journal:
            journal.agree({"station": station.describe(), "frames": frames, "world": station.world})
            repaired = reconcile(journal, recording, scene)
            failed_before = {row.index for row in journal.rows(scene) if row.state == "failed"}
            kept = journal.expect(scene, {view.index: view.places for view in plan.views})
            observer.planned(plan, kept, repaired)
            check_tof_info(station.tof.describe())
            yield _Run(
                *(station, scene, recording, frames, plan, journal, observer, stop, folders),
                *(kept, repaired, failed_before),
            )


@dataclass
class _Run:
    """One run over the views of a scene: what stays the same from view to view, and what came of them."""

    station: Station
    scene: str
    recording: Path
    frames: int
    plan: Plan
    journal: Journal
    observer: Observer
    stop: Stop
    folders: HeldFolders
    kept: set[int]  # sealed by earlier runs
    repaired: list[str]
    failed_before: set[int]
    turned: float | None = None  # how the object stands; after an earlier run nobody knows
    failed_in_a_row: int = 0
    last_error: DeviceError | None = None
    recorded: list[int] = field(default_factory=list)
    reasons: dict[int, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def missing(self, retake: int | None, progress: Progress) -> Iterator[PlannedView]:
        """Go through the views to take; before each the observer may wait, and folders and disk are looked at."""
        views = self.plan.views
        left = [v for v in views if (v.index not in self.kept if retake is None else v.index == retake)]
        for n, planned in enumerate(left):
            progress(len(self.kept) + n - len(self.reasons), len(views))
            self.observer.before_view(planned.index)
            self.folders.check()
            check_space(self.recording, len(left) - n)
            yield planned
        progress(len(views) - len(self.reasons), len(views))

    def place_object(self, planned: PlannedView) -> None:
        """Have the object put on the table, and turned where the plan turns it."""
        if self.turned is None:
            self.station.operator.place(self.scene)
        if planned.turn != self.turned and any(view.turn for view in self.plan.views):
            self.station.operator.turn(self.scene, planned.turn)
        self.turned = planned.turn

    def take(self, planned: PlannedView) -> None:
        """Move, expose, judge and seal; else give the view up.

        Raises :class:`DeviceError`: this view and the one before it failed.
        """
        try:
            view = self.attempts(planned)
        except DeviceError as err:
            return self.give_up(planned.index, err)
        spare = planned.spare
        while spare is not None and _lacking(view):
            view, spare = self.from_elsewhere(view, spare), spare.spare
        notes = view.provenance["quality"]["notes"]
        self.notes += [f"view {planned.index}: {note['words']}" for note in notes]
        moved = view.provenance["pose"] != planned.digest
        return self.seal(view, next(n["words"] for n in notes if n["action"] == ELSEWHERE) if moved else "")

    def from_elsewhere(self, view: View, spare: PlannedView) -> View:
        """Take a view that shows too little of its object from another place too; return the better one, with a note on both."""
        quality = view.provenance["quality"]
        words = next(note["words"] for note in quality["notes"] if note["action"] == ELSEWHERE)
        try:
            other = self.attempts(spare)
        except DeviceError as err:
            self.stop.check()
            words, better = f"{words}; not taken from another place: {err.message}", view
        else:
            there = other.provenance["quality"].get("object_coverage", 0.0)
            better = other if there > quality["object_coverage"] else view
            words = f"{words}, {there:.0%} from another place, which is {'kept' if better is other else 'no better'}"
        notes = better.provenance["quality"]["notes"]
        notes[:] = [n for n in notes if n["check"] != "object_coverage"]
        notes.append({"check": "object_coverage", "action": ELSEWHERE, "words": words})
        return better

    def attempts(self, planned: PlannedView) -> View:
        """Move, expose and judge, in three attempts at most; raises :class:`DeviceError` when the last one failed."""
        for attempt in range(1, ATTEMPTS + 1):
            self.journal.attempt(self.scene, planned.index)
            try:
                before = self.move(planned)
                tof, stereo, after = self.expose(planned)
                numbers = self.judge(tof, stereo, before, after)
            except MotionStopped as err:
                # No fault of the view: it is taken when somebody asks again.
                hint = "look at the arm; ask for the same scene again to go on"
                raise Stopped(err.message, hint=hint) from err
            except DeviceError as err:
                self.stop.check()
                # A refused motion is refused for good.
                if attempt == ATTEMPTS or isinstance(err, MotionRefused):
                    raise
                continue
            broken = broken_limits(numbers)
            if attempt == ATTEMPTS or not any(limit.action == RETAKE for limit in broken):
                break
        provenance = {**self.provenance(planned), "quality": quality_table(numbers)}
        truth, rig = self.station.operator.truth(), self.station.rig
        return View(self.scene, planned.index, tof, stereo, before, after, rig, provenance, truth)

    def move(self, planned: PlannedView) -> ArmState:
        """Move by a clear way; the arm returns settled."""
        self.begin(planned.index, "moving")
        arm = self.station.arm
        if arm.by_hand:
            return self.await_person(planned)
        state, workcell = arm.state(), workcell_of(self.station.config)
        way = route(
            arm.kinematics(), self.station.rig, workcell, state.joints, planned.joints, arm.check_move
        )
        for joints in way:
            state = arm.move_to(joints)
            check_state(state)
        return state

    def await_person(self, planned: PlannedView) -> ArmState:
        """Wait for the person who carries the rig."""
        arm, tell, what = (
            self.station.arm,
            self.station.operator.tell,
            f"view {planned.index} of {self.scene!r}",
        )
        tell(f"{what}: " + ("wait" if arm.fixed else "bring the rig to another place and hold it still"))
        state = arm.await_view(planned.index)
        check_state(state)
        tell(f"{what}: hold on")
        return state

    def expose(self, planned: PlannedView) -> tuple[TofBurst, StereoFrame, ArmState]:
        """Expose ToF first and alone: the stereo camera's projector would shine into its pixels."""
        self.begin(planned.index, "tof")
        tof = self.station.tof.capture(self.frames)
        self.begin(planned.index, "stereo")
        stereo = self.station.stereo.capture()
        return tof, stereo, self.station.arm.state()

    def judge(
        self, tof: TofBurst, stereo: StereoFrame, before: ArmState, after: ArmState
    ) -> dict[str, float]:
        """Refuse what is not what a driver promises, measure what came, refuse what is of no use (``record.quality``)."""
        check_burst(tof, self.station.tof.describe(), before)
        check_points(stereo, self.station.stereo.describe())
        table = not self.station.arm.by_hand and self.scene != CALIBRATION
        numbers = measure(tof, stereo, before, after, self.station.rig, self.frames, table=table)
        for limit in broken_limits(numbers):
            if limit.action == REFUSE:
                raise Refused(limit.sentence(numbers), hint=limit.hint)
        return numbers

    def seal(self, view: View, reason: str = "") -> None:
        """Write a view under its name, then note it in the journal, with the reason of another pose than planned."""
        self.begin(view.index, "sealing")
        path = view_path(self.recording, self.scene, view.index)
        with self.folders.unchanged():
            if path.exists():
                self.journal.forget(self.scene, view.index, "taken again")
                keep_copy(path, "retaken")
            digest = write_view(path, view)
        self.journal.seal(self.scene, view.index, digest, view.provenance["pose"], reason)
        self.observer.sealed(view, digest)
        self.recorded.append(view.index)
        self.failed_in_a_row = 0

    def give_up(self, index: int, error: DeviceError) -> None:
        """Note that a view failed; raise when the one before it failed too."""
        # Whoever was told to stop says so here: that is no failure of the view.
        self.observer.step(index, "failed")
        if view_path(self.recording, self.scene, index).exists():
            self.journal.step(self.scene, index, "")  # it was to be taken again: the one before stays
        else:
            self.journal.fail(self.scene, index, error.message)
        self.observer.failed(index, error.message)
        self.reasons[index] = error.message
        self.last_error = error
        self.failed_in_a_row += 1
        # A fault of the arm is no fault of the view: the next one would meet it as well.
        if self.failed_in_a_row >= FAILURES_IN_A_ROW or isinstance(error, ArmFault):
            raise error

    def judge_the_last(self) -> None:
        """Raise when the last view failed, and never before: no view after it shows that the devices work."""
        known = self.failed_before & self.reasons.keys()
        if self.failed_in_a_row and not isinstance(self.last_error, MotionRefused | Refused) and not known:
            assert self.last_error is not None
            raise self.last_error

    def begin(self, index: int, step: str) -> None:
        """Journal a step of a view, before anything is done; raise :class:`Stopped` when nothing shall be done."""
        self.stop.check()
        self.journal.step(self.scene, index, step)
        self.observer.step(index, step)

    def provenance(self, planned: PlannedView) -> dict[str, Any]:
        """Say how a view came about."""
        return {
            "tofcapture": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "arm": self.station.describe()["arm"],
            "seed": self.station.seed,
            "simulated": self.station.simulated,
            "plan": self.plan.digest,
            "pose": planned.digest,
            **{k: v for k, v in planned.as_json().items() if k in ("distance", "direction", "turn_deg")},
            "utc": utc_now(),
        }

    def result(self) -> RecordResult:
        """Sum up."""
        recorded, kept, failed = (tuple(sorted(n)) for n in (self.recorded, self.kept, self.reasons))
        reasons = tuple(f"view {i}: {self.reasons[i]}" for i in failed)
        repaired, notes = tuple(self.repaired), tuple(self.notes)
        return RecordResult(self.scene, recorded, kept, failed, reasons, repaired, self.plan, notes)


def _lacking(view: View) -> bool:
    """Whether a view shows so little of its object that it is worth a look from elsewhere."""
    return any(limit.action == ELSEWHERE for limit in broken_limits(view.provenance["quality"]))
