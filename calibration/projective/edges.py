"""Depth edges: what holds a registration across the view where surfaces hold little.

Where a surface ends before a deeper one, the last ToF ray that meets it and the first that passes it have the edge between
them. That much is certain and no more: the residual is zero as long as the edge lies between the two rays, whatever part of the
pixel it crosses. (A midpoint with a standard deviation would claim more than is known of an edge along the pixel rows, whose
points all share one rounding.)

Both cameras must see the same edge. The outline of a ball moves with the point of view, and so does that of a plate whose
narrow side comes into sight; so an edge counts only where a smooth surface ends in it, and where a narrow side at right angles
would be hidden from both cameras.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.projective.newton import Match, tukey
from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from calibration.projective.grid import SurfaceGrid

JUMP = 0.045  # m from a surface to what lies behind it, in either camera
FLAT = JUMP / 3  # m between neighbours on one surface; three standard deviations of a ToF pixel's noise
NEIGHBOURS = 12  # px of a curve that its tangent is fitted to
STRAIGHT = 0.2  # largest ratio of their second to their first principal axis
INSIDE = 7.0  # px from a curve to where the surface that ends there is looked up
MARRIED = 0.003  # m, the surface's continuation to the edge from what was measured there
REACH = 8.0  # px of the stereo image, from a ToF edge to the curve; the pose is good to millimetres by then
ALONG = 0.3  # least cosine between a pixel row and the curve's normal for the row to say where the curve is
SIGMA = 0.0004  # m, of an edge: rounding of the stereo image
BESIDE = 0.0001  # m, root mean square over all edges of what is left where they are what they seem: most lie between their rays


@dataclass(frozen=True)
class StereoEdges:
    """Curves in a stereo image in which a smooth surface ends before a deeper one.

    Attributes
    ----------
    camera
        Of the image.
    points
        (3, M) on the surface's edge, stereo frame, metres.
    tangents
        (3, M) unit, along the edge; outward is ``tangent x view``.
    sides
        (3, M) unit, outward normals of the narrow side that a plate would have there.
    tree
        Of the curves' pixels (M, 2), (u, v); None where there are none.
    """

    camera: Camera
    points: Float64
    tangents: Float64
    sides: Float64
    tree: cKDTree | None


@dataclass(frozen=True)
class TofEdges:
    """Couples of ToF rays that have an edge between them.

    Attributes
    ----------
    last, first
        (3, N) ends of the last ray on the nearer surface, and of the first beside it at the same range; ToF frame, metres.
    """

    last: Float64
    first: Float64


def stereo_edges(points: NDArray[np.floating], camera: Camera, grid: SurfaceGrid) -> StereoEdges:
    """Find the depth edges of an organised point map.

    Parameters
    ----------
    points
        (H, W, 3), stereo frame, metres; NaN where nothing was measured.
    camera
        Intrinsics of the stereo camera.
    grid
        The map's surface.

    Raises
    ------
    DataError
        When the map is not of the camera's shape.
    """
    from scipy.spatial import cKDTree

    if points.shape != (*camera.shape, 3):
        raise DataError(f"stereo points: expected ({camera.height}, {camera.width}, 3), got {points.shape}")
    depth = np.ascontiguousarray(points[..., 2])
    across, down = (_curve(*found) for found in _jumps(depth))
    pixels = np.concatenate([across[0], down[0][:, ::-1]])
    outward = np.concatenate([across[1], down[1][:, ::-1]])
    measured = np.concatenate([across[2], down[2]])
    if len(pixels) <= NEIGHBOURS:
        return _no_edges(camera)
    near = pixels[cKDTree(pixels, balanced_tree=False, compact_nodes=False).query(pixels, NEIGHBOURS)[1]]
    at, normal, straight = _tangents(near)
    normal = np.where((normal * outward).sum(axis=1, keepdims=True) < 0, -normal, normal)
    at, normal, measured = at[straight], normal[straight], measured[straight]
    P, t, w, good = _ends(at, normal, measured, camera, grid)
    if not good.any():
        return _no_edges(camera)
    P, t, w = (np.ascontiguousarray(x[:, good]) for x in (P, t, w))
    return StereoEdges(camera, P, t, w, cKDTree(at[good], balanced_tree=False, compact_nodes=False))


def _no_edges(camera: Camera) -> StereoEdges:
    none = np.zeros((3, 0))
    return StereoEdges(camera, none, none, none, None)


def _ends(
    at: Float64, normal: Float64, measured: Float64, camera: Camera, grid: SurfaceGrid
) -> tuple[Float64, Float64, Float64, NDArray[np.bool_]]:
    """Points, tangents and narrow sides (3, N) of a surface's end at pixels (N, 2), and where it is one that both cameras see."""
    planes = grid.planes_at(_rays(at - INSIDE * normal, camera))
    n, ray = planes.normals, _rays(at, camera)
    along = _dot(n, ray)
    depth = planes.offsets / np.where(np.abs(along) > 0, along, 1.0)
    m = _planes(at, normal, camera)
    t = _unit(_cross(n, m))
    w = _cross(t, n)
    w = np.where(_dot(w, m) < 0, -w, w)
    t = np.where(_dot(_cross(t, ray), m) < 0, -t, t)
    good = planes.found & (np.abs(depth - measured) < MARRIED) & (_dot(w, ray) > 0)
    return ray * depth, t, w, good


