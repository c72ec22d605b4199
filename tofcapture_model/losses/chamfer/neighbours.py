"""Exact nearest neighbours between two clouds that live on one camera's grid, for a few shifts of one of them.

A sphere around a query covers a rectangle of pixels; what lies outside of it is no nearer. So windows of pixels about the query's
own pixel (about where the shift moves it, to be exact) are looked at, ring by ring, until nearly all queries' rectangles are
inside; the rest are collected and look through a rectangle of their own. Nothing is approximated. Both directions see the same
pairs, and shifts along the ray share them, too. Pure torch; no gradient.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcapture_model.losses.chamfer.tiles import AT_ONCE, Tiles, squared_distances

FEW = 0.04  # of all queries: below it collecting them costs less than another ring for all
_MOST = 8  # rings
_SAMPLE = 4  # pixels between those that are asked whether a ring was enough
_START = 2  # rings that every shift gets
_SIDES = (4, 6, 8, 11, 16)  # of the rectangles of collected queries that are searched whole, pixels
_NOWHERE = (1e3, -1e3)  # m, where masked points of the first and of the second cloud are
_ROUND = 1e-3  # px, for rounding of the rectangles


Window = tuple[slice, slice]


@dataclass(frozen=True)
class Found:
    """Nearest neighbours of both clouds for one shift s.

    Attributes
    ----------
    squared
        (2, H, W) squared distance, m^2, of every p + s to Q, and of every q to P + s; meaningless where masked.
    index
        (2, H, W) int64 flat pixel of that neighbour.
    """

    squared: Tensor
    index: Tensor


@dataclass(frozen=True)
class Pair:
    """Two clouds (3, H, W) on one grid, masks (H, W), grid's fx, fy, cx, cy, and how far points lie off their rays, m."""

    p: Tensor
    q: Tensor
    p_mask: Tensor
    q_mask: Tensor
    intrinsics: tuple[float, float, float, float]
    off_ray: float


@torch.no_grad()
def nearest(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, intrinsics: Tensor, shifts: Tensor
) -> list[Found]:
    """Find the nearest neighbours of every p + s in Q and of every q in P + s, exactly.

    Parameters
    ----------
    p, q
        (3, H, W) finite points, metres, about on the rays of their pixels.
    p_mask, q_mask
        (H, W) bool: which pixels belong to the clouds; neither is empty.
    intrinsics
        (4,) of the grid.
    shifts
        (S, 3) metres.

    Returns
    -------
    One Found per shift
    """
    search = Search(p, q, p_mask, q_mask, intrinsics, shifts)
    return [search.finish(k) for k in range(len(shifts))]


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, intrinsics: Tensor, shifts: Tensor
) -> tuple[int, Found, Tensor]:
    """Find the shift of the least symmetric mean squared distance, and its neighbours, exactly (arguments as :func:`nearest`).

    Returns
    -------
    index of the shift, its Found, (S,) m^2: its distance, and for every other shift a bound from below that is not less
    """
    search = Search(p, q, p_mask, q_mask, intrinsics, shifts)
    lower = torch.stack([search.upper(k) for k in range(len(shifts))])
    first, *others = lower.argsort().tolist()
    best, found = first, search.finish(first)
    lower[first] = search.upper(first)
    for k in others:
        lower[k] = search.lower(k, first)
        while lower[k] < lower[best] and search.pays(k):
            search.widen(k)
            lower[k] = search.lower(k, first)
        if lower[k] < lower[best]:
            one = search.finish(k)
            lower[k] = search.upper(k)
            if lower[k] < lower[best]:
                best, found = k, one
    return best, found, lower


