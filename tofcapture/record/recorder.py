"""The one capture loop: :func:`record` takes every view of a scene that a recording does not have yet."""

from __future__ import annotations

import platform
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture import __version__
from tofcapture.devices.kinematics import arm_model
from tofcapture.devices.station import Station
from tofcapture.errors import ConfigError, DeviceError, MotionRefused
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.poses import Float64, invert, rotation_angle
from tofcapture.record.clearance import route, stage_of
from tofcapture.record.journal import Journal, hold, hold_arm, utc_now
from tofcapture.record.plan import Plan, PlannedView
from tofcapture.record.reconcile import reconcile
from tofcapture.record.scene_plan import plan_scene
from tofcapture.record.watch import DiskFull, Watch, is_full

_VIEW_BYTES = 40e6  # a view of a full-size rig with truth, and room to spare
_RESERVE_BYTES = 0.5e9
_ATTEMPTS = 3
_GIVE_UP = 2  # views in a row that fail before the run ends
_MOTION = (
    0.2e-3,
    np.radians(0.02),
)  # m, rad: more between the first and the last exposure, and the view is retaken

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
    """

    scene: str
    recorded: tuple[int, ...]
    kept: tuple[int, ...]
    failed: tuple[int, ...]
    reasons: tuple[str, ...]
    repaired: tuple[str, ...]
    plan: Plan


def record(
    station: Station,
    scene: str,
    recording: Path,
    views: int = 25,
    frames: int = 10,
    progress: Progress = _silent,
    watch: Watch | None = None,
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

    Raises
    ------
    ConfigError
        The recording was begun with other cameras, frames or poses.
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
    plan = plan_scene(station, scene, views)
    try:
        _begin(recording, station)
        with hold(recording), hold_arm(station.arm), closing(Journal(recording)) as journal:
            journal.agree(
                {"station": station.describe(), "frames": frames, "sim": station.config.get("sim", {})}
            )
            repaired = reconcile(journal, recording, scene)
            kept = journal.expect(scene, {view.index: view.digest for view in plan.views})
            watch.planned(plan, kept, repaired)
            missing = [view for view in plan.views if view.index not in kept]
            taking = _Taking(station, scene, recording, frames, plan, journal, watch)
            reasons = _take_all(taking, missing, len(kept), progress)
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

    def begin(self, index: int, step: str) -> None:
        """Journal a step of a view, before anything is done."""
        self.journal.step(self.scene, index, step)
        self.watch.step(index, step)


def _take_all(taking: _Taking, missing: list[PlannedView], kept: int, progress: Progress) -> dict[int, str]:
    """Take views in turn; return the reason of each that was given up, by number."""
    _check_space(taking.recording, len(missing))
    if missing:
        taking.station.operator.place(taking.scene)
    total = len(taking.plan.views)
    reasons: dict[int, str] = {}
    for turn, planned in enumerate(missing):
        progress(kept + turn - len(reasons), total)
        taking.watch.before_view(planned.index)
        _check_space(taking.recording, 1)
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
    provenance = _provenance(taking.station, taking.plan, planned)
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
            break
    taking.begin(planned.index, "sealing")
    digest = write_view(view_path(taking.recording, taking.scene, planned.index), view)
    taking.journal.seal(taking.scene, planned.index, digest)
    taking.watch.sealed(view, digest)


def _no_step(step: str) -> None:
    del step


def capture(
    station: Station,
    scene: str,
    planned: PlannedView,
    frames: int,
    provenance: dict[str, Any],
    begin: Callable[[str], None] = _no_step,
) -> View:
    """Go there and take one view: arm, ToF burst, stereo frame, arm again.

    ToF comes first and alone: the stereo camera's projector would shine into its pixels. ``begin`` is called with the name
    of each step ahead of it.

    Raises
    ------
    DeviceError
        A device fails, or the rig moved between the exposures.
    """
    begin("moving")
    before = _go(station, planned)
    begin("tof")
    tof = station.tof.capture(frames)
    begin("stereo")
    stereo = station.stereo.capture()
    after = station.arm.state()
    _check_still(before, after)
    truth = station.operator.truth()
    return View(scene, planned.index, tof, stereo, before, after, station.rig, provenance, truth)


def _go(station: Station, planned: PlannedView) -> ArmState:
    """Move to a planned view by a clear way; the arm returns settled."""
    model, stage = arm_model(station.arm.describe().model), stage_of(station.config)
    state = station.arm.state()
    for joints in route(model, station.rig, stage, state.joints, planned.joints):
        state = station.arm.move_to(joints)
    return state


def _check_still(before: ArmState, after: ArmState) -> None:
    """Refuse a view during which the rig moved."""
    shift, turn = _moved(before.T_base_flange, after.T_base_flange)
    if shift > _MOTION[0] or turn > _MOTION[1]:
        raise DeviceError(
            f"the arm moved by {shift * 1e3:.2f} mm, {np.degrees(turn):.3f} deg during the exposures",
            hint="let it settle longer; look for vibration",
        )


def _moved(a: Float64, b: Float64) -> tuple[float, float]:
    """Metres and radians between two poses."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), rotation_angle(invert(a) @ b)


def _provenance(station: Station, plan: Plan, planned: PlannedView) -> dict[str, Any]:
    """Everything that says how a view came about."""
    return {
        "tofcapture": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "arm": station.describe()["arm"],
        "seed": station.seed,
        "simulated": station.simulated,
        "plan": plan.digest,
        "pose": planned.digest,
        "distance": planned.distance,
        "direction": planned.direction.tolist(),
        "utc": utc_now(),
    }
