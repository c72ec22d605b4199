"""Normals of depth images: planes fitted to inverse depth over pixel rays.

A plane ``n . p = d`` seen along the ray ``r`` (z = 1) at depth z obeys ``m . r = 1 / z`` with ``m = n / d``: a linear
least-squares fit of inverse depth over rays (method.md 2.1). Its regressors carry no noise, unlike those of a fit to points,
and without gating its sums are box filters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

RADII = (2, 4, 8, 12)  # pixels, windows that PlaneField chooses from
TOLERANCE = 2.0  # a window is flat while its residual is below this many times the median of such windows
TYPICAL = 4000  # windows, at least, whose median is taken
GRAZING_COSINE = 0.25882  # cos 75 deg
_MIN_SPREAD = 1e-4  # det / trace^2 of the window's rays; below, they are a line and the plane may swivel


def _moments(depth: NDArray[np.floating], camera: Camera) -> Float64:
    """Regression terms (H, W, 10): 1, x, y, xx, xy, yy, q, xq, yq, qq with q = 1 / depth; zero where NaN."""
    if depth.shape != camera.shape:
        raise DataError(f"normals: expected depth of shape {camera.shape}, got {depth.shape}")
    valid = np.isfinite(depth) & (depth > 0)
    q = np.divide(1.0, depth, out=np.zeros(camera.shape), where=valid, dtype=np.float64)
    x = camera.rays[..., 0] * valid
    y = camera.rays[..., 1] * valid
    out = np.empty((*camera.shape, 10))
    for k, term in enumerate((valid, x, y, x * x, x * y, y * y, q, x * q, y * q, q * q)):
        out[..., k] = term
    return out


def _box(values: Float64, radius: int) -> Float64:
    """Sum over a (2 radius + 1)^2 window along the first two axes, zero outside the image."""
    for axis in (0, 1):
        pad = [(0, 0)] * values.ndim
        pad[axis] = (radius + 1, radius)
        total = np.cumsum(np.pad(values, pad), axis=axis)
        size = values.shape[axis]
        # Differences along one axis at a time: those of a two-dimensional integral image would cost digits.
        values = np.take(total, range(2 * radius + 1, 2 * radius + 1 + size), axis) - np.take(
            total, range(size), axis
        )
    return values


def _fit(sums: Float64) -> tuple[Float64, Float64]:
    """Fit planes to accumulated moments (..., 10).

    Returns camera-facing unit normals (..., 3), NaN where they are not determined, and the residual standard deviation of
    inverse depth (...).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        n = sums[..., 0]
        _, x, y, xx, xy, yy, q, xq, yq, qq = np.moveaxis(sums / n[..., None], -1, 0)
        cxx, cxy, cyy, cxq, cyq = xx - x * x, xy - x * y, yy - y * y, xq - x * q, yq - y * q
        det = cxx * cyy - cxy * cxy
        mx, my = (cyy * cxq - cxy * cyq) / det, (cxx * cyq - cxy * cxq) / det
        m = np.stack([mx, my, q - mx * x - my * y], axis=-1)
        residual = np.sqrt(np.maximum(qq - q * q - mx * cxq - my * cyq, 0) * n / np.maximum(n - 3, 1))
        normals: Float64 = -m / np.linalg.norm(m, axis=-1, keepdims=True)
        normals[~((n > 2.5) & (det > _MIN_SPREAD * (cxx + cyy) ** 2))] = np.nan
    return normals, residual


def _facing(normals: Float64, rays: Float64, depth: NDArray[np.floating]) -> Float64:
    """Drop normals without depth, and those that a fit across an edge turned away from the camera (n . r >= 0)."""
    away = np.einsum("...c,...c->...", normals, rays) >= 0
    normals[away | ~np.isfinite(depth)] = np.nan
    return normals


def normals_from_depth(depth: NDArray[np.floating], camera: Camera, radius: int = 4) -> Float64:
    """Fit a plane to each pixel's window.

    Exact for planes at any tilt. A window that straddles a depth edge mixes both sides: use :func:`gated_normals` there.

    Parameters
    ----------
    depth
        (H, W) z in metres; NaN: none.
    camera
        Intrinsics of the image.
    radius
        The window is ``2 radius + 1`` pixels wide; 4 gives the paper's 9 x 9.

    Returns
    -------
    (H, W, 3) float64, unit, camera frame, facing the camera; NaN where depth is NaN or its window determines no plane.

    Raises
    ------
    DataError
        When depth is not of the camera's shape.
    """
    return _facing(_fit(_box(_moments(depth, camera), radius))[0], camera.rays, depth)


