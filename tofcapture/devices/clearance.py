"""A coarse model of where the arm and the rig may be, stricter than needed, behind the controller's own safety limits.

The arm is a chain of points every few centimetres along its links, the rig a ball about its cameras. None may come near
the table, into the keep-out cylinder about the object, to the arm's own base, or to its upper arm. Plans are made with
it, and drivers of real arms check every motion with it. It does not replace safety planes in the controller.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.kinematics import HOME, ArmModel, link_frames
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import Float64, check_transform
from tofcapture.rig import Rig

_LINK = 0.08  # m; radius of the arm's links
_BLOCK = 0.07  # m; radius of the ball about the cameras
_TABLE_MARGIN = 0.04  # m; air above the table, beyond the radii
_COLUMN = 0.20  # m; the flange and the rig keep this far from the base's axis
_STEP = np.radians(3.0)  # largest joint step between checks on a path
_SAMPLES = np.linspace(0.0, 1.0, 8)

_SHAPES = {"target": (3,), "board": (3,), "board_normal": (3,), "home": (6,)}  # the others are numbers

REASONS = ("table", "object", "base", "self")


@dataclass(frozen=True)
class Workcell:
    """Places of table, object and board, in the base frame, metres."""

    table: float  # height of the table top
    target: Float64  # (3,) what object views look at
    board: Float64  # (3,) what calibration views look at
    board_normal: Float64  # (3,) the direction that the board's front faces
    keep_out_radius: float = 0.30  # of an upright cylinder about the target
    keep_out_height: float = 0.30  # of it, above the table
    home: Float64 = field(default_factory=HOME.copy)  # (6,) rad; from there every view is reached


def workcell_of(config: Mapping[str, Any]) -> Workcell:
    """Read the ``[plan]`` table of a station; raises ConfigError unless all of it are finite numbers of known names."""
    table = config.get("plan")
    if table is None:
        raise ConfigError("station: expected a table [plan] that says where the table and the object stand")
    try:
        values = {key: np.asarray(value, dtype=np.float64) for key, value in table.items()}
        workcell = Workcell(**{key: v if v.ndim else float(v) for key, v in values.items()})  # type: ignore[arg-type]
    except (TypeError, ValueError) as err:
        raise ConfigError(
            f"station: [plan]: {err}", hint="see the comments of the embedded station.toml"
        ) from err
    for key, v in values.items():
        shape = _SHAPES.get(key, ())
        if v.shape != shape or not np.isfinite(v).all():
            raise ConfigError(
                f"station: [plan] {key}: expected {f'{shape[0]} finite numbers' if shape else 'a finite number'}, got {v.tolist()}"
            )
    return workcell


def body_points(model: ArmModel, rig: Rig, joints: NDArray[np.floating]) -> tuple[Float64, Float64]:
    """Points of the arm and of what it carries, base frame, metres, at joint angles (..., 6), radians.

    Returns
    -------
    (..., 40, 3) along the links, and (..., 3, 3): flange, ToF camera, stereo camera.
    """
    frames = link_frames(model, joints)
    origins, flange = frames[..., :3, 3], frames[..., 5, :, :]
    a, b = origins[..., :-1, None, :], origins[..., 1:, None, :]
    links = a + (b - a) * _SAMPLES[:, None]
    carried = [flange, *(flange @ check_transform(T) for T in (rig.T_flange_tof, rig.T_flange_stereo))]
    tools = np.stack([T[..., :3, 3] for T in carried], axis=-2)
    return links.reshape(*links.shape[:-3], links.shape[-3] * len(_SAMPLES), 3), tools


def obstacles(
    model: ArmModel, rig: Rig, workcell: Workcell, joints: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Say what is in the way at joint angles (..., 6), radians; returns (..., 4), one per entry of :data:`REASONS`."""
    links, tools = body_points(model, rig, joints)
    cameras = tools[..., 1:, :]
    origins = np.concatenate([links[..., :: len(_SAMPLES), :], tools[..., :1, :]], axis=-2)
    wrist = np.concatenate([origins[..., 3:, :], cameras], axis=-2)
    return np.stack(
        [
            _low(links, workcell, _LINK) | _low(cameras, workcell, _BLOCK),
            _inside(links, workcell, _LINK) | _inside(cameras, workcell, _BLOCK),
            (np.linalg.norm(tools[..., :2], axis=-1) < _COLUMN).any(axis=-1),
            (_to_segment(wrist, origins[..., 0, :], origins[..., 1, :]) < 2 * _LINK).any(axis=-1)
            | (_to_segment(cameras, origins[..., 1, :], origins[..., 2, :]) < _LINK + _BLOCK).any(axis=-1),
        ],
        axis=-1,
    )


def _low(points: Float64, workcell: Workcell, radius: float) -> NDArray[np.bool_]:
    """Any of the points (..., N, 3) too close above the table."""
    out: NDArray[np.bool_] = np.any(points[..., 2] < workcell.table + radius + _TABLE_MARGIN, axis=-1)
    return out


def _inside(points: Float64, workcell: Workcell, radius: float) -> NDArray[np.bool_]:
    """Any of the points (..., N, 3) inside the keep-out cylinder grown by a radius."""
    aside = np.linalg.norm(points[..., :2] - workcell.target[:2], axis=-1) < workcell.keep_out_radius + radius
    below = points[..., 2] < workcell.table + workcell.keep_out_height + radius
    out: NDArray[np.bool_] = np.any(aside & below, axis=-1)
    return out


def _to_segment(points: Float64, a: Float64, b: Float64) -> Float64:
    """(..., N) distance of points (..., N, 3) to the segments a-b (..., 3)."""
    along = (b - a)[..., None, :]
    offset = points - a[..., None, :]
    t = np.clip((offset * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12), 0, 1)
    out: Float64 = np.linalg.norm(offset - t[..., None] * along, axis=-1)
    return out


def straight_way(start: Float64, goal: Float64, step: float) -> Float64:
    """Joint angles (N, 6) along the straight way in joint space, ``step`` radians apart at most, both ends included."""
    count = max(2, int(np.ceil(np.abs(goal - start).max() / step)) + 1)
    way: Float64 = start + (goal - start) * np.linspace(0, 1, count)[:, None]
    return way


def is_clear(model: ArmModel, rig: Rig, workcell: Workcell, start: Float64, goal: Float64) -> bool:
    """Tell whether the straight way in joint space from (6,) to (6,) meets nothing."""
    return not obstacles(model, rig, workcell, straight_way(start, goal, _STEP)).any()


def route(model: ArmModel, rig: Rig, workcell: Workcell, start: Float64, goal: Float64) -> list[Float64]:
    """Goals (6,) to visit one after the other: straight if nothing is in the way, else by way of home.

    Raises MotionRefused when neither way is clear.
    """
    for way in ([goal], [workcell.home, goal]):
        if all(is_clear(model, rig, workcell, a, b) for a, b in zip([start, *way], way, strict=False)):
            return way
    raise MotionRefused(
        "no clear way to the next view, straight or by way of home",
        hint="move the arm by hand to its home pose; check table, target and keep_out of [plan]",
    )
