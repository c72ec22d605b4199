"""Exact nearest neighbours in the trees of boxes that :mod:`tofcapture_model.losses.chamfer.leaves` builds, and what their answers prove."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled
from tofcapture_model.losses.chamfer.leaves import FAN, Float32, Int64, Point

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

_ZERO, _INF, _ONE, _TINY = np.float32(0), np.float32(np.inf), np.uint32(1), np.float32(1e-12)
_SLACK = 1e-6  # of a distance: its rounding
_ALIKE = np.float32(4)  # times the mean square of the others: farther away than that, a query looks alone
_FACTOR, _TOP = (
    np.uint32(0x077CB531),
    np.uint32(27),
)  # de Bruijn: the top five bits tell by how far it was shifted
_POSITION = np.zeros(32, np.int64)
for _k in range(32):
    _POSITION[(0x077CB531 << _k & 0xFFFFFFFF) >> 27] = _k


@compiled
def _boxes_near(boxes: Float32, g: int, low: Point, high: Point, squared: np.float32) -> np.uint32:
    """Bits of those of sixteen boxes that are nearer to the box from ``low`` to ``high`` than a squared distance."""
    bits = np.uint32(0)
    for k in range(FAN):
        dx = max(boxes[g, 0, k] - high[0], low[0] - boxes[g, 3, k], _ZERO)
        dy = max(boxes[g, 1, k] - high[1], low[1] - boxes[g, 4, k], _ZERO)
        dz = max(boxes[g, 2, k] - high[2], low[2] - boxes[g, 5, k], _ZERO)
        bits |= np.uint32(dx * dx + dy * dy + dz * dz < squared) << np.uint32(k)
    return bits


@compiled
def _points_within(leaves: Float32, g: int, p: Point, s: Point, squared: np.float32) -> np.uint32:
    """Bits of those of sixteen points that are nearer to p + s than a squared distance."""
    x, y, z = p
    sx, sy, sz = s
    bits = np.uint32(0)
    for k in range(FAN):
        dx, dy, dz = (leaves[g, 0, k] - x) - sx, (leaves[g, 1, k] - y) - sy, (leaves[g, 2, k] - z) - sz
        bits |= np.uint32(dx * dx + dy * dy + dz * dz < squared) << np.uint32(k)
    return bits


@compiled
def _between(p: Point, q: Point, s: Point) -> np.float32:
    """Squared distance of p and q + s; the shift is taken from the difference, where it rounds least."""
    dx, dy, dz = (p[0] - q[0]) - s[0], (p[1] - q[1]) - s[1], (p[2] - q[2]) - s[2]
    return dx * dx + dy * dy + dz * dz


@compiled
def _point(leaves: Float32, g: int, k: int) -> Point:
    return leaves[g, 0, k], leaves[g, 1, k], leaves[g, 2, k]


@compiled
def _lowest(bits: np.uint32) -> int:
    """Position of the lowest bit that is set."""
    return _POSITION[np.uint32(np.uint32(bits & (~bits + _ONE)) * _FACTOR) >> _TOP]  # type: ignore[no-any-return]


@compiled
def _look(leaves: Float32, g: int, p: Point, s: Point, best: np.float32, at: int) -> tuple[np.float32, int]:
    """Look at a leaf: the least squared distance so far, and whose it is."""
    bits = _points_within(leaves, g, p, s, best)
    while bits:
        i = FAN * g + _lowest(bits)
        bits &= bits - _ONE
        squared = _between(_point(leaves, i // FAN, i % FAN), p, s)
        if squared < best:
            best, at = squared, i
    return best, at


@compiled
def _likeliest(boxes: Float32, offsets: Int64, x: np.float32, y: np.float32, z: np.float32) -> int:
    """Leaf that one comes to by always taking the nearest box."""
    node = 0
    for level in range(len(offsets) - 2, -1, -1):
        g, least, child = offsets[level] + node, _INF, 0
        for k in range(FAN):
            dx = max(boxes[g, 0, k] - x, x - boxes[g, 3, k], _ZERO)
            dy = max(boxes[g, 1, k] - y, y - boxes[g, 4, k], _ZERO)
            dz = max(boxes[g, 2, k] - z, z - boxes[g, 5, k], _ZERO)
            squared = dx * dx + dy * dy + dz * dz
            if squared < least:
                least, child = squared, k
        node = node * FAN + child
    return node


@compiled
def _descend(
    leaves: Float32, boxes: Float32, offsets: Int64, node: Int64, open_: NDArray[np.uint32],
    p: Point, s: Point, best: np.float32, at: int,
) -> tuple[np.float32, int]:  # fmt: skip
    """Look at all leaves whose box is nearer than what is known; ``node`` and ``open_`` (levels,) are for its use."""
    moved = p[0] + s[0], p[1] + s[1], p[2] + s[2]
    levels = len(offsets) - 1
    level = levels - 1
    node[level], open_[level] = 0, _boxes_near(boxes, offsets[level], moved, moved, best)
    while level < levels:
        bits = open_[level]
        if bits == 0:
            level += 1
            continue
        open_[level] = bits & (bits - _ONE)
        child = FAN * node[level] + _lowest(bits)
        if level > 0:
            level -= 1
            node[level], open_[level] = child, _boxes_near(boxes, offsets[level] + child, moved, moved, best)
        else:
            best, at = _look(leaves, child, p, s, best, at)
    return best, at


@compiled
def _wanted(boxes: Float32, g: int, j: int, moved: Float32, best: Float32) -> bool:
    """Whether box j of sixteen is nearer to any of sixteen queries (3, 16) than what that one has."""
    x0, y0, z0 = boxes[g, 0, j], boxes[g, 1, j], boxes[g, 2, j]
    x1, y1, z1 = boxes[g, 3, j], boxes[g, 4, j], boxes[g, 5, j]
    count = 0
    for k in range(FAN):
        dx = max(x0 - moved[0, k], moved[0, k] - x1, _ZERO)
        dy = max(y0 - moved[1, k], moved[1, k] - y1, _ZERO)
        dz = max(z0 - moved[2, k], moved[2, k] - z1, _ZERO)
        count += dx * dx + dy * dy + dz * dz < best[k]
    return count > 0


@compiled
def _look_all(leaves: Float32, g: int, of: Float32, s: Point, best: Float32, at: Int32) -> np.float32:
    """Let sixteen queries ``of`` (3, 16) + s look at a leaf; returns the largest squared distance that is left."""
    for j in range(0, FAN, 4):  # four at a time: the least so far is a chain of dependent steps
        p0, p1 = _point(leaves, g, j), _point(leaves, g, j + 1)
        p2, p3 = _point(leaves, g, j + 2), _point(leaves, g, j + 3)
        i0 = np.int32(FAN * g + j)
        i1, i2, i3 = np.int32(i0 + 1), np.int32(i0 + 2), np.int32(i0 + 3)
        for k in range(FAN):
            q = (of[0, k], of[1, k], of[2, k])
            d0, d1, d2, d3 = _between(p0, q, s), _between(p1, q, s), _between(p2, q, s), _between(p3, q, s)
            a, b = i1 if d1 < d0 else i0, i3 if d3 < d2 else i2
            da, db = min(d1, d0), min(d3, d2)
            i, d = b if db < da else a, min(db, da)
            at[k] = i if d < best[k] else at[k]
            best[k] = min(d, best[k])
    most = _ZERO
    for k in range(FAN):
        most = max(most, best[k])
    return most


@compiled
def _reach(best: Float32, most: np.float32) -> np.float32:
    """Squared distance within which sixteen queries look together: the largest of theirs, but for a few far above the others."""
    for _ in range(4):
        total, count = _ZERO, 0
        for k in range(FAN):
            below = best[k] <= most
            total += best[k] if below else _ZERO
            count += below
        if most <= _ALIKE * total / np.float32(count):
            break
        most = _ALIKE * total / np.float32(count)
    return most


@compiled
def _descend_all(
    leaves: Float32, boxes: Float32, offsets: Int64, node: Int64, open_: NDArray[np.uint32], of: Float32, moved: Float32,
    s: Point, low: Point, high: Point, first: int, reach: np.float32, best: Float32, at: Int32,
) -> np.float32:  # fmt: skip
    """Let sixteen queries, ``moved`` from ``low`` to ``high``, look at all leaves within reach; returns what reach was enough."""
    levels = len(offsets) - 1
    level = levels - 1
    node[level], open_[level] = 0, _boxes_near(boxes, offsets[level], low, high, reach)
    while level < levels:
        bits = open_[level]
        if bits == 0:
            level += 1
            continue
        k = _lowest(bits)
        open_[level] = bits & (bits - _ONE)
        child = FAN * node[level] + k
        if level > 0:
            level -= 1
            node[level], open_[level] = child, _boxes_near(boxes, offsets[level] + child, low, high, reach)
        elif child != first and _wanted(boxes, node[0], k, moved, best):
            reach = min(reach, _look_all(leaves, child, of, s, best, at))
    return reach


@compiled
def _take(own: Float32, g: int, count: int, s: Point, of: Float32, moved: Float32) -> None:
    """Fill ``of`` with the queries of a leaf, and ``moved`` with them + s. Empty places hold the first."""
    for k in range(FAN):
        for a in range(3):
            of[a, k] = own[g, a, k if k < count else 0]
            moved[a, k] = of[a, k] + s[a]


@compiled
def _recall(leaves: Float32, guesses: Int32, of: Float32, s: Point, best: Float32, at: Int32) -> np.float32:
    """Start sixteen queries ``of`` + s (the first for empty places) at a guess of each; returns the largest squared distance."""
    most = _ZERO
    for k in range(FAN):
        i = guesses[k if k < len(guesses) else 0]
        at[k] = i
        best[k] = _between(_point(leaves, i // FAN, i % FAN), (of[0, k], of[1, k], of[2, k]), s)
        most = max(most, best[k])
    return most


@compiled
def _part(moved: Float32, reach: np.float32, best: Float32, alone: Float32) -> tuple[Point, Point]:
    """Box of the queries that are not beyond reach; what the others have goes to ``alone`` (16,), so that none looks for them."""
    low, high = (_INF, _INF, _INF), (-_INF, -_INF, -_INF)
    for k in range(FAN):
        if best[k] > reach:
            alone[k], best[k] = best[k], -_INF
        else:
            alone[k] = -_INF
            x, y, z = moved[0, k], moved[1, k], moved[2, k]
            low = (min(low[0], x), min(low[1], y), min(low[2], z))
            high = (max(high[0], x), max(high[1], y), max(high[2], z))
    return low, high


@compiled
def search(
    leaves: Float32, boxes: Float32, offsets: Int64, own: Float32, shift: Point, which: Int64, guesses: Int32,
    squared: Float32, whose: Int32, sums: Float64,
) -> None:  # fmt: skip
    """Nearest of the tree ``leaves, boxes, offsets`` to the points of some leaves of ``own`` + shift.

    ``which`` are these leaves, ascending; ``guesses`` are answers to another shift (N,), or none. ``squared``, m^2, and
    ``whose`` (N,) are written at the points of these leaves, and ``sums`` of the squares (L,) at the leaves. The queries of a
    leaf look together, first where the leaf before, their neighbour on the grid, had its answer; those that are much farther
    away from everything than the others go on alone.
    """
    node, open_ = np.zeros(len(offsets), np.int64), np.zeros(len(offsets), np.uint32)
    of, moved = np.empty((3, FAN), np.float32), np.empty((3, FAN), np.float32)
    best, at, alone = np.empty(FAN, np.float32), np.empty(FAN, np.int32), np.empty(FAN, np.float32)
    n, there, before = len(squared), -1, _INF
    for g in which:
        count = min(FAN, n - FAN * g)
        _take(own, g, count, shift, of, moved)
        first, most, best[:] = there, _INF, _INF
        if len(guesses) > 0:
            most = _recall(leaves, guesses[FAN * g : FAN * g + count], of, shift, best, at)
        if there >= 0:
            most = _look_all(leaves, there, of, shift, best, at)
        if len(guesses) == 0 and (there < 0 or most > FAN * before):
            # across a depth step: look there first, lest much be nearer
            first = _likeliest(boxes, offsets, moved[0, 0], moved[1, 0], moved[2, 0])
            most = _look_all(leaves, first, of, shift, best, at)
        reach = _reach(best, most)
        low, high = _part(moved, reach, best, alone)
        reach = _descend_all(
            leaves, boxes, offsets, node, open_, of, moved, shift, low, high, first, reach, best, at
        )
        total = 0.0
        for k in range(count):
            near, i = best[k], int(at[k])
            if alone[k] > 0:
                point = (of[0, k], of[1, k], of[2, k])
                near, i = _descend(leaves, boxes, offsets, node, open_, point, shift, alone[k], i)
            squared[FAN * g + k], whose[FAN * g + k] = near, i
            total += float(near)
        sums[g] = total
        there, before = int(at[FAN // 2]) // FAN, max(reach, _TINY)


@compiled
def bound(squared: Float32, away: float, sums: Float64) -> None:
    """Raise sums (L,) to what squares must at least add up to ``away`` metres from where they are these (N,)."""
    for g in range(len(sums)):
        total = 0.0
        for i in range(FAN * g, min(FAN * g + FAN, len(squared))):
            least = max(np.sqrt(float(squared[i])) * (1.0 - _SLACK) - away, 0.0)
            total += least * least
        sums[g] = max(sums[g], total)


@compiled
def spread(
    own: Int64, other: Int64, squared: Float32, whose: Int32, squared_image: Float32, index_image: Int64
) -> None:
    """Write answers to the pixels of who asked; ``own`` and ``other`` are the pixels of both clouds."""
    for i in range(len(own)):
        squared_image[own[i]], index_image[own[i]] = squared[i], other[whose[i]]
