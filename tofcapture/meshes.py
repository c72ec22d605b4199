"""Triangle meshes: read from files, or built watertight from outlines, profiles of revolution and tubes.

A mesh is ``(vertices (N, 3) float64 metres, triangles (M, 3) int64)``; triangles wind counter-clockwise seen from outside.
Every builder returns closed components: each edge belongs to exactly two triangles, in opposite directions. The builders are
ours because light between surfaces depends on where triangles lie: others would change what a simulated seed gives.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

Index = NDArray[np.int64]
Mesh = tuple[Float64, Index]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SUFFIXES = (".ply", ".obj", ".stl")


def inside(polygon: Float64, points: Float64) -> NDArray[np.bool_]:
    """Say which points (..., 2) lie in a simple polygon (N, 2), by crossings of the ray to the right."""
    x, y = points[..., None, 0], points[..., None, 1]
    x0, y0 = polygon.T
    x1, y1 = np.roll(polygon, -1, axis=0).T
    straddles = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    return np.asarray((straddles & (x < at)).sum(axis=-1) % 2 == 1)


def metres_per(unit: str, where: str) -> float:
    """Look up the metres in one unit; :class:`ConfigError` on anything but m, cm, mm."""
    if unit not in UNITS:
        raise ConfigError(f"{where}: expected a unit among {', '.join(UNITS)}, got {unit!r}")
    return UNITS[unit]


def read_mesh(path: Path, unit: str) -> Mesh:
    """Read a PLY, OBJ or STL file whose numbers are in ``unit``.

    :class:`ConfigError` when it is missing, of another type, unreadable or without triangles.
    """
    scale = metres_per(unit, str(path))
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: expected a mesh file ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise ConfigError(f"{path}: no such mesh", hint="mesh paths are relative to the world file")
    try:
        import trimesh
    except ImportError as err:
        raise ConfigError(
            f"trimesh is needed here and does not load: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err
    try:
        mesh = trimesh.load_mesh(path, process=False)  # processing would merge and reorder vertices
        vertices = np.asarray(mesh.vertices, dtype=np.float64) * scale
        triangles = np.asarray(mesh.faces, dtype=np.int64)
    except Exception as err:
        raise ConfigError(f"{path}: cannot be read as a triangle mesh: {err}") from err
    if len(triangles) == 0:
        raise ConfigError(f"{path}: expected a triangle mesh, found no triangles")
    _expect_whole(path, vertices, triangles)
    return vertices, triangles


def _expect_whole(path: Path, vertices: Float64, triangles: Index) -> None:
    """Refuse a mesh whose file was cut short: less than its header promises, or corners that are not there."""
    head = path.read_bytes()[:4096].partition(b"end_header")[0] if path.suffix.lower() == ".ply" else b""
    promised = {name.decode(): int(n) for name, n in re.findall(rb"element (vertex|face) (\d+)", head)}
    found = {"vertex": len(vertices), "face": len(triangles)}
    short = [f"{n} of element {name}, found {found[name]}" for name, n in promised.items() if found[name] < n]
    if not np.isfinite(vertices).all() or int(triangles.max()) >= len(vertices) or triangles.min() < 0:
        short.append("finite corners for every triangle")
    if short:
        raise ConfigError(f"{path}: cut short or damaged: expected {', '.join(short)}", hint="copy it again")


def extrude(outer: Float64, height: float, holes: Sequence[Float64] = ()) -> Mesh:
    """Build a prism from z = 0 to ``height`` over a polygon with holes, as :func:`triangulate` takes them, metres."""
    points, caps, rings = triangulate(outer, holes)
    n = len(points)
    low = np.column_stack([points, np.zeros(n)])
    high = np.column_stack([points, np.full(n, height)])
    sides = [_band(ring, ring + n) for ring in rings]
    return np.concatenate([low, high]), np.concatenate([caps[:, ::-1], caps + n, *sides])


def revolve(profile: ArrayLike, segments: int = 64) -> Mesh:
    """Build a solid of revolution about z.

    ``profile`` (N, 2) of (radius, z) is an open line from the axis to the axis with the solid on its left when walked with r
    to the right and z upwards, so from the bottom along the outside to the top.
    """
    profile = np.asarray(profile, dtype=np.float64)
    if len(profile) < 3 or profile[0, 0] != 0 or profile[-1, 0] != 0 or (profile[1:-1, 0] <= 0).any():
        raise ConfigError(
            "revolve: expected a profile that leaves the axis at its first and meets it at its last point"
        )
    angle = 2 * np.pi * np.arange(segments) / segments
    r, z = profile[1:-1, 0, None], profile[1:-1, 1, None]
    rings = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z, (len(r), segments))], axis=-1)
    return _skin([0, 0, profile[0, 1]], rings, [0, 0, profile[-1, 1]])


def tube(path: ArrayLike, radius: float, normal: ArrayLike, segments: int = 20) -> Mesh:
    """Build a round bar along a planar path (N, 3), closed by flat ends.

    ``normal`` (3,) is that of the path's plane; ``radius`` must be smaller than the path's radius of curvature, metres.
    """
    path = np.asarray(path, dtype=np.float64)
    side = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.cross(tangent, side)
    angle = 2 * np.pi * np.arange(segments) / segments
    offset = np.cos(angle)[None, :, None] * up[:, None] + np.sin(angle)[None, :, None] * side
    # up x side = (t x s) x s = -t, so the ring runs clockwise about the tangent: walk it backwards.
    return _skin(path[0], (path[:, None] + radius * offset)[:, ::-1], path[-1])


def _skin(start: ArrayLike, rings: Float64, end: ArrayLike) -> Mesh:
    """Close a stack of rings (R, S, 3) by fans about a first and a last point."""
    vertices = np.concatenate([np.array([start]), rings.reshape(-1, 3), np.array([end])])
    count, segments = rings.shape[:2]
    index = 1 + np.arange(count * segments, dtype=np.int64).reshape(count, segments)
    first, last = np.zeros(segments, dtype=np.int64), np.full(segments, len(vertices) - 1)
    bottom = np.stack([first, np.roll(index[0], -1), index[0]], axis=1)
    top = np.stack([last, index[-1], np.roll(index[-1], -1)], axis=1)
    return vertices, np.concatenate([bottom, *(_band(a, b) for a, b in pairwise(index)), top])


def _band(low: Index, high: Index) -> Index:
    """Join two closed rings of equal length by triangles."""
    low2, high2 = np.roll(low, -1), np.roll(high, -1)
    return np.concatenate([np.stack([low, low2, high2], axis=1), np.stack([low, high2, high], axis=1)])


def cuboid(x: float, y: float, z: float) -> Mesh:
    """Build a box x by y by z metres, centred in x and y, standing on z = 0."""
    return extrude(rectangle(x, y), z)


def cylinder(radius: float, height: float, segments: int = 32) -> Mesh:
    """Build an upright cylinder on z = 0, metres."""
    return extrude(circle(radius, segments=segments), height)


def join(*meshes: Mesh) -> Mesh:
    """Put closed components into one mesh; they may touch or overlap."""
    starts = np.cumsum([0, *(len(v) for v, _ in meshes)])
    vertices = np.concatenate([v for v, _ in meshes])
    return vertices, np.concatenate([t + s for (_, t), s in zip(meshes, starts, strict=False)])


def move(mesh: Mesh, T: Float64) -> Mesh:
    """Apply a rigid (4, 4) transform."""
    return mesh[0] @ T[:3, :3].T + T[:3, 3], mesh[1]


def shift(mesh: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    """Translate by metres."""
    return mesh[0] + np.array([x, y, z]), mesh[1]


def settle(mesh: Mesh) -> Mesh:
    """Centre the bounding box in x and y and put the lowest point on z = 0."""
    low, high = mesh[0].min(axis=0), mesh[0].max(axis=0)
    return mesh[0] - [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]], mesh[1]


def volume(mesh: Mesh) -> float:
    """Compute the signed volume, cubic metres: positive when triangles wind outwards (divergence theorem)."""
    a, b, c = np.moveaxis(mesh[0][mesh[1]], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def rectangle(x: float, y: float) -> Float64:
    """Draw a rectangle (4, 2) centred on the origin, counter-clockwise."""
    return np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) / 2


def circle(radius: float, centre: tuple[float, float] = (0.0, 0.0), segments: int = 32) -> Float64:
    """Draw a regular polygon (segments, 2) on a circle, counter-clockwise."""
    angle = 2 * np.pi * np.arange(segments) / segments
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def signed_area(polygon: Float64) -> float:
    """Compute the area of a simple polygon (N, 2), positive when it runs counter-clockwise (shoelace formula)."""
    x, y = polygon.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def triangulate(outer: Float64, holes: Sequence[Float64] = ()) -> tuple[Float64, Index, list[Index]]:
    """Triangulate a polygon with holes by ear clipping; holes are bridged to the outline first.

    After D. Eberly, "Triangulation by Ear Clipping" (Geometric Tools, 2002); quadratic in the corners, a few hundred here.

    ``outer`` (N, 2) and ``holes``, which touch neither it nor each other, are simple polygons of either orientation;
    :class:`ConfigError` when they cross, touch or have no area.

    Returns
    -------
    points, triangles
        (P, 2) all corners, the outline's, then each hole's; (P + 2 H - 2, 3) counter-clockwise, using every corner.
    rings
        Indices of the outline (counter-clockwise) and of each hole (clockwise): the solid is on the left of each.
    """
    polygons = [np.asarray(p, dtype=np.float64) for p in (outer, *holes)]
    starts = np.cumsum([0, *(len(p) for p in polygons)])
    points = np.concatenate(polygons)
    rings = []
    for i, polygon in enumerate(polygons):
        ring = np.arange(starts[i], starts[i + 1], dtype=np.int64)
        rings.append(ring if (signed_area(polygon) > 0) == (i == 0) else ring[::-1])
    loop = rings[0].tolist()
    # Rightmost first: to the right of a hole's rightmost corner there is then always a corner of the loop in sight.
    waiting = sorted(rings[1:], key=lambda ring: -float(points[ring, 0].max()))
    for i in range(len(waiting)):
        loop = _bridge(points, loop, waiting[i:])
    triangles = _clip_ears(points, loop)
    # Outlines that cross can leave ears to clip, but not the area that they enclose.
    areas = _cross(*np.moveaxis(points[triangles], 1, 0)) / 2
    enclosed = sum(signed_area(points[ring]) for ring in rings)
    if areas.min() <= 0 or abs(areas.sum() - enclosed) > 1e-9 * areas.sum():
        raise ConfigError("triangulate: the outline or a hole crosses itself or another")
    return points, triangles, rings


def _cross(o: Float64, a: Float64, b: Float64) -> Float64:
    """Compute twice the signed area of the triangles o, a, b (..., 2)."""
    p, q = a - o, b - o
    out: Float64 = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return out


def _bridge(points: Float64, loop: list[int], holes: Sequence[Index]) -> list[int]:
    """Cut from the first hole's rightmost corner to the nearest corner of the loop that it can see past all holes."""
    hole = holes[0]
    first = int(np.argmax(points[hole, 0]))
    start = int(hole[first])
    begin = points[np.concatenate([loop, *holes])]
    end = points[np.concatenate([np.roll(ring, -1) for ring in (np.asarray(loop), *holes)])]
    for k in np.argsort(np.linalg.norm(points[loop] - points[start], axis=1), kind="stable"):
        if _in_corner(points, loop, int(k), start) and _is_free(begin, end, points[start], points[loop[k]]):
            return [*loop[: k + 1], *np.roll(hole, -first).tolist(), start, *loop[k:]]
    raise ConfigError("triangulate: a hole touches or crosses the outline or another hole")