def _compact(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, intrinsics: Tensor
) -> tuple[Pair, tuple[int, int]]:
    """Cut to the bounding box of both masks, and move what is masked to nowhere."""
    either = p_mask | q_mask
    rows, cols = either.any(1).nonzero()[:, 0], either.any(0).nonzero()[:, 0]
    box = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1))
    fx, fy, cx, cy = (float(x) for x in intrinsics)
    camera = (fx, fy, cx - box[1].start, cy - box[0].start)
    clouds, off = [], 0.0
    for cloud, mask, nowhere in ((p, p_mask, _NOWHERE[0]), (q, q_mask, _NOWHERE[1])):
        part = cloud[:, box[0], box[1]].float()
        off = max(off, _off_ray(part, mask[box], camera))
        clouds.append(torch.where(mask[box], part, nowhere).contiguous())
    return Pair(clouds[0], clouds[1], p_mask[box], q_mask[box], camera, off), (box[0].start, box[1].start)


def _off_ray(cloud: Tensor, mask: Tensor, camera: tuple[float, float, float, float]) -> float:
    """Largest distance of a point to the ray of its pixel (to its point of the same depth, which is not less), metres."""
    fx, fy, cx, cy = camera
    v, u = _pixels(mask)
    x, y, z = cloud
    apart = torch.maximum((x - z * (u - cx) / fx).abs(), (y - z * (v - cy) / fy).abs())
    return math.sqrt(2) * float(torch.where(mask, apart, 0.0).max())


