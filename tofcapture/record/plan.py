"""Which views to take of a scene: spread over directions and distances, reachable, clear of everything.

A UR arm reaches far fewer views than one expects (a UR10e half of those 1.4 m away), so the plan offers thousands of candidates,
keeps what is reachable and clear at the goal and on the straight way from home, and picks from them by farthest-point sampling
over direction and distance. Sampling is greedy: the first 10 of 25 views are the 10 of a plan for 10, so a recording can be
extended.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.kinematics import ArmModel, forward, inverse_all, wrap
from tofcapture.poses import Float64, invert, look_at, rotate_vectors
from tofcapture.record.clearance import REASONS, Stage, is_clear, obstacles
from tofcapture.rig import Rig

Bools = NDArray[np.bool_]

_LOG_DISTANCE = 0.6  # rad per e-fold of distance: how much a nearer view counts against a turned one
_FEW = 24  # candidates that each pick of the sampling chooses among
_BRANCH = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.25])  # weight of each joint in "close to home" and in travel


@dataclass(frozen=True)
class Sampling:
    """Where candidates lie.

    Attributes
    ----------
    axis
        (3,) direction from the target about which views are spread.
    tilt
        Smallest and largest angle to the axis, radians.
    distances
        From the ToF camera to the target, metres.
    aim
        How far from the target the camera may look, metres.
    directions, rolls
        How many of each are tried; of the rolls, the one nearest to home is kept.
    lean
        How much, in radians, it counts that the axis leans in another direction of the image; zero where rolls do not matter.
    """

    axis: Float64
    tilt: tuple[float, float] = (0.0, float(np.radians(65.0)))
    distances: tuple[float, ...] = (0.35, 0.43, 0.53, 0.65, 0.80, 0.98, 1.18, 1.38)
    aim: float = 0.02
    directions: int = 400
    rolls: int = 4
    lean: float = 0.0


def object_sampling() -> Sampling:
    """All around the vertical, 0.35 to 1.5 m."""
    return Sampling(axis=np.array([0.0, 0.0, 1.0]))


def board_sampling(stage: Stage) -> Sampling:
    """Tilts of 15 to 40 deg to the board's normal in all directions, of the room and of the image, 0.5 to 1 m.

    One roll for each candidate, at random: were the one nearest to home taken, the board would lean the same way in most images.
    """
    return Sampling(
        stage.board_normal,
        (float(np.radians(15.0)), float(np.radians(40.0))),
        distances=(0.5, 0.6, 0.72, 0.85, 1.0),
        aim=0.04,
        directions=240,
        rolls=1,
        lean=0.5,
    )


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
    """

    index: int
    joints: Float64
    T_base_flange: Float64
    distance: float
    direction: Float64

    @property
    def digest(self) -> str:
        """Names the pose; a view of another digest is another view."""
        return hashlib.sha256((np.round(self.joints, 6) + 0.0).tobytes()).hexdigest()[:16]


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
    """

    views: tuple[PlannedView, ...]
    wanted: int
    candidates: int
    refused: dict[str, int]

    @property
    def digest(self) -> str:
        """Names the whole plan, whatever the order of travel."""
        ordered = sorted(self.views, key=lambda v: v.index)
        return hashlib.sha256("".join(v.digest for v in ordered).encode()).hexdigest()[:16]

    def summary(self) -> str:
        """One line: how many views, of how many candidates, and what stood against the others."""
        refused = ", ".join(f"{count} {reason}" for reason, count in self.refused.items() if count)
        return f"{len(self.views)} of {self.wanted} views; {self.candidates} candidates, refused: {refused or 'none'}"

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

    Returns
    -------
    Plan
        With fewer views than wanted where the arm reaches no more.
    """
    directions, distances = _candidates(sampling, rng)
    T_base_flange = _flange_poses(rig, target, sampling, directions, distances, rng)
    joints, refused = _branches(model, rig, stage, T_base_flange)
    usable: Bools = np.all(np.isfinite(joints), axis=-1)
    features = np.column_stack([directions, _LOG_DISTANCE * np.log(distances)])
    if sampling.lean:
        features = np.column_stack(
            [features, sampling.lean * _leans(rig, sampling.axis, T_base_flange[:, 0])]
        )
    refused["way from home"] = 0

    def accept(k: int) -> bool:
        clear = is_clear(model, rig, stage, stage.home, joints[k])
        refused["way from home"] += not clear
        return clear

    chosen = _spread(features, usable, views, accept, rng)
    planned = [
        PlannedView(i, joints[k], forward(model, joints[k]), float(distances[k]), directions[k])
        for i, k in enumerate(chosen)
    ]
    return Plan(tuple(_by_travel(planned, stage.home)), views, len(usable), refused)


