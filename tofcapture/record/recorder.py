"""The one capture loop: :func:`record` takes every view of a scene that a recording does not have yet."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices.station import Station
from tofcapture.errors import ConfigError, DeviceError, MotionRefused
from tofcapture.files.view import view_path, write_view
from tofcapture.record.journal import Journal, hold, hold_arm
from tofcapture.record.plan import Plan, PlannedView
from tofcapture.record.reconcile import reconcile
from tofcapture.record.scene_plan import plan_scene
from tofcapture.record.shot import capture, notes_of, provenance_of, worth_retaking
from tofcapture.record.watch import DiskFull, Watch, is_full

_VIEW_BYTES = 40e6  # a view of a full-size rig with truth, and room to spare
_RESERVE_BYTES = 0.5e9
_ATTEMPTS = 3
_GIVE_UP = 2  # views in a row that fail before the run ends

Progress = Callable[[int, int], None]


def _silent(done: int, total: int) -> None:
    del done, total


@dataclass(frozen=True)
class RecordResult:
    """What a run of the recorder did.

    Attributes
    ----------
    scene
        Name.
    recorded, kept, failed
        Numbers of views: taken now, there already, given up.
    reasons
        One sentence for each failed view.
    repaired
        One sentence for each thing put right in the recording.
    plan
        The plan that was followed.
    notes
        One sentence for each thing about a view, taken now, that is not as it should be (``record.quality``).
    """

    scene: str
    recorded: tuple[int, ...]
    kept: tuple[int, ...]
    failed: tuple[int, ...]
    reasons: tuple[str, ...]
    repaired: tuple[str, ...]
    plan: Plan
    notes: tuple[str, ...] = ()


def record(
    station: Station,
    scene: str,
    recording: Path,
    views: int = 25,
    frames: int = 10,
    progress: Progress = _silent,
    watch: Watch | None = None,
    turns: int = 1,
) -> RecordResult:
    """Take every missing view of one scene.

    It can be killed at any moment and run again: views that are sealed stay, the others are taken, and the arrays are those
    of a run that was never killed (on the simulated station).

    Parameters
    ----------
    station
        Open devices.
    scene
        Name; ``calibration`` for views of the board.
    recording
        Folder; made when missing.
    views, frames
        Views of the scene, ToF frames of each burst.
    progress
        Called with (views there, views planned) before the first and after each view.
    watch
        Looks on; may make the recorder wait between views, or end it.
    turns
        In how many ways the object is put on the table (``record.plan``); the operator is asked to turn it.

    Raises
    ------
    ConfigError
        The recording was begun with other cameras, frames or poses; or the operator cannot turn objects.
    DiskFull
        The disk is too small, or full.
    BusyError
        Another recorder is at work on this recording, or moves this arm.
    DeviceError
        Two views in a row failed three times each.
    Stopped
        The watch ended the run.
    """
    if frames < 1:
        raise ConfigError(f"frames: expected at least 1, got {frames}")
    watch = watch or Watch()
    plan = plan_scene(station, scene, views, turns)
    _check_turns(station, plan)
    try:
        _begin(recording, station)
        with hold(recording), hold_arm(station.arm), closing(Journal(recording)) as journal:
            journal.agree({"station": station.describe(), "frames": frames, "sim": _world(station)})
            repaired = reconcile(journal, recording, scene)
            kept = journal.expect(scene, {view.index: view.digest for view in plan.views})
            watch.planned(plan, kept, repaired)
            missing = [view for view in plan.views if view.index not in kept]
            taking = _Taking(station, scene, recording, frames, plan, journal, watch)
            reasons = _take_all(taking, missing, len(kept), progress)
            notes = [f"view {i}: {note}" for i in sorted(taking.notes) for note in taking.notes[i]]
    except (OSError, RuntimeError, sqlite3.OperationalError) as err:
        if not is_full(err):
            raise
        raise DiskFull(
            f"{recording}: the disk takes no more: {str(err).partition('(')[0].strip()}",
            hint="free some space, then run the same again",
        ) from err
    return RecordResult(
        scene=scene,
        recorded=tuple(sorted({view.index for view in missing} - reasons.keys())),
        kept=tuple(sorted(kept)),
        failed=tuple(sorted(reasons)),
        reasons=tuple(f"view {i}: {reasons[i]}" for i in sorted(reasons)),
        repaired=tuple(repaired),
        plan=plan,
        notes=tuple(notes),
    )


def _world(station: Station) -> dict[str, Any]:
    """What a simulated world is made of; faults on demand come and go without making it another."""
    return {key: value for key, value in station.config.get("sim", {}).items() if key != "faults"}


def _check_turns(station: Station, plan: Plan) -> None:
    """Refuse a plan with turns of the object where nobody can turn it."""
    if any(view.turn for view in plan.views) and not station.operator.can_turn:
        raise ConfigError(
            "turns: this station's operator cannot turn the object",
            hint='a person can: [operator] driver = "console", in a terminal; or record without --turns',
        )


@dataclass(frozen=True)
class _Taking:
    """What stays the same from view to view."""

    station: Station
    scene: str
    recording: Path
    frames: int
    plan: Plan
    journal: Journal
    watch: Watch
    notes: dict[int, list[str]] = field(default_factory=dict)

    def begin(self, index: int, step: str) -> None:
        """Journal a step of a view, before anything is done."""
        self.journal.step(self.scene, index, step)
        self.watch.step(index, step)


def _take_all(taking: _Taking, missing: list[PlannedView], kept: int, progress: Progress) -> dict[int, str]:
    """Take views in turn; return the reason of each that was given up, by number."""
    _check_space(taking.recording, len(missing))
    if missing:
        taking.station.operator.place(taking.scene)
    # How the object stands after an earlier run, nobody knows: where it is turned at all, the first view asks too.
    total, turned = len(taking.plan.views), np.nan if any(v.turn for v in taking.plan.views) else 0.0
    reasons: dict[int, str] = {}
    for turn, planned in enumerate(missing):
        progress(kept + turn - len(reasons), total)
        taking.watch.before_view(planned.index)
        _check_space(taking.recording, 1)
        if planned.turn != turned:
            taking.station.operator.turn(taking.scene, planned.turn)
            turned = planned.turn
        try:
            _take(taking, planned)
        except DeviceError as err:
            # An arm that was told to stop refuses to move: that is no failure of the view.
            taking.watch.step(planned.index, "failed")
            taking.journal.fail(taking.scene, planned.index, err.message)
            taking.watch.failed(planned.index, err.message)
            reasons[planned.index] = err.message
            if _hopeless(missing[: turn + 1], reasons):
                raise
    progress(total - len(reasons), total)
    return reasons


def _hopeless(tried: list[PlannedView], reasons: dict[int, str]) -> bool:
    """Tell whether the last views tried failed one after the other: that is no bad pose, that is a broken device."""
    return len(tried) >= _GIVE_UP and all(view.index in reasons for view in tried[-_GIVE_UP:])


def _begin(recording: Path, station: Station) -> None:
    """Make the folder and keep a copy of the station's configuration in it."""
    import tomli_w

    from tofcapture.files.seal import write_text

    recording.mkdir(parents=True, exist_ok=True)
    copy = recording / "station.toml"
    if not copy.exists():
        write_text(copy, tomli_w.dumps(station.config))


