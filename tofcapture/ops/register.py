"""Put the stereo clouds of a scene's views together: every view's pose, found at once from all pairs that overlap.

A view's points, as planes that are fitted to them, are looked up in every other view's image. Where one view's point lies off
another one's plane, both poses share the blame. The arm's poses are where it starts, and what holds a view where the surface
says nothing. One error is common to all, the hand-eye transform's; each view has one of its own besides, the arm's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.libraries import compiled
from tofcapture.poses import exp, invert, log

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

GATES = (
    0.012,
    0.012,
    0.008,
    0.005,
    0.003,
    0.002,
    0.0012,
    0.0012,
    0.0012,
)  # m; points further off are no pairs
COMMON = np.repeat(
    [0.003, 0.005], 3
)  # m, rad; standard deviations of a hand-eye transform that is badly known
OWN = 0.0005, 0.0008  # the same of one pose of a bad arm; a better one shows by how little its poses move
SURE = 2e-5, 2e-5  # the same of the best arm
OUTLYING = 3.0  # times the usual: a pose that is so far off is no arm's error
SETTLED = 4  # gates, after which the poses tell how good the arm is
LEAST = 5e-5  # m; no plane is surer
FACING = 0.7  # cosine; two planes that are one surface have normals at most this far apart
MANY = 10.0  # sampled planes of a view share so many of their points, and the windows' errors
MEETING = 0.6  # of the pairs between two views, those that must agree
FEWEST = 40  # pairs that two views must have to say anything
THROUGH = 0.002  # m; one view sees this far past what another one holds to be surface


@dataclass(frozen=True)
class Samples:
    """Hold planes of one view, its stereo frame: points (M, 3), normals (M, 3), standard deviations (M,) along them, metres."""

    points: Float64
    normals: Float64
    sigma: Float64
    target: NDArray[np.bool_]  #: (M,) on the scene's object.


@dataclass(frozen=True)
class Registration:
    """Tell where the views are, and which of them belong together."""

    poses: Float64  #: (N, 4, 4) of the stereo cameras, in the frame that the first poses were in.
    covariance: Float64  #: (6 N, 6 N) of all twists, each in its own stereo frame.
    group: NDArray[
        np.intp
    ]  #: (N,) the largest group is 0; views of different groups do not see the same surface.
    agreeing: Float64  #: (N, N) share of a pair's points that lie on the other's surface; NaN: they see nothing in common.


def register(
    samples: Sequence[Samples], planes: NDArray[np.float32], free: Float32, camera: Camera, poses: Float64
) -> Registration:
    """Refine poses (N, 4, 4) of stereo cameras, jointly.

    ``planes`` (N, h, w, 5) and ``free`` (N, h, w) are those of :class:`tofcapture.ops.fuse.Clouds`, on cells of the grid that
    ``camera`` describes.
    """
    start, poses, count = poses, poses.copy(), len(poses)
    eye = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    own = np.array(OWN)
    for turn, gate in enumerate(GATES):
        A, b = np.zeros((6 * count + 6, 6 * count + 6)), np.zeros(6 * count + 6)
        for i, j in ((i, j) for i in range(count) for j in range(count) if i != j):
            s = samples[i]
            part, right = np.zeros((12, 12)), np.zeros(12)
            _pair(
                s.points, s.normals, s.sigma, invert(poses[j]) @ poses[i], eye, planes[j], gate, part, right
            )
            at = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
            A[np.ix_(at, at)] += part / MANY
            b[at] += right / MANY
        moved = np.stack([log(invert(t) @ p) for t, p in zip(start, poses, strict=True)])
        _hold(A, b, moved, np.repeat(own, 3))
        covariance = np.asarray(np.linalg.inv(A), dtype=np.float64)
        step = np.linalg.solve(A, b).reshape(count + 1, 6)
        poses = np.asarray([p @ exp(x) for p, x in zip(poses, step[:-1], strict=True)], dtype=np.float64)
        if turn >= SETTLED:
            own = _repeats(moved + step[:-1] - step[-1], covariance)
    covariance = np.ascontiguousarray(covariance[: 6 * count, : 6 * count])
    agreeing = _agreement(samples, planes, free, eye, poses)
    return Registration(poses, covariance, _groups(agreeing), agreeing)


def _repeats(off: Float64, covariance: Float64) -> Float64:
    """Estimate how well the arm repeats, m and rad, from what its poses (N, 6) are off, and from how well that is known.

    One step of expectation and maximisation a call; poses that are wrong altogether do not count.
    """
    count = len(off)
    blocks = covariance.reshape(count + 1, 6, count + 1, 6)
    each = np.einsum("iaia->ia", blocks[:-1, :, :-1])
    shared = np.einsum("iaa->ia", blocks[:-1, :, -1])
    variance = off**2 + each - 2 * shared + np.diagonal(blocks[-1, :, -1])
    squares = variance.reshape(count, 2, 3).mean(axis=2)
    usual = squares <= OUTLYING**2 * np.median(squares, axis=0)
    return np.asarray(np.clip(np.sqrt((squares * usual).sum(axis=0) / usual.sum(axis=0)), SURE, OWN))


def _hold(A: Float64, b: Float64, moved: Float64, sigma: Float64) -> None:
    """Add what is known of the poses: ``moved`` (N, 6) from where they began, a common part and each one's own, ``sigma`` (6,)."""
    own, common = 1 / sigma**2, len(b) - 6
    for i, xi in enumerate(moved):
        for k in range(6):
            at, c = 6 * i + k, common + k
            A[at, at] += own[k]
            A[c, c] += own[k]
            A[at, c] -= own[k]
            A[c, at] -= own[k]
            b[at] -= own[k] * xi[k]
            b[c] += own[k] * xi[k]
    A[range(common, len(b)), range(common, len(b))] += 1 / COMMON**2


