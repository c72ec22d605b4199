"""The one capture loop: :func:`record` takes every view of a scene that a recording does not have yet."""

from __future__ import annotations

import platform
import shutil
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
from tofcapture.record.journal import Journal, hold, utc_now
from tofcapture.record.plan import Plan, PlannedView
from tofcapture.record.reconcile import reconcile
from tofcapture.record.scene_plan import plan_scene

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

    Raises
    ------
    ConfigError
        The recording was begun with other cameras, frames or poses; or the disk is too small.
    BusyError
        Another recorder is at work on this recording.
    DeviceError
        Two views in a row failed three times each.
    """
    if frames < 1:
        raise ConfigError(f"frames: expected at least 1, got {frames}")
    plan = plan_scene(station, scene, views)
    _begin(recording, station)
    with hold(recording), closing(Journal(recording)) as journal:
        journal.agree({"station": station.describe(), "frames": frames, "sim": station.config.get("sim", {})})
        repaired = reconcile(journal, recording, scene)
        kept = journal.expect(scene, {view.index: view.digest for view in plan.views})
        missing = [view for view in plan.views if view.index not in kept]
        _check_space(recording, len(missing))
        if missing:
            station.operator.place(scene)
        reasons: dict[int, str] = {}
        for turn, planned in enumerate(missing):
            progress(len(kept) + turn - len(reasons), len(plan.views))
            try:
                view = _take(station, scene, planned, frames, _provenance(station, plan, planned), journal)
                digest = write_view(view_path(recording, scene, planned.index), view)
                journal.seal(scene, planned.index, digest)
            except DeviceError as err:
                journal.fail(scene, planned.index, err.message)
                reasons[planned.index] = err.message
                if _hopeless(missing[: turn + 1], reasons):
                    raise
        progress(len(plan.views) - len(reasons), len(plan.views))
    return RecordResult(
        scene=scene,
        recorded=tuple(sorted({view.index for view in missing} - reasons.keys())),
        kept=tuple(sorted(kept)),
        failed=tuple(sorted(reasons)),
        reasons=tuple(f"view {i}: {reasons[i]}" for i in sorted(reasons)),
        repaired=tuple(repaired),
        plan=plan,
    )


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
        raise ConfigError(
            f"{recording}: expected {needed / 1e9:.1f} GB of free disk, got {free / 1e9:.1f} GB",
            hint="free some space, or ask for fewer views",
        )


def _take(
    station: Station,
    scene: str,
    planned: PlannedView,
    frames: int,
    provenance: dict[str, Any],
    journal: Journal,
) -> View:
    """Take one view, three times at most; a refused motion is refused for good."""
    for attempt in range(1, _ATTEMPTS + 1):
        journal.attempt(scene, planned.index)
        try:
            return capture(station, scene, planned, frames, provenance)
        except MotionRefused:
            raise
        except DeviceError:
            if attempt == _ATTEMPTS:
                raise
    raise AssertionError


def capture(
    station: Station, scene: str, planned: PlannedView, frames: int, provenance: dict[str, Any]
) -> View:
    """Go there and take one view: arm, ToF burst, stereo frame, arm again.

    ToF comes first and alone: the stereo camera's projector would shine into its pixels.

    Raises
    ------
    DeviceError
        A device fails, or the rig moved between the exposures.
    """
    before = _go(station, planned)
    tof = station.tof.capture(frames)
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
