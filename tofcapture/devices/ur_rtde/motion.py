"""Waiting for an arm: until it is there, until it is at rest; the watchdog is fed meanwhile."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from tofcapture.devices.faults import NotSettled, ProgramStopped
from tofcapture.devices.ur_rtde.link import Link, Sample
from tofcapture.poses import Float64

ARRIVED = np.radians(0.02)
_POLL = 0.02  # s
_READINGS = 3  # at the goal
_WINDOW = 0.2  # s over which the arm must be at rest
_STILL = (1e-3, 1e-4, np.radians(0.02))  # rad/s of any joint; m of the flange; rad of any joint
_SETTLING = 3.0  # s


def follow(link: Link, goal: Float64, seconds: float, stop: threading.Event) -> bool:
    """Wait until the arm is at its goal (6,) rad; returns False when ``stop`` ended the wait.

    Half as much again as the planned ``seconds`` and 2 s are granted, longer when the speed slider is low.

    Raises
    ------
    ProgramStopped
        The arm did not arrive in time.
    ArmFault
        What else went wrong.
    """
    patience, last, near = 1.5 * seconds + 2.0, time.monotonic(), 0
    while near < _READINGS:
        if stop.is_set():
            return False
        sample = link.sample()
        link.kick_seeing()
        left = float(np.abs(sample.joints - goal).max())
        near = near + 1 if left < ARRIVED else 0
        now = time.monotonic()
        patience, last = patience - (now - last) * sample.scaling, now
        if patience < 0:
            raise ProgramStopped(f"the arm did not arrive in time: {np.degrees(left):.1f} deg are left")
        time.sleep(_POLL)
    return True


def settle(link: Link, ringing: float) -> Sample:
    """Wait until joints and flange are at rest, then ``ringing`` seconds; returns what is measured after that.

    Raises
    ------
    NotSettled
        Not at rest within 3 s.
    ArmFault
        What else went wrong.
    """
    window: deque[Sample] = deque([link.fresh()])
    end = time.monotonic() + _SETTLING
    while not _at_rest(window):
        if time.monotonic() > end:
            raise NotSettled(
                f"the arm did not come to rest within {_SETTLING:.0f} s",
                hint="look for vibration, a loose base, or freedrive being on",
            )
        _wait(link, _POLL)
        window.append(link.sample())
        while window[-1].timestamp - window[1].timestamp >= _WINDOW:
            window.popleft()
    _wait(link, ringing)
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
