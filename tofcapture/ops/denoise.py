"""Take veil points, speckles and spikes out of a stereo depth image, on its grid.

Stereo is dense and clean inside surfaces and wrong at their borders: matches there mix foreground and background. Two
rules over a 5 x 5 window: a point needs neighbours on its own surface, and must not stick out of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError

Bool = NDArray[np.bool_]

STEEPEST = 5.67  # tan 80 deg: two neighbours further apart in depth are not one surface
SUPPORT = 8  # of 24 neighbours; a convex right-angled corner has exactly these
SPARSE = 7  # every seventh point tells the noise; no divisor of an image's width
SPIKE_SIGMAS = 5.0
SPIKE_PIXELS = 2.0  # and at least this many pixel footprints, so that creases stay


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
    from tofcapture.ops.kernels.stencil import window

    z = np.pad(np.asarray(depth, dtype=np.float32), 2, constant_values=np.nan)
    support, deviation = np.empty(camera.shape, np.float32), np.empty(camera.shape, np.float32)
    pixel = 1 / min(camera.fx, camera.fy)
    window(z, np.reciprocal(z), np.float32(STEEPEST * pixel), support, deviation)
    keep: Bool = support >= SUPPORT
    some = keep.reshape(-1)[::SPARSE]
    if not some.any():
        return keep
    z = z[2:-2, 2:-2]
    # 1.48 MAD; relative to z, as deviations are: stereo noise grows with z^2.
    sigma = np.float32(1.4826 * np.median((deviation.reshape(-1)[::SPARSE] / z.reshape(-1)[::SPARSE])[some]))
    keep &= deviation <= np.maximum(np.float32(SPIKE_SIGMAS) * sigma * z, np.float32(SPIKE_PIXELS * pixel))
    return keep
