"""Bring the stereo point map into the ToF frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError
from tofcapture.poses import Float64, transform_points


def register(points_stereo: NDArray[np.floating], T_tof_stereo: Float64, far: float) -> Float64:
    """Transform an organised point map to the ToF frame.

    Parameters
    ----------
    points_stereo
        (SH, SW, 3) stereo frame, metres; NaN: not measured.
    T_tof_stereo
        (4, 4) stereo frame to ToF frame.
    far
        Points deeper than this in the ToF frame, or behind its camera, become NaN; metres.

    Returns
    -------
    (SH, SW, 3) float64, ToF frame, on the same grid.

    Raises
    ------
    DataError
        When the point map is not organised.
    """
    if points_stereo.ndim != 3 or points_stereo.shape[2] != 3:
        raise DataError(
            f"register: expected an organised point map (H, W, 3), got shape {points_stereo.shape}"
        )
    points = transform_points(T_tof_stereo, points_stereo)
    z = points[..., 2]
    points[~((z > 0) & (z < far))] = np.nan  # NaN compares false
    return points
