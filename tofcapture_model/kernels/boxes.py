"""Clouds on a pixel grid as trees of boxes: sixteen points to a leaf, sixteen boxes to a node, in the order of a Z-curve.

Points and boxes lie in arrays of sixteen, so that a test of all of them takes a few vector instructions. Empty places hold
infinity, which is far from everything.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Point = tuple[np.float32, np.float32, np.float32]

FAN = 16
_ZERO, _INF, _ONE, _TINY = np.float32(0), np.float32(np.inf), np.uint32(1), np.float32(1e-12)
_SLACK = 1e-6  # of a distance: its rounding
_DEEP = np.float32(1.5)  # times as long along the rays as across: a depth step
_BISECTIONS = 10  # of the range of a node's points
_ALIKE = np.float32(4)  # times the mean square of the others: farther away than that, a query looks alone
_FACTOR, _TOP = (
    np.uint32(0x077CB531),
    np.uint32(27),
)  # de Bruijn: the top five bits tell by how far it was shifted
_POSITION = np.zeros(32, np.int64)
for _k in range(32):
    _POSITION[(0x077CB531 << _k & 0xFFFFFFFF) >> 27] = _k


@compiled
def fill(cloud: Float32, mask: NDArray[np.bool_], leaves: Float32, pixels: Int64) -> None:
    """Put the masked points of a cloud (3, H, W) into leaves (L, 3, 16) along a Z-curve over blocks of 4 x 4 pixels.

    ``pixels`` (N,) receives their flat pixels. N of the mask, L = ceil(N / 16).
    """
    h, w = mask.shape
    side = 1
    while side * 4 < max(h, w):
        side *= 2
    n = 0
    for code in range(side * side):
        left, top = code, code >> 1
        for step, keep in ((0, 0x55555555), (1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0xFFFF)):
            left, top = (left | left >> step) & keep, (top | top >> step) & keep
        for v in range(4 * top, min(4 * top + 4, h)):
            for u in range(4 * left, min(4 * left + 4, w)):
                if mask[v, u]:
                    for a in range(3):
                        leaves[n // FAN, a, n % FAN] = cloud[a, v, u]
                    pixels[n] = v * w + u
                    n += 1
    for i in range(n, len(leaves) * FAN):
        leaves[i // FAN, :, i % FAN] = _INF


@compiled
def _ranges(points: Float32, first: int, last: int) -> tuple[Point, Point]:
    """Box of the points (3, N) from first to last - 1."""
    low, high = (_INF, _INF, _INF), (-_INF, -_INF, -_INF)
    for i in range(first, last):
        x, y, z = points[0, i], points[1, i], points[2, i]
        low = (min(low[0], x), min(low[1], y), min(low[2], z))
        high = (max(high[0], x), max(high[1], y), max(high[2], z))
    return low, high


@compiled
def _halve(keys: Float32, low: np.float32, high: np.float32, middle: int, order: Int64) -> None:
    """Order of keys, which lie from low to high, that puts the ``middle`` least of them first, nearly, and else keeps theirs.

    No branch depends on a key, which makes this faster than a quickselect.
    """
    fewer = 0
    for _ in range(_BISECTIONS):
        pivot, count = np.float32(0.5) * (low + high), 0
        for key in keys:
            count += key < pivot
        if count <= middle:
            low, fewer = pivot, count
        else:
            high = pivot
    room, left, right = middle - fewer, 0, middle
    for i in range(len(keys)):
        between = (keys[i] >= low) & (keys[i] <= high) & (room > 0)
        goes = between | (keys[i] < low)
        room -= between
        order[left if goes else right] = i
        left += goes
        right += not goes


@compiled
def tidy(leaves: Float32, pixels: Int64) -> None:
    """Share out the points of a node among its leaves anew where one reaches across a depth step: halves along the longest axis.

    Blocks of pixels there are long along the rays, and long boxes are near to everything.
    """
    block = FAN * FAN
    points, moved = np.empty((3, block), np.float32), np.empty((3, block), np.float32)
    order, names = np.empty(block, np.int64), np.empty(block, np.int64)
    for start in range(0, len(pixels), block):
        n, deep = min(block, len(pixels) - start), False
        for i in range(n):
            for a in range(3):
                points[a, i] = leaves[(start + i) // FAN, a, i % FAN]
        for first in range(0, n, FAN):
            low, high = _ranges(points, first, min(first + FAN, n))
            if high[2] - low[2] > _DEEP * max(high[0] - low[0], high[1] - low[1]):
                deep = True
        if not deep:
            continue
        width = block
        while width > FAN:
            for first in range(0, n - width // 2, width):
                m = min(width, n - first)
                low, high = _ranges(points, first, first + m)
                x, y, z = high[0] - low[0], high[1] - low[1], high[2] - low[2]
                axis = 0 if x >= max(y, z) else 1 if y >= z else 2
                _halve(points[axis, first : first + m], low[axis], high[axis], width // 2, order)
                for i in range(m):
                    names[i] = pixels[start + first + order[i]]
                    for a in range(3):
                        moved[a, i] = points[a, first + order[i]]
                pixels[start + first : start + first + m] = names[:m]
                points[:, first : first + m] = moved[:, :m]
            width //= 2
        for i in range(n):
            for a in range(3):
                leaves[(start + i) // FAN, a, i % FAN] = points[a, i]


@compiled
def wrap(leaves: Float32, n: int, offsets: Int64, margin: np.float32, boxes: Float32) -> None:
    """Boxes (M, 6, 16), low and high, of the children of every node; ``offsets`` say where each level of nodes starts.

    Boxes are larger than what they hold by ``margin``, metres, which covers the rounding of a shifted query.
    """
    boxes[:, :3], boxes[:, 3:] = _INF, -_INF
    for g in range(len(leaves)):
        for a in range(3):
            low, high = _INF, -_INF
            for k in range(min(FAN, n - FAN * g)):
                low, high = min(low, leaves[g, a, k]), max(high, leaves[g, a, k])
            boxes[g // FAN, a, g % FAN], boxes[g // FAN, a + 3, g % FAN] = low - margin, high + margin
    for level in range(1, len(offsets) - 1):
        for g in range(offsets[level] - offsets[level - 1]):
            for a in range(3):
                low, high = _INF, -_INF
                for k in range(FAN):
                    low = min(low, boxes[offsets[level - 1] + g, a, k])
                    high = max(high, boxes[offsets[level - 1] + g, a + 3, k])
                boxes[offsets[level] + g // FAN, a, g % FAN] = low
                boxes[offsets[level] + g // FAN, a + 3, g % FAN] = high


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
