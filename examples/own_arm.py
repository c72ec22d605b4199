"""A driver of an arm in one file: ``python own_arm.py`` puts it through the contract. Replace what says YOURS."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices.arm.checked import CheckedArm
from tofcapture.devices.arm.limits import Limits, Link, Sample, duration, follow, read_limits
from tofcapture.devices.kinematics import HOME, MODELS, forward
from tofcapture.devices.registry import StationContext
from tofcapture.devices.station import open_station
from tofcapture.testing import check_arm

MODEL = MODELS["ur10e"]  # YOURS: dh_model(...) or urdf_model(...)


class OwnLink(Link):
    """YOURS: what your library knows of the arm; raise ArmFault for all that goes wrong."""

    place = goal = HOME

    def sample(self) -> Sample:
        """YOURS: the controller's time, joints, speeds and flange as measured now; here it jumps in small steps."""
        self.place = self.place + np.clip(self.goal - self.place, -0.02, 0.02)
        return Sample(time.monotonic(), self.place, np.zeros(6), forward(MODEL, self.place)[:3, 3])


class OwnArm(CheckedArm[OwnLink]):
    """Consent, checks of every way, a stop that holds and rest before a view are CheckedArm's."""

    def __init__(self, table: dict[str, Any], context: StationContext) -> None:
        super().__init__(Limits(model=MODEL, **read_limits(table, {})), context)

    def connect(self) -> OwnLink:
        """YOURS: connect to self._limits.host; nothing moves."""
        return OwnLink()

    def flange(self, sample: Sample) -> Any:
        """YOURS: the flange's pose (4, 4) in the base frame, as the controller says it."""
        return forward(MODEL, sample.joints)

    def go(self, start: Sample, goal: Any, speed: float, check: Callable[[], None]) -> None:
        """YOURS: begin to move straight in joint space, and follow."""
        self._opened().goal = goal
        follow(self._opened(), goal, duration(goal - start.joints, speed, self._limits.acceleration), check)

    def halt(self) -> None:
        """YOURS: brake."""
        if (link := self._link) is not None:
            link.goal = link.place


if __name__ == "__main__":
    with open_station() as sim:
        context = StationContext(sim.config, Path(), allow_motion=True)
    check_arm(lambda: OwnArm({"host": "10.0.0.2"}, context), lambda arm: arm.equip(sim.rig))
    print("the driver keeps the contract")
