"""What is decided for every pixel of a ground-truth image, in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float64 = NDArray[np.float64]


@compiled
def refine(
    planes: Float64, residuals: Float64, pose: Float64, rays: Float64, within: float, depth: Float64, normals: Float64
) -> None:  # fmt: skip
    """Put hits onto the planes that fit their surroundings, in place.

    ``planes`` (n, 3) m with ``m . p = 1`` in the frame that ``pose`` maps to the rays' frame, ``rays`` (n, 3). A plane that
    faces the eye gives the normal; where its residual is known and the hit lies within so many of it, it gives the depth.
    """
    m = np.empty(3)
    for i in range(len(planes)):
        for k in range(3):
            m[k] = pose[k, 0] * planes[i, 0] + pose[k, 1] * planes[i, 1] + pose[k, 2] * planes[i, 2]
        along = m[0] * rays[i, 0] + m[1] * rays[i, 1] + m[2] * rays[i, 2]
        if not along > 0:  # NaN compares false
            continue
        size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        for k in range(3):
            normals[i, k] = -m[k] / size
        there = (1 + m[0] * pose[0, 3] + m[1] * pose[1, 3] + m[2] * pose[2, 3]) / along
        if abs(1 / there - 1 / depth[i]) <= within * residuals[i]:
            depth[i] = there


@compiled
def judge(
    depth: Float64, normals: Float64, rays: Float64, second_eye: Float64, steepest: float,
    plane: Float64, centre: Float64, limits: Float64, bits: tuple[int, int], mask: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Set two bits of a mask (H, W): the surface is grazing for either eye, the point is outside the crop.

    The rules of :func:`tofcapture.ops.normals.grazing`, with the eyes at zero and ``second_eye`` and ``steepest`` the least
    cosine, and of :func:`tofcapture.ops.crop.inside`, with ``plane`` (4,) normal and offset, ``limits`` clearance, radius, far.
    """
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            z, n = depth[v, u], normals[v, u]
            if not 0 < z < limits[2]:
                mask[v, u] |= bits[1]
                if not z > 0:
                    continue
            x, y = rays[v, u, 0] * z, rays[v, u, 1] * z
            a, b, c = x - second_eye[0], y - second_eye[1], z - second_eye[2]
            first = -(n[0] * x + n[1] * y + n[2] * z) / np.sqrt(x * x + y * y + z * z)
            second = -(n[0] * a + n[1] * b + n[2] * c) / np.sqrt(a * a + b * b + c * c)
            if first < steepest or second < steepest:
                mask[v, u] |= bits[0]
            if np.isfinite(plane[3]):
                dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
                along = plane[0] * dx + plane[1] * dy + plane[2] * dz
                height = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
                near = dx * dx + dy * dy + dz * dz - along * along < limits[1] ** 2
                if not (height > limits[0] and near):
                    mask[v, u] |= bits[1]
