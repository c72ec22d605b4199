"""Exact nearest neighbours on a GPU, in Triton: all shifts and both ways in one launch, by tiles of 8 x 8 pixels.

A program, one warp, answers for the 64 queries of one tile. It looks at the other cloud's tile in the same place, then at every
tile whose bounding box is nearer than the worst answer so far, nearest box first. Boxes farther than each single query's own
answer are skipped. What is left out cannot hold a nearer point.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from tofcapture_model.losses.chamfer.neighbours import image_of, least_of, pixels_of, tiles_of

SIDE = 8
POINTS = SIDE**2
PART = 8  # points that all queries are compared with at once: registers hold the distances
BLOCK = 256  # boxes that are looked at together


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Tensor, Tensor]:
    """Answer as :func:`tofcapture_model.losses.chamfer.neighbours.nearest_of_best` does, on a GPU."""
    size = (p_mask.shape[0], p_mask.shape[1])
    clouds = [tiles_of(torch.where(m, c.float(), torch.inf), SIDE) for c, m in ((p, p_mask), (q, q_mask))]
    points = torch.stack(clouds)
    most = torch.where(points < torch.inf, points, -torch.inf).amax(-1)
    boxes = torch.cat([points.amin(-1), most], dim=2).transpose(1, 2).contiguous()
    tiles, shape = points.shape[1], (len(shifts), 2, points.shape[1], POINTS)
    squared = torch.empty(shape, device=p.device)
    codes = torch.empty(shape, device=p.device, dtype=torch.int32)
    # Triton launches on the current GPU, whichever the tensors are on
    with torch.cuda.device_of(points):
        search[(tiles, 2 * len(shifts))](
            points, boxes, shifts.float().contiguous(), squared, codes, tiles,
            POINTS=POINTS, PART=PART, BLOCK=BLOCK, num_warps=1,
        )  # fmt: skip
    index = pixels_of(image_of(codes, size, SIDE), size, SIDE)
    return least_of(image_of(squared, size, SIDE), index, p_mask, q_mask)


@triton.jit
def search(
    points,
    boxes,
    shifts,
    squared,
    codes,
    tiles,
    POINTS: tl.constexpr,
    PART: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Find the nearest of P + s in Q (way 0) and of Q - s in P (way 1); grid (T, 2 S), whose second axis counts ``2 shift + way``.

    ``points`` (2, T, 3, 64) float32, metres, are both clouds by tiles; what is masked is at infinity. ``boxes`` (2, 6, T) are the
    least and greatest coordinates of every tile's points, of none inf and -inf; ``shifts`` (S, 3). Written are ``squared``
    (S, 2, T, 64), m^2, -1 where masked, and ``codes`` int32: 64 times the tile of the nearest, plus its place there. POINTS, PART
    and BLOCK are the module's; Triton takes constants as arguments.
    """
    tile, job = tl.program_id(0), tl.program_id(1)
    way = job % 2
    other = 1 - way
    sign = 1.0 - 2.0 * way
    lane = tl.arange(0, POINTS)
    own = points + (way * tiles + tile) * 3 * POINTS + lane
    x, y, z = tl.load(own), tl.load(own + POINTS), tl.load(own + 2 * POINTS)
    there = x < float("inf")
    shift = shifts + 3 * (job // 2)
    x = tl.where(there, x + sign * tl.load(shift), 0.0)
    y = tl.where(there, y + sign * tl.load(shift + 1), 0.0)
    z = tl.where(there, z + sign * tl.load(shift + 2), 0.0)
    least_x, most_x = _extent(x, there)
    least_y, most_y = _extent(y, there)
    least_z, most_z = _extent(z, there)

    theirs = points + other * tiles * 3 * POINTS
    corners = boxes + other * 6 * tiles
    best = tl.where(there, float("inf"), -1.0)
    found = tl.zeros((POINTS,), tl.int32)
    best, found = _look(theirs, tile, x, y, z, best, found, POINTS, PART)
    worst = tl.max(best, 0)
    for start in range(0, tiles, BLOCK):
        number = start + tl.arange(0, BLOCK)
        bound = _apart(corners, number, tiles, least_x, most_x, least_y, most_y, least_z, most_z)
        bound = tl.where(number == tile, float("inf"), bound)
        nearest_box = tl.min(bound, 0)
        while nearest_box < worst:
            one = start + tl.argmin(bound, 0)
            needed = _apart(corners, one + 0 * lane, tiles, x, x, y, y, z, z) < best
            if tl.max(needed.to(tl.int32), 0) > 0:
                best, found = _look(theirs, one, x, y, z, best, found, POINTS, PART)
                worst = tl.max(best, 0)
            bound = tl.where(number == one, float("inf"), bound)
            nearest_box = tl.min(bound, 0)

    out = (job * tiles + tile) * POINTS + lane
    tl.store(squared + out, best)
    tl.store(codes + out, found)


@triton.jit
def _extent(values, there):
    """Least and greatest of the values that are there; inf and -inf of none."""
    least = tl.min(tl.where(there, values, float("inf")), 0)
    return least, tl.max(tl.where(there, values, -float("inf")), 0)


@triton.jit
def _apart(corners, number, tiles, x0, x1, y0, y1, z0, z1):
    """Squared distance, from below, of tiles' boxes to the box from (x0, y0, z0) to (x1, y1, z1); inf beyond the last tile."""
    inside, at, none = number < tiles, corners + number, float("inf")
    x = tl.maximum(tl.load(at, inside, none) - x1, x0 - tl.load(at + 3 * tiles, inside, -none))
    y = tl.maximum(tl.load(at + tiles, inside, none) - y1, y0 - tl.load(at + 4 * tiles, inside, -none))
    z = tl.maximum(tl.load(at + 2 * tiles, inside, none) - z1, z0 - tl.load(at + 5 * tiles, inside, -none))
    x, y, z = tl.maximum(x, 0.0), tl.maximum(y, 0.0), tl.maximum(z, 0.0)
    return (x * x + y * y + z * z) * (1 - 1e-6)  # this sum and that of a distance may round apart


@triton.jit
def _look(theirs, tile, x, y, z, best, found, POINTS: tl.constexpr, PART: tl.constexpr):
    """Compare all queries with all points of a tile; a lane keeps its queries, so that lanes need not agree."""
    for start in tl.static_range(0, POINTS, PART):
        at = theirs + tile * 3 * POINTS + start + tl.arange(0, PART)
        dx = tl.load(at)[:, None] - x[None, :]
        dy = tl.load(at + POINTS)[:, None] - y[None, :]
        dz = tl.load(at + 2 * POINTS)[:, None] - z[None, :]
        squares = dx * dx + dy * dy + dz * dz
        least, which = tl.min(squares, 0, return_indices=True, return_indices_tie_break_left=False)
        found = tl.where(least < best, tile * POINTS + start + which, found)
        best = tl.minimum(best, least)
    return best, found
