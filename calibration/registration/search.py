"""Ask two clouds what they say of a transform between their cameras, and find that transform without any guess.

Each cloud was seen by a camera at its origin, so it says more than where surfaces are: nothing stands between the camera and what it
saw. A wrong transform may lay many points onto surfaces (half of a board fits any board), but it puts others where the other camera
looked through. Where the fields of view overlap, nearly all must agree; elsewhere nothing is asked.

The search lays directions of one cloud into the other at evenly spread rotations and places, follows the best by a few coarse steps
of point-to-plane ICP, and judges what they come to. Its work is bounded, and no chance is involved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Cloud
from tofcapture.poses import (
    Float64,
    exp,
    invert,
    rotation_angle,
    rotation_exp,
    transform,
    transform_points,
)

MARGIN = (
    0.025  # m along a ray: range errors of a centimetre and noise; a board stands 4 cm before its background
)
BESIDE = 3.0  # median distances between neighbouring directions within which a direction counts as seen
NEIGHBOURS = 4
JUDGED = 3000  # points of either cloud that are judged
KEPT = 20_000  # points of either cloud that judge
FACING = 0.3  # cosine from which a surface turned away from a camera cannot have been seen by it

ROTATIONS = 400  # evenly over all: 20 deg apart
PLACES = 8  # where the source's middle may lie
PIECES = 8  # of the target that may be the source's surface
TURNS = 36  # about the normal of a piece
EACH = 3  # turns that are followed on each piece
APART = 3.0  # median distances between neighbours: nearer points are one piece
BASE = 1.0  # m, the farthest that the two cameras are apart
SEED_POINTS = 60
FOLLOWED = 48  # starts that ICP follows
FEW = 300  # source points that a start is followed with
LEAST = 12  # partners without which a start is left
SHARES = (
    0.5,
    0.3,
    0.2,
    0.12,
    0.08,
    0.05,
    0.05,
    0.03,
    0.03,
    0.02,
    0.02,
    0.02,
)  # of the source's radius: reach
FINALISTS = 8
ALIKE = (np.radians(8.0), 0.05)  # rad, and m at the source's middle: nearer ends are one answer
CLEARLY = 0.9  # of the best answer's score that a rival may have
OUTDONE = 1.05  # times an answer's score from which a rival shows that it is wrong; a symmetric board's half turn has as much
SOUND = 0.9  # least share that agrees at an answer
TELLING = (
    0.2  # share of the points about which both cameras must say something: thin clouds cannot contradict
)


@dataclass(frozen=True)
class Agreement:
    """Count what both cameras say of a transform, over the directions that both have seen."""

    agree: int  #: Points on the other camera's surface
    against: int  #: Points before the other camera's surface, or turned away from it
    behind: int  #: Points behind the other camera's surface: hidden, or wrong
    unseen: int  #: Points where the other camera saw nothing, or no surface to speak of

    @property
    def share(self) -> float:
        """Share that does not contradict free space; 1 where next to nothing was seen by both."""
        known = self.agree + self.against
        return self.agree / known if known > TELLING * (known + self.behind + self.unseen) else 1.0

    @property
    def score(self) -> float:
        """Say how much of both clouds agrees, less what does not: what answers are compared by."""
        return (self.agree - self.against - self.behind) / max(
            self.agree + self.against + self.behind + self.unseen, 1
        )


class Sights:
    """Two clouds with what their cameras saw: source points (N, 3) and a target, each in its camera's frame, metres."""

    def __init__(self, source: Float64, target: Cloud) -> None:
        step = max(1, len(target) // KEPT)
        self.target = Cloud(target.points[::step], target.normals[::step])
        self.source, self.middle = _thinned(_once(source), KEPT), source.mean(axis=0)
        self._few = _thinned(source, FEW)  # with what is repeated, which thereby weighs more
        self._radius = float(np.sqrt(np.square(self._few - self.middle).sum(axis=1).mean()))

    @cached_property
    def _seen(self) -> tuple[_Seen, _Seen]:
        return _Seen(self.source), _Seen(self.target.points)

    def agreement(self, T_target_source: Float64, judged: int = JUDGED) -> Agreement:
        """Judge a transform (4, 4) in both directions."""
        by_source, by_target = self._seen
        source = by_target.place(transform_points(T_target_source, _thinned(self.source, judged)))
        back = invert(T_target_source)
        step = max(1, len(self.target) // judged)
        points = transform_points(back, self.target.points[::step])
        target = by_source.place(points)
        cosine = (self.target.normals[::step] @ back[:3, :3].T * points).sum(axis=1)
        away = (target == 0) & (cosine > FACING * np.linalg.norm(points, axis=1))
        target = np.where(away, -1, target)
        return Agreement(*(int((source == k).sum() + (target == k).sum()) for k in (0, -1, 1, 2)))

    def located(self) -> tuple[Float64, bool] | None:
        """Find the transform without a guess: the best answer, and whether it is clearly the best; None where none is sound."""
        flat = [T for piece in _pieces(self.target.points) for T in self._turned(_frame(piece))]
        followed = map(self.followed, [*flat, *self._anywhere()])
        ends = [(self.agreement(T, FEW).score, T) for T in followed]
        ends = sorted(ends, key=lambda e: -e[0])[: 2 * FINALISTS]
        judged = sorted(((self.agreement(T).score, T) for _, T in ends), key=lambda e: -e[0])
        best, T = judged[0]
        if self.agreement(T).share < SOUND:
            return None
        rivals = [score for score, other in judged[1:] if not self.alike(T, other)]
        return T, max(rivals, default=0.0) < CLEARLY * best

    def outdone(self, T_target_source: Float64) -> bool:
        """Tell whether the source, turned about its flattest direction and followed, fits better: half of a board fits any board."""
        score = self.agreement(T_target_source).score
        turned = map(self.followed, self._turned(T_target_source @ _frame(self.source)))
        rivals = [T for T in turned if not self.alike(T, T_target_source)]
        return any(self.agreement(T).score > OUTDONE * score for T in rivals)

    def alike(self, one: Float64, other: Float64) -> bool:
        """Tell whether two transforms are one answer."""
        moved = transform_points(one, self.middle) - transform_points(other, self.middle)
        return bool(rotation_angle(invert(one) @ other) < ALIKE[0] and np.linalg.norm(moved) < ALIKE[1])

    @cached_property
    def _coarse(self) -> tuple[Cloud, Any]:
        from scipy.spatial import cKDTree

        target = Cloud(self.target.points[::3], self.target.normals[::3])
        return target, cKDTree(target.points)

    def followed(self, T: Float64) -> Float64:
        """Follow a start (4, 4) by point-to-plane steps, coarse to fine."""
        target, tree = self._coarse
        for share in SHARES:
            moved = transform_points(T, self._few)
            distance, partner = tree.query(moved, distance_upper_bound=max(share * self._radius, 0.01))
            near = np.isfinite(distance)
            if near.sum() < LEAST:
                break
            p, n = moved[near], target.normals[partner[near]]
            r = ((p - target.points[partner[near]]) * n).sum(axis=1)
            centre = p.mean(axis=0)
            J = np.concatenate([n, np.cross(p - centre, n)], axis=1)
            step = -np.linalg.solve(J.T @ J + 1e-3 * np.eye(6), J.T @ r)
            W = transform(np.eye(3), centre)
            T = W @ exp(step) @ invert(W) @ T
        return T

    def _turned(self, place: Float64) -> list[Float64]:
        """Lay the source flat on a frame (4, 4) of the target, the best of all turns."""
        spin = [transform(rotation_exp([0, 0, 2 * np.pi * k / TURNS]), np.zeros(3)) for k in range(TURNS)]
        laid = [place @ turn @ invert(_frame(self.source)) for turn in spin]
        scored = sorted(((self.agreement(T, FEW).score, i) for i, T in enumerate(laid)), reverse=True)
        return [laid[i] for _, i in scored[:EACH]]

    def _anywhere(self) -> list[Float64]:
        """Rotations and places that lay the source near surfaces, best first."""
        points, radius = _thinned(self.source, SEED_POINTS), self._radius
        middle, scored = points.mean(axis=0), []
        places = _places(self.target.points, PLACES)
        for R in _spread_rotations(ROTATIONS):
            for place in places:
                t = place - R @ middle
                if np.linalg.norm(t) > BASE:
                    continue
                distance, _ = self._coarse[1].query(points @ R.T + t, distance_upper_bound=radius)
                scored.append((float(np.minimum(distance, radius).mean()), transform(R, t)))
        scored.sort(key=lambda item: item[0])
        return [T for _, T in scored[:FOLLOWED]]


def clear_answer(source: Float64, target: Cloud) -> Float64 | None:
    """Find ``T_target_source`` without a guess; None where no answer is clearly the best."""
    found = Sights(source, target).located()
    return found[0] if found is not None and found[1] else None


def same_answer(one: Float64, other: Float64) -> bool:
    """Tell whether two transforms of one rig agree as coarse answers do: within 3 degrees, and 3 cm half a metre ahead."""
    moved = invert(one) @ other
    ahead = np.array([0.0, 0.0, 0.5])
    return bool(
        rotation_angle(moved) < np.radians(3)
        and np.linalg.norm(transform_points(moved, ahead) - ahead) < 0.03
    )


class _Seen:
    """Ranges by direction, as one camera saw them."""

    def __init__(self, points: Float64) -> None:
        from scipy.spatial import cKDTree

        self._range = np.linalg.norm(points, axis=1)
        points, self._range = points[self._range > 0], self._range[self._range > 0]
        self._tree = cKDTree(points / self._range[:, None])
        gap, _ = self._tree.query(_thinned(self._tree.data, 500), 2)
        self._beside = BESIDE * float(np.median(gap[:, 1]))

    def place(self, points: Float64) -> NDArray[np.int64]:
        """Place points (N, 3) to the surfaces seen: -1 before, 0 on, 1 behind, 2 where nothing was seen."""
        away = np.linalg.norm(points, axis=1)
        gap, nearest = self._tree.query(points / away[:, None], NEIGHBOURS, distance_upper_bound=self._beside)
        ranges = self._range[np.where(np.isfinite(gap), nearest, 0)]
        near, far = ranges.min(axis=1), ranges.max(axis=1)
        known = np.isfinite(gap).all(axis=1) & (far - near < MARGIN)
        before, behind = away < near - MARGIN, away > far + MARGIN
        return np.where(known, np.where(before, -1, np.where(behind, 1, 0)), 2)


def _frame(points: Float64) -> Float64:
    """Frame (4, 4) of points (N, 3): their middle, z along their flattest direction towards the camera."""
    middle = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - middle).T))
    z = axes[:, 0] if axes[:, 0] @ middle < 0 else -axes[:, 0]
    return transform(np.stack([axes[:, 2], np.cross(z, axes[:, 2]), z], axis=1), middle)


