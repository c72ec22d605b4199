"""Limits of a real arm's motion, the checks before every one, and waiting for the arm until it is there and at rest."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from tofcapture.devices.clearance import Workcell, body_of, is_clear, segment_in_box, straight_way
from tofcapture.devices.faults import ArmFault, NotSettled, ProgramStopped
from tofcapture.devices.kinematics import ArmModel, check_joints
from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import Float64
from tofcapture.rig import Rig

_STEP = np.radians(2.0)  # between checks of the way
_CHORD = 1.02  # the way between two checks is longer than its chord, by less than this

_RANGES = {
    "speed": (0.01, 1.05), "camera_speed": (0.01, 1.5), "acceleration": (0.05, 1.4), "max_step_deg": (1.0, 360.0),
    "settle": (0.0, 5.0),
}  # fmt: skip
_BOXES = ("workspace", "keep_out")
_DECELERATION, _HALT = 2.0, 0.2  # rad/s^2 of a stop on request at least; s that it takes at most


@dataclass(frozen=True)
class Limits:
    """Address of the arm, and limits of its motion. Boxes are two corners each, base frame, metres."""

    model: ArmModel  # kinematics for the checks of the way
    host: str  # address of the controller
    speed: float = 0.5  # of joints, rad/s
    camera_speed: float = 0.25  # of flange and cameras, m/s
    acceleration: float = 0.5  # rad/s^2
    # Largest turn of a joint in one motion: a change of the kinematic branch is larger
    max_step_deg: float = 150.0
    settle: float = 0.3  # s of ringing after the arm is measured at rest
    workspace: Float64 | None = None  # (2, 3): flange and cameras stay in this box; None for everywhere
    keep_out: Float64 = field(default_factory=lambda: np.empty((0, 2, 3)))  # (N, 2, 3): nothing enters these

    @property
    def deceleration(self) -> float:
        """Of a stop on request, rad/s^2."""
        return max(_DECELERATION, self.speed / _HALT)


def read_limits(
    table: Mapping[str, Any],
    texts: Mapping[str, tuple[str, ...]],
    ranges: Mapping[str, tuple[float, float]] = {},
) -> dict[str, Any]:
    """Check an ``[arm]`` table of these limits and of a driver's own keys: words, chosen from some or free, and numbers.

    Raises ConfigError for unknown keys, no host, and values out of range.
    """
    ranges = {**_RANGES, **ranges}
    check_keys(table, ("host", *texts, *ranges, *_BOXES), "[arm]")
    out: dict[str, Any] = {key: str(table[key]) for key in ("host", *texts) if key in table}
    if not out.get("host"):
        raise ConfigError('[arm] expected host = "address of the controller"')
    for key, known in texts.items():
        if known and out.get(key, known[0]) not in known:
            raise ConfigError(f"[arm] {key}: expected {' or '.join(known)}, got {out[key]!r}")
    out |= {key: _number(key, table[key], *ranges[key]) for key in ranges if key in table}
    return out | {key: _boxes(key, table[key]) for key in _BOXES if key in table}


def _number(key: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ConfigError(f"[arm] {key}: expected a number from {low} to {high}, got {value!r}")
    return float(value)


def _boxes(key: str, value: Any) -> Float64:
    """One box (2, 3) for the workspace, (N, 2, 3) for keep-outs: lower corner, upper corner."""
    try:
        boxes = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        boxes = np.empty(0)
    dimensions = 2 if key == "workspace" else 3
    good = boxes.ndim == dimensions and boxes.shape[-2:] == (2, 3)
    if not good or not np.isfinite(boxes).all() or (boxes[..., 0, :] >= boxes[..., 1, :]).any():
        what = "[[x, y, z], [x, y, z]]" + (
            ", lower corner first" if dimensions == 2 else ", a list of such boxes"
        )
        raise ConfigError(f"[arm] {key}: expected {what}, got {value!r}")
    return boxes


def check_goal(limits: Limits, start: Float64, joints: ArrayLike) -> Float64:
    """Check that a goal (J,) is sane, and one step away from the measured joints ``start`` at most; radians.

    Raises :class:`MotionRefused`: with the joint and the limit.
    """
    goal = check_joints(limits.model, joints)
    turn = np.degrees(np.abs(goal - start))
    worst = int(turn.argmax())
    if turn[worst] > limits.max_step_deg:
        raise MotionRefused(
            f"move: joint {worst + 1} would turn by {turn[worst]:.0f} deg, allowed are {limits.max_step_deg:.0f}",
            hint="go by way of home; a joint one turn off its plan must be turned back by hand",
        )
    return goal


def check_way(limits: Limits, rig: Rig, workcell: Workcell, start: Float64, goal: Float64) -> None:
    """Go along the straight way in joint space and look for what is in the way.

    Raises :class:`MotionRefused`: out of the workspace, into a keep-out, or against table, object, base or
    itself.
    """
    body = body_of(limits.model, rig, workcell, straight_way(start, goal, _STEP))
    if limits.workspace is not None:
        low, high = limits.workspace
        if ((body.cameras < low) | (body.cameras > high)).any():
            raise MotionRefused("move: flange or cameras would leave the [arm] workspace")
    pieces, radii = np.concatenate([body.arm, body.rig], axis=1), np.concatenate(body.radii)
    for number, box in enumerate(limits.keep_out):
        if segment_in_box(pieces, box[0] - radii[:, None], box[1] + radii[:, None]).any():
            raise MotionRefused(f"move: the way goes through [arm] keep_out {number + 1}")
    if not is_clear(limits.model, rig, workcell, start, goal):
        raise MotionRefused(
            "move: table, object, base or the arm itself is in the way",
            hint="go by way of home; check table, target and keep_out of [plan]",
        )


def joint_speed(limits: Limits, rig: Rig, workcell: Workcell, start: Float64, goal: Float64) -> float:
    """Find the speed of the fastest joint, rad/s, at which neither it nor flange and cameras exceed their limits on a straight way."""
    way = straight_way(start, goal, _STEP)
    places = body_of(limits.model, rig, workcell, way).cameras
    longest = np.abs(np.diff(way, axis=0)).max(axis=1)  # rad of the fastest joint from check to check
    lever = _CHORD * (np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=1) / longest).max()
    return float(min(limits.speed, limits.camera_speed / max(lever, 1e-6)))


ARRIVED = np.radians(0.02)
_POLL, _FRESH = 0.02, 0.002  # s between looks; at data that come each millisecond or eight
_READINGS = 3  # at the goal
_WINDOW = 0.2  # s over which the arm must be at rest
_ASTRAY = 0.05  # rad off the way that was checked
_STILL = (1e-3, 1e-4, np.radians(0.02))  # rad/s of any joint; m of the flange; rad of any joint
_SETTLING = 3.0  # s


@dataclass(frozen=True)
class Sample:
    """One reading of an arm."""

    timestamp: float  # controller's clock, s
    joints: Float64  # (J,) measured, rad
    speeds: Float64  # (J,) measured, rad/s
    pose: Float64  # of the active TCP as the controller says it; its first three numbers are the place, m
    scaling: float = 1.0  # speed slider, 0 to 1


class Link(Protocol):
    """An open connection to a controller."""

    def sample(self) -> Sample:
        """Read what the controller says; raises ArmFault for :meth:`trouble`, and for values that are no numbers."""
        ...

    def fresh(self) -> Sample:
        """Wait for a sample that was measured after this call: the second new one."""
        stamps = {self.sample().timestamp}
        while True:
            sample = self.sample()
            stamps.add(sample.timestamp)
            if len(stamps) > 2:
                return sample
            time.sleep(_FRESH)

    def kick(self) -> None:
        """Feed the controller's watchdog, where there is one."""
        return

    def kick_seeing(self) -> None:
        """Feed the watchdog of a moving arm: only while its data are new, else it shall stop."""
        return

    def close(self) -> None:
        """Let go of the controller."""
        return

    def overdue(self) -> ArmFault | None:
        """Find the command that runs too long; none where the library has time limits of its own."""
        return None

    def trouble(self) -> ArmFault | None:
        """Find what is wrong now."""
        try:
            self.sample()
        except ArmFault as fault:
            return fault
        return None


