"""Exact nearest neighbours on the CPU, compiled, with the questions and answers of :mod:`tofcapture_model.losses.chamfer.neighbours`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture_model.losses.chamfer.neighbours import Found

T = TypeVar("T")

_SAMPLE = 32  # one of so many leaves is asked for every shift first,
_TOGETHER = 4  # so many neighbours at a time
_STEPS, _STEP = 16, 64  # at most so many steps in which other shifts are asked, of at least so many leaves
_TASK = 64, 512  # leaves of a thread's task: least, most
_WORTH_A_THREAD = 10_000  # queries of one shift
_MARGIN = 1e-6  # of the largest coordinate: rounding of a shifted query


def usable(device: torch.device) -> bool:
    """Whether the compiled search runs there: on a CPU, with numba."""
    if device.type != "cpu":
        return False
    try:
        from tofcapture_model.losses.chamfer import boxes  # noqa: F401
    except ConfigError:
        return False
    return True


@dataclass(frozen=True)
class Tree:
    """A cloud as :mod:`tofcapture_model.losses.chamfer.leaves` builds it.

    Attributes
    ----------
    leaves, boxes
        (L, 3, 16) and (M, 6, 16) float32, metres.
    offsets
        int64, where the levels of boxes start, and M.
    pixels
        (N,) int64 flat pixels of the points.
    """

    leaves: NDArray[np.float32]
    boxes: NDArray[np.float32]
    offsets: NDArray[np.int64]
    pixels: NDArray[np.int64]


def plant(cloud: Tensor, mask: Tensor) -> Tree:
    """Build the tree of the masked points of a cloud (3, H, W), metres; mask (H, W) is not empty."""
    from tofcapture_model.losses.chamfer.leaves import FAN, fill, tidy, wrap

    points, there = np.ascontiguousarray(cloud.float().numpy()), np.ascontiguousarray(mask.numpy())
    n = int(np.count_nonzero(there))
    levels = [-(-n // FAN)]
    while len(levels) == 1 or levels[-1] > 1:
        levels.append(-(-levels[-1] // FAN))
    offsets = np.cumsum([0, *levels[1:]], dtype=np.int64)
    leaves, pixels = np.empty((levels[0], 3, FAN), np.float32), np.empty(n, np.int64)
    boxes = np.empty((offsets[-1], 6, FAN), np.float32)
    fill(points, there, leaves, pixels)
    tidy(leaves, pixels)
    finite = leaves.reshape(-1)[np.isfinite(leaves.reshape(-1))]
    wrap(leaves, n, offsets, np.float32(_MARGIN * max(abs(finite.min()), abs(finite.max()))), boxes)
    return Tree(leaves, boxes, offsets, pixels)


class _Shift:
    """What is known of one shift: answers of P in Q (way 0) and of Q in P, in the order of the leaves of who asks."""

    def __init__(self, trees: tuple[Tree, Tree], move: tuple[float, float, float]) -> None:
        self.trees, self.move = trees, move
        self.squared = [np.empty(len(tree.pixels), np.float32) for tree in trees]
        self.whose = [np.empty(len(tree.pixels), np.int32) for tree in trees]
        self.guesses = [np.empty(0, np.int32) for _ in trees]
        # of the squares of a leaf; a bound from below until it is asked
        self.sums = [np.zeros(len(tree.leaves)) for tree in trees]

    def ask(self, way: int, which: NDArray[np.int64]) -> None:
        """Find the neighbours of the points of some leaves, ascending."""
        from tofcapture_model.losses.chamfer.boxes import search

        own, other, sign = self.trees[way], self.trees[1 - way], 1 - 2 * way
        x, y, z = (np.float32(sign * a) for a in self.move)
        search(
            other.leaves, other.boxes, other.offsets, own.leaves, (x, y, z), which,
            self.guesses[way], self.squared[way], self.whose[way], self.sums[way],
        )  # fmt: skip

    def learn(self, known: _Shift) -> None:
        """Take the answers of another shift as guesses, and as bounds: none changes by more than the shift does."""
        from tofcapture_model.losses.chamfer.boxes import bound

        apart = math.dist(self.move, known.move)
        apart += _MARGIN * (math.hypot(*self.move) + math.hypot(*known.move))
        self.guesses = known.whose
        for sums, squared in zip(self.sums, known.squared, strict=True):
            bound(squared, apart, sums)

    def seen(self) -> float:
        """Symmetric mean squared distance, m^2; from below until everything was asked."""
        (p, q), (of_p, of_q) = self.trees, self.sums
        return float(of_p.sum() / len(p.pixels) + of_q.sum() / len(q.pixels))

    def found(self, shape: tuple[int, int]) -> Found:
        """Answers as tensors."""
        from tofcapture_model.losses.chamfer.boxes import spread

        size = shape[0] * shape[1]
        squared, index = np.zeros((2, size), np.float32), np.zeros((2, size), np.int64)
        for way in (0, 1):
            own, other = self.trees[way].pixels, self.trees[1 - way].pixels
            spread(own, other, self.squared[way], self.whose[way], squared[way], index[way])
        return Found(torch.from_numpy(squared).view(2, *shape), torch.from_numpy(index).view(2, *shape))


class _Crew:
    """Threads that share tasks; the answers do not depend on how many there are."""

    def __init__(self, p_mask: Tensor, q_mask: Tensor) -> None:
        queries = int(np.count_nonzero(p_mask.numpy()) + np.count_nonzero(q_mask.numpy()))
        size = min(torch.get_num_threads(), 1 + queries // _WORTH_A_THREAD)
        self.pool = ThreadPoolExecutor(size) if size > 1 else None

    def do(self, tasks: Sequence[Callable[[], T]]) -> list[T]:
        """Results of all tasks, in their order."""
        if self.pool is None:
            return [task() for task in tasks]
        return [future.result() for future in [self.pool.submit(task) for task in tasks]]

    def ask(self, shifts: Sequence[_Shift], which: Sequence[NDArray[np.int64]]) -> None:
        """Ask some leaves of P and some of Q, ascending, for all shifts."""
        least, most = _TASK
        tasks = []
        for way, leaves in enumerate(which):
            n = min(max(len(leaves) // 8, least), most)
            parts = [leaves[k : k + n] for k in range(0, len(leaves), n)]
            tasks += [partial(shift.ask, way, part) for shift in shifts for part in parts]
        self.do(tasks)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.pool is not None:
            self.pool.shutdown()


def _plan(crew: _Crew, p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor) -> list[_Shift]:
    tree_p, tree_q = crew.do([partial(plant, p, p_mask), partial(plant, q, q_mask)])
    return [_Shift((tree_p, tree_q), (x, y, z)) for x, y, z in shifts.tolist()]


def _steps(best: _Shift) -> list[list[NDArray[np.int64]]]:
    """Leaves of P and of Q in the order in which other shifts ask: bounds are loose where the best one's squares are large."""
    weights = [sums / len(tree.pixels) for sums, tree in zip(best.sums, best.trees, strict=True)]
    order, n = np.argsort(-np.concatenate(weights), kind="stable"), len(weights[0])
    steps = np.array_split(order, min(max(len(order) // _STEP, 1), _STEPS))
    return [[step[step < n], step[step >= n] - n] for step in map(np.sort, steps)]


@torch.no_grad()
def nearest(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor) -> list[Found]:
    """Find the nearest neighbours of every p + s in Q and of every q in P + s, exactly.

    Parameters
    ----------
    p, q
        (3, H, W) points, metres, on the CPU; finite where masked.
    p_mask, q_mask
        (H, W) bool: which pixels belong to the clouds; neither is empty.
    shifts
        (S, 3) metres.

    Returns
    -------
    One Found per shift
    """
    with _Crew(p_mask, q_mask) as crew:
        plans = _plan(crew, p, q, p_mask, q_mask, shifts)
        crew.ask(plans, [np.arange(len(tree.leaves)) for tree in plans[0].trees])
    return [plan.found((p.shape[1], p.shape[2])) for plan in plans]


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Found, Tensor]:
    """Find the shift of the least symmetric mean squared distance, and its neighbours, exactly (arguments as :func:`nearest`).

    A sample tells which shift is probably the best, and that one is asked everything. By the triangle inequality its answers
    bound those of the others from below; answers take the place of bounds until the sum is above the best one's, which proves
    that the shift cannot win.

    Returns
    -------
    index of the shift, its Found, (S,) m^2: its distance, and for every other shift a bound from below that is not less
    """
    with _Crew(p_mask, q_mask) as crew:
        plans = _plan(crew, p, q, p_mask, q_mask, shifts)
        sampled = [np.arange(len(tree.leaves)) // _TOGETHER % _SAMPLE == 0 for tree in plans[0].trees]
        crew.ask(plans, [there.nonzero()[0] for there in sampled])
        best, *others = sorted(plans, key=_Shift.seen)
        crew.ask([best], [(~there).nonzero()[0] for there in sampled])
        for plan in others:
            plan.learn(best)
        least = best.seen()
        for step in _steps(best):
            others = [plan for plan in others if plan.seen() < least]
            if not others:
                break
            crew.ask(others, step)
    best = min([best, *others], key=_Shift.seen)
    bounds = torch.tensor([plan.seen() for plan in plans], dtype=torch.float32)
    return plans.index(best), best.found((p.shape[1], p.shape[2])), bounds
