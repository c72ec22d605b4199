"""Normals of depth images: planes fitted to inverse depth over pixel rays.

A plane ``n . p = d`` seen along the ray ``r`` (z = 1) at depth z obeys ``m . r = 1 / z`` with ``m = n / d``: a linear
least-squares fit of inverse depth over rays (method.md 2.1), whose regressors carry no noise. :func:`normals_from_depth` is
numpy alone, for readers; :class:`PlaneField` is compiled, and lets every place have its own window.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.libraries import compiled

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

RADII = (2, 4, 8, 12)  # pixels, windows that PlaneField chooses from
TOLERANCE = 2.0  # a window is flat while its residual is below this many times the median of such windows
TYPICAL = 4000  # windows, at least, whose median is taken
GRAZING_COSINE = 0.25882  # cos 75 deg
WITHIN = 4.0  # standard deviations by which a triangle may miss the plane through its surroundings
GRID = 16  # pixels between the places where noise is estimated
ABOUT = 2  # such places on every side that tell the noise of one
QUIET = 30.0  # percentile of their residuals that is noise: edges are in fewer
CELL = 2  # pixels: windows start and end at cells, a quarter of the table's memory and of its cache misses
LAG = 2  # pixels, at which the noise's correlation is measured
MOST = 1000.0  # pixels whose noise is one
_MIN_SPREAD = 1e-4  # det / trace^2 of the window's rays; below, they are a line and the plane may swivel


def normals_from_depth(depth: NDArray[np.floating], camera: Camera, radius: int = 4) -> Float64:
    """Fit a plane to each pixel's window.

    Exact for planes at any tilt. A window that straddles a depth edge mixes both sides.

    Raises :class:`DataError` when depth is not of the camera's shape.

    ``depth`` (H, W) is z in metres, NaN: none. The window is ``2 radius + 1`` pixels wide; 4 gives the paper's 9 x 9.
    Returned are (H, W, 3) unit normals, camera frame, facing the camera; NaN where the window determines no plane.
    """
    _expect(depth, camera)
    valid = np.isfinite(depth) & (depth > 0)
    q = np.divide(1.0, depth, out=np.zeros(camera.shape), where=valid, dtype=np.float64)
    x, y = camera.rays[..., 0] * valid, camera.rays[..., 1] * valid
    sums = np.stack(
        [_box(term, radius) for term in (valid * 1.0, x, y, x * x, x * y, y * y, q, x * q, y * q)]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        n = sums[0]
        _, x, y, xx, xy, yy, q, xq, yq = sums / n
        cxx, cxy, cyy, cxq, cyq = xx - x * x, xy - x * y, yy - y * y, xq - x * q, yq - y * q
        det = cxx * cyy - cxy * cxy
        mx, my = (cyy * cxq - cxy * cyq) / det, (cxx * cyq - cxy * cxq) / det
        m = np.stack([mx, my, q - mx * x - my * y], axis=-1)
        normals: Float64 = -m / np.linalg.norm(m, axis=-1, keepdims=True)
        away = np.einsum("...c,...c->...", normals, camera.rays) >= 0  # as a fit across an edge may turn it
    good = (n > 2.5) & (det > _MIN_SPREAD * (cxx + cyy) ** 2) & ~away & np.isfinite(depth)
    normals[~good] = np.nan
    return normals


def _expect(depth: NDArray[np.floating], camera: Camera) -> None:
    if depth.shape != camera.shape:
        raise DataError(f"normals: expected depth of shape {camera.shape}, got {depth.shape}")


def _box(values: Float64, radius: int) -> Float64:
    """Sum an image over a (2 radius + 1)^2 window, zero outside it."""
    size = 2 * radius + 1
    # Differences along one axis at a time: those of a two-dimensional integral image would cost digits.
    for _ in range(2):
        total = np.cumsum(np.pad(values, ((radius + 1, radius), (0, 0))), axis=0)
        values = (total[size:] - total[:-size]).T
    return values


class PlaneField:
    """Planes through a depth image wherever they are asked for, in windows as large as the surface is flat.

    Windows of several sizes are fitted at each place. The largest is taken whose residual is what noise leaves in such
    windows; beside creases that is a small one. What noise leaves is their median, and more where the smallest windows of the
    neighbourhood, which hardly see curvature, say that it is noisier there. The image's moments are summed once.

    ``depth`` (H, W) is z in metres, NaN: none; ``camera`` holds the intrinsics of the image.
    """

    def __init__(self, depth: NDArray[np.floating], camera: Camera) -> None:
        _expect(depth, camera)
        self._camera = camera.pinhole("plane field")
        self._sums = _table(depth, camera.rays[0, :, 0].copy(), camera.rays[:, 0, 1].copy())

    def at(self, pixels: Float64, radii: Sequence[int] = RADII) -> tuple[Float64, Float64]:
        """Fit planes at pixel coordinates.

        ``pixels`` are (n, 2) as (u, v), inside the image; NaN gives NaN. ``radii`` are those of the windows to choose from,
        ascending, pixels; windows are whole cells of 2 x 2 pixels.

        Returns (n, 3) m with ``m . p = 1`` for points p of the plane, camera frame, 1 / metres, whose normal is -m / |m|, NaN
        where no window determines a plane; and (n,) the standard deviation of inverse depth about it, NaN where no window is
        flat.
        """
        planes, residuals, _, _ = self._fit(pixels, radii)
        return planes, residuals

    def cells(self) -> tuple[Float64, Float64, Float64]:
        """Fit planes in the middle of every cell of 2 x 2 pixels of the image; a last odd row or column is left out.

        Returns (h, w, 3) planes as :meth:`at` does; (h, w) the standard deviation of a point's inverse depth, which no
        curvature is part of, NaN where no window is flat; and (h, w) that of the plane in the middle, as a share of it, were the
        noise of no two pixels alike, NaN where the smallest window alone is flat: how far it misses a bent surface nobody knows.
        """
        width, height = self._camera.width // CELL, self._camera.height // CELL
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        # Half a pixel inside the cell: rounding must not find the next one.
        cells = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
        middle = CELL * cells + (CELL - 1) / 2 - 0.25
        planes, residuals, shares, noise = self._fit(middle, RADII)
        residuals = np.where(np.isfinite(residuals), noise, np.nan)
        return (
            planes.reshape(height, width, 3),
            residuals.reshape(height, width),
            shares.reshape(height, width),
        )

    def _fit(self, pixels: Float64, radii: Sequence[int]) -> tuple[Float64, Float64, Float64, Float64]:
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        cells = np.array([max(1, r // CELL) for r in radii])
        some = pixels[np.isfinite(pixels[:, 0])]
        some = np.ascontiguousarray(some[:: max(1, len(some) // TYPICAL)])
        found = np.empty((len(some), len(radii)))
        _residuals(self._sums, some, cells, _MIN_SPREAD, found)
        fits = [column[np.isfinite(column)] for column in found.T]
        limits = TOLERANCE * np.array([np.median(fit) if len(fit) else np.nan for fit in fits])
        noise = self._noise(cells[:1]) / max(limits[0] / TOLERANCE, 1e-12)
        place = np.minimum(
            np.nan_to_num(pixels, nan=0.0).astype(np.intp) // GRID, np.array(noise.shape[::-1]) - 1
        )
        noisier = np.fmax(noise[place[:, 1], place[:, 0]], 1.0)
        chosen, (residual, share) = np.empty((len(pixels), 3)), np.empty((2, len(pixels)))
        eye = self._camera
        rays = (pixels - [eye.cx, eye.cy]) / [eye.fx, eye.fy]
        _choose(self._sums, pixels, cells, limits, noisier, _MIN_SPREAD, rays, chosen, residual, share)
        return chosen, residual, share, noisier * (limits[-1] / TOLERANCE)

    def _noise(self, cells: NDArray[np.int64]) -> Float64:
        """Estimate the noise of inverse depth every ``GRID`` pixels: what windows of so many cells leave about there."""
        u, v = np.meshgrid(
            np.arange(GRID // 2, self._camera.width, GRID), np.arange(GRID // 2, self._camera.height, GRID)
        )
        left = np.empty((u.size, 1))
        _residuals(
            self._sums, np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64), cells, _MIN_SPREAD, left
        )
        padded = np.pad(left.reshape(u.shape), ABOUT, constant_values=np.nan)
        near = np.lib.stride_tricks.sliding_window_view(padded, (2 * ABOUT + 1, 2 * ABOUT + 1))
        # numpy's own percentile that ignores NaN takes a hundred times as long.
        ranked = np.sort(near.reshape(*near.shape[:2], -1), axis=-1)
        place = np.maximum(np.isfinite(ranked).sum(axis=-1, keepdims=True) - 1, 0) * (QUIET / 100)
        low, high = (np.take_along_axis(ranked, f(place).astype(np.intp), -1) for f in (np.floor, np.ceil))
        return np.asarray((low + (high - low) * (place % 1))[..., 0])

    def smooth(
        self, depth: Float64, normals: Float64, pixels: Float64, camera: Camera, T_camera_own: Float64
    ) -> tuple[Float64, Float64]:
        """Move what another camera's rays hit onto the planes that fit the surface there, where it is flat but for noise.

        A ray's triangle is as noisy as three points. Where the plane through the window about it is as good as planes here
        are, and passes the triangle within the points' noise, the ray is intersected with that plane.

        ``depth`` (H, W) and ``normals`` (H, W, 3) of the hits are in that camera's frame, to which ``T_camera_own`` maps
        this field's. ``pixels`` (H, W, 2) is where this field's image has the hits; NaN: none. Returned are depth, and the
        normals of the best planes that face the camera, a triangle's own where none does.
        """
        planes, residuals = self.at(pixels.reshape(-1, 2))
        depth, normals = depth.copy(), normals.copy()
        hits = depth.reshape(-1), normals.reshape(-1, 3)
        _onto(planes, residuals, T_camera_own, camera.rays.reshape(-1, 3), WITHIN, *hits)
        return depth, normals


def alike_pixels(depth: Float64, planes: Float64, residual: Float64, camera: Camera) -> float:
    """Count the pixels whose noise is one: of noise that a Gaussian window correlates, from its correlation at a lag.

    ``planes`` (h, w, 3) and ``residual`` (h, w) are those of :meth:`PlaneField.cells` of ``depth`` (H, W), metres.
    """
    height, width = residual.shape
    flat = np.isfinite(residual)
    products, squares = 0.0, 0.0
    for rows in (slice(0, None, 8), slice(4, None, 8)):
        rays = camera.rays[: 2 * height : 2, : 2 * width : 2][rows]
        off = 1 / depth[: 2 * height : 2, : 2 * width : 2][rows] - np.einsum(
            "hwc,hwc->hw", planes[rows], rays
        )
        off = np.where(flat[rows] & (np.abs(off) < 4 * residual[rows]), off, np.nan)
        pair = off[:, 1:] * off[:, :-1]  # neighbours of cells are two pixels apart
        products += float(np.nansum(pair))
        squares += float(
            np.nansum(np.where(np.isnan(pair), np.nan, (off[:, 1:] ** 2 + off[:, :-1] ** 2) / 2))
        )
    share = products / squares if squares > 0 else 0.0
    if not 0 < share < 1:
        return 1.0
    return float(np.clip(-np.pi * LAG**2 / np.log(share), 1.0, MOST))


@compiled
def _table(depth: NDArray[np.floating], x: Float64, y: Float64) -> Float64:
    """Sum 1, x, y, xx, xy, yy, q, xq, yq, qq with q = 1 / depth over all cells above and to the left; NaN counts nothing."""
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
def _fit_sums(sums: Float64, min_spread: float, plane: Float64) -> float:
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
def _fit_window(
    sums: Float64, u: int, v: int, r: int, min_spread: float, window: Float64, plane: Float64
) -> float:
    """Fit a plane in the window of radius ``r`` about cell (u, v); as :func:`_fit_sums`, ``window`` (10,) is for its use."""
    left, right = max(u - r, 0), min(u + r + 1, sums.shape[1] - 1)
    top, bottom = max(v - r, 0), min(v + r + 1, sums.shape[0] - 1)
    for k in range(10):
        window[k] = (sums[bottom, right, k] - sums[top, right, k]) - (
            sums[bottom, left, k] - sums[top, left, k]
        )
    return _fit_sums(window, min_spread, plane)


@compiled
def _residuals(
    sums: Float64, pixels: Float64, radii: NDArray[np.int64], min_spread: float, out: Float64
) -> None:
    """Compute residuals (n, r) of the planes in windows of every radius (in cells) about pixels (n, 2)."""
    window, plane = np.empty(10), np.empty(3)
    for i in range(len(pixels)):
        u, v = int(np.rint(pixels[i, 0])) // CELL, int(np.rint(pixels[i, 1])) // CELL
        for j in range(len(radii)):
            out[i, j] = _fit_window(sums, u, v, radii[j], min_spread, window, plane)


@compiled
def _choose(
    sums: Float64, pixels: Float64, radii: NDArray[np.int64], limits: Float64, noisier: Float64, min_spread: float,
    rays: Float64, chosen: Float64, residual: Float64, own: Float64,
) -> None:  # fmt: skip
    """Of every pixel's windows take the largest one's plane whose residual is within the limits, else the smallest one's.

    The limits are ``noisier`` (n,) times wider at each pixel.

    A plane through a bent surface misses its middle by an amount that grows with the square of the window; two windows tell
    it, and the plane is moved to where it vanishes. ``rays`` (n, 2) are x and y at the pixels. ``residual`` (n,) is that of
    a plane within the limits, NaN otherwise; ``own`` (n,) times that is the noise of what was chosen, NaN where nothing tells how
    bent the surface is. Pixels (n, 2) of NaN get NaN.
    """
    window, large, small = np.empty(10), np.empty(3), np.empty(3)
    for i in range(len(pixels)):
        chosen[i, :], residual[i], own[i] = np.nan, np.nan, np.nan
        if not np.isfinite(pixels[i, 0]):
            continue
        u, v = int(np.rint(pixels[i, 0])) // CELL, int(np.rint(pixels[i, 1])) // CELL
        for j in range(len(radii) - 1, -1, -1):
            left = _fit_window(sums, u, v, radii[j], min_spread, window, large)
            if np.isfinite(left):  # the smallest such window stays where none is flat
                chosen[i, :] = large
            if not left <= limits[j] * noisier[i]:
                continue
            residual[i], count = left, window[0]
            if j > 0 and np.isfinite(_fit_window(sums, u, v, radii[j - 1], min_spread, window, small)):
                there = large[0] * rays[i, 0] + large[1] * rays[i, 1] + large[2]
                inner = small[0] * rays[i, 0] + small[1] * rays[i, 1] + small[2]
                share = ((2 * radii[j - 1] + 1) / (2 * radii[j] + 1)) ** 2
                chosen[i, :] *= (inner - share * there) / (1 - share) / there
                own[i] = np.sqrt(1 / window[0] + (share * share - 2 * share) / count) / (1 - share)
            break


@compiled
def _onto(
    planes: Float64, residuals: Float64, pose: Float64, rays: Float64, within: float, depth: Float64, normals: Float64
) -> None:  # fmt: skip
    """Move hits onto the planes that fit their surroundings, in place.

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
def grazing(
    depth: NDArray[np.floating], normals: Float64, rays: Float64, second_eye: Float64, out: Bool
) -> None:
    """Mark in ``out`` (H, W) where either eye sees a surface at more than 75 degrees from its normal; NaN is not marked.

    ``depth`` (H, W), ``normals`` (H, W, 3) and ``rays`` (H, W, 3) with z = 1 are in the frame of the first eye, metres.
    ``second_eye`` (3,) is where the other one stands in it.
    """
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            z, n = depth[v, u], normals[v, u]
            x, y = rays[v, u, 0] * z, rays[v, u, 1] * z
            a, b, c = x - second_eye[0], y - second_eye[1], z - second_eye[2]
            first = -(n[0] * x + n[1] * y + n[2] * z) / np.sqrt(x * x + y * y + z * z)
            second = -(n[0] * a + n[1] * b + n[2] * c) / np.sqrt(a * a + b * b + c * c)
            out[v, u] = first < GRAZING_COSINE or second < GRAZING_COSINE
