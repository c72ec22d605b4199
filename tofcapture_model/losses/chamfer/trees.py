"""Exact nearest neighbours on the CPU: trees of bounding boxes over the pixel grid, sixteen points to a leaf, sixteen boxes to a node.

A leaf is a tile of 4 x 4 pixels, a node one of 4 x 4 leaves or nodes. Sixteen boxes or points are tested by a few vector
instructions. A query starts from a guess, mostly its neighbour's answer, and looks wherever a box is nearer than what it has.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.libraries import compiled
from tofcapture_model.losses.chamfer.neighbours import image_of, pixels_of, tiles_of

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Point = tuple[np.float32, np.float32, np.float32]

SIDE, FAN = 4, 16
_MARGIN = 1e-6  # of the largest coordinate: rounding of a shifted query
# One of so many leaves is asked for every shift first, so many neighbours at a time
_SAMPLE, _TOGETHER = (32, 4)
_STEPS, _STEP = 16, 64  # at most so many steps in which other shifts are asked, of at least so many leaves
_TASK = 256  # leaves of a thread's task
_WORTH_A_THREAD = 10_000  # queries of one shift

_ZERO, _INF, _ONE = np.float32(0), np.float32(np.inf), np.uint32(1)
# De Bruijn: the top five bits tell how far it was shifted
_FACTOR, _TOP = (np.uint32(0x077CB531), np.uint32(27))
_POSITION = np.zeros(32, np.int64)
for _k in range(32):
    _POSITION[(0x077CB531 << _k & 0xFFFFFFFF) >> 27] = _k


@compiled
def _lowest(bits: np.uint32) -> int:
    """Position of the lowest bit that is set."""
    return _POSITION[np.uint32(np.uint32(bits & (~bits + _ONE)) * _FACTOR) >> _TOP]  # type: ignore[no-any-return]


@compiled
def _boxes_near(boxes: Float32, g: int, p: Point, squared: np.float32) -> np.uint32:
    """Bits of those of sixteen boxes that are nearer to p than a squared distance."""
    x, y, z = p
    bits = np.uint32(0)
    for k in range(FAN):
        dx = max(boxes[g, 0, k] - x, boxes[g, 3, k] + x, _ZERO)
        dy = max(boxes[g, 1, k] - y, boxes[g, 4, k] + y, _ZERO)
        dz = max(boxes[g, 2, k] - z, boxes[g, 5, k] + z, _ZERO)
        bits |= np.uint32(dx * dx + dy * dy + dz * dz < squared) << np.uint32(k)
    return bits


@compiled
def _apart(leaves: Float32, g: int, k: int, p: Point, s: Point) -> np.float32:
    """Squared distance of a point of a leaf to p + s; the shift is taken from the difference, where it rounds least."""
    dx, dy = (leaves[g, 0, k] - p[0]) - s[0], (leaves[g, 1, k] - p[1]) - s[1]
    dz = (leaves[g, 2, k] - p[2]) - s[2]
    return np.float32(dx * dx + dy * dy + dz * dz)


@compiled
def _look(leaves: Float32, g: int, p: Point, s: Point, best: np.float32, at: int) -> tuple[np.float32, int]:
    """Look at a leaf: the least squared distance so far, and whose it is."""
    bits = np.uint32(0)
    for k in range(FAN):
        bits |= np.uint32(_apart(leaves, g, k, p, s) < best) << np.uint32(k)
    while bits:
        k = _lowest(bits)
        bits &= bits - _ONE
        squared = _apart(leaves, g, k, p, s)
        if squared < best:
            best, at = squared, FAN * g + k
    return best, at


@compiled
def _descend(
    leaves: Float32, boxes: Float32, levels: Int64, node: Int64, open_: NDArray[np.uint32],
    p: Point, s: Point, best: np.float32, at: int,
) -> tuple[np.float32, int]:  # fmt: skip
    """Look at all leaves whose box is nearer than what is known; ``node`` and ``open_`` (levels,) are for its use."""
    moved = p[0] + s[0], p[1] + s[1], p[2] + s[2]
    top = len(levels) - 1
    level = top
    node[level], open_[level] = 0, _boxes_near(boxes, levels[level, 0], moved, best)
    while level <= top:
        bits = open_[level]
        if bits == 0:
            level += 1
            continue
        k = _lowest(bits)
        open_[level] = bits & (bits - _ONE)
        row, col = node[level] // levels[level, 1], node[level] % levels[level, 1]
        child = (SIDE * row + k // SIDE) * levels[level, 2] + SIDE * col + k % SIDE
        if level > 0:
            level -= 1
            node[level], open_[level] = child, _boxes_near(boxes, levels[level, 0] + child, moved, best)
        else:
            best, at = _look(leaves, child, p, s, best, at)
    return best, at


@compiled
def _search(
    leaves: Float32, boxes: Float32, levels: Int64, own: Float32, shift: Point, which: Int64,
    squared: Float32, whose: Int32, sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Find the nearest of the tree ``leaves, boxes, levels`` to the points of the leaves ``which`` of ``own`` + shift.

    ``whose`` (L, 16) holds guesses and receives the answers, 16 times a leaf plus the place in it; ``squared`` (L, 16), m^2,
    and ``sums`` (L,) of the squares of each leaf are written.
    """
    node, open_ = np.zeros(len(levels), np.int64), np.zeros(len(levels), np.uint32)
    there = -1
    for g in which:
        total = 0.0
        for k in range(FAN):
            p = (own[g, 0, k], own[g, 1, k], own[g, 2, k])
            if p[0] == _INF:
                continue
            at = int(whose[g, k])
            best = _apart(leaves, at // FAN, at % FAN, p, shift)
            if there >= 0:
                best, at = _look(leaves, there, p, shift, best, at)
            best, at = _descend(leaves, boxes, levels, node, open_, p, shift, best, at)
            squared[g, k], whose[g, k] = best, at
            total += float(best)
            there = at // FAN
        sums[g] = total


class _Tree:
    """A cloud's tree: leaves (L, 3, 16), boxes (M, 6, 16), and of each level of boxes its first, its width, its children's width.

    A box is its least coordinates and its negated greatest, less a margin that covers the rounding of a shifted query.
    """

    def __init__(self, cloud: Tensor, mask: Tensor) -> None:
        there = torch.where(mask, cloud, torch.inf)
        largest = float(torch.where(mask, cloud, 0.0).abs().max())
        leaves = tiles_of(there, SIDE)
        h, w = (-(-n // SIDE) for n in mask.shape)
        corners = torch.cat(
            [leaves.amin(2), torch.where(leaves < torch.inf, -leaves, torch.inf).amin(2)], dim=1
        )
        corners = corners.T.reshape(6, h, w) - _MARGIN * largest
        boxes: list[Tensor] = []
        levels: list[tuple[int, int, int]] = []
        start = 0
        while not levels or h * w > 1:
            boxes.append(tiles_of(corners, SIDE))
            width, h, w = w, -(-h // SIDE), -(-w // SIDE)
            levels.append((start, w, width))
            start += h * w
            corners = boxes[-1].amin(2).T.reshape(6, h, w)
        self.leaves, self.boxes = leaves.numpy(), torch.cat(boxes).numpy()
        self.levels, self.count = np.array(levels), int(mask.sum())


class _Shift:
    """Hold what is known of one shift: answers of P in Q (way 0) and of Q in P, by the leaves of who asks."""

    def __init__(self, trees: Sequence[_Tree], move: Sequence[float]) -> None:
        shape = (2, len(trees[0].leaves), FAN)
        self.trees, self.move = trees, move
        self.squared = np.zeros(shape, np.float32)
        self.whose = np.empty(shape, np.int32)
        self.whose[:] = np.arange(shape[1] * FAN).reshape(shape[1:])  # the same pixel of the other cloud
        self.sums = np.zeros(shape[:2])  # of a leaf's squares; a bound from below until it is asked

    def ask(self, way: int, which: Int64) -> None:
        """Find the neighbours of the points of some leaves, ascending."""
        own, other, sign = self.trees[way], self.trees[1 - way], 1 - 2 * way
        x, y, z = (np.float32(sign * a) for a in self.move)
        _search(
            other.leaves, other.boxes, other.levels, own.leaves, (x, y, z), which,
            self.squared[way], self.whose[way], self.sums[way],
        )  # fmt: skip

    def learn(self, known: _Shift) -> None:
        """Take the answers of another shift as guesses, and as bounds: no distance changes by more than the shift does."""
        away = math.dist(self.move, known.move)
        away += _MARGIN * (math.hypot(*self.move) + math.hypot(*known.move))
        self.whose[:] = known.whose
        least = np.maximum(np.sqrt(known.squared) * np.float32(1 - 2 * _MARGIN) - np.float32(away), 0)
        self.sums = np.maximum(self.sums, np.square(least).sum(2, dtype=np.float64))

    def shares(self) -> NDArray[np.float64]:
        """(2, L) parts of the symmetric mean squared distance, m^2; from below until everything was asked."""
        found: NDArray[np.float64] = self.sums / np.array([[tree.count] for tree in self.trees])
        return found

    def seen(self) -> float:
        """Symmetric mean squared distance, m^2; from below until everything was asked."""
        return float(self.shares().sum())


def _ask(pool: ThreadPoolExecutor, shifts: Sequence[_Shift], which: NDArray[np.bool_]) -> None:
    """Ask the leaves ``which`` (2, L) of P and of Q for some shifts; answers do not depend on the number of threads."""
    tasks: list[Future[None]] = []
    for way in (0, 1):
        leaves = which[way].nonzero()[0]
        for part in (leaves[k : k + _TASK] for k in range(0, len(leaves), _TASK)):
            tasks += [pool.submit(shift.ask, way, part) for shift in shifts]
    for task in tasks:
        task.result()


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Tensor, Tensor]:
    """Answer as :func:`tofcapture_model.losses.chamfer.neighbours.nearest_of_best` does, on the CPU.

    A sample of leaves tells the likeliest shift, which is asked everything. By the triangle inequality its answers bound those
    of the others from below. Answers replace bounds until a shift's sum exceeds the best one's: it cannot win.
    """
    trees = _Tree(p, p_mask), _Tree(q, q_mask)
    leaves, size = len(trees[0].leaves), (p_mask.shape[0], p_mask.shape[1])
    every = [_Shift(trees, move) for move in shifts.tolist()]
    sample = np.broadcast_to(np.arange(leaves) // _TOGETHER % _SAMPLE == 0, (2, leaves))
    workers = min(torch.get_num_threads(), 1 + (trees[0].count + trees[1].count) // _WORTH_A_THREAD)
    with ThreadPoolExecutor(workers) as pool:
        _ask(pool, every, sample)
        best, *others = sorted(every, key=_Shift.seen)
        _ask(pool, [best], ~sample)
        for shift in others:
            shift.learn(best)
        # bounds are loosest where the best one's squares are large: these leaves are asked first
        order = np.argsort(-best.shares().ravel(), kind="stable")
        for some in np.array_split(order, min(max(len(order) // _STEP, 1), _STEPS)):
            others = [shift for shift in others if shift.seen() < best.seen()]
            if not others:
                break
            step = np.zeros(2 * leaves, bool)
            step[some] = True
            _ask(pool, others, step.reshape(2, -1))
    best = min([best, *others], key=_Shift.seen)
    scores = torch.tensor([shift.seen() for shift in every], dtype=torch.float32)
    index = pixels_of(image_of(torch.from_numpy(best.whose), size, SIDE), size, SIDE)
    return every.index(best), index, scores
