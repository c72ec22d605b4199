"""Exact nearest neighbours on the CPU, compiled, with the questions and answers of :mod:`tofcapture_model.neighbours`."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture_model.neighbours import Found

_PARTS = 16  # of the queries
_RUN = 4  # leaves that stay together
_WORTH_A_THREAD = 10_000  # queries of one shift
_MARGIN = 1e-6  # of the largest coordinate: rounding of a shifted query


def usable(device: torch.device) -> bool:
    """Whether the compiled search runs there: on a CPU, with numba."""
    if device.type != "cpu":
        return False
    try:
        from tofcapture_model.kernels import boxes  # noqa: F401
    except ConfigError:
        return False
    return True


@dataclass(frozen=True)
class Tree:
    """A cloud as :mod:`tofcapture_model.kernels.boxes` has it.

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
    from tofcapture_model.kernels.boxes import FAN, fill, wrap

    points, there = np.ascontiguousarray(cloud.float().numpy()), np.ascontiguousarray(mask.numpy())
    n = int(np.count_nonzero(there))
    levels = [-(-n // FAN)]
    while len(levels) == 1 or levels[-1] > 1:
        levels.append(-(-levels[-1] // FAN))
    offsets = np.cumsum([0, *levels[1:]], dtype=np.int64)
    leaves, pixels = np.empty((levels[0], 3, FAN), np.float32), np.empty(n, np.int64)
    boxes = np.empty((offsets[-1], 6, FAN), np.float32)
    fill(points, there, leaves, pixels)
    finite = leaves.reshape(-1)[np.isfinite(leaves.reshape(-1))]
    wrap(leaves, n, offsets, np.float32(_MARGIN * max(abs(finite.min()), abs(finite.max()))), boxes)
    return Tree(leaves, boxes, offsets, pixels)


class _Shift:
    """What is known of one shift: answers (2, H W) and the sums of their squares over the parts that were asked."""

    def __init__(self, trees: tuple[Tree, Tree], shift: Sequence[float], shape: tuple[int, int]) -> None:
        self.trees, self.shape = trees, shape
        x, y, z = shift
        self.moves = [(np.float32(sign * x), np.float32(sign * y), np.float32(sign * z)) for sign in (1, -1)]
        self.squared = np.full((2, shape[0] * shape[1]), np.inf, np.float32)
        self.index = np.zeros((2, shape[0] * shape[1]), np.int64)
        self.sums = np.zeros((2, _PARTS))

    def ask(self, way: int, first: int, last: int) -> None:
        """Find the neighbours of some parts of P in Q (way 0) or of Q in P."""
        from tofcapture_model.kernels.boxes import search

        own, other = self.trees[way], self.trees[1 - way]
        self.sums[way, first] = search(
            other.leaves, other.boxes, other.offsets, other.pixels, own.leaves, own.pixels,
            self.moves[way], (first, last, _PARTS), _RUN, self.squared[way], self.index[way],
        )  # fmt: skip

    def seen(self) -> float:
        """Symmetric mean squared distance, m^2, from below: what was not asked counts nothing."""
        p, q = (len(tree.pixels) for tree in self.trees)
        return float(self.sums[0].sum() / p + self.sums[1].sum() / q)

    def found(self) -> Found:
        """Answers as tensors."""
        return Found(
            torch.from_numpy(self.squared).view(2, *self.shape),
            torch.from_numpy(self.index).view(2, *self.shape),
        )


class _Crew:
    """Threads that ask; the answers and their sums do not depend on how many there are."""

    def __init__(self, queries: int) -> None:
        self.size = min(torch.get_num_threads(), 1 + queries // _WORTH_A_THREAD)
        self.pool = ThreadPoolExecutor(self.size) if self.size > 1 else None

    def ask(self, shifts: Sequence[_Shift], first: int, last: int) -> None:
        """Ask parts of both directions, a part at a time where there are many threads."""
        step = 1 if self.size > 2 else last - first
        tasks = [(s, way, k, min(k + step, last)) for s in shifts for way in (0, 1) for k in range(first, last, step)]  # fmt: skip
        if self.pool is None:
            for shift, *what in tasks:
                shift.ask(*what)
            return
        for future in [self.pool.submit(shift.ask, *what) for shift, *what in tasks]:
            future.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.pool is not None:
            self.pool.shutdown()


def _plan(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor) -> list[_Shift]:
    trees, shape = (plant(p, p_mask), plant(q, q_mask)), (p_mask.shape[0], p_mask.shape[1])
    return [_Shift(trees, shift, shape) for shift in shifts.tolist()]


def _queries(plans: Sequence[_Shift]) -> int:
    return sum(len(tree.pixels) for tree in plans[0].trees)


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
    plans = _plan(p, q, p_mask, q_mask, shifts)
    with _Crew(_queries(plans)) as crew:
        crew.ask(plans, 0, _PARTS)
    return [plan.found() for plan in plans]


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Found, Tensor]:
    """Find the shift of the least symmetric mean squared distance, and its neighbours, exactly (arguments as :func:`nearest`).

    Squares only add up: a shift whose sum over some of the queries is above the best one's over all cannot win.

    Returns
    -------
    index of the shift, its Found, (S,) m^2: its distance, and for every other shift a bound from below that is not less
    """
    plans = _plan(p, q, p_mask, q_mask, shifts)
    with _Crew(_queries(plans)) as crew:
        crew.ask(plans, 0, 1)
        best, *others = sorted(plans, key=_Shift.seen)
        crew.ask([best], 1, _PARTS)
        for plan in others:
            asked = 1
            while asked < _PARTS and plan.seen() < best.seen():
                enough = (
                    int(asked * best.seen() / max(plan.seen(), 1e-30)) + 1
                )  # where the rest is like what was seen
                first, asked = asked, min(max(enough, asked + 1), _PARTS)
                crew.ask([plan], first, asked)
            if plan.seen() < best.seen():
                best = plan
    return plans.index(best), best.found(), torch.tensor([plan.seen() for plan in plans], dtype=torch.float32)
