"""Clouds on a pixel grid become trees of boxes: sixteen points to a leaf, sixteen boxes to a node, in the order of a Z-curve.

Points and boxes lie in arrays of sixteen, so that a test of all of them takes a few vector instructions. Empty places hold
infinity, which is far from everything. :mod:`tofcapture_model.losses.chamfer.boxes` searches them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Point = tuple[np.float32, np.float32, np.float32]

FAN = 16
_INF = np.float32(np.inf)
_DEEP = np.float32(1.5)  # times as long along the rays as across: a depth step
_BISECTIONS = 10  # of the range of a node's points


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
