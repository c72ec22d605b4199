"""Which views to take of a scene: spread over directions and distances, reachable, clear of everything.

A UR arm reaches far fewer views than one expects. The plan tries thousands of candidates and keeps those that are clear, at
the goal and on the straight way from home. It picks from them by greedy farthest-point sampling over direction and
distance: 10 views are the first 10 of 25, so a recording can be extended. A person may turn the object between views.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.clearance import Stage, is_clear, stage_of
from tofcapture.devices.kinematics import ArmModel, arm_model, forward
from tofcapture.devices.station import Station
from tofcapture.errors import ConfigError
from tofcapture.files.view import check_scene_name
from tofcapture.frames import CALIBRATION
from tofcapture.poses import Float64, rotate_vectors
from tofcapture.record.candidates import (
    JOINT_WEIGHTS,
    REFUSALS,
    REMEDIES,
    Bools,
    Sampling,
    board_sampling,
    candidates,
    flange_poses,
    hold_poses,
    leans,
    object_sampling,
)
from tofcapture.rig import Rig

_LOG_DISTANCE = 0.6  # rad per e-fold of distance: how much a nearer view counts against a turned one
_FEW = 24  # candidates that each pick of the sampling chooses among
_MOST_TURNS = 36


@dataclass(frozen=True)
class PlannedView:
    """One view to take; lengths in metres, angles in radians."""

    index: int  # rank in the sampling, not in the order of travel
    joints: Float64  # (6,) goal
    T_base_flange: Float64  # (4, 4) nominal pose there
    distance: float  # from the ToF camera to the target
    direction: Float64  # (3,) unit, from the target to the camera, base frame
    turn: float = 0.0  # of the object about the vertical, counter-clockwise seen from above

    @property
    def digest(self) -> str:
        """Name the pose of arm and object: a view of another digest is another view."""
        numbers = np.append(self.joints, self.turn) if self.turn else self.joints
        return hashlib.sha256((np.round(numbers, 6) + 0.0).tobytes()).hexdigest()[:16]

    def as_json(self) -> dict[str, Any]:
        """Write the view as JSON types."""
        return {
            "index": self.index,
            "joints": self.joints.tolist(),
            "distance": self.distance,
            "direction": self.direction.tolist(),
            "turn_deg": round(float(np.degrees(self.turn)), 6),
        }


@dataclass(frozen=True)
class Tried:
    """What became of the candidates."""

    spots: Float64  # (C, 3) where the ToF camera would stand, base frame, metres
    refusal: NDArray[np.int8]  # (C,) index into REFUSALS, -1 where nothing stands against it


@dataclass(frozen=True)
class Plan:
    """Views in the order of travel, and why there are not more."""

    views: tuple[PlannedView, ...]
    wanted: int  # how many views were asked for
    candidates: int  # how many were tried
    refused: dict[str, int]  # candidates by refusal; "way from home" counts those that sampling came upon
    tried: Tried | None = field(default=None, repr=False, compare=False)

    @property
    def digest(self) -> str:
        """Name the whole plan, whatever the order of travel."""
        ordered = sorted(self.views, key=lambda v: v.index)
        return hashlib.sha256("".join(v.digest for v in ordered).encode()).hexdigest()[:16]

    def summary(self) -> str:
        """Say in one line how many views there are, and what stood against the other candidates."""
        refused = ", ".join(f"{count} {reason}" for reason, count in self.refused.items() if count)
        return f"{len(self.views)} of {self.wanted} views; {self.candidates} candidates, refused: {refused or 'none'}"

    def shortfall(self) -> list[str]:
        """Say why there are fewer views than wanted, the commonest reason first; nothing when there are enough."""
        if len(self.views) >= self.wanted:
            return []
        counts = sorted(((n, reason) for reason, n in self.refused.items() if n), reverse=True)
        lines = [
            f"only {len(self.views)} of {self.wanted} views can be taken, of {self.candidates} candidates"
        ]
        lines += [f"  {n} are {REMEDIES[reason][0]}: {REMEDIES[reason][1]}" for n, reason in counts]
        return [*lines, "  or have the object turned between views: --turns 4"]

    def as_json(self) -> dict[str, Any]:
        """Write the plan as JSON types."""
        views = [view.as_json() for view in self.views]
        numbers = {"wanted": self.wanted, "candidates": self.candidates, "refused": self.refused}
        return {"digest": self.digest, **numbers, "views": views}


def plan_scene(station: Station, scene: str, views: int, turns: int = 1) -> Plan:
    """Plan the views of a scene on a station: its arm, its rig, its ``[plan]``, its seed.

    Raises :class:`ConfigError`: the name is no safe file name, no view is wanted, the board shall be turned, or not one view can be reached.
    """
    check_scene_name(scene)
    if views < 1:
        raise ConfigError(f"views: expected at least 1, got {views}")
    stage, board = stage_of(station.config), scene == CALIBRATION
    if not 1 <= turns <= (1 if board else _MOST_TURNS):
        limit = "the board stays as it stands" if board else f"expected 1 to {_MOST_TURNS}"
        raise ConfigError(f"turns: {limit}, got {turns}")
    digest = hashlib.sha256(f"plan|{station.seed}|{scene}".encode()).digest()
    plan = plan_views(
        arm_model(station.arm.describe().model),
        station.rig,
        stage,
        stage.board if board else stage.target,
        board_sampling(stage) if board else object_sampling(),
        views,
        np.random.default_rng(np.frombuffer(digest, dtype="<u4").tolist()),
        turns,
    )
    if not plan.views:
        raise ConfigError(
            f"no view of {scene!r} can be taken: {plan.summary()}",
            hint="move the target, see [plan] of the station",
        )
    return plan


def plan_views(
    model: ArmModel,
    rig: Rig,
    stage: Stage,
    target: Float64,
    sampling: Sampling,
    views: int,
    rng: np.random.Generator,
    turns: int = 1,
) -> Plan:
    """Plan views of a target (3,), base frame, metres; fewer than wanted where the arm reaches no more.

    The same generator gives the same plan. With ``turns`` the object stands in so many ways, a full turn divided by this
    apart; views of one turn follow each other.
    """
    directions, distances = candidates(sampling, rng)
    T_base_flange = flange_poses(rig, target, sampling, directions, distances, rng)
    joints, refusal = hold_poses(model, rig, stage, T_base_flange)
    count = len(joints)
    angles = 2 * np.pi * np.arange(turns) / turns
    seen = np.concatenate([rotate_vectors(_about_vertical(-angle), directions) for angle in angles])
    features = np.column_stack([seen, _LOG_DISTANCE * np.log(np.tile(distances, turns))])
    if sampling.lean:
        lean = sampling.lean * leans(rig, sampling.axis, T_base_flange[:, 0])
        features = np.column_stack([features, np.tile(lean, (turns, 1))])

    def accept(k: int) -> bool:
        clear = is_clear(model, rig, stage, stage.home, joints[k % count])
        if not clear:
            refusal[k % count] = REFUSALS.index("way from home")
        return clear

    chosen = _spread(features, np.tile(refusal < 0, turns), views, accept, rng)
    planned = [
        PlannedView(i, joints[c], forward(model, joints[c]), float(distances[c]), directions[c], angle)
        for i, c, angle in ((i, k % count, float(angles[k // count])) for i, k in enumerate(chosen))
    ]
    refused = {reason: int((refusal == i).sum()) for i, reason in enumerate(REFUSALS)}
    tried = Tried(target + distances[:, None] * directions, refusal)
    return Plan(tuple(_by_travel(planned, stage.home)), views, count, refused, tried)


def _about_vertical(angle: float) -> Float64:
    """(4, 4) turn about the base's z."""
    out = np.eye(4)
    out[0, 0] = out[1, 1] = np.cos(angle)
    out[1, 0] = np.sin(angle)
    out[0, 1] = -out[1, 0]
    return out