def _pixels(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (H, 1) and columns (1, W), float."""
    h, w = mask.shape
    rows = torch.arange(h, device=mask.device, dtype=torch.float32)[:, None]
    return rows, torch.arange(w, device=mask.device, dtype=torch.float32)[None]


def _centre(
    shift: Sequence[float], camera: tuple[float, float, float, float], depth: float
) -> tuple[int, int]:
    """(rows, columns) by which a shift moves a point of that depth about the middle of the image."""
    return round(camera[1] * shift[1] / depth), round(camera[0] * shift[0] / depth)


def _ring(radius: int) -> Iterator[tuple[int, int]]:
    """(dy, dx) at a Chebyshev distance."""
    reach = range(-radius, radius + 1)
    return ((dy, dx) for dy in reach for dx in reach if max(abs(dy), abs(dx)) == radius)


class Search:
    """Windows and bounds for all shifts of one pair of clouds; see :func:`nearest` for the arguments."""

    def __init__(
        self, p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, intrinsics: Tensor, shifts: Tensor
    ) -> None:
        self.whole, self.shifts = tuple(p_mask.shape), shifts
        self.pair, self.corner = _compact(p, q, p_mask, q_mask, intrinsics)
        depth = float(self.pair.q[2][self.pair.q_mask].median())
        self.centres = [_centre(s, self.pair.intrinsics, depth) for s in shifts.tolist()]
        h, w = self.size = tuple(self.pair.p_mask.shape)
        n, device = len(shifts), p.device
        self.best = torch.full((n, 2, h, w), torch.inf, device=device)
        self.apart, self.work = torch.empty(3 * h * w, device=device), torch.empty((3, h * w), device=device)
        self.radius = [_START] * n
        for lateral in dict.fromkeys(tuple(s[:2]) for s in shifts.tolist()):
            group = [k for k, s in enumerate(shifts.tolist()) if tuple(s[:2]) == lateral]
            for radius in range(_START + 1):
                self._look(group, radius)

    def widen(self, k: int) -> None:
        """Look at one more ring of pixels."""
        self.radius[k] += 1
        self._look([k], self.radius[k])

    def _look(self, group: Sequence[int], radius: int) -> None:
        """Look at one ring for shifts that differ in z only: the least squares of both directions."""
        for i, j, side, apart in self._ring_pairs(group[0], radius):
            for k in group:
                value = self._value(k, side, apart)
                for way, here in ((0, i), (1, j)):
                    best = self.best[k, way][here]
                    torch.minimum(best, value, out=best)

    def _ring_pairs(self, k: int, radius: int) -> Iterator[tuple[Window, Window, Tensor, Tensor]]:
        """Windows of p and of q, squared lateral distance, distance along z before the shift; buffers are reused."""
        h, w = self.size
        lateral = self.shifts[k].clone()
        lateral[2] = 0
        moved = self.pair.p + lateral.reshape(3, 1, 1)
        for ring_y, ring_x in _ring(radius):
            dy, dx = self.centres[k][0] + ring_y, self.centres[k][1] + ring_x
            if abs(dy) >= h or abs(dx) >= w:
                continue
            i = (slice(max(-dy, 0), h - max(dy, 0)), slice(max(-dx, 0), w - max(dx, 0)))
            j = (slice(i[0].start + dy, i[0].stop + dy), slice(i[1].start + dx, i[1].stop + dx))
            shape = (i[0].stop - i[0].start, i[1].stop - i[1].start)
            apart = self.apart[: 3 * shape[0] * shape[1]].view(3, *shape)
            torch.sub(moved[:, i[0], i[1]], self.pair.q[:, j[0], j[1]], out=apart)
            side = torch.mul(apart[0], apart[0], out=self._buffer(0, shape))
            yield i, j, side.addcmul_(apart[1], apart[1]), apart[2]

    def _buffer(self, number: int, shape: tuple[int, int]) -> Tensor:
        return self.work[number, : shape[0] * shape[1]].view(shape)

    def _value(self, k: int, side: Tensor, apart: Tensor) -> Tensor:
        """Squared distance of the pairs; the same bits whenever it is asked for."""
        z, shape = float(self.shifts[k, 2]), (side.shape[0], side.shape[1])
        along = torch.add(apart, z, out=self._buffer(1, shape)) if z else apart
        return torch.addcmul(side, along, along, out=self._buffer(2, shape))

    def _locate(self, k: int) -> Tensor:
        """(2, h, w) int32 flat pixel at which the window's least square was: the pairs once more, compared for equality.

        In floating point, because a masked write costs twenty times an addition: where values differ at all, their difference
        times 1e30 is far below any number of an offset.
        """
        h, w = self.size
        number = torch.full((2, h, w), -1.0, device=self.best.device)
        offsets: list[int] = []
        for radius in range(self.radius[k] + 1):
            for i, j, side, apart in self._ring_pairs(k, radius):
                value = self._value(k, side, apart)
                label = torch.tensor(float(len(offsets)), device=value.device)
                offsets.append((j[0].start - i[0].start) * w + j[1].start - i[1].start)
                for way, here in ((0, i), (1, j)):
                    differs = torch.sub(self.best[k, way][here], value, out=self._buffer(1, value.shape))  # type: ignore[arg-type]
                    torch.add(label, differs, alpha=1e30, out=differs)
                    torch.maximum(number[way][here], differs, out=number[way][here])
        table = torch.tensor(offsets, dtype=torch.int32, device=number.device)
        steps = table.index_select(0, number.clamp(0, len(offsets) - 1).int().flatten()).view(2, h, w)
        own = torch.arange(h * w, device=number.device, dtype=torch.int32).reshape(h, w)
        return torch.stack([own + steps[0], own - steps[1]]).clamp_(0, h * w - 1)

    def upper(self, k: int) -> Tensor:
        """Symmetric mean squared distance to what was seen, m^2; that of the clouds once ``k`` is finished."""
        return self._mean(self.best[k, 0], 0) + self._mean(self.best[k, 1], 1)

    def lower(self, k: int, other: int) -> Tensor:
        """Bound of the symmetric mean squared distance from below, m^2, that uses the finished shift ``other``.

        What was not seen is outside of the window, and no nearer than with the other shift less the distance of the shifts.
        """
        total = torch.zeros((), device=self.best.device)
        far = float((self.shifts[k] - self.shifts[other]).norm())
        for way in (0, 1):
            known = self.best[other, way].sqrt().mul_(1 - 1e-6).sub_(far)
            unseen = torch.maximum(known, self._beyond(k, way), out=known).clamp_min_(0).square_()
            total = total + self._mean(torch.minimum(unseen, self.best[k, way], out=unseen), way)
        return total

    def _mean(self, values: Tensor, way: int) -> Tensor:
        mask = self.pair.q_mask if way else self.pair.p_mask
        return torch.where(mask, values, 0.0).sum() / mask.sum()

    def _beyond(self, k: int, way: int) -> Tensor:
        """(h, w) m: everything outside of the window is at least so far from the query.

        The distance of a query of pixel u from the plane of all rays of column u + n is ``n z / |(f, u + n - c)|`` before it is
        shifted, and a shift changes it by no more than its part along the plane's normal.
        """
        cloud, sign = (self.pair.q, -1) if way else (self.pair.p, 1)
        fx, fy, cx, cy = self.pair.intrinsics
        v, u = _pixels(self.pair.p_mask)
        reach = self.radius[k] + 1
        sides = []
        for axis, (own, f, c) in enumerate(((u, fx, cx), (v, fy, cy))):
            moved, centre = sign * float(self.shifts[k, axis]), sign * self.centres[k][1 - axis]
            slope = (own - c).abs() + (reach + abs(centre))
            norm = (slope.square() + f * f).sqrt()
            along = float((slope / norm).max()) * abs(float(self.shifts[k, 2]))
            least = float((f / norm).min())
            for side in (-1, 1):
                towards = side * moved
                nearer = (towards if towards > 0 else least * towards) + along
                sides.append((cloud[2] * ((reach + side * centre) / norm)).sub_(nearer))
        apart = torch.minimum(sides[0], sides[1], out=sides[0])
        for other in sides[2:]:
            torch.minimum(apart, other, out=apart)
        return apart.sub_(self.pair.off_ray + 1e-7)

    def _queries(self, i: int, way: int) -> tuple[Tensor, Tensor, int]:
        """Queries (3, h, w) as the other cloud's camera sees them, their mask, and the sign of the centre."""
        shift = self.shifts[i].reshape(3, 1, 1)
        if way == 0:
            return self.pair.p + shift, self.pair.p_mask, 1
        return self.pair.q - shift, self.pair.q_mask, -1

    def _rectangles(self, x: Tensor, squared: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """First and last column, first and last row that a sphere about each query covers; x (3, ...)."""
        fx, fy, cx, cy = self.pair.intrinsics
        h, w = self.size
        d = squared.sqrt() * (1 + 1e-6) + self.pair.off_ray
        left, right = _shadow(x[0], x[2], d)
        top, bottom = _shadow(x[1], x[2], d)
        return (
            (left * fx + (cx - _ROUND)).ceil().clamp(0, w - 1),
            (right * fx + (cx + _ROUND)).floor().clamp(0, w - 1),
            (top * fy + (cy - _ROUND)).ceil().clamp(0, h - 1),
            (bottom * fy + (cy + _ROUND)).floor().clamp(0, h - 1),
        )

    def _left(self, i: int, way: int, step: int) -> tuple[Tensor, Tensor]:
        """Which queries need more than the window, of every ``step``-th pixel, and how many there are."""
        x, mask, sign = self._queries(i, way)
        x, mask, squared = (a[..., ::step, ::step] for a in (x, mask, self.best[i, way]))
        u0, u1, v0, v1 = self._rectangles(x, squared)
        rows, cols = (a + sign * c for a, c in zip(_pixels(self.pair.p_mask), self.centres[i], strict=True))
        rows, cols = rows[::step], cols[:, ::step]
        r = self.radius[i]
        inside = (u0 >= cols - r) & (u1 <= cols + r) & (v0 >= rows - r) & (v1 <= rows + r)
        return mask & ~inside, mask.sum()

    def pays(self, k: int) -> bool:
        """Whether another ring for all costs less than collecting those that need it."""
        return self.radius[k] < _MOST and self.share_left(k) > FEW

    def share_left(self, k: int) -> float:
        """Share of all queries whose rectangle is not inside the window yet, of the direction that is worse off."""
        shares = []
        for way in (0, 1):
            left, total = self._left(k, way, _SAMPLE)
            shares.append(left.sum() / total.clamp_min(1))
        return float(torch.stack(shares).max())

    def finish(self, k: int) -> Found:
        """Widen the window while it pays, let those look on by themselves whose rectangle is larger, and answer."""
        while self.pays(k):
            self.widen(k)
        code = self._locate(k)
        for way in (0, 1):
            at = self._left(k, way, 1)[0].flatten().nonzero()[:, 0]
            if len(at):
                self._collect(k, way, at, code[way])
        (top, left), (h, w) = self.corner, self.size
        squared = torch.full((2, *self.whole), torch.inf, device=self.best.device)
        index = torch.zeros((2, *self.whole), dtype=torch.int64, device=self.best.device)
        squared[:, top : top + h, left : left + w] = self.best[k]
        index[:, top : top + h, left : left + w] = (code // w + top) * self.whole[1] + code % w + left
        return Found(squared, index)

    def _collect(self, i: int, way: int, at: Tensor, codes: Tensor) -> None:
        """Search the rectangles of the queries at flat pixels ``at``: small ones whole, large ones by tiles."""
        cloud, mask = (self.pair.q, self.pair.q_mask) if way == 0 else (self.pair.p, self.pair.p_mask)
        queries = self._queries(i, way)[0].flatten(1)[:, at]
        squared = self.best[i, way].flatten()[at]
        code = codes.flatten()[at]
        least = 0
        for side in _SIDES:
            self._scan(cloud.flatten(1), queries, squared, code, least, side)
            least = side
        tiles = Tiles(cloud, mask)
        u0, u1, v0, v1 = (a.int() for a in self._rectangles(queries, squared))
        longer = torch.maximum(u1 - u0, v1 - v0) + 1
        while bool((longer > least).any()):
            chosen = ((longer > least) & (longer <= 2 * least)).nonzero()[:, 0]
            window = [a[chosen] for a in (u0, u1, v0, v1)]
            squared[chosen], code[chosen] = tiles.search(
                queries[:, chosen], window, squared[chosen], code[chosen], 2 * least
            )
            least *= 2
        self.best[i, way].view(-1)[at] = squared
        codes.view(-1)[at] = code

    def _scan(
        self, cloud: Tensor, queries: Tensor, squared: Tensor, code: Tensor, least: int, most: int
    ) -> None:
        """Search whole rectangles whose longer side is above ``least`` and at most ``most`` pixels; updates in place."""
        h, w = self.size
        u0, u1, v0, v1 = (a.int() for a in self._rectangles(queries, squared))
        longer = torch.maximum(u1 - u0, v1 - v0) + 1
        chosen = ((longer > least) & (longer <= most)).nonzero()[:, 0]
        ramp = torch.arange(most, device=cloud.device, dtype=torch.int32)
        for part in chosen.split(max(AT_ONCE // most**2, 1)):  # type: ignore[no-untyped-call]
            rows = (v0[part, None] + ramp).clamp_max(h - 1)
            cols = (u0[part, None] + ramp).clamp_max(w - 1)
            index = (rows[:, :, None] * w + cols[:, None]).flatten(1)
            total = squared_distances(cloud, index, queries[:, part])
            found, which = total.min(1)
            nearer = found < squared[part]
            squared[part] = torch.where(nearer, found, squared[part])
            code[part] = torch.where(nearer, index.gather(1, which[:, None])[:, 0], code[part])


def _shadow(a: Tensor, z: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes a / z of the two tangents from the camera to a circle of radius d about (a, z); +-inf where there are none."""
    long = (a * a + z * z - d * d).clamp_min(0).sqrt()
    low, high = z * long + a * d, z * long - a * d
    infinite = torch.full_like(a, torch.inf)
    return (
        torch.where((low > 0) & (long > 0), (a * long - z * d) / low, -infinite),
        torch.where((high > 0) & (long > 0), (a * long + z * d) / high, infinite),
    )
