"""Watertight meshes from planar outlines, profiles of revolution, tubes and boxes.

A mesh is ``(vertices (N, 3) float64 metres, triangles (M, 3) int64)``; triangles wind counter-clockwise seen from outside. Every
builder returns closed components: each edge belongs to exactly two triangles, in opposite directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.devices.sim.shapes.polygon import triangulate
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

Mesh = tuple[Float64, NDArray[np.int64]]


def extrude(outer: Float64, height: float, holes: Sequence[Float64] = ()) -> Mesh:
    """Prism over a polygon with holes, from z = 0 to ``height``.

    Parameters
    ----------
    outer
        (N, 2) simple polygon in the xy plane, either orientation, metres.
    height
        Metres, positive.
    holes
        Simple polygons (M, 2) inside ``outer`` that do not touch it or each other.
    """
    points, caps, rings = triangulate(outer, holes)
    n = len(points)
    low = np.column_stack([points, np.zeros(n)])
    high = np.column_stack([points, np.full(n, height)])
    sides = [_band(ring, ring + n) for ring in rings]
    triangles = np.concatenate([caps[:, ::-1], caps + n, *sides])
    return np.concatenate([low, high]), triangles


def _band(low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles between two closed rings of vertices of equal length."""
    low2, high2 = np.roll(low, -1), np.roll(high, -1)
    return np.concatenate([np.stack([low, low2, high2], axis=1), np.stack([low, high2, high], axis=1)])


def revolve(profile: ArrayLike, segments: int = 64) -> Mesh:
    """Solid of revolution about z.

    Parameters
    ----------
    profile
        (N, 2) of (radius, z): an open line that starts and ends on the axis (radius 0) and has the solid on its left
        when walked with r to the right and z upwards, so from the bottom along the outside to the top.
    segments
        Facets around the axis.
    """
    profile = np.asarray(profile, dtype=np.float64)
    if len(profile) < 3 or profile[0, 0] != 0 or profile[-1, 0] != 0 or (profile[1:-1, 0] <= 0).any():
        raise ConfigError(
            "revolve: expected a profile that leaves the axis at its first and meets it at its last point"
        )
    angle = 2 * np.pi * np.arange(segments) / segments
    r, z = profile[1:-1, 0, None], profile[1:-1, 1, None]
    rings = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z, (len(r), segments))], axis=-1)
    vertices = np.concatenate([[[0, 0, profile[0, 1]]], rings.reshape(-1, 3), [[0, 0, profile[-1, 1]]]])
    index = 1 + np.arange(len(r) * segments, dtype=np.int64).reshape(len(r), segments)
    last = len(vertices) - 1
    bottom = np.stack([np.zeros(segments, dtype=np.int64), np.roll(index[0], -1), index[0]], axis=1)
    top = np.stack([np.full(segments, last), index[-1], np.roll(index[-1], -1)], axis=1)
    bands = [_band(a, b) for a, b in pairwise(index)]
    return vertices, np.concatenate([bottom, *bands, top])


def tube(path: ArrayLike, radius: float, normal: ArrayLike, segments: int = 20) -> Mesh:
    """Round bar along a planar path, closed by flat ends.

    Parameters
    ----------
    path
        (N, 3) centre line in a plane, metres.
    radius
        Metres, smaller than the path's radius of curvature.
    normal
        (3,) normal of the path's plane.
    segments
        Facets around.
    """
    path = np.asarray(path, dtype=np.float64)
    side = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.cross(tangent, side)
    angle = 2 * np.pi * np.arange(segments) / segments
    offset = np.cos(angle)[None, :, None] * up[:, None] + np.sin(angle)[None, :, None] * side
    # up x side = (t x s) x s = -t, so the ring runs clockwise about the tangent; walk it backwards.
    rings = (path[:, None] + radius * offset)[:, ::-1]
    vertices = np.concatenate([path[:1], rings.reshape(-1, 3), path[-1:]])
    index = 1 + np.arange(len(path) * segments, dtype=np.int64).reshape(len(path), segments)
    start = np.stack([np.zeros(segments, dtype=np.int64), np.roll(index[0], -1), index[0]], axis=1)
    end = np.stack([np.full(segments, len(vertices) - 1), index[-1], np.roll(index[-1], -1)], axis=1)
    bands = [_band(a, b) for a, b in pairwise(index)]
    return vertices, np.concatenate([start, *bands, end])


def cuboid(x: float, y: float, z: float) -> Mesh:
    """Box x by y by z metres, centred in x and y, standing on z = 0."""
    return extrude(rectangle(x, y), z)


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
    """Signed volume, cubic metres: positive when triangles wind outwards (divergence theorem)."""
    a, b, c = np.moveaxis(mesh[0][mesh[1]], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def rectangle(x: float, y: float) -> Float64:
    """(4, 2) rectangle centred on the origin, counter-clockwise."""
    return np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) / 2


def circle(radius: float, centre: tuple[float, float] = (0.0, 0.0), segments: int = 32) -> Float64:
    """(segments, 2) regular polygon on a circle, counter-clockwise."""
    angle = 2 * np.pi * np.arange(segments) / segments
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