def _rays(pixels: Float64, camera: Camera) -> Float64:
    """Rays (3, N) of depth one through pixels (N, 2)."""
    u, v = pixels.T
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])


def _cross(a: Float64, b: Float64) -> Float64:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _unit(a: Float64) -> Float64:
    length = np.sqrt(_dot(a, a))
    out: Float64 = a / np.where(length > 0, length, 1.0)
    return out


def _jumps(
    depth: NDArray[np.floating],
) -> Iterator[tuple[NDArray[np.floating], NDArray[np.intp], NDArray[np.intp]]]:
    """Views of a depth image with each of its axes last, rows and columns in them after which it jumps, borders left out."""
    step = np.zeros_like(depth)  # one buffer: fresh pages would cost more than the arithmetic
    for axis in (1, 0):
        before, after = (slice(None),) * axis + (slice(1, -2),), (slice(None),) * axis + (slice(2, -1),)
        step[...] = 0
        np.subtract(depth[after], depth[before], out=step[before])
        at = np.flatnonzero(np.abs(step, out=step) > JUMP)
        row, column = np.divmod(at, depth.shape[1])
        yield (depth, row, column) if axis == 1 else (depth.T, column, row)


def _curve(
    depth: NDArray[np.floating], row: NDArray[np.intp], column: NDArray[np.intp]
) -> tuple[Float64, Float64, Float64]:
    """Borders (N, 2), (u, v), after those columns where one side lies deeper, the ways there, the nearer depths."""
    z = depth[row[:, None], column[:, None] + np.arange(-1, 3)]
    ends = (np.abs(z[:, 0] - z[:, 1]) < FLAT) & (np.abs(z[:, 3] - z[:, 2]) < FLAT)
    z, row, column = z[ends], row[ends], column[ends]
    outward = np.zeros((len(row), 2))
    outward[:, 0] = np.where(z[:, 2] > z[:, 1], 1.0, -1.0)
    measured = z[:, 1:3].min(axis=1).astype(np.float64)
    return np.column_stack([column + 0.5, row]).astype(np.float64), outward, measured


def _tangents(near: Float64) -> tuple[Float64, Float64, NDArray[np.bool_]]:
    """Centres and normals (N, 2) of lines through neighbours (N, K, 2), and which of those lie along a line."""
    at = near.mean(axis=1)
    du, dv = np.moveaxis(near - at[:, None], -1, 0)
    uu, uv, vv = (du * du).sum(axis=1), (du * dv).sum(axis=1), (dv * dv).sum(axis=1)
    angle = np.arctan2(2 * uv, uu - vv) / 2
    spread = np.hypot(uu - vv, 2 * uv)
    straight = uu + vv - spread < STRAIGHT**2 * (uu + vv + spread)
    return at, np.column_stack([-np.sin(angle), np.cos(angle)]), straight


def _planes(at: Float64, normal: Float64, camera: Camera) -> Float64:
    """Normals (3, N) of the planes through the centre of the camera and image lines at (N, 2) with normals (N, 2)."""
    a, b = normal[:, 0] * camera.fx, normal[:, 1] * camera.fy
    return np.stack([a, b, -a * (at[:, 0] - camera.cx) / camera.fx - b * (at[:, 1] - camera.cy) / camera.fy])