def _check_space(recording: Path, missing: int) -> None:
    """Refuse to begin what the disk cannot hold."""
    free = shutil.disk_usage(recording).free
    needed = missing * _VIEW_BYTES + _RESERVE_BYTES
    if missing and free < needed:
        raise DiskFull(
            f"{recording}: expected {needed / 1e9:.1f} GB of free disk, got {free / 1e9:.1f} GB",
            hint="free some space, or ask for fewer views",
        )


def _take(taking: _Taking, planned: PlannedView) -> None:
    """Take and seal one view, three attempts at most; a refused motion is refused for good."""
    provenance = provenance_of(taking.station, taking.plan, planned)
    for attempt in range(1, _ATTEMPTS + 1):
        taking.journal.attempt(taking.scene, planned.index)
        try:
            view = capture(
                taking.station,
                taking.scene,
                planned,
                taking.frames,
                provenance,
                lambda step: taking.begin(planned.index, step),
            )
        except MotionRefused:
            raise
        except DeviceError:
            if attempt == _ATTEMPTS:
                raise
        else:
            if attempt == _ATTEMPTS or not worth_retaking(view):
                break
    if notes := notes_of(view):
        taking.notes[planned.index] = notes
    taking.begin(planned.index, "sealing")
    digest = write_view(view_path(taking.recording, taking.scene, planned.index), view)
    taking.journal.seal(taking.scene, planned.index, digest)
    taking.watch.sealed(view, digest)
