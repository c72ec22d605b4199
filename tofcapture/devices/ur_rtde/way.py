"""Checks before every motion: the goal is sane, the way to it is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.devices.clearance import Stage, is_clear
from tofcapture.devices.kinematics import link_frames
from tofcapture.devices.ur_rtde.settings import Settings
from tofcapture.errors import MotionRefused
from tofcapture.poses import Float64
from tofcapture.rig import Rig

_STEP = np.radians(2.0)  # between checks of the way
_RADIUS = 0.08  # m; of the arm's links and the rig, by which keep-outs grow
_ALONG = np.linspace(0.0, 1.0, 6)


def check_goal(settings: Settings, start: Float64, joints: ArrayLike) -> Float64:
    """Six finite angles within the limits, one step away from here at most.

    Parameters
    ----------
    settings
        Limits.
    start
        (6,) measured joints, rad.
    joints
        (6,) where to go, rad.

    Returns
    -------
    (6,) float64

    Raises
    ------
    MotionRefused
        With the joint and the limit.
    """
    goal = np.array(joints, dtype=np.float64)
    if goal.shape != (6,) or not np.isfinite(goal).all():
        raise MotionRefused(f"move: expected 6 finite joint angles, got {goal.tolist()}")
    limit = settings.model.limit
    worst = int(np.abs(goal).argmax())
    if abs(goal[worst]) > limit:
        raise MotionRefused(f"move: joint {worst + 1} at {goal[worst]:.3f} rad is outside +-{limit:.3f} rad")
    turn = np.degrees(np.abs(goal - start))
    worst = int(turn.argmax())
    if turn[worst] > settings.max_step_deg:
        raise MotionRefused(
            f"move: joint {worst + 1} would turn by {turn[worst]:.0f} deg, allowed are {settings.max_step_deg:.0f}",
            hint="go by way of home; a joint one turn off its plan must be turned back by hand",
        )
    return goal


def check_way(settings: Settings, rig: Rig, stage: Stage, start: Float64, goal: Float64) -> None:
    """Go along the straight way in joint space and look for what is in the way.

    Raises
    ------
    MotionRefused
        Out of the workspace, into a keep-out, or against table, object, base or itself.
    """
    count = max(2, int(np.ceil(np.abs(goal - start).max() / _STEP)) + 1)
    path = start + (goal - start) * np.linspace(0, 1, count)[:, None]
    links, tools = _points(settings, rig, path)
    if settings.workspace is not None:
        low, high = settings.workspace
        if ((tools < low) | (tools > high)).any():
            raise MotionRefused("move: flange or cameras would leave the [arm] workspace")
    body = np.concatenate([links, tools], axis=1)
    for number, (low, high) in enumerate(settings.keep_out):
        if ((body > low - _RADIUS) & (body < high + _RADIUS)).all(axis=-1).any():
            raise MotionRefused(f"move: the way goes through [arm] keep_out {number + 1}")
    if not is_clear(settings.model, rig, stage, start, goal):
        raise MotionRefused(
            "move: table, object, base or the arm itself is in the way",
            hint="go by way of home; check table, target and keep_out of [plan]",
        )


def _points(settings: Settings, rig: Rig, path: NDArray[np.float64]) -> tuple[Float64, Float64]:
    """Points (N, K, 3) along the links, and (N, 3, 3) flange and both cameras, for joints (N, 6)."""
    frames = link_frames(settings.model, path)
    origins = frames[:, :, :3, 3]
    a, b = origins[:, :-1, None, :], origins[:, 1:, None, :]
    links = (a + (b - a) * _ALONG[:, None]).reshape(len(path), -1, 3)
    flange = frames[:, 5]
    tools = [flange, flange @ rig.T_flange_tof, flange @ rig.T_flange_stereo]
    return links, np.stack([T[:, :3, 3] for T in tools], axis=1)