def tof_edges(points: NDArray[np.floating]) -> TofEdges:
    """Find the depth edges of an organised ToF cloud.

    One mixed pixel between the two surfaces is stepped over: the edge then lies somewhere in two pixels.

    Parameters
    ----------
    points
        (H, W, 3), ToF frame, metres, each along the ray of its pixel; NaN where nothing was measured.
    """
    P = np.asarray(points, dtype=np.float64)
    found = [_steps(_facing(P, axis, sign)) for axis in (0, 1) for sign in (1, -1)]
    return TofEdges(*(np.ascontiguousarray(np.concatenate(part).T) for part in zip(*found, strict=True)))


def _facing(P: Float64, axis: int, sign: int) -> Float64:
    return (P if axis == 1 else P.swapaxes(0, 1))[:, ::sign]


def _steps(P: Float64) -> tuple[Float64, Float64]:
    """Last ends on a surface and first ends beside it, where surfaces end rightwards."""
    r = np.sqrt(np.square(P).sum(axis=-1))
    before, here, one, two, three = (r[:, k : r.shape[1] - 4 + k] for k in range(5))
    with np.errstate(invalid="ignore"):
        surface = np.abs(here - before) < FLAT
        clean = surface & (one - here > JUMP) & (np.abs(two - one) < FLAT)
        mixed = surface & (two - here > JUMP) & (one - here > FLAT) & (two - one > FLAT)
        mixed &= np.abs(three - two) < FLAT
    row, column = np.nonzero(clean | mixed)
    beside = column + np.where(clean[row, column], 2, 3)
    scale = r[row, column + 1] / r[row, beside]
    return P[row, column + 1], P[row, beside] * scale[:, None]


def match_edges(tof: TofEdges, stereo: StereoEdges, T: Float64, kernel: float) -> tuple[Match, Float64]:
    """Pair ToF edges with the stereo curves that they project onto.

    Parameters
    ----------
    tof, stereo
        Edges of both cameras.
    T
        (4, 4) ``T_stereo_tof``.
    kernel
        Tukey's scale, metres.

    Returns
    -------
    match
        ``distance`` is by how much the edge lies beside the two rays, zero where it lies between them.
    weights
        (M,) of the robust kernel over the variance.
    """
    last, first = (np.einsum("ij,jn->in", T[:3, :3], P) for P in (tof.last, tof.first))
    chosen, curve = _nearest((last + first) / 2 + T[:3, 3:], stereo)
    view = stereo.points[:, curve] - T[:3, 3:]
    n = _unit(_cross(stereo.tangents[:, curve], view))
    scale = np.sqrt(_dot(view, view) / _dot(last[:, chosen], last[:, chosen]))
    last, first = (
        last[:, chosen] * scale,
        first[:, chosen] * scale,
    )  # the range is the edge's own, free of noise
    inner, outer = _dot(n, last), _dot(n, first)
    distance = np.maximum(inner, 0) + np.minimum(outer, 0)
    good = outer - inner > ALONG * np.sqrt(_dot(first - last, first - last))
    good &= (_dot(stereo.sides[:, curve], view) > 0) & (np.abs(distance) < kernel)
    keep = np.flatnonzero(good)
    points = (last + first)[:, keep] / 2 + T[:3, 3:]
    # Rounded or slanted sides show as edges that lie beside their rays too often; they all count for less then.
    doubt = float(np.sqrt(np.mean(np.square(distance[keep])))) / BESIDE if len(keep) else 1.0
    variance, reach = np.full(len(keep), (SIGMA * max(doubt, 1.0)) ** 2), np.zeros(len(keep))
    match = Match(chosen[keep], points, n[:, keep], distance[keep], variance, reach)
    return match, np.where(match.distance != 0, tukey(match.distance / kernel) / variance, 0.0)


def _nearest(points: Float64, stereo: StereoEdges) -> tuple[NDArray[np.intp], NDArray[Any]]:
    """Which points (3, N) project near a curve, and its nearest pixel."""
    camera = stereo.camera
    ahead = np.flatnonzero(points[2] > 0)
    x, y, z = points[:, ahead]
    pixels = np.column_stack([x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy])
    if stereo.tree is None or len(pixels) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    distance, curve = stereo.tree.query(pixels, distance_upper_bound=REACH)
    found = np.isfinite(distance)
    return ahead[found], curve[found]


def _dot(a: Float64, b: Float64) -> Float64:
    out: Float64 = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out
