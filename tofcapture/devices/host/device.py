"""A driver in a child process, with the face of a driver."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

from tofcapture.devices import Arm, Device, StereoDevice, TofCamera
from tofcapture.devices.faults import ArmFault, HostLost, StopLatch
from tofcapture.devices.host.process import Host
from tofcapture.devices.kinematics import ArmModel
from tofcapture.devices.registry import StationContext, make_target
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.poses import Float64
from tofcapture.rig import Rig

# Seconds; a driver's own deadlines are laid over them.
_DEADLINES = {
    "__enter__": 12.0, "__exit__": 2.0, "equip": 4.0, "state": 4.0, "stop": 2.0, "move_to": 300.0, "capture": 60.0,
}  # fmt: skip
_GUARD = 3.0  # s beyond the deadline of opening; a child whose parent is silent for longer ends itself
_PAUSES = (0.5, 1.0, 2.0)  # s before the first, second ... new child


class HostedDevice(Device):
    """A driver that lives in a child process; :func:`hosted` makes them and explains their parameters.

    The driver is also made here, without opening it, to answer ``describe`` and ``probe``. What the devices of a station
    share stays here.
    """

    respawn = 3  # how often a lost child is replaced

    def __init__(
        self,
        role: str,
        target: str,
        table: Mapping[str, Any],
        context: StationContext,
        deadlines: Mapping[str, float],
        overdue: type[ArmFault],
    ) -> None:
        self._role, self._overdue = role, overdue
        self._left = self.respawn
        self._local = make_target(target, table, context)
        self._order = {"target": target, "table": dict(table), "context": replace(context, shared={})}
        self._deadlines = {**_DEADLINES, **deadlines}
        self._host: Host | None = None
        self._one = threading.Lock()

    def __enter__(self) -> Self:
        if self._host is not None and self._host.lost is None:
            return self
        if self._host is not None:
            self._host.close()
        self._left = self.respawn
        try:
            self._start()
        except BaseException:
            host, self._host = self._host, None
            if host is not None:
                host.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        host, self._host = self._host, None
        if host is None:
            return
        try:
            if host.lost is None:
                host.call("__exit__", (None, None, None), self._deadlines["__exit__"])
        except DeviceError:
            if kind is None:
                raise
        finally:
            host.close()

    @property
    def pid(self) -> int | None:
        """Process id of the child, while it is open."""
        return None if self._host is None else self._host.pid

    def describe(self) -> Any:
        """Say what this device is, without opening it."""
        return self._local.describe()

    def probe(self) -> str:
        """Ask whether the device is there; nothing is opened and no child is started."""
        return str(self._local.probe())

    def call(self, verb: str, *args: Any) -> Any:
        """Call a method of the driver, one at a time.

        Raises :class:`ArmFault`: the child was lost or reported a state that needs a person; the same again
        until opened anew; :class:`TofError`: what the driver raised.
        """
        with self._one:
            return self._called(verb, *args)

    def _called(self, verb: str, *args: Any) -> Any:
        host = self._living()
        try:
            return host.call(verb, args, self._deadlines.get(verb, 10.0))
        except ArmFault as fault:
            host.kill(fault)
            raise

    def _start(self) -> None:
        guard = _GUARD + self._deadlines["__enter__"]
        self._host = Host(self._role, self._order, guard, self._overdue)
        try:
            self._host.call("__enter__", (), self._deadlines["__enter__"], quiet=True)
            self._host.opening = False
        except DeviceError as err:
            self._host.kill(err)
            raise
        except BaseException:
            self._host.kill(HostLost(f"{self._role}: not opened"))
            raise

    def _living(self) -> Host:
        """Give the child; a new one if it was lost and may be replaced."""
        if self._host is None:
            raise DeviceError(f"{self._role} is not open", hint="use the station as a context manager")
        while self._host.lost is not None:
            if self._left == 0:
                raise self._host.lost
            time.sleep(_PAUSES[min(self.respawn - self._left, len(_PAUSES) - 1)])
            self._left -= 1
            self._host.close()
            self._start()
        return self._host


class HostedArm(HostedDevice, Arm):
    """An arm in a child process; a lost one is not replaced, for a person must look first."""

    respawn = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._latch = StopLatch()

    def __enter__(self) -> Self:
        if self._host is None or self._host.lost is not None:
            self._latch = StopLatch()
        return super().__enter__()

    @property
    def simulated(self) -> bool:
        """True when the driver says so of itself."""
        return bool(self._local.simulated)

    def kinematics(self) -> ArmModel:
        """Give the arm's geometry, without opening it."""
        model: ArmModel = self._local.kinematics()
        return model

    def cautions(self) -> list[str]:
        """Say which protection is switched off."""
        return list(self._local.cautions())

    def check_move(self, start: Float64, goal: Float64) -> None:
        """Have the driver check a motion, as it will before it moves."""
        self.call("check_move", start, goal)

    def equip(self, rig: Rig) -> None:
        """Tell the arm what it carries, for its checks of the way."""
        self.call("equip", rig)

    def state(self) -> Any:
        """Measure the joints now."""
        return self.call("state")

    def move_to(self, joints: Float64) -> Any:
        """Move, wait until settled, return the measured state; not after a stop."""
        token = self._latch.token
        self._latch.check(token)
        with self._one:
            self._latch.check(token)
            return self._called("move_to", joints)

    def stop(self) -> None:
        """Stop now, also in the middle of a move of another thread, and stay so.

        An arm that cannot be told has its process killed: the watchdog on the controller stops it then. While it is being
        opened nothing moves, and nothing will after.
        """
        self._latch.stop()
        host = self._host
        if host is None or host.lost is not None or host.opening:
            return
        try:
            host.call("stop", (), self._deadlines["stop"])
        except DeviceError as err:
            host.kill(err)

    def resume(self) -> None:
        """Let the arm move again after a stop."""
        token = self._latch.token
        if self._host is not None and self._host.lost is None:
            self.call("resume")
        self._latch.resume(token)


class HostedTof(HostedDevice, TofCamera):
    """A ToF camera in a child process."""

    def capture(self, frames: int) -> Any:
        """Take a burst of ``frames`` static frames."""
        return self.call("capture", frames)


class HostedStereo(HostedDevice, StereoDevice):
    """A stereo camera in a child process."""

    def capture(self) -> Any:
        """Take one point map."""
        return self.call("capture")


_KINDS: dict[str, type[HostedDevice]] = {"arm": HostedArm, "tof": HostedTof, "stereo": HostedStereo}


def hosted(
    role: str,
    target: str,
    deadlines: Mapping[str, float] | None = None,
    overdue: type[ArmFault] = HostLost,
) -> Callable[[Mapping[str, Any], StationContext], Any]:
    """Make a factory, for ``DRIVERS``, of a driver that lives in a child process; ``role`` is ``arm``, ``tof`` or ``stereo``.

    ``target`` is ``module:name`` of the driver's own factory; the module imports without the vendor's library. ``deadlines``
    are seconds by verb, where the usual ones do not fit; ``overdue`` is what a missed one means for this device.

    Raises :class:`ConfigError`: another role.
    """
    if role not in _KINDS:
        raise ConfigError(f"hosted driver: expected a role of {', '.join(_KINDS)}, got {role!r}")

    def factory(table: Mapping[str, Any], context: StationContext) -> HostedDevice:
        return _KINDS[role](role, target, table, context, deadlines or {}, overdue)

    return factory
