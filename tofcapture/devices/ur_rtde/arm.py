"""A Universal Robots arm, as it lives in the driver's process."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.devices import Arm
from tofcapture.devices.clearance import workcell_of
from tofcapture.devices.faults import ArmFault, NotReady, StopLatch
from tofcapture.devices.kinematics import check_joints, forward, pose_error
from tofcapture.devices.ur_rtde.limits import (
    ARRIVED,
    check_goal,
    check_way,
    duration,
    follow,
    joint_speed,
    read_settings,
    settle,
)
from tofcapture.devices.ur_rtde.link import Link, Sample
from tofcapture.devices.ur_rtde.probe import Controller, probe
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.frames import ArmInfo, ArmState
from tofcapture.poses import Float64, invert, rotation_exp, transform

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext
    from tofcapture.rig import Rig

_DECELERATION, _HALT = 2.0, 0.2  # rad/s^2 of a stop on request at least; s that it takes at most
_PARENT = (2.0, 10.0)  # s of the station's silence that stop a motion, and an idle arm


class UrArm(Arm):
    """A UR arm behind ``ur_rtde``; ``table`` is that of :class:`limits.Settings`.

    The station's ``context`` says whether motion is allowed, and where things stand.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        self._settings = read_settings(table)
        self._context = context
        self._link: Link | None = None
        self._controller: Controller | None = None
        self._rig: Rig | None = None
        self._T_flange_tcp: Float64 = np.eye(4)
        self._latch, self._moving, self._closed = StopLatch(), False, threading.Event()
        self._goal: Float64 | None = None  # where it was sent last
        self._silence = 0.0
        self._fault: ArmFault | None = None

    def describe(self) -> ArmInfo:
        """Name the model, and the serial number or the address of the station file."""
        return ArmInfo(self._settings.model.name, self._settings.serial or self._settings.host)

    def probe(self) -> str:
        """Ask the controller who and how it is; see :func:`probe.probe`. Nothing is sent that moves."""
        there = probe(self._settings)
        return f"PolyScope {'.'.join(map(str, there.version))}, arm {there.serial or 'unknown'} is ready"

    def __enter__(self) -> Self:
        """Probe, connect, check that this is the arm it should be. Nothing moves.

        Raises :class:`ArmFault`: the named state in which the controller is; :class:`ConfigError`: the arm's
        pose is not that of the model, or the library is missing.
        """
        self._latch, self._goal = StopLatch(), None
        self._controller = probe(self._settings)
        self._closed.clear()
        self._link = Link(self._settings.host, scaling=self._controller.scaling)
        try:
            self._prepare(self._link)
        except BaseException:
            self.__exit__(None, None, None)  # leave no script running on the controller
            raise
        threading.Thread(target=self._keep_alive, daemon=True).start()
        return self

    def _prepare(self, link: Link) -> None:
        """Wait for the script, learn the TCP, check the model, and set the watchdog."""
        link.started()
        self._T_flange_tcp = self._tcp()
        sample = link.fresh()
        self._check_model(sample)
        if not self._within(sample.joints):
            raise NotReady(
                "the controller says that its safety limits do not allow the pose in which the arm stands",
                hint="move it within its limits on the pendant. A controller that denies every pose cannot be asked: "
                '[arm] controller_limits = "ignore" does without, with a caution at each run',
            )
        if not link.command("setWatchdog", 3.0, self._settings.watchdog_hz):
            raise link.reason("setWatchdog")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the script on the controller.

        The library's own farewell is left out: it crashes after a lost link, and its destructors hang. The process ends.
        """
        self._closed.set()
        if self._link is not None and self._link.playing and self._link.trouble() is None:
            self._link.command("stopJ", 2.0, self._deceleration)
            self._link.command("stopScript", 2.0)

    def equip(self, rig: Rig) -> None:
        """Say what the arm carries; without it nothing moves."""
        self._rig = rig

    def cautions(self) -> list[str]:
        """Say which checks the station file leaves out."""
        out = []
        if self._settings.controller_limits == "ignore":
            out.append(
                '[arm] controller_limits = "ignore": the controller is not asked whether goals are within its limits'
            )
        if self._settings.pose == "joints":
            out.append(f'[arm] pose = "joints": nobody checks that this arm is a {self._settings.model.name}')
        return out

    @property
    def _deceleration(self) -> float:
        return max(_DECELERATION, self._settings.speed / _HALT)

    def state(self) -> ArmState:
        """Measure the joints now, newer than this call."""
        return self._state(self._opened().fresh())

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
                self._go(link, start, goal, token)
            return self._state(settle(link, self._settings.settle, lambda: self._latch.check(token)))
        except BaseException:
            self._halt(link)
            raise
        finally:
            self._moving = False

    def check_move(self, start: Float64, goal: Float64) -> None:
        """Check a motion as ``move_to`` does, the controller's own limits too."""
        if self._rig is None:
            raise MotionRefused("the arm does not know what it carries", hint="open it as part of a station")
        goal = check_goal(self._settings, start, goal)
        check_way(self._settings, self._rig, workcell_of(self._context.config), start, goal)
        if not self._within(goal):
            raise MotionRefused("move: the controller's safety limits refuse the goal")

    def stop(self) -> None:
        """Stop now, and stay so; an arm whose script has ended has stopped already."""
        self._latch.stop()
        link = self._link
        if link is not None and not self._closed.is_set() and link.playing:
            link.command("stopJ", 4.0, self._deceleration)

    def interrupt(self) -> None:
        """Make a running ``move_to`` stop; from another thread."""
        self._latch.stop()

    def resume(self) -> None:
        """Move again when asked."""
        self._latch.resume(self._latch.token)

    def watch(self, silence: float) -> None:
        """Look after link, safety and script; stop a motion when the station has fallen silent. See :class:`Device`."""
        self._silence = silence
        link = self._link
        if link is None or self._closed.is_set():
            return
        if self._moving and silence > _PARENT[0]:
            self._latch.stop()
        fault = self._fault or link.overdue()
        if fault is None and not self._moving:  # a move reports its own faults, after stopping
            fault = link.trouble()
        if fault is not None and not self._closed.is_set():
            raise fault

    def _opened(self) -> Link:
        if self._link is None or self._closed.is_set():
            raise NotReady("the arm is not open", hint="use the station as a context manager")
        return self._link

    def _keep_alive(self) -> None:
        """Feed the watchdog between calls, as long as the station lives."""
        while not self._closed.wait(0.1):
            if self._silence > _PARENT[1] or self._moving or self._link is None:
                continue
            try:
                self._link.kick()
            except ArmFault as fault:
                self._fault = fault
                return

    def _tcp(self) -> Float64:
        """(4, 4) pose of the active TCP on the flange: from the data if they have it, else asked."""
        assert self._controller is not None
        offset = self._controller.tcp_offset
        if offset is None and self._settings.pose == "controller":
            offset = tuple(self._opened().command("getTCPOffset", 3.0))
        return np.eye(4) if offset is None or len(offset) != 6 else _matrix(np.array(offset))

    def _check_model(self, sample: Sample) -> None:
        """Refuse an arm that is not the model of the station file: every check of the way would be wrong."""
        if self._settings.pose == "joints":
            return
        if wrong := pose_error(self._settings.model, sample.joints, self._flange(sample)):
            raise ConfigError(
                f"[arm] model {self._settings.model.name}: {wrong}",
                hint='correct [arm] model, or the TCP on the pendant; pose = "joints" does without the controller\'s pose',
            )

    def _flange(self, sample: Sample) -> Float64:
        if self._settings.pose == "joints":
            return forward(self._settings.model, sample.joints)
        return _matrix(sample.pose) @ invert(self._T_flange_tcp)

    def _state(self, sample: Sample) -> ArmState:
        return ArmState(sample.joints, self._flange(sample), time.monotonic_ns())

    def _within(self, joints: Float64) -> bool:
        if self._settings.controller_limits == "ignore":
            return True
        link = self._opened()
        within = bool(link.command("isJointsWithinSafetyLimits", 3.0, joints.tolist()))
        if not within and (fault := link.trouble()) is not None:
            raise fault  # it is not the goal that stands against it
        return within

    def _checked(self, start: Sample, joints: Float64) -> Float64:
        if not self._context.allow_motion:
            raise MotionRefused(
                "motion was not allowed in this run",
                hint="look at --dry-run, clear the workspace, then add --allow-motion",
            )
        goal = check_joints(self._settings.model, joints)
        # As a dry run checked it: from where the arm was sent, if it stands there.
        here = start.joints
        if self._goal is not None and np.abs(self._goal - here).max() < 2 * ARRIVED:
            here = self._goal
        self.check_move(here, goal)
        return goal

    def _go(self, link: Link, start: Sample, goal: Float64, token: object) -> None:
        settings, workcell = self._settings, workcell_of(self._context.config)
        assert self._rig is not None
        speed = joint_speed(settings, self._rig, workcell, start.joints, goal)
        self._latch.check(token)
        if not link.command("moveJ", 5.0, goal.tolist(), speed, settings.acceleration, True):
            raise link.reason("moveJ")
        seconds = duration(goal - start.joints, speed, settings.acceleration)
        follow(link, goal, seconds, lambda: self._latch.check(token))

    def _halt(self, link: Link) -> None:
        """Stop the arm if it can be told; one that cannot has its watchdog."""
        if link.playing and link.seeing:
            link.command("stopJ", 4.0, self._deceleration)


def _matrix(pose: Float64) -> Float64:
    return transform(rotation_exp(pose[3:]), pose[:3])