def _candidates(sampling: Sampling, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Directions (C, 3) on a Fibonacci spiral about the axis, each at all distances (C,), jittered by up to 8 %."""
    n = sampling.directions
    low, high = np.cos(sampling.tilt[0]), np.cos(sampling.tilt[1])
    cosine = low + (high - low) * (np.arange(n) + 0.5) / n
    sine = np.sqrt(1 - cosine**2)
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(n) + rng.uniform(0, 2 * np.pi)
    local = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1)
    about_axis = look_at(np.zeros(3), sampling.axis)
    directions = np.repeat(rotate_vectors(about_axis, local), len(sampling.distances), axis=0)
    distances = np.tile(sampling.distances, n) * rng.uniform(1.0, 1.08, n * len(sampling.distances))
    return directions, distances


def _flange_poses(
    rig: Rig,
    target: Float64,
    sampling: Sampling,
    directions: Float64,
    distances: Float64,
    rng: np.random.Generator,
) -> Float64:
    """(C, rolls, 4, 4) flange poses from which the ToF camera looks at the target, one per roll."""
    spots = target + rng.uniform(-sampling.aim, sampling.aim, directions.shape)
    rolls = 2 * np.pi * (np.arange(sampling.rolls) / sampling.rolls) + rng.uniform(
        0, 2 * np.pi, (len(spots), 1)
    )
    cameras = np.stack(
        [look_at(spot + r * u, spot) for spot, r, u in zip(spots, distances, directions, strict=True)]
    )
    c, s = np.cos(rolls), np.sin(rolls)
    turns = np.broadcast_to(np.eye(4), (*rolls.shape, 4, 4)).copy()
    turns[..., 0, 0], turns[..., 0, 1], turns[..., 1, 0], turns[..., 1, 1] = c, -s, s, c
    return cameras[:, None] @ turns @ invert(rig.T_flange_tof)


def _leans(rig: Rig, axis: Float64, T_base_flange: Float64) -> Float64:
    """Directions (C, 2), unit, in which the axis leans in the ToF image."""
    T_base_tof = T_base_flange @ rig.T_flange_tof
    lean = np.swapaxes(T_base_tof[:, :3, :2], 1, 2) @ axis
    out: Float64 = lean / np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-9)
    return out


def _branches(
    model: ArmModel, rig: Rig, stage: Stage, T_base_flange: Float64
) -> tuple[Float64, dict[str, int]]:
    """(C, 6) of the clear branch and roll nearest to home, NaN where there is none; what stood in the way how often."""
    count = len(T_base_flange)
    q = stage.home + wrap(inverse_all(model, T_base_flange) - stage.home)
    q = q.reshape(count, -1, 6)
    reached: Bools = np.all(np.abs(q) <= model.limit, axis=-1)  # NaN is not
    hits = np.zeros((*reached.shape, len(REASONS)), dtype=bool)
    hits[reached] = obstacles(model, rig, stage, q[reached])
    clear: Bools = reached & ~np.any(hits, axis=-1)
    cost = np.where(clear, (_BRANCH * np.nan_to_num(q - stage.home) ** 2).sum(axis=-1), np.inf)
    best = q[np.arange(count), cost.argmin(axis=1)]
    lost: Bools = ~np.any(clear, axis=1)
    # Rounded to a millionth, goals are the same on machines whose last bits differ.
    return np.where(lost[:, None], np.nan, np.round(best, 6)), _tally(reached, hits, lost)


def _tally(reached: Bools, hits: Bools, lost: Bools) -> dict[str, int]:
    """Count each lost candidate under the first reason that stands against all of its branches, else under ``mixed``."""
    out = {"reach": int((~reached.any(axis=1)).sum())}
    left = lost & reached.any(axis=1)
    for i, reason in enumerate(REASONS):
        always = left & (hits[..., i] | ~reached).all(axis=1)
        out[reason] = int(always.sum())
        left &= ~always
    out["mixed"] = int(left.sum())
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
    """Order by nearest neighbour in weighted joint space, starting from home."""
    left, here, out = list(views), home, []
    while left:
        costs = [float(np.abs(_BRANCH * (v.joints - here)).max()) for v in left]
        out.append(left.pop(int(np.argmin(costs))))
        here = out[-1].joints
    return out
