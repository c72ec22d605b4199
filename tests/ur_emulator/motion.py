"""Joint motion: all joints together along a straight line in joint space, trapezoidal in time."""

from __future__ import annotations

import math
from collections.abc import Sequence

_STEP = 0.002  # s; one cycle of an e-series controller
_NEAR = 1e-7  # rad


class Motion:
    """One move from here to there.

    Parameters
    ----------
    start, goal
        (6,) rad.
    speed, acceleration
        Of the joint that has the longest way, rad/s and rad/s^2.
    """

    def __init__(
        self, start: Sequence[float], goal: Sequence[float], speed: float, acceleration: float
    ) -> None:
        self._start = tuple(start)
        self._way = tuple(g - s for s, g in zip(start, goal, strict=True))
        self._goal = tuple(goal)
        self._speed, self._acceleration = speed, acceleration
        self._length = max((abs(w) for w in self._way), default=0.0)
        self._done, self._rate = 0.0, 0.0  # rad and rad/s along the longest joint's way
        self._braking: float | None = None
        self.finished = self._length < _NEAR

    @property
    def share(self) -> float:
        """Part of the way that is behind, 0 to 1."""
        return 1.0 if self._length < _NEAR else min(1.0, self._done / self._length)

    @property
    def position(self) -> tuple[float, ...]:
        """(6,) rad, now."""
        if self.finished and self._braking is None:
            return self._goal
        return tuple(s + w * self.share for s, w in zip(self._start, self._way, strict=True))

    @property
    def velocity(self) -> tuple[float, ...]:
        """(6,) rad/s, now."""
        scale = 0.0 if self.finished or self._length < _NEAR else self._rate / self._length
        return tuple(w * scale for w in self._way)

    def brake(self, deceleration: float) -> None:
        """Come to rest on the way, at ``deceleration`` rad/s^2."""
        self._braking = max(deceleration, 1e-3)

    def advance(self, seconds: float, scaling: float = 1.0) -> None:
        """Let time pass; ``scaling`` is the speed slider."""
        left = seconds
        while left > 0 and not self.finished:
            dt = min(left, _STEP)
            self._cycle(dt, scaling)
            left -= dt

    def _cycle(self, dt: float, scaling: float) -> None:
        if self._braking is not None:
            self._rate = max(0.0, self._rate - self._braking * dt)
        else:
            room = max(self._length - self._done, 0.0)
            target = min(self._speed * scaling, math.sqrt(2 * self._acceleration * room))
            self._rate = min(target, self._rate + self._acceleration * dt)
        self._done += self._rate * dt
        arrived = self._length - self._done < max(_NEAR, self._rate * dt)
        self.finished = self._rate == 0.0 if self._braking is not None else arrived
