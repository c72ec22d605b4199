"""Make a simulated station fail on demand, for tests of recovery.

::

    [sim.faults]
    arm_refuses = [2]      # the move before the ToF camera's burst number 2 is refused
    tof_drops = [4]        # burst number 4 is lost
    stereo_empty = [5]     # the point map after burst number 5 holds no point
    stereo_fails = [6]     # the stereo camera does not answer after burst number 6
    moves = [7]            # the arm moves by ``shift`` between burst number 7 and the point map
    shift = 0.001          # metres
    slow = 0.2             # seconds that every burst and every point map takes longer
    until = 20             # bursts after which nothing goes wrong any more

Bursts are counted from 0 since the station was opened, lost ones too, so each fault strikes once and a second try succeeds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, DeviceError, MotionRefused
from tofcapture.poses import Float64, transform


@dataclass(frozen=True)
class FaultPlan:
    """What goes wrong when; see the module's head."""

    arm_refuses: tuple[int, ...] = ()
    tof_drops: tuple[int, ...] = ()
    stereo_empty: tuple[int, ...] = ()
    stereo_fails: tuple[int, ...] = ()
    moves: tuple[int, ...] = ()
    shift: float = 0.001
    slow: float = 0.0
    until: float = np.inf


def read_faults(table: Mapping[str, Any]) -> FaultPlan:
    """Read ``[sim.faults]``; :class:`ConfigError` on unknown keys, and anything but lists of burst numbers or numbers."""
    known = {f.name: f.default for f in fields(FaultPlan)}
    check_keys(table, known, "[sim.faults]")
    values: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(known[key], tuple):
            good, expected = (
                isinstance(value, list) and all(type(k) is int and k >= 0 for k in value),
                "a list of burst numbers",
            )
        else:
            good, expected = type(value) in (int, float) and value >= 0, "a number from 0 on"
        if not good:
            raise ConfigError(f"[sim.faults] {key}: expected {expected}, got {value!r}")
        values[key] = tuple(value) if isinstance(value, list) else float(value)
    return FaultPlan(**values)


class Faults:
    """The faults of one open station; ``sleep`` is how slow devices wait."""

    def __init__(self, plan: FaultPlan, sleep: Callable[[float], None] = time.sleep) -> None:
        self._plan, self._sleep = plan, sleep
        self._bursts = 0
        self._refused: set[int] = set()
        self.offset: Float64 = np.eye(
            4
        )  # how far the flange has moved from where it was sent, in its own frame

    def _strikes(self, when: tuple[int, ...], burst: int) -> bool:
        return burst in when and burst < self._plan.until

    def before_move(self) -> None:
        """Refuse a move as planned, once before each listed burst; raises :class:`MotionRefused`."""
        self.offset = np.eye(4)
        if self._strikes(self._plan.arm_refuses, self._bursts) and self._bursts not in self._refused:
            self._refused.add(self._bursts)
            raise MotionRefused(f"fault on demand: the arm refuses to move before burst {self._bursts}")

    def before_burst(self) -> None:
        """Lose the burst that the ToF camera is about to take, as planned; raises :class:`DeviceError`."""
        burst, self._bursts = self._bursts, self._bursts + 1
        self._wait(burst)
        if self._strikes(self._plan.tof_drops, burst):
            raise DeviceError(f"fault on demand: the ToF camera lost burst {burst}")

    def before_points(self) -> bool:
        """Move the arm or raise :class:`DeviceError`, as planned; tells whether the point map is to be empty."""
        burst = self._bursts - 1
        self._wait(burst)
        if self._strikes(self._plan.stereo_fails, burst):
            raise DeviceError(f"fault on demand: the stereo camera does not answer after burst {burst}")
        if self._strikes(self._plan.moves, burst):
            self.offset = transform(np.eye(3), [self._plan.shift, 0.0, 0.0])
        return self._strikes(self._plan.stereo_empty, burst)

    def _wait(self, burst: int) -> None:
        if self._plan.slow and burst < self._plan.until:
            self._sleep(self._plan.slow)
