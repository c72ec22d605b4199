"""Planes fitted to inverse depth over pixel rays, anywhere on an image, from one table of sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float64 = NDArray[np.float64]
CELL = 2  # pixels: windows start and end at cells, a quarter of the table's memory and of its cache misses


@compiled
def table(depth: NDArray[np.floating], x: Float64, y: Float64) -> Float64:
    """Sums over all cells above and to the left of 1, x, y, xx, xy, yy, q, xq, yq, qq with q = 1 / depth; NaN counts nothing.

    Returns (rows + 1, columns + 1, 10) float64, cells of :data:`CELL` pixels.
    """
    height, width = depth.shape
    rows, columns = (height + CELL - 1) // CELL, (width + CELL - 1) // CELL
    out = np.zeros((rows + 1, columns + 1, 10))
    line = np.empty((columns, 10))
    for row in range(rows):
        line[:] = 0
        for v in range(row * CELL, min(height, (row + 1) * CELL)):
            for u in range(width):
                z = depth[v, u]
                if z > 0:
                    q, cell = 1 / np.float64(z), line[u // CELL]
                    cell[0] += 1
                    cell[1] += x[u]
                    cell[2] += y[v]
                    cell[3] += x[u] * x[u]
                    cell[4] += x[u] * y[v]
                    cell[5] += y[v] * y[v]
                    cell[6] += q
                    cell[7] += x[u] * q
                    cell[8] += y[v] * q
                    cell[9] += q * q
        run = np.zeros(10)
        for column in range(columns):
            for k in range(10):
                run[k] += line[column, k]
                out[row + 1, column + 1, k] = out[row, column + 1, k] + run[k]
    return out


@compiled
def fit(sums: Float64, min_spread: float, plane: Float64) -> float:
    """Fit ``plane . ray = 1 / depth`` to sums (10,); returns the residual of inverse depth, NaN where undetermined."""
    n = sums[0]
    if not n > 2.5:
        return np.nan
    x, y, q = sums[1] / n, sums[2] / n, sums[6] / n
    cxx, cxy, cyy = sums[3] / n - x * x, sums[4] / n - x * y, sums[5] / n - y * y
    cxq, cyq = sums[7] / n - x * q, sums[8] / n - y * q
    det = cxx * cyy - cxy * cxy
    if not det > min_spread * (cxx + cyy) ** 2:
        return np.nan
    plane[0], plane[1] = (cyy * cxq - cxy * cyq) / det, (cxx * cyq - cxy * cxq) / det
    plane[2] = q - plane[0] * x - plane[1] * y
    left = sums[9] / n - q * q - plane[0] * cxq - plane[1] * cyq
    return np.sqrt(max(left, 0.0) * n / max(n - 3, 1.0))  # type: ignore[no-any-return]


@compiled
def fits(
    sums: Float64,
    pixels: Float64,
    radii: NDArray[np.int64],
    min_spread: float,
    planes: Float64,
    residuals: Float64,
) -> None:
    """Fit a plane in windows of every radius (in cells) about every pixel (n, 2): (n, r, 3) planes, (n, r) residuals."""
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    window = np.empty(10)
    for i in range(len(pixels)):
        u, v = int(np.rint(pixels[i, 0])) // CELL, int(np.rint(pixels[i, 1])) // CELL
        for j in range(len(radii)):
            r = radii[j]
            left, right = max(u - r, 0), min(u + r + 1, columns)
            top, bottom = max(v - r, 0), min(v + r + 1, rows)
            for k in range(10):
                window[k] = (sums[bottom, right, k] - sums[top, right, k]) - (
                    sums[bottom, left, k] - sums[top, left, k]
                )
            residuals[i, j] = fit(window, min_spread, planes[i, j])


@compiled
def choose(
    planes: Float64, residuals: Float64, limits: Float64, radii: NDArray[np.int64], rays: Float64,
    chosen: Float64, residual: Float64,
) -> None:  # fmt: skip
    """Of every pixel's planes take the largest window's whose residual is within the limits, else the smallest window's.

    A plane through a bent surface misses its middle by an amount that grows with the square of the window; two windows tell
    it, and the plane is moved to where it vanishes. ``rays`` (n, 2) are x and y at the pixels. ``residual`` (n,) is that of
    a plane within the limits, NaN otherwise.
    """
    for i in range(len(planes)):
        chosen[i, :], residual[i], best = np.nan, np.nan, -1
        for j in range(planes.shape[1]):
            flat = residuals[i, j] <= limits[j]
            if flat or (best < 0 and np.isfinite(residuals[i, j])):
                best = j
                residual[i] = residuals[i, j] if flat else np.nan
        if best < 0:
            continue
        chosen[i, :] = planes[i, best]
        if best > 0 and np.isfinite(residuals[i, best - 1]) and np.isfinite(residual[i]):
            large, small = planes[i, best], planes[i, best - 1]
            there = large[0] * rays[i, 0] + large[1] * rays[i, 1] + large[2]
            inner = small[0] * rays[i, 0] + small[1] * rays[i, 1] + small[2]
            share = ((2 * radii[best - 1] + 1) / (2 * radii[best] + 1)) ** 2
            chosen[i, :] *= (inner - share * there) / (1 - share) / there
