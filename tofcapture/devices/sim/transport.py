"""Light between surfaces, as phasors, until it has converged; and the patches that surfaces are cut into for it.

Light that has travelled L metres and is modulated at f carries the phase ``k L`` with ``k = 2 pi f / c``. With h the irradiance
phasor of a surface per unit of radiant intensity of the illuminator (1/m^2), Lambertian surfaces obey

    h(x) = cos(theta) / d^2 exp(i k d) V(x)  +  mean over cosine-weighted directions of  rho(y) h(y) exp(i k |x - y|)

(the rendering equation, linear in the phasor; k = 0 gives the steady light that only adds to the taps' mean). Between surfaces the
operator depends on the scene alone: patches and their ray-cast transport matrix are made once per scene. A view adds its own
source term, solves, and gathers the last bounce at every pixel with rays, so that near fields and contact edges are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.devices.sim.scene import Caster, Float32, Geometry, Hits, Int64, lift

Complex64 = NDArray[np.complex64]

_GOLDEN = (np.sqrt(5) - 1) / 2


@dataclass(frozen=True)
class Lamp:
    """A point light."""

    position: NDArray[np.float64]  #: (3,) world frame, metres.
    #: (3,) unit, where it points.
    axis: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    half_angle: float = np.pi  #: Full strength within this angle of the axis, radians; pi: in all directions.
    edge: float = 0.0  #: Width of a smooth step to nothing from there, radians.

    def strength(self, towards: Float32) -> Float32 | float:
        """Compute the intensity in unit directions (N, 3) away from the lamp, 1 on the axis."""
        if self.half_angle >= np.pi:
            return 1.0
        angle = np.arccos(np.clip(towards @ self.axis.astype(np.float32), -1, 1))
        t = np.clip((self.half_angle + self.edge - angle) / max(self.edge, 1e-6), 0, 1)
        out: Float32 = (t * t * (3 - 2 * t)).astype(np.float32)
        return out


def wavenumbers(hz: Sequence[float]) -> tuple[float, ...]:
    """Compute ``2 pi f / c`` of each frequency, with 0 (steady light) in front; radians per metre of path."""
    return (0.0, *(2 * np.pi * f / SPEED_OF_LIGHT for f in hz))


def _cosine_directions(normals: Float32, u: NDArray[Any], v: NDArray[Any]) -> Float32:
    """Draw cosine-weighted directions (N, R, 3) about unit normals (N, 3) from numbers u, v (N, R) in [0, 1)."""
    x, y, z = (normals[:, k] for k in range(3))
    sign = np.where(z >= 0, np.float32(1), np.float32(-1))
    a = -1 / (sign + z)
    b = x * y * a  # two vectors upright on the normal, without a branch: Duff et al., JCGT 6(1), 2017
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    r, angle = np.sqrt(u).astype(np.float32), (2 * np.pi * v).astype(np.float32)
    p, q, w = r * np.cos(angle), r * np.sin(angle), np.sqrt(np.maximum(0, 1 - u)).astype(np.float32)
    out = np.empty((*p.shape, 3), dtype=np.float32)
    for k in range(3):
        np.multiply(p, first[:, k, None], out=out[..., k])
        out[..., k] += q * second[:, k, None]
        out[..., k] += w * normals[:, k, None]
    return out


def direct(
    caster: Caster, points: NDArray[Any], normals: Float32, lamp: Lamp, k: Sequence[float]
) -> Complex64:
    """Compute irradiance phasors straight from a point light.

    ``points`` and ``normals`` are (N, 3), world frame; the normal names the side that is looked at. ``k`` are wavenumbers.
    Returns (len(k), N) complex64, strength x ``cos / d^2 exp(i k d)``, zero in shadow and from behind; 1/m^2.
    """
    strength, d, lit = _lit(caster, points.astype(np.float32), normals, lamp)
    h = np.zeros((len(k), len(points)), dtype=np.complex64)
    for c, kk in enumerate(k):
        h[c, lit] = strength * turn(kk * d)
    return h


def _lit(
    caster: Caster, points: Float32, normals: Float32, lamp: Lamp
) -> tuple[Float32, Float32, NDArray[np.int64]]:
    """Irradiance, distance, and indices of the points (N, 3) that the lamp reaches; rays only where light could arrive."""
    to_light = lamp.position.astype(np.float32) - points
    d = np.sqrt(np.einsum("ij,ij->i", to_light, to_light))
    cosine = np.einsum("ij,ij->i", to_light, normals) / d
    lit = np.flatnonzero(cosine > 0)
    strength = np.broadcast_to(lamp.strength(-to_light[lit] / d[lit, None]), lit.shape)
    lit, strength = lit[strength > 0], strength[strength > 0]
    free = ~caster.blocked(lift(points[lit], normals[lit]), lamp.position)
    lit = lit[free]
    e: Float32 = strength[free] * cosine[lit] / d[lit] ** 2
    return e.astype(np.float32), d[lit], lit


def turn(phase: NDArray[Any]) -> Complex64:
    """Compute ``exp(i phase)``."""
    out = np.empty(phase.shape, dtype=np.complex64)
    out.real, out.imag = np.cos(phase), np.sin(phase)
    return out


@dataclass(frozen=True)
class Patches:
    """The surfaces cut into patches: each triangle in n x n barycentric cells, neighbouring cells of like normal joined."""

    divisions: Int64  #: (M,) n of each triangle.
    first: Int64  #: (M,) where its cells begin in ``patch_of_cell``.
    patch_of_cell: Int64  #: (C,) patch of each cell; -1 for cells outside the triangle.
    cells: Int64  #: (S,) indices of real cells, sorted by patch.
    cell_area: NDArray[np.float64]  #: (S,) their areas, m^2.
    start: Int64  #: (P + 1,) where each patch begins in ``cells``.

    @property
    def count(self) -> int:
        """Count the patches; each has two sides."""
        return len(self.start) - 1

    def side_of(self, geometry: Geometry, hits: Hits, directions: NDArray[Any]) -> Int64:
        """Name the ``2 * patch + side`` (N,) that each ray met, -1 for none; side 0 is the one the winding normal points to."""
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
    """Cut a scene into about ``budget`` patches, shared by area.

    No object gets fewer than ``least``, so that a small object on a large table still has a shape.
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
    """List triangle, row, column and half of every barycentric cell that lies inside its triangle."""
    tri = np.repeat(np.arange(len(n)), 2 * n**2)
    within = np.arange(len(tri)) - np.repeat(np.cumsum(2 * n**2) - 2 * n**2, 2 * n**2)
    upper, square = within % 2, within // 2
    i, j = square // n[tri], square % n[tri]
    inside = i + j + upper < n[tri]
    return tri[inside], i[inside], j[inside], upper[inside]


