"""Candidates for views: where they lie, how the arm would hold them, and what stands against each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.clearance import REASONS, Stage, obstacles
from tofcapture.devices.kinematics import ArmModel, inverse_all, wrap
from tofcapture.poses import Float64, invert, look_at, rotate_vectors
from tofcapture.rig import Rig

Bools = NDArray[np.bool_]

REMEDIES = {
    "reach": (
        "beyond the arm's reach",
        "put the object nearer to the arm, or use a larger arm ([plan] target)",
    ),
    "table": ("too near to the table", "raise the object, or lower the table ([plan] table)"),
    "object": (
        "inside the object's keep-out",
        "make the keep-out as small as the object allows ([plan] keep_out_*)",
    ),
    "base": ("too near to the arm's base", "move the object away from the base ([plan] target)"),
    "self": ("where the arm would meet itself", "choose another home ([plan] home)"),
    "mixed": (
        "where each way to hold the arm meets something",
        "make room: table, keep-out and base together",
    ),
    "way from home": ("not to be reached from home in a straight way", "choose another home ([plan] home)"),
}
"""Why a candidate is no view, in words, and what would help."""
REFUSALS = tuple(REMEDIES)  # the number of a refusal is its place here
JOINT_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.25])  # in "close to home" and in travel


@dataclass(frozen=True)
class Sampling:
    """Where candidates lie; lengths in metres, angles in radians."""

    axis: Float64  # (3,) direction from the target about which views are spread
    tilt: tuple[float, float] = (0.0, float(np.radians(65.0)))  # smallest and largest angle to the axis
    distances: tuple[float, ...] = (0.35, 0.43, 0.53, 0.65, 0.80, 0.98, 1.18, 1.38)
    aim: float = 0.02  # how far from the target the camera may look
    directions: int = 400
    rolls: int = 4  # the one nearest to home is kept
    lean: float = 0.0  # how much it counts that the axis leans in another direction of the image


def object_sampling() -> Sampling:
    """Sample all around the vertical, 0.35 to 1.5 m away."""
    return Sampling(axis=np.array([0.0, 0.0, 1.0]))


def board_sampling(stage: Stage) -> Sampling:
    """Sample tilts of 15 to 40 deg to the board's normal in all directions, 0.5 to 1 m away.

    Each candidate has one random roll. The roll nearest to home would lean the board the same way in most images.
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


def candidates(sampling: Sampling, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Spread directions (C, 3) on a Fibonacci spiral, each at all distances (C,), jittered by up to 8 %."""
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


def flange_poses(
    rig: Rig,
    target: Float64,
    sampling: Sampling,
    directions: Float64,
    distances: Float64,
    rng: np.random.Generator,
) -> Float64:
    """Find flange poses (C, rolls, 4, 4) from which the ToF camera looks at the target."""
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


def leans(rig: Rig, axis: Float64, T_base_flange: Float64) -> Float64:
    """Find unit directions (C, 2) in which the axis leans in the ToF image."""
    T_base_tof = T_base_flange @ rig.T_flange_tof
    lean = np.swapaxes(T_base_tof[:, :3, :2], 1, 2) @ axis
    out: Float64 = lean / np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-9)
    return out


def hold_poses(
    model: ArmModel, rig: Rig, stage: Stage, T_base_flange: Float64
) -> tuple[Float64, NDArray[np.int8]]:
    """Find joints (C, 6), nearest to home, that hold flange poses (C, rolls, 4, 4) and meet nothing; NaN: there are none.

    With them come refusals (C,): indices into :data:`REFUSALS` of what stood in the way, -1 for nothing.
    """
    count = len(T_base_flange)
    q = stage.home + wrap(inverse_all(model, T_base_flange) - stage.home)
    q = q.reshape(count, -1, 6)
    reached: Bools = np.all(np.abs(q) <= model.limit, axis=-1)  # NaN is not
    hits = np.zeros((*reached.shape, len(REASONS)), dtype=bool)
    hits[reached] = obstacles(model, rig, stage, q[reached])
    clear: Bools = reached & ~np.any(hits, axis=-1)
    cost = np.where(clear, (JOINT_WEIGHTS * np.nan_to_num(q - stage.home) ** 2).sum(axis=-1), np.inf)
    best = q[np.arange(count), cost.argmin(axis=1)]
    lost: Bools = ~np.any(clear, axis=1)
    # Rounded to a millionth, goals are the same on machines whose last bits differ.
    return np.where(lost[:, None], np.nan, np.round(best, 6)), _refusals(reached, hits, lost)


def _refusals(reached: Bools, hits: Bools, lost: Bools) -> NDArray[np.int8]:
    """Name for each lost candidate the first obstacle of all its solutions, else ``mixed``."""
    out = np.where(reached.any(axis=1), -1, REFUSALS.index("reach")).astype(np.int8)
    left = lost & reached.any(axis=1)
    for i, reason in enumerate(REASONS):
        always = left & (hits[..., i] | ~reached).all(axis=1)
        out[always] = REFUSALS.index(reason)
        left &= ~always
    out[left] = REFUSALS.index("mixed")
    return out
