"""The ``[arm]`` table of the driver ``ur_rtde``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tofcapture.devices.arm.limits import Limits, read_limits
from tofcapture.devices.kinematics import arm_model

_RANGES = {"watchdog_hz": (1.0, 10.0), "payload": (0.0, 30.0)}
_TEXTS: dict[str, tuple[str, ...]] = {
    "model": (),
    "serial": (),
    "pose": ("controller", "joints"),
    "controller_limits": ("ask", "ignore"),
}


@dataclass(frozen=True)
class Settings(Limits):
    """Limits of a UR arm.

    ``pose`` says where the flange's pose comes from: the ``controller``, with the arm's calibration in it, or nominal
    kinematics of the measured ``joints``.
    """

    serial: str = ""  # expected serial number of the arm; empty for any
    watchdog_hz: float = 2.0  # the controller stops the program when it hears less often from us
    payload: float = float("nan")  # expected, kg; NaN for any
    pose: str = "controller"
    controller_limits: str = "ask"  # whether goals are within its safety limits; "ignore": it cannot be asked


def read_settings(table: Mapping[str, Any]) -> Settings:
    """Check the table; raises ConfigError for unknown keys, no host, and values out of range."""
    said = read_limits(table, _TEXTS, _RANGES)
    return Settings(model=arm_model(said.pop("model", "ur10e")), **said)
