"""The driver ``franka``: a Franka Research 3 through ``franky-control``; see docs/devices.md.

::

    [arm]
    driver = "franka"
    host = "172.16.0.2"
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcapture.devices import faults
from tofcapture.devices.arm.checked import CheckedArm
from tofcapture.devices.arm.limits import Limits, Link, Sample, duration, follow, read_limits, stopping
from tofcapture.devices.faults import ArmFault, NotReady
from tofcapture.devices.host import hosted
from tofcapture.devices.kinematics import ArmModel, chain_model
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, rotation_exp, transform

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_PORT = 1337
_CONNECT, _POLL, _LATE = 2.0, 0.02, 0.01  # s; the last until an order to stop is obeyed
_STALE = 1.0  # s without a newer state
_NEAR = np.radians(0.05)  # its joint controller leaves a small error
_JERK = 50.0  # of a stop, times its deceleration: 0.02 s to build it up
_STRETCH = 0.1  # of the time that counts while the library is on the way
_SHARE = 0.01  # of the limits that a joint has at least, however little it turns
_CALM = (1e-3, 1e-2)  # rad/s and rad/s^2 that a motion may begin with
_BRAKES = 2.0  # s that a stop may take before it is cut off
_MARGIN = 0.05  # rad; within the manufacturer's limits
_STATES: dict[str, tuple[type[ArmFault], str, str]] = {
    "Reflex": (faults.ProtectiveStop, "it stopped by reflex", "look for what it hit; press and release the user stop; then start again"),
    "UserStopped": (faults.SafetyStop, "the user stop is pressed", "find out why; release it; then start again"),
    "Guiding": (NotReady, "it is guided by hand", "let go of the guiding button; choose Execution in Desk"),
    "AutomaticErrorRecovery": (NotReady, "it recovers from an error", "wait; then start again"),
    "Other": (NotReady, "its brakes are closed", "unlock the joints and activate FCI in Desk; then start again"),
}  # fmt: skip


def fr3() -> ArmModel:
    """Make the model of the Research 3, from the manufacturer's ``franka_description``."""
    quarter = np.pi / 2
    rows = [
        (0.0, (0, 0, 0.333)), (-quarter, (0, 0, 0)), (quarter, (0, -0.316, 0)), (quarter, (0.0825, 0, 0)),
        (-quarter, (-0.0825, 0.384, 0)), (quarter, (0, 0, 0)), (quarter, (0.088, 0, 0)), (0.0, (0, 0, 0.107)),
    ]  # fmt: skip
    fixed = [transform(rotation_exp(np.array([roll, 0, 0])), np.array(xyz, float)) for roll, xyz in rows]
    low = np.array([-2.9007, -1.8361, -2.9007, -3.077, -2.8763, 0.4398, -3.0508]) + _MARGIN
    high = np.array([2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508]) - _MARGIN
    return chain_model("fr3", fixed, low, high, radius=0.09)


class FrankaLink(Link):
    """The library's connection to the controller at ``host``.

    Raises :class:`ConfigError`: the library is not installed; :class:`ArmFault`: it cannot connect.
    """

    def __init__(self, host: str, *, enforce: bool) -> None:
        try:
            import franky
        except ImportError as err:
            raise ConfigError(
                f"the driver franka needs franky-control: {err}", hint="pip install 'tofcapture[franka]'"
            ) from err
        kind = franky.RealtimeConfig.Enforce if enforce else franky.RealtimeConfig.Ignore
        self.franky, self._host, self._lock, self.moving = franky, host, threading.Lock(), False
        self._newest, self._seen = -1.0, time.monotonic()
        with self.errors("connecting"):
            self.robot: Any = franky.Robot(host, realtime_config=kind)

    @contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Turn the library's errors into named states, here and nowhere else."""
        franky = self.franky
        kinds = {
            franky.NetworkException: faults.LinkLost, franky.IncompatibleVersionException: NotReady,
            franky.RealtimeException: NotReady, franky.ControlException: faults.ProtectiveStop,
            franky.Exception: faults.ProgramStopped,
            RuntimeError: faults.LinkLost,  # of its network library, unless its planner fails
        }  # fmt: skip
        try:
            yield
        except tuple(kinds) as err:
            kind = next(k for e, k in kinds.items() if isinstance(err, e))
            if "planner" in str(err):
                kind = faults.ProgramStopped
            kernel = "realtime" in str(err).lower()
            hint = 'realtime = "ignore" does without, with a caution' if kernel else ""
            raise kind(f"{self._host}: {doing}: {err}", hint) from err

    def _state(self) -> Any:
        """Read the newest state; raises ArmFault for all that is wrong."""
        with self._lock, self.errors("reading the arm's state"):
            state = self.robot.state
            if self.moving:
                self.robot.poll_motion()
        stamp, now = state.time.to_sec(), time.monotonic()
        if stamp != self._newest:
            self._newest, self._seen = stamp, now
        if now - self._seen > _STALE:
            raise faults.StaleData(f"{self._host}: no newer state for {now - self._seen:.1f} s")
        if state.robot_mode.name in _STATES:
            kind, words, hint = _STATES[state.robot_mode.name]
            raise kind(f"the controller reports: {words}", hint)
        return state

    def sample(self) -> Sample:
        """Read joints, speeds and the flange's pose (4, 4), flat after its place."""
        state = self._state()
        joints, speeds = np.array(state.q, float), np.array(state.dq, float)
        T = np.array(state.O_T_EE.matrix, float) @ np.linalg.inv(np.array(state.F_T_EE.matrix, float))
        if not all(np.isfinite(a).all() for a in (joints, speeds, T)):
            raise faults.StaleData(f"{self._host}: the measured joints are no numbers: {joints.tolist()}")
        # The library makes the way as fast as it hears from the arm: late states stretch it.
        scaling = _STRETCH if self.moving and self.robot.is_in_control else 1.0
        return Sample(self._newest, joints, speeds, np.concatenate([T[:3, 3], T.ravel()]), scaling)

    def brake(self) -> Float64:
        """Find where the arm comes to rest if it brakes on its way now; the library's own stop goes back to where it was told."""
        state, most = self.robot.state, self.robot.joint_acceleration_limit.get()
        place, speeds = np.array(state.q_d, float), np.array(state.dq_d, float)
        lead = int(np.abs(speeds).argmax())
        if (speed := float(abs(speeds[lead]))) < _CALM[0]:
            return place
        rate = float(state.ddq_d[lead] * np.sign(speeds[lead]))
        way = stopping(speed, rate, float(most[lead]), _JERK * float(most[lead])) + _LATE * speed
        return place + speeds / speed * way

    def close(self) -> None:
        """Let go of the controller, which talks to one at a time."""
        self.robot = None

    def rest(self) -> None:
        """Wait until no speed or acceleration is commanded: the library begins with them, and a joint of a short way cannot brake."""
        end = self.sample().timestamp + _BRAKES
        while (state := self._state()) and any(
            np.abs(a).max() > most for a, most in zip((state.dq_d, state.ddq_d), _CALM, strict=True)
        ):
            if self._newest > end:
                raise faults.NotSettled(f"{self._host}: a speed is still commanded, after {_BRAKES:g} s")
            time.sleep(_POLL)


