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
def fit_window(
    sums: Float64, u: int, v: int, r: int, min_spread: float, window: Float64, plane: Float64
) -> float:
    """Fit a plane in the window of radius ``r`` about cell (u, v); as :func:`fit`, ``window`` (10,) is for its use."""
    left, right = max(u - r, 0), min(u + r + 1, sums.shape[1] - 1)
    top, bottom = max(v - r, 0), min(v + r + 1, sums.shape[0] - 1)
    for k in range(10):
        window[k] = (sums[bottom, right, k] - sums[top, right, k]) - (
            sums[bottom, left, k] - sums[top, left, k]
        )
    return fit(window, min_spread, plane)


@compiled
def residuals(
    sums: Float64, pixels: Float64, radii: NDArray[np.int64], min_spread: float, out: Float64
) -> None:
    """Residuals (n, r) of the planes in windows of every radius (in cells) about pixels (n, 2)."""
    window, plane = np.empty(10), np.empty(3)
    for i in range(len(pixels)):
        u, v = int(np.rint(pixels[i, 0])) // CELL, int(np.rint(pixels[i, 1])) // CELL
        for j in range(len(radii)):
            out[i, j] = fit_window(sums, u, v, radii[j], min_spread, window, plane)


@compiled
def choose(
    sums: Float64, pixels: Float64, radii: NDArray[np.int64], limits: Float64, min_spread: float, rays: Float64,
    chosen: Float64, residual: Float64,
) -> None:  # fmt: skip
    """Of every pixel's windows take the largest one's plane whose residual is within the limits, else the smallest one's.

    A plane through a bent surface misses its middle by an amount that grows with the square of the window; two windows tell
    it, and the plane is moved to where it vanishes. ``rays`` (n, 2) are x and y at the pixels. ``residual`` (n,) is that of
    a plane within the limits, NaN otherwise. Pixels (n, 2) of NaN get NaN.
    """
    window, large, small = np.empty(10), np.empty(3), np.empty(3)
    for i in range(len(pixels)):
        chosen[i, :], residual[i] = np.nan, np.nan
        if not np.isfinite(pixels[i, 0]):
            continue
        u, v = int(np.rint(pixels[i, 0])) // CELL, int(np.rint(pixels[i, 1])) // CELL
        for j in range(len(radii) - 1, -1, -1):
            left = fit_window(sums, u, v, radii[j], min_spread, window, large)
            if np.isfinite(left):  # the smallest such window stays where none is flat
                chosen[i, :] = large
            if not left <= limits[j]:
                continue
            residual[i] = left
            if j > 0 and np.isfinite(fit_window(sums, u, v, radii[j - 1], min_spread, window, small)):
                there = large[0] * rays[i, 0] + large[1] * rays[i, 1] + large[2]
                inner = small[0] * rays[i, 0] + small[1] * rays[i, 1] + small[2]
                share = ((2 * radii[j - 1] + 1) / (2 * radii[j] + 1)) ** 2
                chosen[i, :] *= (inner - share * there) / (1 - share) / there
            break
