"""The simulated devices: plain classes over the shared world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from tofcapture.frames import StereoFrame, StereoInfo, TofBurst, TofInfo, Truth

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext
    from tofcapture.devices.sim.world import SimWorld


class _InWorld:
    """Opens by joining the shared world; there is nothing to close."""

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del table
        self._context = context

    @property
    def _world(self) -> SimWorld:
        from tofcapture.devices.sim.world import shared_world

        return shared_world(self._context)

    @property
    def _clock(self) -> Callable[[], int]:
        from tofcapture.devices.sim.arm import shared_clock

        return shared_clock(self._context)

    def __enter__(self) -> Self:
        _ = self._world
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None


class SimTof(_InWorld):
    """The simulated ToF camera."""

    def describe(self) -> TofInfo:
        """Say what this camera is."""
        return self._world.tof_info

    def capture(self, frames: int) -> TofBurst:
        """Take a burst at the arm's present pose."""
        return self._world.tof(frames, self._clock)


class SimStereo(_InWorld):
    """The simulated stereo camera."""

    def describe(self) -> StereoInfo:
        """Say what this camera is."""
        return self._world.stereo_info

    def capture(self) -> StereoFrame:
        """Take one point map at the arm's present pose."""
        return self._world.stereo(self._clock)


class SimOperator(_InWorld):
    """Who changes the scene in the simulated world, and knows the truth about it."""

    def place(self, scene: str) -> None:
        """Put the scene on the simulated table."""
        self._world.place(scene)

    def truth(self) -> Truth | None:
        """Return what is exactly true of the present view."""
        return self._world.truth()


def _arm(table: Mapping[str, Any], context: StationContext) -> object:
    from tofcapture.devices.sim.arm import SimArm

    return SimArm(table, context)


DRIVERS = {"arm": _arm, "tof": SimTof, "stereo": SimStereo, "operator": SimOperator}