def _pieces(points: Float64) -> list[Float64]:
    """Largest connected pieces of a cloud."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    few = _thinned(points, 6000)
    tree = cKDTree(few)
    gap, _ = tree.query(few, 2)
    pairs = tree.query_pairs(APART * float(np.median(gap[:, 1])), output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(few), len(few)))
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    largest = np.argsort(-sizes, kind="stable")[:PIECES]
    return [few[label == k] for k in largest if sizes[k] > len(few) / 100]


def _spread_rotations(count: int) -> Float64:
    """Spread rotations (count, 3, 3) evenly over all: super-Fibonacci spirals (Alexa, CVPR 2022)."""
    from scipy.spatial.transform import Rotation

    s = np.arange(count) + 0.5
    t, d = s / count, 2 * np.pi * s
    r, R = np.sqrt(t), np.sqrt(1 - t)
    alpha, beta = d / np.sqrt(2), d / 1.533751168755204288118041
    q = np.stack([r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)], axis=1)
    return np.asarray(Rotation.from_quat(q).as_matrix())


def _places(points: Float64, count: int) -> Float64:
    """Spread places (count, 3) over a cloud: each next one the farthest from those there are, from the middle on."""
    few = _thinned(points, 600)
    chosen = [few[int(np.linalg.norm(few - few.mean(axis=0), axis=1).argmin())]]
    away = np.full(len(few), np.inf)
    while len(chosen) < count:
        away = np.minimum(away, np.linalg.norm(few - chosen[-1], axis=1))
        chosen.append(few[int(away.argmax())])
    return np.stack(chosen)


def _thinned(points: Float64, most: int) -> Float64:
    return points[:: max(1, len(points) // most)]


def _once(points: Float64) -> Float64:
    """Points (N, 3) without what is repeated behind each other."""
    return (
        points[np.concatenate([[True], (points[1:] != points[:-1]).any(axis=1)])] if len(points) else points
    )
