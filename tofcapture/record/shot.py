"""One view: go there, expose, look at what came, say how it came about."""

from __future__ import annotations

import platform
from collections.abc import Callable
from typing import Any

import numpy as np

from tofcapture import __version__
from tofcapture.devices.clearance import route, stage_of
from tofcapture.devices.kinematics import arm_model
from tofcapture.devices.station import Station
from tofcapture.errors import DeviceError
from tofcapture.frames import ArmState, View
from tofcapture.record.journal import utc_now
from tofcapture.record.plan import Plan, PlannedView
from tofcapture.record.quality import REFUSE, RETAKE, judge, measure, record_of, sentence


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
        A device fails, or the view is of no use (``record.quality``): the rig moved between the exposures, frames are missing ...
    """
    begin("moving")
    before = _go(station, planned)
    begin("tof")
    tof = station.tof.capture(frames)
    begin("stereo")
    stereo = station.stereo.capture()
    after = station.arm.state()
    numbers = measure(tof, stereo, before, after, station.rig, frames)
    failed = judge(numbers)
    if failed and failed[0].action == REFUSE:
        raise DeviceError(sentence(failed[0], numbers), hint=failed[0].hint)
    provenance = {**provenance, "quality": record_of(numbers, failed)}
    truth = station.operator.truth()
    return View(scene, planned.index, tof, stereo, before, after, station.rig, provenance, truth)


def worth_retaking(view: View) -> bool:
    """Tell whether something is wrong with a view that another try may mend."""
    return any(note["action"] == RETAKE for note in view.provenance["quality"]["notes"])


def notes_of(view: View) -> list[str]:
    """What is not as it should be, in sentences."""
    return [note["words"] for note in view.provenance["quality"]["notes"]]


def _go(station: Station, planned: PlannedView) -> ArmState:
    """Move to a planned view by a clear way; the arm returns settled."""
    model, stage = arm_model(station.arm.describe().model), stage_of(station.config)
    state = station.arm.state()
    for joints in route(model, station.rig, stage, state.joints, planned.joints):
        state = station.arm.move_to(joints)
    return state


def provenance_of(station: Station, plan: Plan, planned: PlannedView) -> dict[str, Any]:
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
        "turn_deg": round(float(np.degrees(planned.turn)), 6),
        "utc": utc_now(),
    }
