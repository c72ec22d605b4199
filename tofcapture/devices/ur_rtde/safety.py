"""The controller's codes, turned into named states here and nowhere else.

Bits of ``safety_status_bits``: 0 normal, 1 reduced, 2 protective stop, 3 recovery, 4 safeguard, 5 system emergency stop,
6 robot emergency stop, 7 emergency stopped, 8 violation, 9 fault, 10 stopped due to safety.
"""

from __future__ import annotations

from tofcapture.devices.faults import (
    ArmFault,
    EmergencyStop,
    NotReady,
    ProgramStopped,
    ProtectiveStop,
    SafetyStop,
)

PLAYING = 2
_RUNNING = 7
_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirming safety", 2: "booting", 3: "power off", 4: "power on",
    5: "idle, brakes closed", 6: "backdrive", 8: "updating firmware",
}  # fmt: skip
_STATES = {0: "is stopping", 1: "stopped", 3: "is pausing", 4: "is paused", 5: "is resuming"}
_STOPS: tuple[tuple[int, type[ArmFault], str], ...] = (
    (1 << 5 | 1 << 6 | 1 << 7, EmergencyStop, "emergency stop"),
    (1 << 8, SafetyStop, "safety violation"),
    (1 << 9, SafetyStop, "safety fault"),
    (1 << 2, ProtectiveStop, "protective stop"),
    (1 << 4, SafetyStop, "safeguard stop"),
    (1 << 3, SafetyStop, "recovery mode"),
    (1 << 10, SafetyStop, "stopped for safety"),
)


def danger(bits: int, mode: int) -> ArmFault | None:
    """What stands in the way of motion.

    Parameters
    ----------
    bits
        ``safety_status_bits``.
    mode
        ``robot_mode``.

    Returns
    -------
    ArmFault or None
        The gravest state first.
    """
    for mask, kind, name in _STOPS:
        if bits & mask:
            return kind(f"the controller reports: {name}")
    if mode != _RUNNING:
        return NotReady(f"the arm is not running: {_MODES.get(mode, f'mode {mode}')}")
    return None


def halted(runtime: int) -> ArmFault | None:
    """What is wrong with the control script, by ``runtime_state``."""
    if runtime == PLAYING:
        return None
    return ProgramStopped(f"the control script {_STATES.get(runtime, f'is in state {runtime}')}")
