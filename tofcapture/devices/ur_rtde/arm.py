"""A Universal Robots arm, as it lives in the driver's process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.devices.arm.checked import CheckedArm
from tofcapture.devices.arm.limits import Sample, duration, follow
from tofcapture.devices.faults import ArmFault, NotReady
from tofcapture.devices.kinematics import forward, pose_error
from tofcapture.devices.ur_rtde.link import Link
from tofcapture.devices.ur_rtde.probe import Controller, probe
from tofcapture.devices.ur_rtde.settings import read_settings
from tofcapture.errors import ConfigError
from tofcapture.frames import ArmInfo
from tofcapture.poses import Float64, invert, rotation_exp, transform

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_PARENT = 10.0  # s of the station's silence after which an idle arm's watchdog is not fed


class UrArm(CheckedArm[Link]):
    """A UR arm behind ``ur_rtde``; ``table`` is that of :class:`settings.Settings`.

    The station's ``context`` says whether motion is allowed, and where things stand.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        self._settings = read_settings(table)
        super().__init__(self._settings, context)
        self._controller: Controller | None = None
        self._T_flange_tcp: Float64 = np.eye(4)

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
        self._controller = probe(self._settings)
        self.opening()
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
        if not self.within(sample.joints):
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
            self._link.command("stopJ", 2.0, self._settings.deceleration)
            self._link.command("stopScript", 2.0)

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

    def stop(self) -> None:
        """Stop now, and stay so; an arm whose script has ended has stopped already."""
        self._latch.stop()
        link = self._link
        if link is not None and not self._closed.is_set() and link.playing:
            link.command("stopJ", 4.0, self._settings.deceleration)

    def _keep_alive(self) -> None:
        """Feed the watchdog between calls, as long as the station lives."""
        while not self._closed.wait(0.1):
            if self._silence > _PARENT or self._moving or self._link is None:
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
        if wrong := pose_error(self._settings.model, sample.joints, self.flange(sample)):
            raise ConfigError(
                f"[arm] model {self._settings.model.name}: {wrong}",
                hint='correct [arm] model, or the TCP on the pendant; pose = "joints" does without the controller\'s pose',
            )

    def flange(self, sample: Sample) -> Float64:
        """Find the flange's pose of a sample."""
        if self._settings.pose == "joints":
            return forward(self._settings.model, sample.joints)
        return _matrix(sample.pose) @ invert(self._T_flange_tcp)

    def within(self, joints: Float64) -> bool:
        """Ask the controller whether joints are within its safety limits."""
        if self._settings.controller_limits == "ignore":
            return True
        link = self._opened()
        within = bool(link.command("isJointsWithinSafetyLimits", 3.0, joints.tolist()))
        if not within and (fault := link.trouble()) is not None:
            raise fault  # it is not the goal that stands against it
        return within

    def go(self, start: Sample, goal: Float64, speed: float, check: Callable[[], None]) -> None:
        """Move at a speed; see :class:`CheckedArm`."""
        link = self._opened()
        if not link.command("moveJ", 5.0, goal.tolist(), speed, self._settings.acceleration, True):
            raise link.reason("moveJ")
        seconds = duration(goal - start.joints, speed, self._settings.acceleration)
        follow(link, goal, seconds, check)

    def halt(self) -> None:
        """Stop the arm if it can be told; one that cannot has its watchdog."""
        link = self._link
        if link is not None and link.playing and link.seeing:
            link.command("stopJ", 4.0, self._settings.deceleration)


def _matrix(pose: Float64) -> Float64:
    return transform(rotation_exp(pose[3:]), pose[:3])
