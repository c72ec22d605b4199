"""Which views to take of a scene: spread over directions and distances, reachable, clear of everything.

A UR arm reaches far fewer views than one expects (a UR10e half of those 1.4 m away), so the plan offers thousands of candidates,
keeps what is reachable and clear at the goal and on the straight way from home, and picks from them by farthest-point sampling
over direction and distance. Sampling is greedy: the first 10 of 25 views are the 10 of a plan for 10, so a recording can be
extended. Where the arm sees an object from one side only, a person may turn the object: directions are then told apart as the
object sees them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.clearance import Stage, is_clear
from tofcapture.devices.kinematics import ArmModel, forward
from tofcapture.poses import Float64, rotate_vectors
from tofcapture.record.candidates import (
    BRANCH,
    FATES,
    REMEDIES,
    Bools,
    Sampling,
    board_sampling,
    branches,
    candidates,
    flange_poses,
    leans,
    object_sampling,
)
from tofcapture.rig import Rig

__all__ = [
    "FATES",
    "REMEDIES",
    "Plan",
    "PlannedView",
    "Sampling",
    "Tried",
    "board_sampling",
    "object_sampling",
    "plan_views",
]

_LOG_DISTANCE = 0.6  # rad per e-fold of distance: how much a nearer view counts against a turned one
_FEW = 24  # candidates that each pick of the sampling chooses among


@dataclass(frozen=True)
class PlannedView:
    """One view to take.

    Attributes
    ----------
    index
        Number of the view: its rank in the sampling, not its turn.
    joints
        (6,) goal, radians.
    T_base_flange
        (4, 4) nominal flange pose there.
    distance
        From the ToF camera to the target, metres.
    direction
        (3,) unit, from the target to the camera, base frame.
    turn
        How far the object has been turned about the vertical by then, counter-clockwise seen from above, radians.
    """

    index: int
    joints: Float64
    T_base_flange: Float64
    distance: float
    direction: Float64
    turn: float = 0.0

    @property
    def digest(self) -> str:
        """Names the pose, of the arm and of the object; a view of another digest is another view."""
        numbers = np.append(self.joints, self.turn) if self.turn else self.joints
        return hashlib.sha256((np.round(numbers, 6) + 0.0).tobytes()).hexdigest()[:16]


@dataclass(frozen=True)
class Tried:
    """What became of the candidates.

    Attributes
    ----------
    spots
        (C, 3) where the ToF camera would stand, base frame, metres.
    fates
        (C,) int, index into :data:`FATES` of what stood against it, -1 for nothing.
    """

    spots: Float64
    fates: NDArray[np.int8]


@dataclass(frozen=True)
class Plan:
    """Views in the order of travel, and why there are not more.

    Attributes
    ----------
    views
        In the order to visit them.
    wanted
        How many were asked for.
    candidates
        How many were tried.
    refused
        Reason -> number of candidates: ``reach``; those of :data:`clearance.REASONS`; ``mixed``, no branch clear for one
        reason alone; ``way from home``, of the candidates that sampling came upon.
    tried
        The candidates themselves, for the picture.
    """

    views: tuple[PlannedView, ...]
    wanted: int
    candidates: int
    refused: dict[str, int]
    tried: Tried | None = field(default=None, repr=False, compare=False)

    @property
    def digest(self) -> str:
        """Names the whole plan, whatever the order of travel."""
        ordered = sorted(self.views, key=lambda v: v.index)
        return hashlib.sha256("".join(v.digest for v in ordered).encode()).hexdigest()[:16]

    def summary(self) -> str:
        """One line: how many views, of how many candidates, and what stood against the others."""
        refused = ", ".join(f"{count} {reason}" for reason, count in self.refused.items() if count)
        return f"{len(self.views)} of {self.wanted} views; {self.candidates} candidates, refused: {refused or 'none'}"

    def shortfall(self) -> list[str]:
        """Say why there are fewer views than wanted, the commonest reason first; nothing when there are enough."""
        if len(self.views) >= self.wanted:
            return []
        counts = sorted(((n, fate) for fate, n in self.refused.items() if n), reverse=True)
        lines = [
            f"only {len(self.views)} of {self.wanted} views can be taken, of {self.candidates} candidates"
        ]
        lines += [f"  {n} are {REMEDIES[fate][0]}: {REMEDIES[fate][1]}" for n, fate in counts]
        return [*lines, "  or have the object turned between views: --turns 4"]

    def table(self) -> dict[str, Any]:
        """Write the plan as JSON types."""
        return {
            "digest": self.digest,
            "wanted": self.wanted,
            "candidates": self.candidates,
            "refused": self.refused,
            "views": [
                {
                    "index": v.index,
                    "joints": v.joints.tolist(),
                    "distance": v.distance,
                    "direction": v.direction.tolist(),
                    "turn_deg": round(float(np.degrees(v.turn)), 6),
                }
                for v in self.views
            ],
        }


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
    """Plan the views of one scene.

    Parameters
    ----------
    model, rig, stage
        The arm, what it carries, what stands around it.
    target
        (3,) what the ToF camera looks at, base frame, metres.
    sampling
        Where candidates lie.
    views
        How many are wanted.
    rng
        Turns and jitters the candidates, so that scenes differ; the same generator gives the same plan.
    turns
        In how many ways the object is put on the table, a full turn divided by this apart. Views of one turn are taken one after
        the other.

    Returns
    -------
    Plan
        With fewer views than wanted where the arm reaches no more.
    """
    directions, distances = candidates(sampling, rng)
    T_base_flange = flange_poses(rig, target, sampling, directions, distances, rng)
    joints, fates = branches(model, rig, stage, T_base_flange)
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
            fates[k % count] = FATES.index("way from home")
        return clear

    chosen = _spread(features, np.tile(fates < 0, turns), views, accept, rng)
    planned = [
        PlannedView(i, joints[c], forward(model, joints[c]), float(distances[c]), directions[c], angle)
        for i, c, angle in ((i, k % count, float(angles[k // count])) for i, k in enumerate(chosen))
    ]
    refused = {fate: int((fates == i).sum()) for i, fate in enumerate(FATES)}
    tried = Tried(target + distances[:, None] * directions, fates)
    return Plan(tuple(_by_travel(planned, stage.home)), views, count, refused, tried)


def _about_vertical(angle: float) -> Float64:
    """(4, 4) turn about the base's z."""
    out = np.eye(4)
    out[0, 0] = out[1, 1] = np.cos(angle)
    out[1, 0] = np.sin(angle)
    out[0, 1] = -out[1, 0]
    return out


def _spread(
    features: Float64,
    usable: Bools,
    views: int,
    accept: Callable[[int], bool],
    rng: np.random.Generator,
) -> list[int]:
    """Farthest-point sampling (greedy, so that fewer views are a prefix of more).

    Every pick is the farthest of a few random candidates (Mitchell's best candidate): the farthest of all would put nearly
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
        costs = [float(np.abs(BRANCH * (v.joints - here)).max()) if v.turn == turn else np.inf for v in left]
        out.append(left.pop(int(np.argmin(costs))))
        here = out[-1].joints
    return out
