"""Tiles of a cloud on a grid with bounding boxes: for the few queries whose nearest neighbour may lie far away on the grid."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

TILE = 8  # pixels
AT_ONCE = 2_000_000  # distances per step


def squared_distances(cloud: Tensor, index: Tensor, queries: Tensor) -> Tensor:
    """(N, M) squared distances of queries (3, N) to points of cloud (3, H W) at index (N, M)."""
    total = torch.zeros(index.shape, device=cloud.device)
    flat = index.flatten()
    for points, query in zip(cloud, queries, strict=True):
        apart = points.index_select(0, flat).view(index.shape) - query[:, None]
        total.addcmul_(apart, apart)
    return total


class Tiles:
    """Tiles of a cloud (3, H, W) with their bounding boxes, for queries that look far."""

    def __init__(self, cloud: Tensor, mask: Tensor) -> None:
        h, w = self.size = tuple(mask.shape)
        self.cloud = cloud.flatten(1)
        pad = (0, -w % TILE, 0, -h % TILE)

        def least(values: Tensor) -> Tensor:
            there = torch.nn.functional.pad(torch.where(mask, values, torch.inf), pad, value=torch.inf)
            return -torch.nn.functional.max_pool2d(-there[None], TILE)[0]

        low, high = least(cloud), -least(-cloud)
        self.grid = tuple(low.shape[1:])
        self.low, self.high = low.flatten(1), high.flatten(1)
        inside = torch.arange(TILE, device=cloud.device, dtype=torch.int32)
        self.rows, self.cols = inside.repeat_interleave(TILE), inside.repeat(TILE)

    def search(
        self, queries: Tensor, window: Sequence[Tensor], squared: Tensor, code: Tensor, side: int
    ) -> tuple[Tensor, Tensor]:
        """Nearest of queries (3, N) in rectangles (first, last column, first, last row) of at most ``side`` pixels."""
        taps = side // TILE + 2
        parts = torch.arange(len(squared), device=squared.device).split(max(AT_ONCE // taps**2, 1))  # type: ignore[no-untyped-call]
        found = [self._part(queries[:, k], [a[k] for a in window], squared[k], code[k], taps) for k in parts]
        if not found:
            return squared, code
        return torch.cat([f[0] for f in found]), torch.cat([f[1] for f in found])

    def _part(
        self, queries: Tensor, window: Sequence[Tensor], squared: Tensor, code: Tensor, taps: int
    ) -> tuple[Tensor, Tensor]:
        ramp = torch.arange(taps, device=squared.device, dtype=torch.int32)
        cols, rows = (window[k][:, None] // TILE + ramp for k in (0, 2))
        inside = (rows <= window[3][:, None] // TILE)[:, :, None] & (cols <= window[1][:, None] // TILE)[
            :, None
        ]
        tile = torch.where(inside, rows[:, :, None] * self.grid[1] + cols[:, None], 0).flatten(1)
        bound = torch.zeros(tile.shape, device=squared.device)
        flat = tile.flatten()
        for low, high, query in zip(self.low, self.high, queries, strict=True):
            below = low.index_select(0, flat).view(tile.shape).sub_(query[:, None])
            above = high.index_select(0, flat).view(tile.shape).sub_(query[:, None]).neg_()
            short = torch.maximum(below, above, out=below).clamp_min_(0)
            bound.addcmul_(short, short)
        bound = torch.where(inside.flatten(1), bound, torch.inf)
        first = bound.argmin(
            1, keepdim=True
        )  # the likeliest tile alone, which shrinks the sphere for the others
        everyone = torch.arange(len(squared), device=squared.device)
        squared, code = self._compare(queries, everyone, tile.gather(1, first)[:, 0], squared, code)
        bound.scatter_(1, first, torch.inf)
        who, which = (bound * (1 - 1e-5) < squared[:, None]).nonzero().unbind(1)
        return self._compare(queries, who, tile[who, which], squared, code)

    def _compare(
        self, queries: Tensor, who: Tensor, tile: Tensor, squared: Tensor, code: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compare queries ``who`` (M,) with all points of tiles (M,)."""
        h, w = self.size
        for part in torch.arange(len(who), device=who.device).split(AT_ONCE // TILE**2):  # type: ignore[no-untyped-call]
            rows = (tile[part, None] // self.grid[1] * TILE + self.rows).clamp_max(h - 1)
            cols = (tile[part, None] % self.grid[1] * TILE + self.cols).clamp_max(w - 1)
            index = (rows * w + cols).int()
            least, which = squared_distances(self.cloud, index, queries[:, who[part]]).min(1)
            nearest_pixel = index.gather(1, which[:, None])[:, 0]
            before = squared
            squared = squared.scatter_reduce(0, who[part], least, "amin")
            winner = (least == squared[who[part]]) & (least < before[who[part]])
            code = code.clone()
            code[who[part][winner]] = nearest_pixel[winner]
        return squared, code
