"""Triangulation of polygons with holes by ear clipping; holes are bridged to the outline first.

After D. Eberly, "Triangulation by Ear Clipping" (Geometric Tools, 2002). Quadratic in the number of corners, which
are a few hundred here; no triangulation is needed elsewhere, so no library is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

Index = NDArray[np.int64]


def signed_area(polygon: Float64) -> float:
    """Area of a simple polygon (N, 2), positive when it runs counter-clockwise (shoelace formula)."""
    x, y = polygon.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def triangulate(outer: Float64, holes: Sequence[Float64] = ()) -> tuple[Float64, Index, list[Index]]:
    """Triangulate a polygon with holes.

    Parameters
    ----------
    outer
        (N, 2) simple polygon, either orientation.
    holes
        Simple polygons inside it that touch neither it nor each other, either orientation.

    Returns
    -------
    points
        (P, 2) all corners: the outline's, then each hole's.
    triangles
        (P + 2 H - 2, 3) int64, counter-clockwise, using every corner.
    rings
        Indices of the outline (counter-clockwise) and of each hole (clockwise): the solid is on the left of each.

    Raises
    ------
    ConfigError
        When the polygons cross, touch or have no area.
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
    while waiting:
        loop = _bridge(points, loop, waiting)
        waiting = waiting[1:]
    triangles = _clip_ears(points, loop)
    _check_area(points, triangles, rings)
    return points, triangles, rings


def _check_area(points: Float64, triangles: Index, rings: list[Index]) -> None:
    """Compare areas: outlines that cross can leave ears to clip, but not the area that they enclose."""
    enclosed = sum(signed_area(points[ring]) for ring in rings)
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    areas = _cross(a, b, c) / 2
    if areas.min() <= 0 or abs(areas.sum() - enclosed) > 1e-9 * areas.sum():
        raise ConfigError("triangulate: the outline or a hole crosses itself or another")


def _cross(o: Float64, a: Float64, b: Float64) -> Float64:
    """Twice the signed area of the triangles o, a, b (..., 2)."""
    out: Float64 = (a[..., 0] - o[..., 0]) * (b[..., 1] - o[..., 1]) - (a[..., 1] - o[..., 1]) * (
        b[..., 0] - o[..., 0]
    )
    return out


def _bridge(points: Float64, loop: list[int], holes: Sequence[Index]) -> list[int]:
    """Cut from the first hole's rightmost corner to the nearest corner of the loop that it can see past all holes."""
    hole = holes[0]
    first = int(np.argmax(points[hole, 0]))
    start = int(hole[first])
    begin = np.concatenate([loop, *holes])
    end = np.concatenate([np.roll(ring, -1) for ring in (np.asarray(loop), *holes)])
    for k in np.argsort(np.linalg.norm(points[loop] - points[start], axis=1), kind="stable"):
        if _in_corner(points, loop, int(k), start) and _is_free(
            points[begin], points[end], points[start], points[loop[k]]
        ):
            inner = [int(i) for i in np.roll(hole, -first)]
            return [*loop[: k + 1], *inner, start, *loop[k:]]
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
    scale = float(np.ptp(points, axis=0).max()) ** 2
    out = []
    k = 0
    while len(loop) > 3:
        for step in range(len(loop)):
            i = (k + step) % len(loop)
            if _is_ear(points, loop, i, scale):
                break
        else:
            raise ConfigError("triangulate: the outline or a hole crosses itself or another")
        out.append((loop[i - 1], loop[i], loop[(i + 1) % len(loop)]))
        del loop[i]
        # Going on two corners further keeps ears from fanning around one corner.
        k = (i + 1) % len(loop)
    out.append((loop[0], loop[1], loop[2]))
    return np.array(out, dtype=np.int64)


def _is_ear(points: Float64, loop: list[int], i: int, scale: float) -> bool:
    """Tell whether corner i of the loop is convex and its triangle holds no other corner."""
    a, b, c = points[loop[i - 1]], points[loop[i]], points[loop[(i + 1) % len(loop)]]
    border = 1e-12 * scale
    if _cross(a, b, c) <= border:
        return False
    p = points[loop]
    # Corners on the border count as inside: cutting past them would leave corners on one line.
    inside = (_cross(a, b, p) >= -border) & (_cross(b, c, p) >= -border) & (_cross(c, a, p) >= -border)
    corner = (p == a).all(axis=1) | (p == b).all(axis=1) | (p == c).all(axis=1)
    return not bool((inside & ~corner).any())
