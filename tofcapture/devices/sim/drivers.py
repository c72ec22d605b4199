"""The simulated devices, over the world that they share: an arm, two cameras, and who changes the scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.devices import Arm, Device, Operator, StereoDevice, TofCamera
from tofcapture.devices.faults import StopLatch
from tofcapture.devices.kinematics import HOME, arm_model, check_joints, forward
from tofcapture.devices.registry import check_keys
from tofcapture.devices.sim import hashed_generator
from tofcapture.devices.sim.world import SimWorld, shared_world
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth
from tofcapture.poses import Float64, exp

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

# ISO 9283 pose repeatability of the UR10e is 0.05 mm; this is one standard deviation per axis.
REPEATABILITY = np.repeat([0.02e-3, np.radians(0.001)], 3)  # m, rad
_SETTLE = 0.5  # s; ringing after a stop, capture.md 7


class SimClock:
    """The simulated station's monotonic clock, int64 ns; every reading moves it on by half a second, longer than a burst.

    It starts anew at every pose, as if each move came from home: a view taken again then carries the same times.
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


class _InWorld(Device):
    """Opens by joining the shared world; there is nothing to close."""

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del table
        self._context = context

    @property
    def _world(self) -> SimWorld:
        return shared_world(self._context)

    def _present(self) -> tuple[SimWorld, Callable[[], int]]:
        """Return the world at the arm's pose, and a clock; only a real arm is asked."""
        arm = self._context.shared.get("arm")
        if arm is None or arm.simulated:
            return self._world, shared_clock(self._context)
        if arm.by_hand:  # it asks these cameras where it is: it stands where an arm's home is
            self._world.set_pose(forward(arm_model("ur10e"), HOME), b"by hand")
            return self._world, time.monotonic_ns
        state = arm.state()
        self._world.set_pose(state.T_base_flange, state.joints.round(5).tobytes())
        return self._world, time.monotonic_ns

    def __enter__(self) -> Self:
        _ = self._world
        return self


class SimArm(_InWorld, Arm):
    """Simulated six-axis arm: kinematics, speed, limits and repeatability error of a real ``model``, ``ur10e`` or ``ur5e``."""

    simulated = True  # moves nothing that could hurt anyone

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        super().__init__(table, context)
        check_keys(table, ("model",), "[arm]")
        self._model = arm_model(str(table.get("model", "ur10e")))
        self._joints: Float64 | None = None
        self._latch = StopLatch()

    def __enter__(self) -> Self:
        self._latch = StopLatch()
        self._go(HOME)
        return self

    def __exit__(self, *_: object) -> None:
        self._joints = None

    def describe(self) -> ArmInfo:
        """Say what this arm is."""
        return ArmInfo(model=self._model.name, serial="sim-arm")

    def state(self) -> ArmState:
        """Report the commanded joints; the repeatability error is what no arm can know of itself."""
        if self._joints is None:
            raise DeviceError("the simulated arm is not open", hint="use the station as a context manager")
        T_base_flange = forward(self._model, self._joints) @ self._world.faults.offset
        return ArmState(self._joints.copy(), T_base_flange, shared_clock(self._context)())

    def move_to(self, joints: Float64) -> ArmState:
        """Move along the joints at the model's speed, settle, and report; takes no time of ours.

        Raises :class:`MotionRefused`: the goal is not six finite angles within the limits, or somebody said stop.
        """
        goal = check_joints(self._model, joints)
        self._world.faults.before_move()
        self._latch.check(self._latch.token)
        self._go(goal)
        return self.state()

    def _go(self, goal: Float64) -> None:
        world, key = self._world, np.round(goal, 9).tobytes()
        error = hashed_generator(b"arm" + str(world.seed).encode() + key).standard_normal(6) * REPEATABILITY
        world.set_pose(forward(self._model, goal) @ exp(error), key)
        shared_clock(self._context).arrive(float(np.abs(goal - HOME).max()) / self._model.speed + _SETTLE)
        self._joints = goal

    def stop(self) -> None:
        """Refuse every further move: a simulated one is over when it returns."""
        self._latch.stop()

    def resume(self) -> None:
        """Move again when asked."""
        self._latch.resume(self._latch.token)


class SimTof(_InWorld, TofCamera):
    """The simulated ToF camera."""

    def describe(self) -> TofInfo:
        """Say what this camera is."""
        return self._world.tof_info

    def capture(self, frames: int) -> TofBurst:
        """Take a burst at the arm's present pose."""
        if frames < 1:
            raise ConfigError(f"burst: expected at least 1 frame, got {frames}")
        self._world.faults.before_burst()
        world, clock = self._present()
        return world.tof(frames, clock)


class SimStereo(_InWorld, StereoDevice):
    """The simulated stereo camera."""

    def describe(self) -> StereoInfo:
        """Say what this camera is."""
        return self._world.stereo_info

    def capture(self) -> StereoFrame:
        """Take one point map at the arm's present pose."""
        empty = self._world.faults.before_points()
        world, clock = self._present()
        frame = world.stereo(clock)
        return replace(frame, points=np.full_like(frame.points, np.nan)) if empty else frame


class SimOperator(_InWorld, Operator):
    """Tell who changes the scene in the simulated world, and knows the truth about it."""

    def place(self, scene: str) -> None:
        """Put the scene on the simulated table."""
        self._world.place(scene)

    def truth(self) -> Truth | None:
        """Return what is exactly true of the present view."""
        return self._present()[0].truth()


DRIVERS = {"arm": SimArm, "tof": SimTof, "stereo": SimStereo, "operator": SimOperator}
