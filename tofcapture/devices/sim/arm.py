"""The simulated arm: a real arm's kinematics, its speed, its limits and its repeatability error."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.devices import Arm
from tofcapture.devices.kinematics import HOME, arm_model, check_joints, forward
from tofcapture.devices.registry import check_keys
from tofcapture.devices.sim import hashed_generator
from tofcapture.errors import DeviceError
from tofcapture.frames import ArmInfo, ArmState
from tofcapture.poses import Float64, exp

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

# ISO 9283 pose repeatability of the UR10e is 0.05 mm; this is one standard deviation per axis.
REPEATABILITY = np.repeat([0.02e-3, np.radians(0.001)], 3)  # m, rad
_SETTLE = 0.5  # s; ringing after a stop, capture.md 7


class SimClock:
    """The simulated station's monotonic clock, int64 ns; every reading moves it on by half a second, longer than a burst.

    It starts anew at every pose, as if each move came from home: a view that is taken again, after whatever other views,
    then carries the same times.
    """

    def __init__(self) -> None:
        self._now = 0

    def arrive(self, seconds: float) -> None:
        """Set the clock to the end of a move from home."""
        self._now = round(seconds * 1e9)

    def __call__(self) -> int:
        """Read the clock."""
        self._now += 500_000_000
        return self._now


def shared_clock(context: StationContext) -> SimClock:
    """Return the clock that all simulated devices of one station share."""
    clock: SimClock = context.shared.setdefault("sim_clock", SimClock())
    return clock


class SimArm(Arm):
    """Simulated six-axis arm.

    Parameters
    ----------
    table
        ``model``: ``ur10e`` or ``ur5e``.
    context
        The station; holds the simulated world.
    """

    simulated = True  # moves nothing that could hurt anyone

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        check_keys(table, ("model",), "[arm]")
        self._context = context
        self._model = arm_model(str(table.get("model", "ur10e")))
        self._joints: Float64 | None = None

    def __enter__(self) -> Self:
        self._go(HOME)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._joints = None

    def describe(self) -> ArmInfo:
        """Model and a serial number that names the seed."""
        return ArmInfo(model=self._model.name, serial="sim-arm")

    def state(self) -> ArmState:
        """Report the commanded joints; the repeatability error is what no arm can know of itself."""
        if self._joints is None:
            raise DeviceError("the simulated arm is not open", hint="use the station as a context manager")
        from tofcapture.devices.sim.world import shared_world

        T_base_flange = forward(self._model, self._joints) @ shared_world(self._context).faults.offset
        return ArmState(self._joints.copy(), T_base_flange, shared_clock(self._context)())

    def move_to(self, joints: Float64) -> ArmState:
        """Move along the joints at the model's speed, settle, and report; takes no time of ours.

        Raises
        ------
        MotionRefused
            The goal is not six finite angles within the limits.
        """
        from tofcapture.devices.sim.world import shared_world

        goal = check_joints(self._model, joints)
        shared_world(self._context).faults.before_move()
        self._go(goal)
        return self.state()

    def _go(self, goal: Float64) -> None:
        from tofcapture.devices.sim.world import shared_world

        world = shared_world(self._context)
        key = np.round(goal, 9).tobytes()
        error = hashed_generator(b"arm" + str(world.seed).encode() + key).standard_normal(6) * REPEATABILITY
        world.set_pose(forward(self._model, goal) @ exp(error), key)
        travel = float(np.abs(goal - HOME).max()) / self._model.speed
        shared_clock(self._context).arrive(travel + _SETTLE)
        self._joints = goal

    def stop(self) -> None:
        """Do nothing: a simulated move is over when it returns."""
