"""The surfaces of a scene cut into patches, for light between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.sim.render import Geometry, Hits, Int64


@dataclass(frozen=True)
class Patches:
    """The surfaces cut into patches: each triangle in n x n barycentric cells, neighbouring cells of like normal joined.

    Attributes
    ----------
    divisions
        (M,) n of each triangle.
    first
        (M,) where the triangle's cells begin in ``patch_of_cell``.
    patch_of_cell
        (C,) patch of each cell; -1 for cells outside the triangle.
    cells
        (S,) indices of real cells, sorted by patch.
    cell_area
        (S,) area of each, m^2.
    start
        (P + 1,) where each patch begins in ``cells``.
    """

    divisions: Int64
    first: Int64
    patch_of_cell: Int64
    cells: Int64
    cell_area: NDArray[np.float64]
    start: Int64

    @property
    def count(self) -> int:
        """Number of patches; each has two sides."""
        return len(self.start) - 1

    def side_of(self, geometry: Geometry, hits: Hits, directions: NDArray[Any]) -> Int64:
        """(N,) ``2 * patch + side`` that each ray met, -1 for none; side 0 is the one the winding normal points to."""
        found = hits.found
        tri = hits.triangle if found.all() else np.where(found, hits.triangle, 0)
        n = self.divisions[tri]
        u, v = (np.clip(hits.uv[:, a], 0.0, 1.0) * n.astype(np.float32) for a in (0, 1))
        i, j = (np.minimum(x.astype(np.int64), n - 1) for x in (u, v))
        upper = (u - i) + (v - j) > 1.0
        # Rounding may put a hit on the hypotenuse just outside: pull it back into the triangle.
        j = np.minimum(j, n - 1 - i)
        upper &= i + j < n - 1
        patch = self.patch_of_cell[self.first[tri] + (i * n + j) * 2 + upper]
        normals = geometry.normals[tri]
        behind = np.einsum("ij,ij->i", normals, np.asarray(directions, dtype=np.float32)) > 0
        return np.where(found, 2 * patch + behind, -1)


def cut_patches(geometry: Geometry, budget: int, least: int = 150) -> Patches:
    """Cut a scene into about ``budget`` patches.

    Parameters
    ----------
    geometry
        The scene.
    budget
        Patches to spend; shared by area, but no object gets fewer than ``least``, so that a small object on a large
        table still has a shape.
    least
        See above.
    """
    edges = geometry.corners[:, [1, 2, 0]] - geometry.corners
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    objects = int(geometry.owner.max()) + 1
    object_area = np.bincount(geometry.owner, weights=area, minlength=objects)
    wanted = np.maximum(budget * object_area / area.sum(), least)
    size = np.sqrt(object_area / wanted)[geometry.owner]
    n = np.clip(np.ceil(longest / size), 1, 256).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(2 * n**2)])[:-1]
    tri, i, j, upper = _cells(n)
    index = first[tri] + (i * n[tri] + j) * 2 + upper
    third = (1 + upper) / 3
    u, v = (i + third) / n[tri], (j + third) / n[tri]
    a, b, c = (geometry.corners[tri, k] for k in range(3))
    centre = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    voxel = np.floor(centre / size[tri, None]).astype(np.int64)
    axis = np.abs(geometry.normals[tri]).argmax(axis=1)
    sign = np.take_along_axis(geometry.normals[tri], axis[:, None], axis=1)[:, 0] > 0
    key = np.column_stack([geometry.owner[tri], voxel, 2 * axis + sign])
    _, patch = np.unique(key, axis=0, return_inverse=True)
    patch = patch.reshape(-1)
    order = np.argsort(patch, kind="stable")
    patch_of_cell = np.full(int((2 * n**2).sum()), -1, dtype=np.int64)
    patch_of_cell[index] = patch
    return Patches(
        divisions=n,
        first=first,
        patch_of_cell=patch_of_cell,
        cells=index[order],
        cell_area=(area[tri] / n[tri] ** 2)[order],
        start=np.searchsorted(patch[order], np.arange(patch.max() + 2)),
    )


def _cells(n: Int64) -> tuple[Int64, Int64, Int64, Int64]:
    """Triangle, row, column and half of every barycentric cell that lies inside its triangle."""
    tri = np.repeat(np.arange(len(n)), 2 * n**2)
    within = np.arange(len(tri)) - np.repeat(np.cumsum(2 * n**2) - 2 * n**2, 2 * n**2)
    upper, square = within % 2, within // 2
    i, j = square // n[tri], square % n[tri]
    inside = i + j + upper < n[tri]
    return tri[inside], i[inside], j[inside], upper[inside]
