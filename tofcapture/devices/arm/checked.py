"""What every real arm's driver does: consent, a check of every leg, a stop that holds, rest before a view."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Generic, Self, TypeVar

import numpy as np

from tofcapture.devices import Arm
from tofcapture.devices.arm.limits import (
    ARRIVED,
    Limits,
    Link,
    Sample,
    check_goal,
    check_way,
    joint_speed,
    settle,
)
from tofcapture.devices.clearance import workcell_of
from tofcapture.devices.faults import ArmFault, NotReady, StopLatch
from tofcapture.devices.kinematics import ArmModel, check_joints, pose_error
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.frames import ArmInfo, ArmState
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext
    from tofcapture.rig import Rig

_PARENT = 2.0  # s of the station's silence that stop a motion
L = TypeVar("L", bound=Link)


class CheckedArm(Arm, Generic[L]):
    """A real arm; its driver says how to ``connect``, and gives the abstract verbs below."""

    def __init__(self, limits: Limits, context: StationContext) -> None:
        self._limits, self._context = limits, context
        self._link: L | None = None
        self._rig: Rig | None = None
        self._latch, self._moving, self._closed = StopLatch(), False, threading.Event()
        self._goal: Float64 | None = None  # where it was sent last
        self._silence = 0.0
        self._fault: ArmFault | None = None

    def connect(self) -> L:
        """Connect to the controller; nothing moves. Raises :class:`ArmFault`: the named state in which it is."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        """Connect, and check that this is the arm it should be; raises ConfigError for another one."""
        self.opening()
        self._link = self.connect()
        try:
            self._check_model(self._link.fresh())
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop, and let go of the controller."""
        link = self._link
        try:
            if link is not None and link.trouble() is None:
                self.halt()
        finally:
            self._closed.set()
            if link is not None:
                link.close()
            self._link = None

    @abstractmethod
    def go(self, start: Sample, goal: Float64, speed: float, check: Callable[[], None]) -> None:
        """Move the fastest joint at ``speed`` rad/s on the straight way, until arrived; ``check`` raises when it shall stop."""

    @abstractmethod
    def halt(self) -> None:
        """Stop the arm if it can be told; one that is not open, or does not move, is left alone."""

    @abstractmethod
    def flange(self, sample: Sample) -> Float64:
        """Find the flange's pose (4, 4) of a sample."""

    def within(self, joints: Float64) -> bool:
        """Ask the controller whether it allows joints (J,); one that cannot be asked leaves this out."""
        del joints
        return True

    def opening(self) -> None:
        """Begin anew: no stop holds, nothing was sent."""
        self._latch, self._goal, self._fault = StopLatch(), None, None
        self._closed.clear()

    def describe(self) -> ArmInfo:
        """Name the model and the controller's address."""
        return ArmInfo(self._limits.model.name, self._limits.host)

    def kinematics(self) -> ArmModel:
        """Give the geometry that every motion is checked with."""
        return self._limits.model

    def equip(self, rig: Rig) -> None:
        """Say what the arm carries; without it nothing moves."""
        self._rig = rig

    def state(self) -> ArmState:
        """Measure the joints now, newer than this call."""
        return self._state(self._opened().fresh())

    def check_move(self, start: Float64, goal: Float64) -> None:
        """Check a motion as ``move_to`` does, the controller's own limits too."""
        if self._rig is None:
            raise MotionRefused("the arm does not know what it carries", hint="open it as part of a station")
        goal = check_goal(self._limits, start, goal)
        check_way(self._limits, self._rig, workcell_of(self._context.config), start, goal)
        if not self.within(goal):
            raise MotionRefused("move: the controller's safety limits refuse the goal")

    def move_to(self, joints: Float64) -> ArmState:
        """Check the way, move, wait until settled.

        Raises :class:`MotionRefused`: motion is not allowed, the goal or the way is refused, or somebody said
        stop (MotionStopped); :class:`NotSettled`: the arm does not come to rest; :class:`ArmFault`: the named
        state in which the arm is now.
        """
        token, link = self._latch.token, self._opened()
        start = link.fresh()
        goal = self._checked(start, joints)
        self._moving = True
        try:
            self._goal = goal
            if np.abs(goal - start.joints).max() > ARRIVED:
                assert self._rig is not None
                cell = workcell_of(self._context.config)
                speed = joint_speed(self._limits, self._rig, cell, start.joints, goal)
                self._latch.check(token)
                self.go(start, goal, speed, lambda: self._latch.check(token))
            return self._state(settle(link, self._limits.settle, lambda: self._latch.check(token)))
        except BaseException:
            self.halt()
            raise
        finally:
            self._moving = False

    def stop(self) -> None:
        """Stop now, and stay so."""
        self._latch.stop()
        self.halt()

    def interrupt(self) -> None:
        """Make a running ``move_to`` stop; from another thread."""
        self._latch.stop()

    def resume(self) -> None:
        """Move again when asked."""
        self._latch.resume(self._latch.token)

    def watch(self, silence: float) -> None:
        """Look after link and safety; stop a motion when the station has fallen silent. See :class:`Device`."""
        self._silence = silence
        link = self._link
        if link is None or self._closed.is_set():
            return
        if self._moving and silence > _PARENT:
            self._latch.stop()
        fault = self._fault or link.overdue()
        if fault is None and not self._moving:  # a move reports its own faults, after stopping
            fault = link.trouble()
        if fault is not None and not self._closed.is_set():
            raise fault

    def _check_model(self, sample: Sample) -> None:
        """Refuse an arm that is not the model: every check of the way would be wrong."""
        if wrong := pose_error(self._limits.model, sample.joints, self.flange(sample)):
            raise ConfigError(f"[arm] {wrong}", hint="is this the arm that the driver is for?")

    def _opened(self) -> L:
        if self._link is None or self._closed.is_set():
            raise NotReady("the arm is not open", hint="use the station as a context manager")
        return self._link

    def _state(self, sample: Sample) -> ArmState:
        return ArmState(sample.joints, self.flange(sample), time.monotonic_ns())

    def _checked(self, start: Sample, joints: Float64) -> Float64:
        if not self._context.allow_motion:
            raise MotionRefused(
                "motion was not allowed in this run",
                hint="look at --dry-run, clear the workspace, then add --allow-motion",
            )
        goal = check_joints(self._limits.model, joints)
        # As a dry run checked it: from where the arm was sent, if it stands there.
        here = start.joints
        if self._goal is not None and np.abs(self._goal - here).max() < 2 * ARRIVED:
            here = self._goal
        self.check_move(here, goal)
        return goal
