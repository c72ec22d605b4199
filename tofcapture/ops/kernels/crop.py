"""Which points of a stereo depth image stand on the table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float64 = NDArray[np.float64]


@compiled
def above(
    z: NDArray[np.float32], x: Float64, y: Float64, plane: Float64, centre: Float64, limits: Float64,
    pose: Float64, out: NDArray[np.float32],
) -> None:  # fmt: skip
    """Keep the depths of a stereo image that lie over a table and near its centre; the others become NaN.

    ``plane`` (4,) is normal and offset, ``centre`` (3,), ``limits`` clearance, radius and far, all in the frame that
    ``pose`` maps the stereo frame to; a NaN offset keeps everything within ``far``.
    """
    p = np.empty(3)
    for v in range(len(y)):
        for u in range(len(x)):
            out[v, u] = np.nan
            for k in range(3):
                p[k] = z[v, u] * (pose[k, 0] * x[u] + pose[k, 1] * y[v] + pose[k, 2]) + pose[k, 3]
            if not 0 < p[2] < limits[2]:
                continue
            height = plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[3]
            dx, dy, dz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            along = plane[0] * dx + plane[1] * dy + plane[2] * dz
            near = dx * dx + dy * dy + dz * dz - along * along < limits[1] ** 2
            if not np.isfinite(plane[3]) or (height > limits[0] and near):
                out[v, u] = z[v, u]
