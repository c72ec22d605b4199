"""5 x 5 windows of a stereo depth image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float32 = NDArray[np.float32]


@compiled
def add_pair(
    centre: Float32, za: Float32, zb: Float32, qa: Float32, qb: Float32, step: Any,
    support: Float32, pairs: Float32, total: Float32,
) -> None:  # fmt: skip
    """Add two opposite neighbours of every pixel of a row to its counts; NaN compares false."""
    zero, one = np.float32(0), np.float32(1)
    for u in range(len(centre)):
        limit = step * centre[u]
        near_a = abs(za[u] - centre[u]) <= limit
        near_b = abs(zb[u] - centre[u]) <= limit
        support[u] += (one if near_a else zero) + (one if near_b else zero)
        both = near_a & near_b
        pairs[u] += one if both else zero
        total[u] += qa[u] + qb[u] if both else zero


@compiled
def window(z: Float32, q: Float32, step: Any, support: Float32, deviation: Float32) -> None:
    """Supporting neighbours, and the relative deviation from opposite pairs of them, of every pixel.

    Parameters
    ----------
    z, q
        (H + 4, W + 4) depth and inverse depth, with a border of NaN.
    step
        Largest difference of neighbours on one surface, relative to depth and per pixel.
    support, deviation
        (H, W) results; deviation is ``|z mean(1 / z_j) - 1|``, zero without pairs.
    """
    height, width = support.shape
    pairs, total = np.empty(width, np.float32), np.empty(width, np.float32)
    for v in range(height):
        count, centre = support[v], z[v + 2, 2 : 2 + width]
        count[:], pairs[:], total[:] = 0, 0, 0
        for dv in range(3):
            for du in range(-2, 3):
                if dv > 0 or du > 0:
                    ahead, behind = slice(2 + du, 2 + du + width), slice(2 - du, 2 - du + width)
                    add_pair(
                        centre, z[v + 2 + dv, ahead], z[v + 2 - dv, behind],
                        q[v + 2 + dv, ahead], q[v + 2 - dv, behind],
                        np.float32(step * np.sqrt(np.float32(dv * dv + du * du))), count, pairs, total,
                    )  # fmt: skip
        for u in range(width):
            mean = total[u] / (2 * pairs[u]) if pairs[u] > 0 else 1 / centre[u]
            deviation[v, u] = abs(mean * centre[u] - 1)