def gated_normals(
    depth: NDArray[np.floating], camera: Camera, radius: int = 4, gate: float = 0.05
) -> Float64:
    """Fit a plane to each pixel's window, leaving out neighbours across depth edges.

    Parameters
    ----------
    depth, camera, radius
        As for :func:`normals_from_depth`.
    gate
        A neighbour j counts where ``|z_j - z_i| <= gate z_i``; 0.05 after GeoNet's common value.

    Returns
    -------
    As :func:`normals_from_depth`; costs a pass per pixel of the window.
    """
    terms = np.pad(_moments(depth, camera), ((radius, radius), (radius, radius), (0, 0)))
    z = np.pad(np.asarray(depth, dtype=np.float64), radius, constant_values=np.nan)
    height, width = camera.shape
    sums = np.zeros((height, width, 10))
    for dv in range(2 * radius + 1):
        for du in range(2 * radius + 1):
            window = slice(dv, dv + height), slice(du, du + width)
            near = np.abs(z[window] - depth) <= gate * depth  # NaN compares false
            sums += np.where(near[..., None], terms[window], 0.0)
    return _facing(_fit(sums)[0], camera.rays, depth)


class PlaneField:
    """Planes through a depth image wherever they are asked for, in windows as large as the surface is flat.

    Windows of several sizes are fitted at each place, and the largest is taken whose residual is what noise leaves in such
    windows (their median); beside creases that is a small one. The image's moments are summed once.

    Parameters
    ----------
    depth
        (H, W) z in metres; NaN: none.
    camera
        Intrinsics of the image.
    """

    def __init__(self, depth: NDArray[np.floating], camera: Camera) -> None:
        from tofcapture.ops.kernels.planes import table

        if depth.shape != camera.shape:
            raise DataError(f"normals: expected depth of shape {camera.shape}, got {depth.shape}")
        self._camera = camera.pinhole("plane field")
        self._sums = table(depth, camera.rays[0, :, 0].copy(), camera.rays[:, 0, 1].copy())

    def at(self, pixels: Float64, radii: Sequence[int] = RADII) -> tuple[Float64, Float64]:
        """Planes at pixel coordinates.

        Parameters
        ----------
        pixels
            (n, 2) as (u, v), inside the image; NaN gives NaN.
        radii
            Of the windows to choose from, ascending, pixels; windows are whole cells of 2 x 2 pixels.

        Returns
        -------
        planes
            (n, 3) float64 m with ``m . p = 1`` for points p of the plane, camera frame, 1 / metres; its normal is -m / |m|.
            NaN where no window determines a plane.
        residual
            (n,) standard deviation of inverse depth about it, 1 / metres; NaN where no window is flat.
        """
        from tofcapture.ops.kernels.planes import CELL, choose, residuals

        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        cells = np.array([max(1, r // CELL) for r in radii])
        some = pixels[np.isfinite(pixels[:, 0])]
        some = np.ascontiguousarray(some[:: max(1, len(some) // TYPICAL)])
        found = np.empty((len(some), len(radii)))
        residuals(self._sums, some, cells, _MIN_SPREAD, found)
        limits = TOLERANCE * np.array([_typical(found[:, k]) for k in range(len(radii))])
        chosen, residual = np.empty((len(pixels), 3)), np.empty(len(pixels))
        eye = self._camera
        rays = (pixels - [eye.cx, eye.cy]) / [eye.fx, eye.fy]
        choose(self._sums, pixels, cells, limits, _MIN_SPREAD, rays, chosen, residual)
        return chosen, residual


def _typical(residuals: Float64) -> float:
    """Median of those that there are; NaN for none."""
    fitted = residuals[np.isfinite(residuals)]
    return float(np.median(fitted)) if len(fitted) else np.nan


def grazing(points: Float64, normals: Float64, eyes: Sequence[Float64]) -> Bool:
    """Say where a surface is seen at more than 75 degrees from its normal.

    Parameters
    ----------
    points, normals
        (..., 3), one frame, metres; NaN gives False.
    eyes
        Camera centres (3,) in that frame; one grazing view is enough.
    """
    out = np.zeros(points.shape[:-1], dtype=bool)
    for eye in eyes:
        rays = points - eye
        cosine = -np.einsum("...c,...c->...", normals, rays) / np.linalg.norm(rays, axis=-1)
        out |= cosine < GRAZING_COSINE
    return out