def _spread(
    features: Float64, usable: Bools, views: int, accept: Callable[[int], bool], rng: np.random.Generator
) -> list[int]:
    """Pick by farthest-point sampling: greedy, so that fewer views are a prefix of more.

    Every pick is the farthest of a few random candidates (Mitchell's best candidate). The farthest of all would put nearly
    every view on the rim of what the arm reaches.
    """
    left = np.flatnonzero(usable)
    gap = np.full(len(features), np.inf)
    chosen: list[int] = []
    while len(left) and len(chosen) < views:
        few = rng.choice(left, size=min(_FEW, len(left)), replace=False)
        k = int(few[gap[few].argmax()])
        left = left[left != k]
        if accept(k):
            chosen.append(k)
            gap = np.minimum(gap, np.linalg.norm(features - features[k], axis=1))
    return chosen


def _by_travel(views: Sequence[PlannedView], home: Float64) -> list[PlannedView]:
    """Order by turn of the object, then by nearest neighbour in weighted joint space, starting from home."""
    left, here, out = list(views), home, []
    while left:
        turn = min(v.turn for v in left)
        costs = [
            float(np.abs(JOINT_WEIGHTS * (v.joints - here)).max()) if v.turn == turn else np.inf for v in left
        ]
        out.append(left.pop(int(np.argmin(costs))))
        here = out[-1].joints
    return out
