"""The surface that a stereo camera saw, as a function on its image.

Inverse depth is linear in the pixel coordinates on any plane (method.md 2.1), so that a quadratic in them, fitted to 3 x 3
block means, describes a smooth surface to third order. It answers where a ray meets the surface, with value and tangent
plane, at the price of one look-up; noise of the stereo depth is averaged over 6 x 6 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.clouds import WORKING_DEPTH, Cloud
from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.poses import Float64

BLOCK = 2  # px averaged along each axis; a ToF pixel covers six
FULL = 0.75  # share of a block's pixels that must be measured
STRIP = 16  # rows of blocks fitted at a time: they stay in the processor's cache
BEND = 1.0  # departure from the tangent plane after one block, in blocks: beyond it lies a depth edge, not a surface
GRAZING = 0.1  # cosine of the steepest incidence (84 deg) at which a ray's intersection is believed


@dataclass(frozen=True)
class Planes:
    """Tangent planes ``n . x = h`` at the places where points were looked up.

    Attributes
    ----------
    normals
        (3, N) float64, unit, stereo frame, away from the camera.
    offsets
        (N,) float64, metres.
    found
        (N,) bool; where False the other two mean nothing.
    inside
        (N,) bool: in the camera's field of view, measured there or not.
    """

    normals: Float64
    offsets: Float64
    found: NDArray[np.bool_]
    inside: NDArray[np.bool_]


@dataclass(frozen=True)
class SurfaceGrid:
    """Local quadratics of inverse depth on the blocks of a stereo image.

    Attributes
    ----------
    camera
        Intrinsics of the image of blocks.
    coefficients
        (h w, 6), of the map's own precision: ``1/z = c0 + c1 s + c2 t + c3 s^2 + c4 s t + c5 t^2``, 1/m, with (s, t) the
        distance to the block's centre in blocks.
    smooth
        (h w,) bool: measured all around, within the working depth, and no depth edge.
    """

    camera: Camera
    coefficients: NDArray[np.floating]
    smooth: NDArray[np.bool_]

    def planes_at(self, points: Float64) -> Planes:
        """Tangent planes of the surface behind points.

        Parameters
        ----------
        points
            (3, N), stereo frame, metres.

        Returns
        -------
        Planes
            Found where a point projects onto a smooth block.
        """
        camera = self.camera
        u, v, inside = self._pixels(points)
        column, row = np.rint(u), np.rint(v)
        cell = row.astype(np.intp) * camera.width + column.astype(np.intp)
        c = np.ascontiguousarray(self.coefficients.take(cell, axis=0).T, dtype=np.float64)
        normals, offsets = _tangent(c, u, v, u - column, v - row, camera)
        return Planes(normals, offsets, inside & self.smooth.take(cell), inside)

    def _pixels(self, points: Float64) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Pixels (N,) of points (3, N), zero outside the image, and which lie inside."""
        camera = self.camera
        with np.errstate(divide="ignore", invalid="ignore"):
            u = points[0] / points[2] * camera.fx + camera.cx
            v = points[1] / points[2] * camera.fy + camera.cy
        inside = (points[2] > 0) & (np.abs(u - camera.width / 2 + 0.5) < camera.width / 2)
        inside &= np.abs(v - camera.height / 2 + 0.5) < camera.height / 2
        return np.where(inside, u, 0.0), np.where(inside, v, 0.0), inside

    def cloud(self) -> Cloud:
        """Block centres with normals that face the camera, stereo frame; what nearest-neighbour backends and gates take."""
        rays = self.camera.rays.reshape(-1, 3)[self.smooth]
        c = self.coefficients[self.smooth].T.astype(np.float64)
        u = rays[:, 0] * self.camera.fx + self.camera.cx
        v = rays[:, 1] * self.camera.fy + self.camera.cy
        normals, _ = _tangent(c, u, v, np.zeros(len(u)), np.zeros(len(u)), self.camera)
        return Cloud(rays / c[0][:, None], -normals.T)


def surface_grid(points: NDArray[np.floating], camera: Camera) -> SurfaceGrid:
    """Fit the surface of an organised point map.

    Parameters
    ----------
    points
        (H, W, 3), stereo frame, metres, each on the ray of its pixel; NaN where nothing was measured.
    camera
        Intrinsics of the stereo camera.

    Returns
    -------
    SurfaceGrid

    Raises
    ------
    DataError
        When the map is not of the camera's shape.

    Notes
    -----
    Least squares of a quadratic on the 3 x 3 lattice has closed-form moments; the mean of a quadratic over a block exceeds
    its value at the centre by the second moment of the block's pixels, which is taken off.
    """
    if points.shape != (*camera.shape, 3):
        raise DataError(f"stereo points: expected ({camera.height}, {camera.width}, 3), got {points.shape}")
    return grid_of_depth(points[..., 2], camera)


