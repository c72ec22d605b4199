"""Take veil points, speckles and spikes out of a stereo depth image, on its grid.

Stereo is dense and clean inside surfaces and wrong at their borders: matches there mix foreground and background. Two
rules over a 5 x 5 window: a point needs neighbours on its own surface, and must not stick out of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]

STEEPEST = 5.67  # tan 80 deg: two neighbours further apart in depth are not one surface
SUPPORT = 8  # of 24 neighbours; a convex right-angled corner has exactly these
SPIKE_SIGMAS = 5.0
SPIKE_PIXELS = 2.0  # and at least this many pixel footprints, so that creases stay


def _half_window() -> Iterator[tuple[int, int]]:
    """One offset of each pair of opposite neighbours in a 5 x 5 window."""
    return ((dv, du) for dv in range(3) for du in range(-2, 3) if (dv, du) > (0, 0))


def _shift(image: Float32, dv: int, du: int) -> Float32:
    """``out[v, u] = image[v + dv, u + du]``, NaN from outside."""
    out = np.full_like(image, np.nan)
    height, width = image.shape
    out[max(0, -dv) : height - max(0, dv), max(0, -du) : width - max(0, du)] = image[
        max(0, dv) : height - max(0, -dv), max(0, du) : width - max(0, -du)
    ]
    return out


def _window(depth: Float32, step: Float32) -> tuple[Float32, Float32]:
    """Count supporting neighbours, and average opposite pairs of them in inverse depth (0: no pair)."""
    support, pairs, total = (np.zeros(depth.shape, np.float32) for _ in range(3))
    for dv, du in _half_window():
        ahead, behind = _shift(depth, dv, du), _shift(depth, -dv, -du)
        limit = step * np.float32(np.hypot(dv, du))
        near_a, near_b = np.abs(ahead - depth) <= limit, np.abs(behind - depth) <= limit
        support += near_a
        support += near_b
        both = near_a & near_b
        total += np.where(both, 1 / ahead + 1 / behind, 0)
        pairs += both
    return support, total / (2 * np.maximum(pairs, 1))


def denoise(depth: NDArray[np.floating], camera: Camera) -> Bool:
    """Say which points of a stereo depth image to keep.

    Parameters
    ----------
    depth
        (SH, SW) z in the stereo frame, metres; NaN: not measured.
    camera
        Intrinsics of the stereo grid.

    Returns
    -------
    (SH, SW) bool; False where depth is NaN.

    Raises
    ------
    DataError
        When depth is not of the camera's shape.
    """
    if depth.shape != camera.shape:
        raise DataError(f"denoise: expected depth of shape {camera.shape}, got {depth.shape}")
    z = np.asarray(depth, dtype=np.float32)
    footprint = z / np.float32(min(camera.fx, camera.fy))
    with np.errstate(invalid="ignore", divide="ignore"):
        support, smooth = _window(z, np.float32(STEEPEST) * footprint)
        deviation = np.where(smooth > 0, np.abs(smooth * z - 1) * z, 0)
        keep = support >= SUPPORT
    if not keep.any():
        return keep
    # 1.48 MAD; relative to z^2, as stereo noise grows.
    sigma = 1.4826 * float(np.median(deviation[keep] / z[keep] ** 2)) * z**2
    out: Bool = keep & (deviation <= np.maximum(SPIKE_SIGMAS * sigma, SPIKE_PIXELS * footprint))
    return out
