"""Project the stereo surface onto the ToF image plane.

The organised stereo points are a triangulated sheet. Where two neighbours are further apart in depth than a surface can be,
the sheet is cut; the cut quads become a *skirt*. A row's hole is bridged by a straight line: from a foreground edge to
the first background point that both eyes see, that line is the right eye's line of sight, so the skirt bounds the space that
the stereo camera does not know. A ToF ray that crosses the skirt before it hits the sheet went through unknown space.

Rays through pixel centres are intersected exactly with every triangle they can meet; nothing is splatted, so background
never leaks through a foreground that is sparser than the image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

STEEPEST = 5.67  # tan 80 deg: neighbours further apart in depth are not one surface
FILLED_GAP = 4  # pixels; a hole that is not wider, in a smooth surface, is interpolated
HIDES = 0.002  # m, and relative; a skirt hides the sheet when it is nearer by both
CHUNK = 1_000_000  # pairs of ray and quad at a time


@dataclass(frozen=True)
class Sheet:
    """A triangulated stereo depth image.

    Attributes
    ----------
    depth
        (SH, SW) float64, stereo frame, metres; holes are bridged along rows, NaN outside the outermost points of a row.
    vertex
        (SH, SW) bool, measured, or interpolated across a small hole of a smooth surface.
    surface
        (SH-1, SW-1) bool, the quad between four neighbours is surface; other quads with four depths are skirt.
    """

    depth: Float64
    vertex: Bool
    surface: Bool


@dataclass(frozen=True)
class Projection:
    """What the ToF camera's rays meet.

    Attributes
    ----------
    depth
        (H, W) float64, metres; NaN: no surface.
    pixels
        (H, W, 2) float64, (u, v) on the stereo grid of the point that is met; NaN where depth is.
    normals
        (H, W, 3) float64, of the triangles (noisy), ToF frame, unit, facing the camera; NaN where depth is.
    occluded, edge
        (H, W) bool, reasons to mistrust the pixel.
    """

    depth: Float64
    pixels: Float64
    normals: Float64
    occluded: Bool
    edge: Bool


@dataclass(frozen=True)
class _Hits:
    """Intersections of rays with triangles: flat pixel, depth, flat corner indices (n, 4) and their weights (n, 4)."""

    pixel: Int64
    depth: Float64
    corners: Int64
    weights: Float64

    def only(self, keep: Bool) -> _Hits:
        return _Hits(self.pixel[keep], self.depth[keep], self.corners[keep], self.weights[keep])


def _bridge(z: Float64, footprint: float) -> tuple[Float64, Bool]:
    """Fill holes of rows linearly in inverse depth, a straight line in space; say which fills are smooth and small."""
    valid = np.isfinite(z)
    columns = np.where(valid, np.arange(z.shape[1]), -1)
    left = np.maximum.accumulate(columns, axis=1)
    columns = np.where(valid, np.arange(z.shape[1]), z.shape[1])
    right = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    rows, at = np.nonzero(~valid & (left >= 0) & (right < z.shape[1]))
    a, b = left[rows, at], right[rows, at]
    za, zb = z[rows, a], z[rows, b]
    t = (at - a) / (b - a)
    out, vertex = z.copy(), valid.copy()
    out[rows, at] = 1 / ((1 - t) / za + t / zb)
    limit = STEEPEST * footprint * np.minimum(za, zb) * (b - a)
    vertex[rows, at] = (b - a - 1 <= FILLED_GAP) & (np.abs(za - zb) <= limit)
    return out, vertex


def triangulate(depth: NDArray[np.floating], camera: Camera) -> Sheet:
    """Turn a stereo depth image into a sheet with cuts.

    ``depth`` is (SH, SW) z in the stereo frame in metres, NaN: none; ``camera`` holds the intrinsics of that grid.

    Raises
    ------
    DataError
        When depth is not of the camera's shape.
    """
    if depth.shape != camera.shape:
        raise DataError(f"triangulate: expected depth of shape {camera.shape}, got {depth.shape}")
    footprint = 1 / min(camera.fx, camera.fy)
    z, vertex = _bridge(np.asarray(depth, dtype=np.float64), footprint)
    with np.errstate(invalid="ignore"):
        limit = STEEPEST * footprint * z
        across = vertex[:, 1:] & vertex[:, :-1] & (np.abs(z[:, 1:] - z[:, :-1]) <= limit[:, 1:])
        down = vertex[1:] & vertex[:-1] & (np.abs(z[1:] - z[:-1]) <= limit[1:])
    return Sheet(z, vertex, across[1:] & across[:-1] & down[:, 1:] & down[:, :-1])


def _extremes(image: Float64) -> tuple[Float64, Float64]:
    """Smallest and largest value at the four corners of each quad; NaN where a corner is."""
    low = np.minimum(image[:, 1:], image[:, :-1])
    high = np.maximum(image[:, 1:], image[:, :-1])
    return np.minimum(low[1:], low[:-1]), np.maximum(high[1:], high[:-1])


def _candidates(points: Float64, camera: Camera) -> tuple[Int64, Int64]:
    """Quads whose image bounds a pixel centre: flat quad index (n,), and (n, 4) bounds u0, u1, v0, v1, inclusive."""
    pixels, _ = camera.project(points)
    (u0, u1), (v0, v1) = _extremes(pixels[..., 0]), _extremes(pixels[..., 1])
    with np.errstate(invalid="ignore"):
        bounds = [
            np.ceil(np.maximum(u0, 0)),
            np.floor(np.minimum(u1, camera.width - 1)),
            np.ceil(np.maximum(v0, 0)),
            np.floor(np.minimum(v1, camera.height - 1)),
        ]
        some = np.flatnonzero((bounds[0] <= bounds[1]) & (bounds[2] <= bounds[3]))
    return some, np.stack([b.reshape(-1)[some] for b in bounds], axis=1).astype(np.int64)


def _pairs(bounds: Int64) -> Iterator[tuple[Int64, Int64, Int64]]:
    """Every pixel (u, v) within the bounds of every quad, a chunk of quads at a time."""
    width = bounds[:, 1] - bounds[:, 0] + 1
    count = width * (bounds[:, 3] - bounds[:, 2] + 1)
    chunk = np.cumsum(count) // CHUNK
    for k in np.unique(chunk):
        mine = np.flatnonzero(chunk == k)
        row = np.repeat(mine, count[mine])
        step = np.arange(len(row)) - np.repeat(np.cumsum(count[mine]) - count[mine], count[mine])
        yield row, bounds[row, 0] + step % width[row], bounds[row, 2] + step // width[row]


def _intersect(points: Float64, camera: Camera) -> _Hits:
    """Intersect the rays of all pixels with both triangles of every quad.

    For a triangle abc and a ray r the numbers ``r . (b x c)``, ``r . (c x a)``, ``r . (a x b)`` have one sign exactly when
    the ray goes through it, are its barycentric weights, and ``det(a, b, c)`` over their sum is the depth. Neighbouring
    triangles compute the same numbers for their common edge: no ray slips between them.
    """
    quads, bounds = _candidates(points, camera)
    row, column = np.divmod(quads, points.shape[1] - 1)
    first = row * points.shape[1] + column
    corners = np.stack([first, first + 1, first + points.shape[1], first + points.shape[1] + 1], axis=1)
    a, b, c, d = np.moveaxis(points.reshape(-1, 3)[corners], 1, 0)
    bc = np.cross(b, c)
    halves = (  # corner weights as cross products, in the order a b c d, and the determinant
        (bc, np.cross(c, a), np.cross(a, b), None, np.einsum("nc,nc->n", a, bc)),
        (None, np.cross(d, c), np.cross(b, d), -bc, -np.einsum("nc,nc->n", d, bc)),
    )
    nothing = np.zeros(0, dtype=np.int64)
    found = [_Hits(nothing, np.zeros(0), np.zeros((0, 4), dtype=np.int64), np.zeros((0, 4)))]
    for quad, u, v in _pairs(bounds):
        rays = camera.rays[v, u]
        for *crosses, det in halves:
            found.append(_through(rays, quad, crosses, det, corners, v * camera.width + u))
    return _Hits(*(np.concatenate([getattr(f, k.name) for f in found]) for k in fields(_Hits)))


def _through(
    rays: Float64, quad: Int64, crosses: list[Float64 | None], det: Float64, corners: Int64, pixel: Int64
) -> _Hits:
    weights = np.zeros((len(quad), 4))
    for k, cross in enumerate(crosses):
        if cross is not None:
            weights[:, k] = np.einsum("nc,nc->n", rays, cross[quad])
    total = weights.sum(axis=1)
    inside = ((weights >= 0).all(axis=1) | (weights <= 0).all(axis=1)) & (total != 0)
    depth = det[quad[inside]] / total[inside]
    ahead = depth > 0
    keep = np.flatnonzero(inside)[ahead]
    return _Hits(pixel[keep], depth[ahead], corners[quad[keep]], weights[keep] / total[keep, None])


def _nearest(hits: _Hits, camera: Camera) -> tuple[Float64, Int64]:
    """Depth image of the nearest hits, NaN where there is none, and which hit it is (-1: none)."""
    order = np.argsort(-hits.depth, kind="stable")  # of several assignments to a pixel the last one stays
    index = np.full(camera.height * camera.width, -1)
    index[hits.pixel[order]] = order
    depth = np.where(index >= 0, hits.depth[index] if len(order) else np.nan, np.nan)
    return depth.reshape(camera.shape), index.reshape(camera.shape)


def _triangle_normals(hits: _Hits, points: Float64) -> Float64:
    """Unit normals (n, 3) of the triangles, pointing to the side from which the stereo camera saw them."""
    a, b, c, d = np.moveaxis(points.reshape(-1, 3)[hits.corners], 1, 0)
    upper = hits.weights[:, 3] == 0
    normals = np.where(upper[:, None], np.cross(c - a, b - a), np.cross(b - d, c - d))
    out: Float64 = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return out


def _grid_position(hits: _Hits, width: int) -> Float64:
    """Return (n, 2) positions (u, v) on the stereo grid."""
    row, column = np.divmod(hits.corners[:, 0], width)
    _, b, c, d = hits.weights.T
    return np.stack([column + b + d, row + c + d], axis=1)


def _dilate(mask: Bool, radius: int) -> Bool:
    padded = np.pad(mask, radius)
    height, width = mask.shape
    out = np.zeros_like(mask)
    for dv in range(2 * radius + 1):
        for du in range(2 * radius + 1):
            out |= padded[dv : dv + height, du : du + width]
    return out


def _borders(sheet: Sheet, points: Float64, camera: Camera, depth: Float64) -> Bool:
    """Pixels where the sheet visibly ends or is cut."""
    whole = np.pad(sheet.surface, 1)
    border = sheet.vertex & ~(whole[1:, 1:] & whole[1:, :-1] & whole[:-1, 1:] & whole[:-1, :-1])
    pixels, z = camera.project(points[border])
    u, v = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64).T
    within = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v, z = u[within], v[within], z[within]
    visible = ~(z > depth[v, u] * 1.01 + 0.005)
    out = np.zeros(camera.shape, dtype=bool)
    out[v[visible], u[visible]] = True
    return out


def _jumps(depth: Float64, camera: Camera) -> Bool:
    """Pixels beside a step in depth that no surface at less than 80 degrees makes."""
    limit = STEEPEST / min(camera.fx, camera.fy) * depth
    out = np.zeros(camera.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        across = np.abs(np.diff(depth, axis=1)) > np.fmin(limit[:, 1:], limit[:, :-1])
        down = np.abs(np.diff(depth, axis=0)) > np.fmin(limit[1:], limit[:-1])
    out[:, 1:] |= across
    out[:, :-1] |= across
    out[1:] |= down
    out[:-1] |= down
    return out


def project(sheet: Sheet, points: Float64, camera: Camera, edge_pixels: int) -> Projection:
    """Render the sheet into a camera on the ToF plane.

    Parameters
    ----------
    sheet
        From :func:`triangulate`.
    points
        (SH, SW, 3) the sheet's vertices in the ToF frame, metres; NaN: none.
    camera
        Intrinsics on the ToF plane, any size.
    edge_pixels
        Pixels this near to a depth edge or to a pixel without surface are marked.
    """
    hits = _intersect(points, camera)
    normals = _triangle_normals(hits, points)
    row, column = np.divmod(hits.corners[:, 0], points.shape[1])
    # The back of the sheet is no surface either: the ray came through space behind it.
    front = np.einsum("nc,nc->n", normals, camera.rays.reshape(-1, 3)[hits.pixel]) < 0
    real = sheet.surface[row, column] & front
    depth, index = _nearest(hits.only(real), camera)
    skirt, _ = _nearest(hits.only(~real), camera)
    hit = index >= 0
    return Projection(
        depth=depth,
        pixels=_spread(_grid_position(hits, points.shape[1])[real], index),
        normals=_spread(normals[real], index),
        occluded=np.isfinite(skirt) & ~(skirt > depth * (1 - HIDES) - HIDES),
        edge=_dilate(~hit | _borders(sheet, points, camera, depth) | _jumps(depth, camera), edge_pixels),
    )


def _spread(values: Float64, index: Int64) -> Float64:
    """Image of ``values[index]``, NaN where the index is -1."""
    out = np.full((*index.shape, values.shape[1]), np.nan)
    out[index >= 0] = values[index[index >= 0]]
    return out
