"""Clouds on a pixel grid as trees of boxes: sixteen points to a leaf, sixteen boxes to a node, in the order of a Z-curve.

Points and boxes lie in arrays of sixteen, so that a test of all of them takes a few vector instructions. Empty places hold
infinity, which is far from everything.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Point = tuple[np.float32, np.float32, np.float32]

FAN = 16
_ZERO, _INF, _ONE = np.float32(0), np.float32(np.inf), np.uint32(1)
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
def _boxes_within(
    boxes: Float32, g: int, x: np.float32, y: np.float32, z: np.float32, squared: np.float32
) -> np.uint32:
    """Bits of those of sixteen boxes that are nearer than a squared distance."""
    bits = np.uint32(0)
    for k in range(FAN):
        dx = max(boxes[g, 0, k] - x, x - boxes[g, 3, k], _ZERO)
        dy = max(boxes[g, 1, k] - y, y - boxes[g, 4, k], _ZERO)
        dz = max(boxes[g, 2, k] - z, z - boxes[g, 5, k], _ZERO)
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
def _apart(leaves: Float32, i: int, p: Point, s: Point) -> np.float32:
    """Squared distance of p + s to point i; the shift is taken from the difference, where it rounds least."""
    g, k = i // FAN, i % FAN
    dx, dy, dz = (
        (leaves[g, 0, k] - p[0]) - s[0],
        (leaves[g, 1, k] - p[1]) - s[1],
        (leaves[g, 2, k] - p[2]) - s[2],
    )
    return dx * dx + dy * dy + dz * dz  # type: ignore[no-any-return]


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
        squared = _apart(leaves, i, p, s)
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
    x, y, z = p[0] + s[0], p[1] + s[1], p[2] + s[2]
    first, levels = at // FAN, len(offsets) - 1
    level = levels - 1
    node[level], open_[level] = 0, _boxes_within(boxes, offsets[level], x, y, z, best)
    while level < levels:
        bits = open_[level]
        if bits == 0:
            level += 1
            continue
        open_[level] = bits & (bits - _ONE)
        child = FAN * node[level] + _lowest(bits)
        if level > 0:
            level -= 1
            node[level], open_[level] = child, _boxes_within(boxes, offsets[level] + child, x, y, z, best)
        elif child != first:
            best, at = _look(leaves, child, p, s, best, at)
    return best, at


@compiled
def search(
    leaves: Float32, boxes: Float32, offsets: Int64, names: Int64, own: Float32, own_names: Int64,
    shift: Point, parts: tuple[int, int, int], run: int, squared: Float32, index: Int64,
) -> float:  # fmt: skip
    """Nearest of the tree ``leaves, boxes, offsets`` to the points of leaves ``own`` + shift; returns the sum of squares, m^2.

    ``parts`` are first, last + 1 and how many there are: runs of so many leaves belong to the parts in turns. ``names`` and
    ``own_names`` are the pixels of both clouds; ``squared`` and ``index`` (H W,) are written at those of the queries. A
    query starts with the answer of the one before it, which is its neighbour on the grid.
    """
    node, open_ = np.zeros(len(offsets), np.int64), np.zeros(len(offsets), np.uint32)
    n, at, before, total = len(own_names), -1, _INF, 0.0
    for i in range(n):
        g, k = i // FAN, i % FAN
        part = (g // run) % parts[2]
        if part < parts[0] or part >= parts[1]:
            at = -1
            continue
        p = (own[g, 0, k], own[g, 1, k], own[g, 2, k])
        best = _INF
        if at >= 0:
            best, at = _look(leaves, at // FAN, p, shift, _apart(leaves, at, p, shift), at)
        if at < 0 or best > FAN * before:  # across a depth step: look there first, lest much be nearer
            there = _likeliest(boxes, offsets, p[0] + shift[0], p[1] + shift[1], p[2] + shift[2])
            best, at = _look(leaves, there, p, shift, best, max(at, 0))
        best, at = _descend(leaves, boxes, offsets, node, open_, p, shift, best, at)
        before = best
        squared[own_names[i]], index[own_names[i]] = best, names[at]
        total += float(best)
    return total
