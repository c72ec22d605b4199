"""Normals of depth images: planes fitted to inverse depth over pixel rays.

A plane ``n . p = d`` seen along the ray ``r`` (z = 1) at depth z obeys ``m . r = 1 / z`` with ``m = n / d``: a linear
least-squares fit of inverse depth over rays (method.md 2.1). Its regressors carry no noise, unlike those of a fit to points,
and without gating its sums are box filters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError

Float64 = NDArray[np.float64]

_MIN_SPREAD = 1e-4  # smallest share of the window's spread across its thinnest direction; below, the plane may swivel


def _moments(depth: NDArray[np.floating], camera: Camera) -> Float64:
    """Regression terms (9, H, W) of each pixel: 1, x, y, xx, xy, yy, q, xq, yq with q = 1 / depth; zero where NaN."""
    if depth.shape != camera.shape:
        raise DataError(f"normals: expected depth of shape {camera.shape}, got {depth.shape}")
    valid = np.isfinite(depth) & (depth > 0)
    q = np.divide(1.0, depth, out=np.zeros(camera.shape), where=valid, dtype=np.float64)
    x = camera.rays[..., 0] * valid
    y = camera.rays[..., 1] * valid
    return np.stack([valid.astype(np.float64), x, y, x * x, x * y, y * y, q, x * q, y * q])


def _box(values: Float64, radius: int) -> Float64:
    """Sum over a (2 radius + 1)^2 window along the last two axes, zero outside the image."""
    for axis in (-1, -2):
        pad = [(0, 0)] * values.ndim
        pad[axis] = (radius + 1, radius)
        total = np.cumsum(np.pad(values, pad), axis=axis)
        size = values.shape[axis]
        values = np.take(total, range(2 * radius + 1, 2 * radius + 1 + size), axis) - np.take(total, range(size), axis)
    return values


def _solve(sums: Float64, depth: NDArray[np.floating]) -> Float64:
    """Camera-facing unit normals (H, W, 3) of the accumulated moments; NaN where they determine no plane."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums / sums[0]
        _, x, y, xx, xy, yy, q, xq, yq = mean
        cxx, cxy, cyy = xx - x * x, xy - x * y, yy - y * y
        cxq, cyq = xq - x * q, yq - y * q
        det, trace = cxx * cyy - cxy * cxy, cxx + cyy
        m = np.stack([cyy * cxq - cxy * cyq, cxx * cyq - cxy * cxq, np.zeros_like(det)], axis=-1) / det[..., None]
        m[..., 2] = q - m[..., 0] * x - m[..., 1] * y
        normals: Float64 = -m / np.linalg.norm(m, axis=-1, keepdims=True)
    bad = ~(np.isfinite(depth) & (sums[0] > 2.5) & (det > _MIN_SPREAD * trace * trace) & (m[..., 2] != 0))
    normals[bad] = np.nan
    return normals


def _facing(normals: Float64, camera: Camera) -> Float64:
    """Drop normals that a fit across an edge turned away from the camera (n . r >= 0)."""
    away = np.einsum("hwc,hwc->hw", normals, camera.rays) >= 0
    normals[away] = np.nan
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
    """
    return _facing(_solve(_box(_moments(depth, camera), radius), depth), camera)


def gated_normals(depth: NDArray[np.floating], camera: Camera, radius: int = 4, gate: float = 0.05) -> Float64:
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
    terms = np.pad(_moments(depth, camera), ((0, 0), (radius, radius), (radius, radius)))
    z = np.pad(np.asarray(depth, dtype=np.float64), radius, constant_values=np.nan)
    height, width = camera.shape
    sums = np.zeros((9, height, width))
    for dv in range(2 * radius + 1):
        for du in range(2 * radius + 1):
            window = slice(dv, dv + height), slice(du, du + width)
            near = np.abs(z[window] - depth) <= gate * depth  # NaN compares false
            sums += np.where(near, terms[(slice(None), *window)], 0.0)
    return _facing(_solve(sums, depth), camera)
