"""The ``[arm]`` table of a station whose driver is ``ur_rtde``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tofcapture.devices.kinematics import ArmModel, arm_model
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

_RANGES = {
    "speed": (0.01, 1.05),
    "acceleration": (0.05, 1.4),
    "max_step_deg": (1.0, 360.0),
    "watchdog_hz": (1.0, 10.0),
    "settle": (0.0, 5.0),
    "payload": (0.0, 30.0),
}
_TEXTS = ("model", "host", "serial", "pose")


@dataclass(frozen=True)
class Settings:
    """How the arm is reached and how it moves.

    Attributes
    ----------
    model
        Kinematics for the checks of the way.
    host
        Address of the controller.
    serial
        Expected serial number of the arm; empty for any.
    speed, acceleration
        Of joints, rad/s and rad/s^2.
    max_step_deg
        Largest turn of one joint in one motion: a change of the kinematic branch is larger.
    watchdog_hz
        The controller stops the program when it hears less often from us.
    settle
        Seconds of ringing after the arm is measured at rest.
    payload
        Expected payload, kg; NaN for any.
    pose
        ``controller``: the flange's pose is the controller's own, with the arm's calibration in it. ``joints``: nominal
        kinematics of the measured joints.
    workspace
        (2, 3) corners of the box, base frame, m, that flange and cameras stay in; ``None`` for everywhere.
    keep_out
        (N, 2, 3) corners of boxes that nothing may enter.
    """

    model: ArmModel
    host: str
    serial: str = ""
    speed: float = 0.5
    acceleration: float = 0.5
    max_step_deg: float = 150.0
    watchdog_hz: float = 2.0
    settle: float = 0.3
    payload: float = float("nan")
    pose: str = "controller"
    workspace: Float64 | None = None
    keep_out: Float64 = field(default_factory=lambda: np.empty((0, 2, 3)))


def read_settings(table: Mapping[str, Any]) -> Settings:
    """Check the ``[arm]`` table.

    Raises
    ------
    ConfigError
        Unknown keys, no host, values out of range.
    """
    known = (*_TEXTS, *_RANGES, "workspace", "keep_out")
    unknown = table.keys() - set(known)
    if unknown:
        raise ConfigError(
            f"[arm] does not know {', '.join(sorted(unknown))}", hint=f"it knows {', '.join(known)}"
        )
    texts = {key: str(table[key]) for key in _TEXTS if key in table}
    if not texts.get("host"):
        raise ConfigError('[arm] ur_rtde: expected host = "address of the controller"')
    if texts.get("pose", "joints") not in {"controller", "joints"}:
        raise ConfigError(f"[arm] pose: expected controller or joints, got {texts['pose']!r}")
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
