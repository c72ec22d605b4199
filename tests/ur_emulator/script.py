"""The register handshake that the control script of ``ur_rtde`` keeps with its client.

The client writes a command's number to input integer register 0. The script answers in output integer register 0: 1 ready,
2 done, until the client writes 0 again. Booleans come back in output integer register 1, vectors in output double registers
0 to 5, the progress of asynchronous moves in output integer register 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from tests.ur_emulator.robot import Program, Robot

_READY, _DONE = 1, 2
_EVERY_CYCLE = {6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)}
_STOP_SCRIPT = 255


class ControlScript(Program):
    """The handshake, one cycle at a time."""

    def __init__(self) -> None:
        self._executing = False
        self._waiting: Callable[[Robot], bool] | None = None  # a blocking command and when it is over
        self._asynchronous = False
        self._operation = self._writes = 0
        self._frequency = 0.0

    def cycle(self, robot: Robot) -> None:
        """Answer the command that stands in the register."""
        if robot.faults.silent("ready"):
            return
        if self._frequency and robot.now - robot.written_at > 1 / self._frequency:
            robot.end_program()
            return
        self._progress(robot)
        command = robot.int_in.get(0, 0)
        if command == 0:
            self._executing, self._waiting = False, None
            robot.int_out[0] = _READY
        elif command == _STOP_SCRIPT:
            robot.end_program()
        elif command in _EVERY_CYCLE:
            robot.int_out[0] = _READY
        else:
            self._regular(robot, command)

    def _regular(self, robot: Robot, command: int) -> None:
        if not self._executing:
            self._executing = True
            self._waiting = self._begin(robot, command)
        if self._waiting is not None and self._waiting(robot):
            self._waiting = None
        if self._waiting is None and robot.program is self and not robot.faults.silent("done"):
            robot.int_out[0] = _DONE

    def _begin(self, robot: Robot, command: int) -> Callable[[Robot], bool] | None:
        """Do a command; what it waits for, if it blocks."""
        doubles = [robot.double_in.get(i, 0.0) for i in range(14)]
        if command == 1:
            return self._move(robot, doubles)
        if command in {33, 34}:
            robot.brake(doubles[0])
            self._settle(robot)
            return _at_rest
        if command == 31:
            robot.protective_stop()
        elif command == 35:
            self._frequency = doubles[0]
        elif command == 17:
            robot.payload, robot.cog = doubles[0], tuple(doubles[1:4])
        elif command in {36, 37}:
            robot.int_out[1] = int(_within(robot, doubles[:6]) if command == 37 else True)
        elif command == 40:
            robot.double_out.update(enumerate(robot.tcp))
        elif command == 47:
            robot.int_out[1] = int(_at_rest(robot))
        return None

    def _move(self, robot: Robot, doubles: list[float]) -> Callable[[Robot], bool] | None:
        robot.move(doubles[:6], doubles[6], doubles[7])
        self._asynchronous = bool(robot.int_in.get(1, 0))
        if not self._asynchronous:
            return _at_rest
        self._operation = (self._operation + 1) % 128
        self._report(robot, 0, running=True)
        return None

    def _progress(self, robot: Robot) -> None:
        if self._asynchronous and _at_rest(robot):
            self._settle(robot)

    def _settle(self, robot: Robot) -> None:
        """Say that the asynchronous move is over."""
        if self._asynchronous:
            self._asynchronous = False
            self._report(robot, 0, running=False)

    def _report(self, robot: Robot, progress: int, *, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        robot.int_out[2] = progress | running << 15 | self._writes << 16 | self._operation << 24


def _at_rest(robot: Robot) -> bool:
    return robot.motion is None


def _within(robot: Robot, joints: list[float]) -> bool:
    return not robot.faults.denies and all(math.isfinite(q) and abs(q) <= 2 * math.pi for q in joints)