class FrankaArm(CheckedArm[FrankaLink]):
    """A Franka Research 3; seven joints, ways straight in joint space.

    Parameters
    ----------
    table
        ``host``; optionally ``realtime`` (``"enforce"``, or ``"ignore"`` for a kernel that is none) and those of
        :class:`tofcapture.devices.arm.limits.Limits`.
    context
        The station: whether motion is allowed, and where things stand.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        said = read_limits(table, {"realtime": ("enforce", "ignore")})
        self._enforce = said.pop("realtime", "enforce") == "enforce"
        super().__init__(Limits(model=fr3(), **said), context)
        self._halting = threading.Lock()

    def probe(self) -> str:
        """See whether a controller listens; it hears nothing else."""
        host = self._limits.host
        try:
            socket.create_connection((host, _PORT), timeout=_CONNECT).close()
        except OSError as err:
            raise faults.ControllerSilent(f"{host}: nothing answers at port {_PORT}: {err}") from err
        return f"{host} listens"

    def cautions(self) -> list[str]:
        """Say what the station file leaves out."""
        late = '[arm] realtime = "ignore": a late command makes the controller stop the arm by reflex'
        return [] if self._enforce else [late]

    def connect(self) -> FrankaLink:
        """Look for the controller, and connect."""
        self.probe()
        return FrankaLink(self._limits.host, enforce=self._enforce)

    def flange(self, sample: Sample) -> Float64:
        """Find the flange's pose: the controller's, without its end effector."""
        return sample.pose[3:].reshape(4, 4)

    def go(self, start: Sample, goal: Float64, speed: float, check: Callable[[], None]) -> None:
        """Move at a speed. Limits in proportion to each joint's turn make the way straight."""
        link, limits = self._opened(), self._limits
        turn = np.abs(goal - start.joints)
        share = np.maximum(turn / turn.max(), _SHARE)
        hard = limits.deceleration
        soft = min(limits.acceleration / hard, 1.0)
        link.rest()
        with link.errors("moving"):
            link.robot.joint_velocity_limit.set(speed * share)
            link.robot.joint_acceleration_limit.set(hard * share)
            link.robot.joint_jerk_limit.set(_JERK * hard * share)
            factor = link.franky.RelativeDynamicsFactor(1.0, soft, soft)
            motion = link.franky.JointMotion(goal.tolist(), relative_dynamics_factor=factor)
            link.robot.move(motion, asynchronous=True)
        link.moving = True
        try:
            seconds = duration(goal - start.joints, speed, limits.acceleration) + 2 / _JERK
            follow(link, goal, seconds, check, _NEAR)
        finally:
            link.moving = False

    def halt(self) -> None:
        """Brake on the way, and let the controller go; who stops and who moves may ask at once."""
        link = self._link
        if link is None or self._closed.is_set():
            return
        with self._halting, link.errors("stopping"):
            if not link.robot.is_in_control:
                return
            link.robot.move(link.franky.JointMotion(link.brake().tolist()), asynchronous=True)
            if not link.robot.join_motion(_BRAKES):
                link.robot.stop()


_DEADLINES = {"__enter__": 12.0, "move_to": 600.0}
DRIVERS = {
    "arm": hosted(
        "arm", "tofcapture.devices.arm.franka:FrankaArm", _DEADLINES, overdue=faults.ControllerSilent
    )
}
