"""The ``[arm]`` table of the driver ``ur_rtde``, the checks before every motion, and waiting for an arm until it is there and at rest."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofcapture.devices.clearance import Workcell, body_of, is_clear, segment_in_box, straight_way
from tofcapture.devices.faults import NotSettled, ProgramStopped
from tofcapture.devices.kinematics import ArmModel, arm_model, check_joints
from tofcapture.devices.registry import check_keys
from tofcapture.devices.ur_rtde.link import Link, Sample
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import Float64
from tofcapture.rig import Rig

_STEP = np.radians(2.0)  # between checks of the way
_CHORD = 1.02  # the way between two checks is longer than its chord, by less than this

_RANGES = {
    "speed": (0.01, 1.05), "camera_speed": (0.01, 1.5), "acceleration": (0.05, 1.4), "max_step_deg": (1.0, 360.0), "watchdog_hz": (1.0, 10.0),
    "settle": (0.0, 5.0), "payload": (0.0, 30.0),
}  # fmt: skip
_TEXTS = ("model", "host", "serial", "pose", "controller_limits")
_CHOICES = {"pose": ("controller", "joints"), "controller_limits": ("ask", "ignore")}


@dataclass(frozen=True)
class Settings:
    """Address of the arm, and limits of its motion.

    ``pose`` says where the flange's pose comes from: the ``controller``, with the arm's calibration in it, or nominal
    kinematics of the measured ``joints``. Boxes are two corners each, base frame, metres.
    """

    model: ArmModel  # kinematics for the checks of the way
    host: str  # address of the controller
    serial: str = ""  # expected serial number of the arm; empty for any
    speed: float = 0.5  # of joints, rad/s
    camera_speed: float = 0.25  # of flange and cameras, m/s
    acceleration: float = 0.5  # rad/s^2
    # Largest turn of a joint in one motion: a change of the kinematic branch is larger
    max_step_deg: float = 150.0
    watchdog_hz: float = 2.0  # the controller stops the program when it hears less often from us
    settle: float = 0.3  # s of ringing after the arm is measured at rest
    payload: float = float("nan")  # expected, kg; NaN for any
    pose: str = "controller"
    controller_limits: str = "ask"  # whether goals are within its safety limits; "ignore": it cannot be asked
    workspace: Float64 | None = None  # (2, 3): flange and cameras stay in this box; None for everywhere
    keep_out: Float64 = field(default_factory=lambda: np.empty((0, 2, 3)))  # (N, 2, 3): nothing enters these


def read_settings(table: Mapping[str, Any]) -> Settings:
    """Check the ``[arm]`` table; raises ConfigError for unknown keys, no host, and values out of range."""
    check_keys(table, (*_TEXTS, *_RANGES, "workspace", "keep_out"), "[arm]")
    texts = {key: str(table[key]) for key in _TEXTS if key in table}
    if not texts.get("host"):
        raise ConfigError('[arm] ur_rtde: expected host = "address of the controller"')
    for key, known in _CHOICES.items():
        if texts.get(key, known[0]) not in known:
            raise ConfigError(f"[arm] {key}: expected {' or '.join(known)}, got {texts[key]!r}")
    model = arm_model(texts.pop("model", "ur10e"))
    numbers = {key: _number(key, table[key]) for key in _RANGES if key in table}
    boxes = {key: _boxes(key, table[key]) for key in ("workspace", "keep_out") if key in table}
    return Settings(model=model, **texts, **numbers, **boxes)  # type: ignore[arg-type]


def _number(key: str, value: Any) -> float:
    low, high = _RANGES[key]
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


def check_goal(settings: Settings, start: Float64, joints: ArrayLike) -> Float64:
    """Check that a goal (6,) is sane, and one step away from the measured joints ``start`` at most; radians.

    Raises :class:`MotionRefused`: with the joint and the limit.
    """
    goal = check_joints(settings.model, joints)
    turn = np.degrees(np.abs(goal - start))
    worst = int(turn.argmax())
    if turn[worst] > settings.max_step_deg:
        raise MotionRefused(
            f"move: joint {worst + 1} would turn by {turn[worst]:.0f} deg, allowed are {settings.max_step_deg:.0f}",
            hint="go by way of home; a joint one turn off its plan must be turned back by hand",
        )
    return goal


def check_way(settings: Settings, rig: Rig, workcell: Workcell, start: Float64, goal: Float64) -> None:
    """Go along the straight way in joint space and look for what is in the way.

    Raises :class:`MotionRefused`: out of the workspace, into a keep-out, or against table, object, base or
    itself.
    """
    body = body_of(settings.model, rig, workcell, straight_way(start, goal, _STEP))
    if settings.workspace is not None:
        low, high = settings.workspace
        if ((body.cameras < low) | (body.cameras > high)).any():
            raise MotionRefused("move: flange or cameras would leave the [arm] workspace")
    pieces, radii = np.concatenate([body.arm, body.rig], axis=1), np.concatenate(body.radii)
    for number, box in enumerate(settings.keep_out):
        if segment_in_box(pieces, box[0] - radii[:, None], box[1] + radii[:, None]).any():
            raise MotionRefused(f"move: the way goes through [arm] keep_out {number + 1}")
    if not is_clear(settings.model, rig, workcell, start, goal):
        raise MotionRefused(
            "move: table, object, base or the arm itself is in the way",
            hint="go by way of home; check table, target and keep_out of [plan]",
        )


def joint_speed(settings: Settings, rig: Rig, workcell: Workcell, start: Float64, goal: Float64) -> float:
    """Find the speed of the fastest joint, rad/s, at which neither it nor flange and cameras exceed their limits on a straight way."""
    way = straight_way(start, goal, _STEP)
    places = body_of(settings.model, rig, workcell, way).cameras
    longest = np.abs(np.diff(way, axis=0)).max(axis=1)  # rad of the fastest joint from check to check
    lever = _CHORD * (np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=1) / longest).max()
    return float(min(settings.speed, settings.camera_speed / max(lever, 1e-6)))


ARRIVED = np.radians(0.02)
_POLL = 0.02  # s
_READINGS = 3  # at the goal
_WINDOW = 0.2  # s over which the arm must be at rest
_STILL = (1e-3, 1e-4, np.radians(0.02))  # rad/s of any joint; m of the flange; rad of any joint
_SETTLING = 3.0  # s


def follow(link: Link, goal: Float64, seconds: float, check: Callable[[], None]) -> None:
    """Wait until the arm is at its goal (6,) rad; ``check`` ends the wait by raising MotionStopped.

    Half as much again as the planned ``seconds`` and 2 s are granted, longer when the speed slider is low.

    Raises :class:`MotionStopped`: somebody said stop; :class:`ProgramStopped`: the arm did not arrive in
    time; :class:`ArmFault`: what else went wrong.
    """
    patience, last, near = 1.5 * seconds + 2.0, time.monotonic(), 0
    while near < _READINGS:
        check()
        sample = link.sample()
        link.kick_seeing()
        left = float(np.abs(sample.joints - goal).max())
        near = near + 1 if left < ARRIVED else 0
        now = time.monotonic()
        patience, last = patience - (now - last) * sample.scaling, now
        if patience < 0:
            raise ProgramStopped(f"the arm did not arrive in time: {np.degrees(left):.1f} deg are left")
        time.sleep(_POLL)


def settle(link: Link, ringing: float, check: Callable[[], None]) -> Sample:
    """Wait until joints and flange are at rest, then ``ringing`` seconds; returns what is measured after that.

    ``check`` ends the wait by raising MotionStopped.

    Raises :class:`NotSettled`: not at rest within 3 s; :class:`ArmFault`: what else went wrong.
    """
    window: deque[Sample] = deque([link.fresh()])
    end = time.monotonic() + _SETTLING
    while not _at_rest(window):
        if time.monotonic() > end:
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
    """Tell the seconds of a trapezoidal move by (6,) rad at ``speed`` rad/s and ``acceleration`` rad/s^2 of the longest joint."""
    length = float(np.abs(way).max())
    ramp = speed / acceleration
    if length < speed * ramp:
        return 2 * float(np.sqrt(length / acceleration))
    return length / speed + ramp


def _wait(link: Link, seconds: float) -> None:
    """Let time pass, the watchdog fed."""
    end = time.monotonic() + seconds
    while True:
        link.kick()
        left = end - time.monotonic()
        if left <= 0:
            return
        time.sleep(min(left, 0.1))