def _in_corner(points: Float64, loop: list[int], k: int, start: int) -> bool:
    """Tell whether the segment from corner k of the loop to point ``start`` begins inside the polygon."""
    here, there = points[start], points[loop[k]]
    before, after = points[loop[k - 1]], points[loop[(k + 1) % len(loop)]]
    left, right = _cross(there, after, here) > 0, _cross(before, there, here) > 0
    convex = _cross(before, there, after) > 0
    return bool((left and right) if convex else (left or right))


def _is_free(a: Float64, b: Float64, here: Float64, there: Float64) -> bool:
    """Tell whether no edge a-b (E, 2) crosses the segment here-there, but for edges that share an end with it."""
    apart = ~((a == here) | (a == there)).all(axis=1) & ~((b == here) | (b == there)).all(axis=1)
    a, b = a[apart], b[apart]
    straddles = _cross(here, there, a) * _cross(here, there, b) <= 0
    divided = _cross(a, b, here) * _cross(a, b, there) <= 0
    return not bool((straddles & divided).any())


def _clip_ears(points: Float64, loop: list[int]) -> Index:
    """Cut ears off a loop until a triangle is left."""
    loop = list(loop)
    border = 1e-12 * float(np.ptp(points, axis=0).max()) ** 2
    out = []
    k = 0
    while len(loop) > 3:
        turns = ((k + step) % len(loop) for step in range(len(loop)))
        i = next((i for i in turns if _is_ear(points[loop], i, border)), None)
        if i is None:
            raise ConfigError("triangulate: the outline or a hole crosses itself or another")
        out.append((loop[i - 1], loop[i], loop[(i + 1) % len(loop)]))
        del loop[i]
        # Going on two corners further keeps ears from fanning around one corner.
        k = (i + 1) % len(loop)
    return np.array([*out, (loop[0], loop[1], loop[2])], dtype=np.int64)


def _is_ear(p: Float64, i: int, border: float) -> bool:
    """Tell whether corner i of a loop (N, 2) is convex and its triangle holds no other corner."""
    a, b, c = p[i - 1], p[i], p[(i + 1) % len(p)]
    if _cross(a, b, c) <= border:
        return False
    # Corners on the border count as inside: cutting past them would leave corners on one line.
    inside = (_cross(a, b, p) >= -border) & (_cross(b, c, p) >= -border) & (_cross(c, a, p) >= -border)
    corner = (p == a).all(axis=1) | (p == b).all(axis=1) | (p == c).all(axis=1)
    return not bool((inside & ~corner).any())