class Transport:
    """Multiple bounces of one scene: patches and the matrices between them, made once.

    ``hz`` are modulation frequencies; ``budget`` and ``rays`` are numbers of patches, and of rays per side of a patch.
    """

    def __init__(self, caster: Caster, hz: Sequence[float], budget: int = 2500, rays: int = 256) -> None:
        self.caster = caster
        self.k = wavenumbers(hz)
        self.patches = cut_patches(caster.geometry, budget)
        self._rng = np.random.default_rng(20_100)  # the same scene gives the same matrices
        points, normals, albedo = self._sample(rays)
        self._points, self._normals, self._rays = points, normals, rays
        self.albedo: Float32 = albedo
        self.matrices = self._trace(points, normals)

    def _sample(self, rays: int) -> tuple[Float32, Float32, Float32]:
        """Spread ``rays`` points on each side of each patch by area: (2P * rays, 3), normals, and albedo (2P,)."""
        p, geometry = self.patches, self.caster.geometry
        sum_area = np.concatenate([[0.0], np.cumsum(p.cell_area)])
        low, high = sum_area[p.start[:-1]], sum_area[p.start[1:]]
        spread = (np.arange(rays) * 0.8191725134 + self._rng.random((p.count, 1))) % 1.0
        pick = np.searchsorted(sum_area, low[:, None] + spread * (high - low)[:, None], side="right") - 1
        pick = np.clip(pick, p.start[:-1, None], p.start[1:, None] - 1).reshape(-1)
        cell = p.cells[pick]
        tri = np.searchsorted(p.first, cell, side="right") - 1
        n, local = p.divisions[tri], cell - p.first[tri]
        upper, square = local % 2, local // 2
        i, j = square // n, square % n
        a, b = self._rng.random((2, len(cell)))
        a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
        u = (i + np.where(upper == 1, 1 - a, a)) / n
        v = (j + np.where(upper == 1, 1 - b, b)) / n
        c = geometry.corners[tri]
        point = c[:, 0] + u[:, None] * (c[:, 1] - c[:, 0]) + v[:, None] * (c[:, 2] - c[:, 0])
        normal = geometry.normals[tri].reshape(p.count, 1, rays, 3)
        points = np.repeat(point.reshape(p.count, 1, rays, 3), 2, axis=1)
        normals = np.concatenate([normal, -normal], axis=1)
        albedo = np.repeat(geometry.albedo[tri].reshape(p.count, rays)[:, 0], 2)
        return points.reshape(-1, 3).astype(np.float32), normals.reshape(-1, 3), albedo

    def _trace(self, points: Float32, normals: Float32) -> list[Any]:
        from scipy.sparse import csr_matrix

        sides, rays = 2 * self.patches.count, self._rays
        k = np.arange(rays)
        shift = self._rng.random((2, sides, 1))
        u = (((k + 0.5) / rays + shift[0]) % 1.0).reshape(-1, 1)
        v = ((k * _GOLDEN + shift[1]) % 1.0).reshape(-1, 1)
        directions = _cosine_directions(normals, u, v)[:, 0]
        hits = self.caster.cast(lift(points, normals), directions)
        column = self.patches.side_of(self.caster.geometry, hits, directions)
        row = np.repeat(np.arange(sides), rays)
        found = column >= 0
        row, column, r = row[found], column[found], hits.distance[found]
        out = []
        for wavenumber in self.k:
            weight = turn(wavenumber * r) * (self.albedo[column] / rays)
            out.append(csr_matrix((weight, (row, column)), shape=(sides, sides)))
        return out

    def source(self, lamp: Lamp) -> Complex64:
        """Compute irradiance (len(k), 2P) straight from the light, averaged over points of each side of each patch."""
        few = max(1, self._rays // 16)
        pick = (np.arange(2 * self.patches.count)[:, None] * self._rays + np.arange(few) * 16).reshape(-1)
        source = direct(self.caster, self._points[pick], self._normals[pick], lamp, self.k)
        out: Complex64 = source.reshape(len(self.k), -1, few).mean(axis=2)
        return out

    def solve(self, lamp: Lamp, tolerance: float = 1e-4) -> Complex64:
        """Compute the indirect irradiance phasors (len(k), 2P) of every side of every patch, 1/m^2.

        Bounces are added until one adds less than ``tolerance`` of the whole.
        """
        out = []
        for matrix, h in zip(self.matrices, self.source(lamp), strict=True):
            bounce, total = h, np.zeros_like(h)
            for _ in range(500):
                bounce = matrix @ bounce
                total = total + bounce
                if np.abs(bounce).sum() <= tolerance * (np.abs(total).sum() + np.abs(h).sum()):
                    break
            out.append(total)
        return np.stack(out)

    def gather(
        self,
        points: NDArray[Any],
        normals: Float32,
        lamp: Lamp,
        solution: Complex64,
        rays: int,
        pattern: Int64,
    ) -> Complex64:
        """Compute indirect irradiance phasors at points: the last bounce by rays, the ones before from the solution.

        ``points`` and ``normals`` are (N, 3), world frame, ``solution`` is what :meth:`solve` returned for the lamp, ``rays``
        are those of each point. Points of different ``pattern`` (N,), small integers, use different directions (interleaved
        sampling), so that a filter over neighbours sees them all. Returns (len(k), N) complex64, 1/m^2.
        """
        count = len(points)
        total = np.zeros((len(self.k), count), dtype=np.complex64)
        lifted = lift(points, normals)
        s = np.arange(rays)
        patterns = np.arange(int(pattern.max()) + 1 if count else 1)[:, None]
        u = ((s + 0.5) / rays + patterns * 0.7548776662 % 1.0 / rays) % 1.0
        v = (s * _GOLDEN + patterns * 0.5698402910 % 1.0) % 1.0
        step = max(1, 100_000 // rays)  # what a step needs stays in the cache
        for begin in range(0, count, step):
            part = slice(begin, begin + step)
            directions = _cosine_directions(normals[part], u[pattern[part]], v[pattern[part]])
            total[:, part] = self._arriving(lifted[part], directions, lamp, solution)
        return total

    def _arriving(self, origins: Float32, directions: Float32, lamp: Lamp, solution: Complex64) -> Complex64:
        """Average (len(k), N) over rays from origins (N, 3) in directions (N, R, 3) of the light that comes along them."""
        geometry, shape = self.caster.geometry, directions.shape[:2]
        origins = np.repeat(origins, shape[1], axis=0)
        directions = directions.reshape(-1, 3)
        hits = self.caster.cast(origins, directions)
        found = np.flatnonzero(hits.found)
        hits = Hits(hits.distance[found], hits.triangle[found], hits.uv[found])
        directions = directions[found]
        r = hits.distance
        side = self.patches.side_of(geometry, hits, directions)
        facing = geometry.normals[hits.triangle] * (1 - 2 * (side & 1)).astype(np.float32)[:, None]
        met = origins[found] + r[:, None] * directions
        strength, d, lit = _lit(self.caster, met, facing, lamp)
        weight = geometry.albedo[hits.triangle] / np.float32(shape[1])
        strength *= weight[lit]
        ray = np.zeros(shape[0] * shape[1], dtype=np.complex64)
        total = np.empty((len(self.k), shape[0]), dtype=np.complex64)
        for c, kk in enumerate(self.k):
            light = solution[c, side] * weight * turn(kk * r)
            light[lit] += strength * turn(kk * (r[lit] + d))
            ray[found] = light
            total[c] = ray.reshape(shape).sum(axis=1)
        return total
