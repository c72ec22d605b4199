"""The simulated devices: plain classes over the shared world."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.devices import Device, Operator, StereoDevice, TofCamera
from tofcapture.errors import ConfigError
from tofcapture.frames import StereoFrame, StereoInfo, TofBurst, TofInfo, Truth

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext
    from tofcapture.devices.sim.world import SimWorld


class _InWorld(Device):
    """Opens by joining the shared world; there is nothing to close."""

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del table
        self._context = context

    @property
    def _world(self) -> SimWorld:
        from tofcapture.devices.sim.world import shared_world

        return shared_world(self._context)

    @property
    def _here(self) -> SimWorld:
        """The world at the arm's pose: an arm that is not simulated is asked for it, the simulated one has said it."""
        arm = self._context.shared.get("arm")
        if arm is not None and not arm.simulated:
            state = arm.state()
            self._world.set_pose(state.T_base_flange, state.joints.round(5).tobytes())
        return self._world

    @property
    def _clock(self) -> Callable[[], int]:
        from tofcapture.devices.sim.arm import shared_clock

        arm = self._context.shared.get("arm")
        if arm is not None and not arm.simulated:
            return time.monotonic_ns
        return shared_clock(self._context)

    def __enter__(self) -> Self:
        _ = self._world
        return self


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
        return self._here.tof(frames, self._clock)


class SimStereo(_InWorld, StereoDevice):
    """The simulated stereo camera."""

    def describe(self) -> StereoInfo:
        """Say what this camera is."""
        return self._world.stereo_info

    def capture(self) -> StereoFrame:
        """Take one point map at the arm's present pose."""
        empty = self._world.faults.before_points()
        frame = self._here.stereo(self._clock)
        return replace(frame, points=np.full_like(frame.points, np.nan)) if empty else frame


class SimOperator(_InWorld, Operator):
    """Who changes the scene in the simulated world, and knows the truth about it."""

    def place(self, scene: str) -> None:
        """Put the scene on the simulated table."""
        self._world.place(scene)

    def truth(self) -> Truth | None:
        """Return what is exactly true of the present view."""
        return self._here.truth()


def _arm(table: Mapping[str, Any], context: StationContext) -> object:
    from tofcapture.devices.sim.arm import SimArm

    return SimArm(table, context)


DRIVERS = {"arm": _arm, "tof": SimTof, "stereo": SimStereo, "operator": SimOperator}