def _agreement(
    samples: Sequence[Samples], planes: Float32, free: Float32, eye: Float64, poses: Float64
) -> Float64:
    """Share of the object's points of view i that lie on view j's surface, of those that j says anything of; NaN: too few."""
    out = np.full((len(poses), len(poses)), np.nan)
    for i, j in ((i, j) for i in range(len(poses)) for j in range(len(poses)) if i != j):
        s = samples[i]
        on, past = _meeting(s.points[s.target], invert(poses[j]) @ poses[i], eye, planes[j], free[j])
        if on + past >= FEWEST:
            out[i, j] = on / (on + past)
    return out


def _groups(agreeing: Float64) -> NDArray[np.intp]:
    """Number the groups of views that see one surface, the largest first.

    Two views agree unless one of them sees through what the other one saw. A view joins the group of which it agrees with most,
    beginning with the views that agree with most others.
    """
    with np.errstate(invalid="ignore"):
        both = np.fmin(agreeing, agreeing.T)
        votes = np.where(np.isnan(both), 0, np.where(both >= MEETING, 1, -1))
    order = np.argsort(-votes.sum(axis=1), kind="stable")
    groups: list[list[int]] = []
    for i in order.tolist():
        sums = [int(votes[i, g].sum()) for g in groups]
        best = int(np.argmax(sums)) if sums else -1
        if best >= 0 and sums[best] > 0:
            groups[best].append(i)
        else:
            groups.append([i])
    groups.sort(key=lambda g: (-len(g), min(g)))
    out = np.zeros(len(agreeing), dtype=np.intp)
    for number, members in enumerate(groups):
        out[members] = number
    return out


@compiled
def _pair(
    points: Float64, normals: Float64, sigma: Float64, T: Float64, eye: Float64, planes: Float32, gate: float,
    A: Float64, b: Float64,
) -> None:  # fmt: skip
    """Add to the normal equations (12, 12), (12,) what the points (M, 3) of one view say of its pose and another's.

    ``T`` (4, 4) maps the points' frame to the other's, whose ``planes`` (h, w, 5) are looked up.
    """
    x, n, back, J = np.empty(3), np.empty(3), np.empty(3), np.empty(12)
    height, width = planes.shape[:2]
    for i in range(len(points)):
        p = points[i]
        for k in range(3):
            x[k] = T[k, 0] * p[0] + T[k, 1] * p[1] + T[k, 2] * p[2] + T[k, 3]
        if not x[2] > 0:
            continue
        u, v = eye[0] * x[0] / x[2] + eye[2], eye[1] * x[1] / x[2] + eye[3]
        if not (0 <= u < 2 * width and 0 <= v < 2 * height):
            continue
        m = planes[int(v) // 2, int(u) // 2]
        if not m[4] > 0:  # not flat there, or nothing; NaN compares false
            continue
        size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        for k in range(3):
            n[k] = m[k] / size
        off = n[0] * x[0] + n[1] * x[1] + n[2] * x[2] - 1 / size
        facing = 0.0
        for k in range(3):  # the other's normal in this frame
            back[k] = T[0, k] * n[0] + T[1, k] * n[1] + T[2, k] * n[2]
            facing -= back[k] * normals[i, k]
        if not (abs(off) < gate and facing > FACING):
            continue
        other = x[2] * m[4] / size
        variance = sigma[i] ** 2 + other**2 + LEAST**2
        scale = max((gate / 3) ** 2, 4 * variance)
        weight = 1 / variance * (scale / (scale + off * off)) ** 2
        for k in range(3):
            J[k], J[6 + k] = back[k], -n[k]
        J[3], J[4], J[5] = (
            p[1] * back[2] - p[2] * back[1],
            p[2] * back[0] - p[0] * back[2],
            p[0] * back[1] - p[1] * back[0],
        )
        J[9], J[10], J[11] = (
            -(x[1] * n[2] - x[2] * n[1]),
            -(x[2] * n[0] - x[0] * n[2]),
            -(x[0] * n[1] - x[1] * n[0]),
        )
        for k in range(12):
            b[k] -= weight * J[k] * off
            for q in range(12):
                A[k, q] += weight * J[k] * J[q]


@compiled
def _meeting(points: Float64, T: Float64, eye: Float64, planes: Float32, free: Float32) -> tuple[int, int]:
    """Count points (M, 3) that lie on another view's surface, and those that it sees past, or that stand before it."""
    on, past = 0, 0
    height, width = free.shape
    for i in range(len(points)):
        p = points[i]
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not z > 0:
            continue
        u, v = eye[0] * x / z + eye[2], eye[1] * y / z + eye[3]
        if not (0 <= u < 2 * width and 0 <= v < 2 * height):
            continue
        column, row = int(u) // 2, int(v) // 2
        if free[row, column] - z > THROUGH:
            past += 1
            continue
        m = planes[row, column]
        size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        off = abs(m[0] * x + m[1] * y + m[2] * z - 1) / size
        if off < THROUGH / 2:
            on += 1
    return on, past