def grid_of_depth(depth: NDArray[np.floating], camera: Camera) -> SurfaceGrid:
    """Fit the surface of a depth map (H, W), metres, NaN where nothing was measured; see :func:`surface_grid`."""
    q, measured = _block_means(depth)
    height, width = q.shape
    cx, cy = ((p + 0.5) / BLOCK - 0.5 for p in (camera.cx, camera.cy))
    small = Camera(width, height, camera.fx / BLOCK, camera.fy / BLOCK, cx, cy)
    coefficients = np.zeros((height, width, 6), dtype=q.dtype)
    smooth = np.zeros((height, width), dtype=bool)
    smooth[1:-1, 1:-1] = _all_of_nine(measured)
    for top in range(1, height - 1, STRIP):
        inner = slice(top, min(top + STRIP, height - 1)), slice(1, -1)
        c = _quadratic(q[top - 1 : top + STRIP + 1])
        c[0] -= (c[3] + c[5]) * q.dtype.type((BLOCK**2 - 1) / (12 * BLOCK**2))
        coefficients[inner] = np.moveaxis(c, 0, -1)
        smooth[inner] &= _is_surface(c, small)
    return SurfaceGrid(small, coefficients.reshape(-1, 6), smooth.ravel())


def _is_surface(c: NDArray[np.floating], camera: Camera) -> NDArray[np.bool_]:
    """Which quadratics (6, h, w) lie within the working depth and bend as a surface does."""
    near, far = WORKING_DEPTH
    bend = np.abs(c[3:]).max(axis=0)
    out: NDArray[np.bool_] = (c[0] > 1 / far) & (c[0] < 1 / near) & (bend * camera.fx < BEND * c[0])
    return out


def _block_means(depth: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Mean inverse depth (h, w) of blocks, and whether enough of their pixels were measured."""
    height, width = (n // BLOCK for n in depth.shape)
    z = np.ascontiguousarray(depth[: height * BLOCK, : width * BLOCK])
    valid = z > 0
    q = np.divide(1, z, out=np.zeros_like(z), where=valid)
    count = _block_sums(valid.view(np.uint8))
    return _block_sums(q) / np.maximum(count, 1).astype(z.dtype), count >= FULL * BLOCK**2


def _block_sums(image: NDArray[np.floating] | NDArray[np.uint8]) -> NDArray[np.floating] | NDArray[np.uint8]:
    rows = image[0::BLOCK]
    for k in range(1, BLOCK):
        rows = rows + image[k::BLOCK]
    out = rows[:, 0::BLOCK]
    for k in range(1, BLOCK):
        out = out + rows[:, k::BLOCK]
    return out


def _quadratic(q: NDArray[np.floating]) -> NDArray[np.floating]:
    """Least-squares quadratics (6, h - 2, w - 2), 1/m, on the 3 x 3 neighbourhoods of an image (h, w)."""
    left, middle, right = q[:, :-2], q[:, 1:-1], q[:, 2:]
    sums, slopes, squares = left + middle + right, right - left, left + right
    total = sums[:-2] + sums[1:-1] + sums[2:]
    ss = squares[:-2] + squares[1:-1] + squares[2:]
    tt = sums[:-2] + sums[2:]
    s2, t2 = (ss - total / 1.5) / 2, (tt - total / 1.5) / 2
    s1 = (slopes[:-2] + slopes[1:-1] + slopes[2:]) / 6
    t1 = (sums[2:] - sums[:-2]) / 6
    st = (slopes[2:] - slopes[:-2]) / 4
    return np.stack([(total - 6 * (s2 + t2)) / 9, s1, t1, s2, st, t2])


def _all_of_nine(good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    rows = good[:-2] & good[1:-1] & good[2:]
    return rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]


def _tangent(
    c: Float64, u: Float64, v: Float64, s: Float64, t: Float64, camera: Camera
) -> tuple[Float64, Float64]:
    """Unit normals (3, N) and offsets (N,) of the planes ``m . x = 1`` that touch quadratics (6, N) at (s, t)."""
    along_s = c[1] + 2 * c[3] * s + c[4] * t
    along_t = c[2] + c[4] * s + 2 * c[5] * t
    q = c[0] + s * (c[1] + along_s) / 2 + t * (c[2] + along_t) / 2
    m = np.empty((3, len(u)))
    np.multiply(along_s, camera.fx, out=m[0])
    np.multiply(along_t, camera.fy, out=m[1])
    m[2] = q - along_s * (u - camera.cx) - along_t * (v - camera.cy)
    length = np.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
    length = np.where(length > 0, length, 1.0)
    return m / length, 1 / length
