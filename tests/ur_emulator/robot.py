"""The emulated robot: joints, safety, the running program and the registers it shares with clients."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from tests.ur_emulator.faults import Faults
from tests.ur_emulator.motion import Motion
from tofcapture.devices.kinematics import HOME, arm_model, forward
from tofcapture.devices.ur_rtde.link import Value
from tofcapture.poses import rotation_log

STOPPED, PLAYING, PAUSED = 1, 2, 4  # runtime_state
NORMAL, PROTECTIVE, EMERGENCY = 1, 3, 7  # safety_mode; 7 is the robot's own emergency stop
_BITS = {NORMAL: 1 << 0, PROTECTIVE: 1 << 2 | 1 << 10, EMERGENCY: 1 << 6 | 1 << 7 | 1 << 10}
_NAMES = {NORMAL: "NORMAL", PROTECTIVE: "PROTECTIVE_STOP", EMERGENCY: "ROBOT_EMERGENCY_STOP"}
_BRAKE = 8.0  # rad/s^2 of a protective stop
_UNLOCK = 5.0  # s; a real controller unlocks no sooner


class Robot:
    """State of the emulated robot, and what time does to it.

    Parameters
    ----------
    model
        ``ur10e`` or ``ur5e``.
    faults
        What goes wrong.
    clock
        Seconds; ``time.monotonic`` unless a test has its own.
    """

    def __init__(
        self,
        model: str,
        faults: Faults,
        clock: Callable[[], float] = time.monotonic,
        serial: str = "20235500001",
    ) -> None:
        self.model, self.faults, self.serial = arm_model(model), faults, serial
        self._clock = clock
        self._start = self._last = clock()
        self.joints: tuple[float, ...] = tuple(float(x) for x in HOME)
        self.velocity: tuple[float, ...] = (0.0,) * 6
        self.motion: Motion | None = None
        self.safety, self._stopped_at = NORMAL, 0.0
        self.runtime, self.remote = STOPPED, True
        self.program: Program | None = None
        self.payload = 1.0
        self.cog: tuple[float, ...] = (0.0,) * 3
        self.tcp: tuple[float, ...] = (0.0,) * 6
        self.int_in: dict[int, int] = {}
        self.double_in: dict[int, float] = {}
        self.int_out: dict[int, int] = {}
        self.double_out: dict[int, float] = {}
        self.written_at = 0.0  # `now` when a client last wrote input_int_register_0
        self._pose: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    @property
    def now(self) -> float:
        """Seconds since the controller was switched on."""
        return self._last - self._start

    def tick(self) -> None:
        """Let time pass, up to the present: the motion goes on, the program runs one cycle, faults come due."""
        now = self._clock()
        passed, self._last = now - self._last, now
        if self.motion is not None:
            self.motion.advance(passed * self.faults.haste, self.faults.speed)
            self.joints, self.velocity = self.motion.position, self.motion.velocity
            if self.motion.finished:
                self.motion, self.velocity = None, (0.0,) * 6
        self._faults()
        if self.runtime == PLAYING and self.program is not None:
            self.program.cycle(self)

    def _faults(self) -> None:
        """Let those happen that wait for a part of a move to be done."""
        for name in self.faults.due(None if self.motion is None else self.motion.share):
            {
                "protective_stop": self.protective_stop,
                "emergency_stop": self.emergency_stop,
                "script_death": self.end_program,
                "drop": self.faults.drop_links,
                "freeze": self.faults.freeze,
                "nan": self.faults.spoil,
            }[name]()

    def move(self, goal: Sequence[float], speed: float, acceleration: float) -> None:
        """Begin to move; URScript stops on values that are no numbers."""
        if not all(map(math.isfinite, (*goal, speed, acceleration))) or speed <= 0 or acceleration <= 0:
            self.end_program()
            return
        self.motion = Motion(self.joints, goal, speed, acceleration)

    def brake(self, deceleration: float) -> None:
        """Come to rest, if it moves."""
        if self.motion is not None:
            self.motion.brake(deceleration)

    def protective_stop(self) -> None:
        """Stop as after a collision: the program is paused, nothing moves until somebody unlocks it."""
        self.safety, self._stopped_at = PROTECTIVE, self._clock()
        self.runtime = PAUSED
        self.brake(_BRAKE)

    def emergency_stop(self) -> None:
        """Stop as by the red button: power is off, the program has ended."""
        self.safety = EMERGENCY
        self.end_program()

    def unlock(self) -> bool:
        """Release a protective stop; refused for five seconds. The paused program is ended."""
        if self.safety != PROTECTIVE or self._clock() - self._stopped_at < _UNLOCK:
            return False
        self.release()
        return True

    def release(self) -> None:
        """Do what a person at the pendant does: clear the stop, whatever it was."""
        self.safety = NORMAL
        self.end_program()

    def start_program(self, program: Program) -> None:
        """Replace the running program."""
        self.end_program()
        if self.safety != NORMAL:
            return
        self.program, self.runtime = program, PLAYING
        self.written_at = self.now

    def end_program(self) -> None:
        """End the program; what moves comes to rest."""
        self.brake(_BRAKE)
        self.program = None
        self.runtime = STOPPED
        self.int_out.update({0: 0, 1: 0, 2: 0})

    @property
    def tcp_pose(self) -> tuple[float, ...]:
        """(6,) position, m, and rotation vector, rad, of the flange: the emulator's TCP offset is zero."""
        if self._pose[0] != self.joints:
            T = forward(self.model, np.asarray(self.joints))
            self._pose = (self.joints, (*T[:3, 3].tolist(), *rotation_log(T[:3, :3]).tolist()))
        return self._pose[1]

    @property
    def safety_name(self) -> str:
        """As the dashboard says it."""
        return _NAMES[self.safety]

    def output(self, name: str) -> Value | None:
        """Value of an RTDE output; ``None`` when the emulator does not have it."""
        if name.startswith("output_int_register_"):
            return self.int_out.get(int(name.rpartition("_")[2]), 0)
        if name.startswith("output_double_register_"):
            return self.double_out.get(int(name.rpartition("_")[2]), 0.0)
        joints = (math.nan,) * 6 if self.faults.spoiled else self.joints
        values: dict[str, Callable[[], Value]] = {
            "timestamp": lambda: self.now,
            "actual_q": lambda: joints,
            "target_q": lambda: self.joints,
            "actual_qd": lambda: self.velocity,
            "target_qd": lambda: self.velocity,
            "actual_TCP_pose": lambda: self.tcp_pose,
            "target_TCP_pose": lambda: self.tcp_pose,
            "robot_mode": lambda: 7 if self.safety != EMERGENCY else 3,
            "safety_mode": lambda: self.safety,
            "safety_status_bits": lambda: _BITS[self.safety],
            "robot_status_bits": lambda: 1 | (2 if self.runtime == PLAYING else 0),
            "runtime_state": lambda: self.runtime,
            "speed_scaling": lambda: self.faults.speed,
            "target_speed_fraction": lambda: self.faults.speed,
            "payload": lambda: self.payload,
            "payload_cog": lambda: self.cog,
            "tcp_offset": lambda: self.tcp,
        }
        return values[name]() if name in values else None


class Program:
    """What a running program does in each cycle; the base of the control script does nothing."""

    def cycle(self, robot: Robot) -> None:
        """Run one cycle."""