def follow(
    link: Link, goal: Float64, seconds: float, check: Callable[[], None], near: float = ARRIVED
) -> None:
    """Wait until the arm is at its goal (J,) rad; ``check`` ends the wait by raising MotionStopped.

    Half as much again as the planned ``seconds`` and 2 s are granted, by the controller's clock, longer when the speed slider is low.

    Raises :class:`MotionStopped`: somebody said stop; :class:`ProgramStopped`: the arm did not arrive in
    time, or left the straight way; :class:`ArmFault`: what else went wrong.
    """
    start = link.sample()
    patience, last, there = 1.5 * seconds + 2.0, start.timestamp, 0
    while there < _READINGS:
        check()
        sample = link.sample()
        if (off := _off_way(sample.joints - start.joints, goal - start.joints)) > _ASTRAY:
            raise ProgramStopped(
                f"the arm left the way that was checked, by {np.degrees(off):.1f} deg",
                hint="was it pushed, guided or driven by another program? look at the arm, then start again",
            )
        link.kick_seeing()
        left = float(np.abs(sample.joints - goal).max())
        there = there + 1 if left < near else 0
        patience, last = patience - (sample.timestamp - last) * sample.scaling, sample.timestamp
        if patience < 0:
            raise ProgramStopped(f"the arm did not arrive in time: {np.degrees(left):.1f} deg are left")
        time.sleep(_POLL)


