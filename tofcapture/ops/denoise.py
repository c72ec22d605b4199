"""Take veil points, speckles and spikes out of a stereo depth image, on its grid.

Stereo is dense and clean inside surfaces and wrong at their borders: matches there mix foreground and background. Two
rules over a 5 x 5 window: a point needs neighbours on its own surface, and must not stick out of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.libraries import compiled

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]

STEEPEST = 5.67  # tan 80 deg: two neighbours further apart in depth are not one surface
SUPPORT = 8  # of 24 neighbours; a convex right-angled corner has exactly these
SPARSE = 7  # every seventh point tells the noise; no divisor of an image's width
SPIKE_SIGMAS = 5.0
SPIKE_PIXELS = 2.0  # and at least this many pixel footprints, so that creases stay


def denoise(depth: NDArray[np.floating], camera: Camera) -> Bool:
    """Say which points of a stereo depth image (SH, SW), z in metres, to keep: none where it is NaN.

    Raises :class:`DataError` when depth is not of the shape of the ``camera``, whose intrinsics are the stereo grid's.
    """
    if depth.shape != camera.shape:
        raise DataError(f"denoise: expected depth of shape {camera.shape}, got {depth.shape}")
    z = np.pad(np.asarray(depth, dtype=np.float32), 2, constant_values=np.nan)
    support, deviation = np.empty(camera.shape, np.float32), np.empty(camera.shape, np.float32)
    pixel = 1 / min(camera.fx, camera.fy)
    _window(z, np.reciprocal(z), np.float32(STEEPEST * pixel), support, deviation)
    keep: Bool = support >= SUPPORT
    some = keep.reshape(-1)[::SPARSE]
    if not some.any():
        return keep
    z = z[2:-2, 2:-2]
    # 1.48 MAD; relative to z, as deviations are: stereo noise grows with z^2.
    sigma = np.float32(1.4826 * np.median((deviation.reshape(-1)[::SPARSE] / z.reshape(-1)[::SPARSE])[some]))
    keep &= deviation <= np.maximum(np.float32(SPIKE_SIGMAS) * sigma * z, np.float32(SPIKE_PIXELS * pixel))
    return keep


@compiled
def _add_pair(
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
def _window(z: Float32, q: Float32, step: Any, support: Float32, deviation: Float32) -> None:
    """Count supporting neighbours of every pixel, and its relative deviation from opposite pairs of them.

    ``z`` and ``q`` (H + 4, W + 4) are depth and inverse depth within a border of NaN, ``step`` is the largest difference of
    neighbours on one surface, relative to depth and per pixel. ``deviation`` is ``|z mean(1 / z_j) - 1|``, 0 without pairs.
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
                    _add_pair(
                        centre, z[v + 2 + dv, ahead], z[v + 2 - dv, behind],
                        q[v + 2 + dv, ahead], q[v + 2 - dv, behind],
                        np.float32(step * np.sqrt(np.float32(dv * dv + du * du))), count, pairs, total,
                    )  # fmt: skip
        for u in range(width):
            mean = total[u] / (2 * pairs[u]) if pairs[u] > 0 else 1 / centre[u]
            deviation[v, u] = abs(mean * centre[u] - 1)
