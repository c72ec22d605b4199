"""Fuse what all views' stereo cameras measured of a scene into the ground truth of one view, with its standard deviation.

Along a ray of the target camera every view's surface gives a depth, or none. The nearest depth wins that is not refuted: one
view's surface is refuted where more views see past it than agree with it, as they do with wrong points at edges. All depths
that agree are averaged by stereo's own noise. A depth counts as seen only where every place on the ray before it is empty,
by one view or another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.libraries import compiled

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

SURFACE, INNER, TARGET = 1, 2, 4  # bits of a quad: surface; away from where it is cut; of the scene's object
WITHIN = 4.0  # standard deviations by which a triangle may miss the plane through its surroundings
GRAZING_COSINE = 0.25882  # cos 75 deg
AGREE = 4.0  # standard deviations, and
AGREE_M = 0.0004  # m; two surfaces further apart are two
PAST = 0.003  # m; a view sees past a point that is so much nearer than what it saw
FLOOR = 1.5e-6  # m; what planes leave out, and no average takes away
LARGEST = 0.45  # of a point's deviation: a plane that is less sure is of a small window and may be bent
BENT = 0.3  # of such a plane's deviation, by which all views alike may miss a bent surface
BEHIND = 0.004  # m; so near behind a surface more views must not hold another one for the first
UNSURE = 0.0005  # m; a depth whose standard deviation is larger is doubtful
STEP = 0.004  # m, between places on a ray that must be empty
CLEAR = 0.005  # m; the last of them before the surface
CHANCE = 2.0  # times its mean; so large the scatter of a few depths may be without being an error
LEAST_SLOPE = 0.02  # metres along the normal for a metre of depth; surfaces that are seen more from their side are edges
TILE = 16  # pixels that are fused together


@dataclass(frozen=True)
class Clouds:
    """Hold what the stereo cameras of N views measured, on (h, w) cells of 2 x 2 pixels of their grids.

    Pixel (u, v) lies in cell (u // 2, v // 2), whose depth is that of its first pixel.
    """

    depth: Float32  #: (N, h, w) metres; NaN: no corner of a surface.
    quads: NDArray[np.uint8]  #: (N, h-1, w-1) bits SURFACE, INNER, TARGET between cells.
    #: (N, h, w, 5) m with ``m . p = 1`` of planes, the deviation of a point's inverse depth, and the plane's own, NaN: not flat.
    planes: Float32
    free: Float32  #: (N, h, w) metres up to which space is known to be empty about a cell; 0: unknown.
    boxes: NDArray[np.intp]  #: (N, 4) first and last row and column of cells about the object.


@dataclass(frozen=True)
class Hits:
    """Hold what the rays of P pixels meet in each of N views."""

    depth: Float32  #: (N, P) metres; NaN: nothing.
    sigma: Float32  #: (N, P) metres along the surface's normal; negative where it is not to be trusted.
    noise: Float32  #: (N, P) metres, what of it is the view's own and not its pose's.
    cell: NDArray[np.int32]  #: (N, P) number of the cell of the view's plane.

    @staticmethod
    def none(views: int, pixels: int) -> Hits:
        """Return hits of nothing."""
        nothing = np.full((views, pixels), np.nan, dtype=np.float32)
        sigma, noise = np.empty_like(nothing), np.empty_like(nothing)
        return Hits(nothing, sigma, noise, np.empty_like(nothing, np.int32))


@dataclass(frozen=True)
class Fused:
    """Hold the fused surface at P pixels."""

    depth: Float64  #: (P,) metres; NaN: none.
    normals: Float64  #: (P, 3) unit, facing the camera.
    sigma: Float64  #: (P,) metres, one standard deviation of depth.
    views: NDArray[np.int8]  #: (P,) how many it is made of; negative: the target's own is not among them.
    doubtful: Bool  #: (P,) made of points that no view is sure of, or held by fewer views than what is behind it, or refuted.
    occluded: Bool  #: (P,) the way there is not known to be empty.
    others: Bool  #: (P,) met by another view than the target's own.


def meet(
    hits: Hits, view: int, met: Float64, corner: tuple[int, int], clouds: Clouds, T_target_stereo: Float64, rays: Float64,
    off: Float64,
) -> None:  # fmt: skip
    """Put into ``hits`` what the target's rays (P, 3) meet of one view.

    ``met`` (P, 3), depth and place in cells, the first of them in row and column ``corner`` of the view's, is what
    :meth:`tofcapture.ops.project.RayCast.met` found. ``off`` (6, 6) is the covariance of the view's pose as a twist in the target's frame.
    """
    _meet(
        met, *corner, clouds.planes[view], clouds.quads[view], T_target_stereo, rays, off,
        hits.depth[view], hits.sigma[view], hits.noise[view], hits.cell[view],
    )  # fmt: skip


def fuse(
    hits: Hits, members: NDArray[np.intp], own: int, clouds: Clouds, T_target_stereo: Float64, eye: Float64,
    rays: Float64, off: Float64, near: Float64, clear: Bool, columns: int,
) -> Fused:  # fmt: skip
    """Fuse the hits of the views that are members.

    ``own`` is the target's own view, ``T_target_stereo`` (N, 4, 4), ``eye`` fx, fy, cx, cy of the stereo grid, ``off``
    (N, 6, N, 6) the covariance of all views' poses as twists in the target's frame. Up to ``near`` (P,) metres deep there is
    nothing; the own view saw that there is nothing before its hit where it is ``clear`` (P,). The image has so many ``columns``.
    """
    pixels = hits.depth.shape[1]
    out = Fused(
        np.full(pixels, np.nan),
        np.full((pixels, 3), np.nan),
        np.full(pixels, np.nan),
        np.zeros(pixels, dtype=np.int8),
        *np.zeros((3, pixels), dtype=bool),
    )
    into = _images(T_target_stereo, eye)
    pairs = np.ascontiguousarray(off.swapaxes(1, 2)).reshape(*off.shape[::2], 36)
    _fuse(
        _tiled(pixels // columns, columns), hits.depth, hits.sigma, hits.noise, pairs, hits.cell, members, own, clouds.planes, clouds.free, T_target_stereo, into, rays, near, clear,
        out.depth, out.normals, out.sigma, out.views, out.doubtful, out.occluded, out.others,
    )  # fmt: skip
    return out


def _tiled(rows: int, columns: int) -> NDArray[np.intp]:
    """Number an image's pixels tile by tile: what neighbours look up in other images is still in the processor's cache."""
    high, wide = -(-rows // TILE), -(-columns // TILE)
    number = np.full((high * TILE, wide * TILE), -1, dtype=np.intp)
    number[:rows, :columns] = np.arange(rows * columns).reshape(rows, columns)
    tiles = number.reshape(high, TILE, wide, TILE).swapaxes(1, 2).ravel()
    return np.asarray(tiles[tiles >= 0])


def _images(T_target_stereo: Float64, eye: Float64) -> Float64:
    """Return (3, 4, N): what maps points of the target's frame to column and row of a view's cells, times depth, and to depth."""
    turned = T_target_stereo[:, :3, :3].transpose(0, 2, 1)
    back = np.concatenate([turned, -turned @ T_target_stereo[:, :3, 3:]], axis=2)
    fx, fy, cx, cy = eye / 2
    return np.ascontiguousarray((np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) @ back).transpose(1, 2, 0))


@compiled
def _meet(
    met: Float64, top: int, left: int, planes: Float32, quads: NDArray[np.uint8], pose: Float64, rays: Float64, off: Float64,
    out: Float32, sigma: Float32, noise: Float32, cell: NDArray[np.int32],
) -> None:  # fmt: skip
    """Move hits onto the planes that fit about them, as those of one view alone are, and say how sure each is."""
    height, width = planes.shape[:2]
    m, J = np.empty(3), np.empty(6)
    for i in range(len(met)):
        z, u, v = met[i, 0], met[i, 1] + left, met[i, 2] + top
        if not 0 < z < np.inf:
            continue
        column, row = min(int(u + 0.25), width - 1), min(int(v + 0.25), height - 1)
        plane = planes[row, column]
        for k in range(3):
            m[k] = pose[k, 0] * plane[0] + pose[k, 1] * plane[1] + pose[k, 2] * plane[2]
        along = m[0] * rays[i, 0] + m[1] * rays[i, 1] + m[2] * rays[i, 2]
        size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        own_z, distance = 0.0, 0.0  # in the view's own frame
        for k in range(3):
            offset = z * rays[i, k] - pose[k, 3]
            own_z += pose[k, 2] * offset
            distance += offset * offset
        cell[i], out[i] = row * width + column, z
        if not along > 0:
            sigma[i], noise[i] = -1e-3, 1e-3
            continue
        error = own_z * plane[3] / size  # of one point, along the normal
        there = (1 + m[0] * pose[0, 3] + m[1] * pose[1, 3] + m[2] * pose[2, 3]) / along
        if plane[4] > 0 and abs(there - z) * along / size <= WITHIN * error:
            out[i], error = there, own_z * plane[4] / size
        trusted = (
            quads[min(int(v), height - 2), min(int(u), width - 2)] & INNER
            and 1 / (size * np.sqrt(distance)) > GRAZING_COSINE
        )
        _lever(rays[i], out[i], m[0] / size, m[1] / size, m[2] / size, J)
        sigma[i] = np.sqrt(error * error + _product(J, off)) * (1.0 if trusted else -1.0)
        noise[i] = error


@compiled
def _lever(ray: Float64, z: float, a: float, b: float, c: float, out: Float64) -> None:
    """Write into ``out`` (6,) how a twist moves a surface of normal (a, b, c) along it, at depth z on a ray (3,)."""
    x, y, w = z * ray[0], z * ray[1], z * ray[2]
    out[0], out[1], out[2] = a, b, c
    out[3], out[4], out[5] = y * c - w * b, w * a - x * c, x * b - y * a


@compiled
def _product(J: Float64, off: Float64) -> float:
    """Return ``J off J`` for J (6,) and off (6, 6)."""
    total = 0.0
    for a in range(6):
        row = 0.0
        for b in range(6):
            row += off[a, b] * J[b]
        total += J[a] * row
    return total


@compiled
def _ways(into: Float64, ray: Float64, way: Float64) -> None:
    """Write into ``way`` (3, N) where a ray (3,) goes in the image of every view: ``into`` (3, 4, N) are those of :func:`_images`."""
    x, y, z = ray
    for k in range(3):
        for j in range(way.shape[1]):  # innermost: it becomes vector instructions
            way[k, j] = into[k, 0, j] * x + into[k, 1, j] * y + into[k, 2, j] * z


@compiled
def _places(into: Float64, way: Float64, z: float, place: Float64) -> None:
    """Write into ``place`` (3, N) the column and row of cells, and the depth, at which every view has depth z of a ray."""
    for j in range(way.shape[1]):
        place[2, j] = z * way[2, j] + into[2, 3, j]
    for k in range(2):
        for j in range(way.shape[1]):
            place[k, j] = (z * way[k, j] + into[k, 3, j]) / place[2, j]


@compiled
def _free(free: Float32, j: int, u: float, v: float, own: float) -> float:
    """Tell how far view ``j`` of (N, h, w) sees past a place in its image; not above 0: it does not."""
    if not (own > 0 and 0 <= u < free.shape[2] and 0 <= v < free.shape[1]):
        return 0.0
    return free[j, int(v), int(u)] - own  # type: ignore[no-any-return]


@compiled
def _empty(free: Float32, into: Float64, way: Float64, j: int, z: float) -> bool:
    """Tell whether view ``j`` sees past depth z of a ray."""
    own = z * way[2, j] + into[2, 3, j]
    u, v = (z * way[0, j] + into[0, 3, j]) / own, (z * way[1, j] + into[1, 3, j]) / own
    return _free(free, j, u, v, own) > 0


@compiled
def _fuse(
    turn: NDArray[np.intp], depth: Float32, sigma: Float32, noise: Float32, off: Float64, cell: NDArray[np.int32], members_of: NDArray[np.intp], own: int, planes: Float32, free: Float32,
    poses: Float64, into: Float64, rays: Float64, near: Float64, clear: Bool,
    out: Float64, normals: Float64, deviation: Float64, views: NDArray[np.int8], doubtful: Bool, occluded: Bool, others: Bool,
) -> None:  # fmt: skip
    """Fuse the hits (N, P) of all pixels, in ``turn``; see :func:`fuse`."""
    count = len(depth)
    width = planes.shape[2]
    order, kept, member = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.bool_)
    slope, weight = np.empty(count), np.empty(count)
    m, J, M = np.empty(3), np.empty(6), np.empty(36)
    way, place, last = np.empty((3, count)), np.empty((3, count)), own  # the last that saw past a place
    for i in turn:
        found = 0
        for j in range(count):
            if depth[j, i] > 0:
                order[found] = j
                found += 1
                others[i] |= j != own
        for a in range(1, found):  # by insertion: they are few
            j, b = order[a], a
            while b > 0 and depth[order[b - 1], i] > depth[j, i]:
                order[b] = order[b - 1]
                b -= 1
            order[b] = j
        if not found:
            continue
        x, y, w = rays[i, 0], rays[i, 1], rays[i, 2]
        doubtful[i] = True
        _ways(into, rays[i], way)
        for a in range(found):  # metres along the normal for a metre of depth
            j = order[a]
            row, column = cell[j, i] // width, cell[j, i] % width
            p, q, r = planes[j, row, column, 0], planes[j, row, column, 1], planes[j, row, column, 2]
            size = np.sqrt(p**2 + q**2 + r**2)
            along = 0.0
            for k in range(3):
                along += rays[i, k] * (poses[j, k, 0] * p + poses[j, k, 1] * q + poses[j, k, 2] * r)
            slope[j] = max(along / size, LEAST_SLOPE)
        outvoted = False
        for first in range(found):
            begin = order[first]
            members, sure, behind = 0, 0, 0
            for a in range(found):
                j = order[a]
                # The flatter look at it decides: along a wall that is seen from its side, depths say little.
                apart = abs(depth[j, i] - depth[begin, i]) * max(slope[j], slope[begin])
                member[j] = apart < AGREE * np.sqrt(sigma[j, i] ** 2 + sigma[begin, i] ** 2) + AGREE_M
                members += member[j]
                sure += member[j] and sigma[j, i] > 0
                behind += not member[j] and sigma[j, i] > 0 and 0 < depth[j, i] - depth[begin, i] < BEHIND
            z = float(depth[begin, i])
            past = 0
            if 2 * members < len(members_of):
                _places(into, way, z, place)
                for j in members_of:
                    past += _free(free, j, place[0, j], place[1, j], place[2, j]) > PAST
            if past > members:
                outvoted |= begin == own and sigma[own, i] > 0  # its camera was sure: who is right?
                continue
            used = 0
            for a in range(found):
                j = order[a]
                if member[j] and (sigma[j, i] > 0 or not sure):
                    kept[used] = j
                    used += 1
            out[i], left, beyond = _average(depth[:, i], sigma[:, i], noise[:, i], kept[:used], slope, weight)
            # The normal of the planes that the depth is made of.
            m[:] = 0
            views[i], has_own, bent = 0, False, 0.0
            for j in kept[:used]:
                views[i] += 1
                has_own |= j == own
                row, column = cell[j, i] // width, cell[j, i] % width
                p, q, r = planes[j, row, column, 0], planes[j, row, column, 1], planes[j, row, column, 2]
                if planes[j, row, column, 4] > LARGEST * planes[j, row, column, 3]:
                    bent += weight[j] * BENT * noise[j, i]
                size = np.sqrt(p**2 + q**2 + r**2)
                share = 1 / (size * sigma[j, i] ** 2)
                if slope[j] > LEAST_SLOPE:  # those that face away say nothing
                    for k in range(3):
                        m[k] -= share * (poses[j, k, 0] * p + poses[j, k, 1] * q + poses[j, k, 2] * r)
            size = np.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
            if size == 0:
                m[0], m[1], m[2], size = -x, -y, -w, np.sqrt(x * x + y * y + w * w)
            for k in range(3):
                normals[i, k] = m[k] / size
            steepest = max(-normals[i, 0] * x - normals[i, 1] * y - normals[i, 2] * w, LEAST_SLOPE)
            _lever(rays[i], out[i], normals[i, 0], normals[i, 1], normals[i, 2], J)
            off_normal = _unplaced(J, off, kept, used, weight, M) + FLOOR**2 + bent**2
            deviation[i] = np.sqrt(beyond * left + beyond * off_normal / steepest**2)
            views[i] = views[i] if has_own else -views[i]
            doubtful[i] = outvoted or sure == 0 or behind > sure or deviation[i] > UNSURE
            z = out[i] - CLEAR
            while z > near[i] and not (has_own and clear[i]):
                empty = _empty(free, into, way, last, z)
                for j in members_of:
                    if empty:
                        break
                    empty = _empty(free, into, way, j, z)
                    if empty:
                        last = j
                if not empty:
                    occluded[i] = True
                    break
                z -= STEP
            break


@compiled
def _average(
    depth: Float32, sigma: Float32, noise: Float32, kept: NDArray[np.int64], slope: Float64, weight: Float64
) -> tuple[float, float, float]:
    """Average the depths of the views that are ``kept`` by their errors; one that is far from the others counts less.

    Writes each one's ``weight`` (N,). Returns the mean, the variance that noise leaves it, m^2, and by how much the variance is
    to be multiplied, as the depths scatter more than errors may leave.
    """
    mean, beyond, left = 0.0, 1.0, 0.0
    for turn in range(3):
        total, weights, squares, left = 0.0, 0.0, 0.0, 0.0
        for j in kept:
            s, apart = sigma[j] / slope[j], depth[j] - mean  # along the ray
            weight[j] = 1 / (s * s)
            if turn:
                weight[j] /= max(1.0, abs(apart / s) / 2)
            total += weight[j] * depth[j]
            weights += weight[j]
            squares += weight[j] * apart * apart
            left += (weight[j] * noise[j] / slope[j]) ** 2
        mean = total / weights
        for j in kept:
            weight[j] /= weights
        left /= weights * weights
        if turn and len(kept) > 1:
            beyond = max(1.0, squares / (len(kept) - 1) / CHANCE)
    return mean, left, beyond


@compiled
def _unplaced(
    J: Float64, off: Float64, kept: NDArray[np.int64], used: int, weight: Float64, M: Float64
) -> float:
    """Return the variance, m^2, along a normal of the mean surface through the poses of the first ``used`` views that are ``kept``.

    ``J`` (6,) is the normal's, ``off`` (N, N, 36); what is off in all views alike stays in the mean. ``M`` (36,) is for its use.
    """
    M[:] = 0
    for a in range(used):
        for b in range(a + 1):
            j, k = kept[a], kept[b]
            share = (1.0 if a == b else 2.0) * weight[j] * weight[k]
            for c in range(36):
                M[c] += share * off[j, k, c]
    total = 0.0
    for a in range(6):
        for b in range(6):
            total += J[a] * M[6 * a + b] * J[b]
    return max(total, 0.0)