def _off_way(gone: Float64, way: Float64) -> float:
    """Find the largest angle of a joint, rad, between (J,) and the nearest place of the straight ``way`` (J,)."""
    share = float(gone @ way) / max(float(way @ way), 1e-12)
    return float(np.abs(gone - min(max(share, 0.0), 1.0) * way).max())


def settle(link: Link, ringing: float, check: Callable[[], None]) -> Sample:
    """Wait until joints and flange are at rest, then ``ringing`` seconds; returns what is measured after that.

    ``check`` ends the wait by raising MotionStopped.

    Raises :class:`NotSettled`: not at rest within 3 s; :class:`ArmFault`: what else went wrong.
    """
    window: deque[Sample] = deque([link.fresh()])
    end = window[0].timestamp + _SETTLING
    while not _at_rest(window):
        if window[-1].timestamp > end:
            raise NotSettled(
                f"the arm did not come to rest within {_SETTLING:.0f} s",
                hint="look for vibration, a loose base, or freedrive being on",
            )
        check()
        _wait(link, _POLL)
        window.append(link.sample())
        while window[-1].timestamp - window[1].timestamp >= _WINDOW:
            window.popleft()
    _wait(link, ringing)
    check()
    return link.fresh()


def _at_rest(samples: Sequence[Sample]) -> bool:
    """Tell whether speeds of the joints and spread of the flange are those of an arm at rest, for 0.2 s at least."""
    if len(samples) < _READINGS or samples[-1].timestamp - samples[0].timestamp < _WINDOW:
        return False
    speed = max(float(np.abs(s.speeds).max()) for s in samples)
    places = np.stack([s.pose[:3] for s in samples])
    joints = np.stack([s.joints for s in samples])
    return (
        speed < _STILL[0]
        and float(np.linalg.norm(np.ptp(places, axis=0))) < _STILL[1]
        and float(np.ptp(joints, axis=0).max()) < _STILL[2]
    )


def duration(way: Float64, speed: float, acceleration: float) -> float:
    """Tell the seconds of a trapezoidal move by (J,) rad at ``speed`` rad/s and ``acceleration`` rad/s^2 of the longest joint."""
    length = float(np.abs(way).max())
    ramp = speed / acceleration
    if length < speed * ramp:
        return 2 * float(np.sqrt(length / acceleration))
    return length / speed + ramp


def stopping(speed: float, rate: float, most: float, jerk: float) -> float:
    """Tell how far, rad, a joint goes from ``speed`` >= 0 rad/s and ``rate`` rad/s^2 until it rests, at ``most`` rad/s^2 and ``jerk`` rad/s^3."""
    peak = min(most, float(np.sqrt(jerk * speed + rate**2 / 2)))
    rise = max(rate + peak, 0.0) / jerk  # s until it brakes at its peak
    fast, slow = speed + rate * rise - jerk * rise**2 / 2, peak**2 / (2 * jerk)
    braking = max(fast**2 - slow**2, 0.0) / (2 * peak)
    return speed * rise + rate * rise**2 / 2 - jerk * rise**3 / 6 + braking + peak**3 / (6 * jerk**2)


def _wait(link: Link, seconds: float) -> None:
    """Let time pass, the watchdog fed."""
    end = time.monotonic() + seconds
    while True:
        link.kick()
        left = end - time.monotonic()
        if left <= 0:
            return
        time.sleep(min(left, 0.1))
