"""Nearest neighbours of two clouds on one pixel grid: the answer's form, clouds cut into tiles, and the brute-force oracle.

Both engines cut clouds into square tiles of the grid. Pixels without a point lie at infinity, far from everything.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

_AT_ONCE = 1 << 22  # pairs that are compared at once


class Found(NamedTuple):
    """Nearest neighbours for S shifts s.

    Attributes
    ----------
    squared
        (S, 2, H, W) m^2: of every p + s to Q, and of every q to P + s; meaningless where masked.
    index
        (S, 2, H, W) int64 flat pixel of that neighbour.
    """

    squared: Tensor
    index: Tensor


@torch.no_grad()
def nearest(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor) -> Found:
    """Find the nearest neighbours of every p + s in Q and of every q in P + s by comparing all pairs, on any device.

    Parameters
    ----------
    p, q
        (3, H, W) points, metres; finite where masked.
    p_mask, q_mask
        (H, W) bool: which pixels belong to the clouds; neither is empty.
    shifts
        (S, 3) metres.
    """
    shape = (len(shifts), 2, *p_mask.shape)
    squared = torch.zeros(shape, device=p.device)
    index = torch.zeros(shape, dtype=torch.int64, device=p.device)
    of_p, of_q = (mask.flatten().nonzero()[:, 0] for mask in (p_mask, q_mask))
    for k, shift in enumerate(shifts.unbind()):
        ways = ((p, of_p, q, of_q, shift), (q, of_q, p, of_p, -shift))
        for way, (own, of_own, other, of_other, moved) in enumerate(ways):
            queries, points = own.flatten(1)[:, of_own], other.flatten(1)[:, of_other]
            best, which = [], []
            for some in queries.split(max(_AT_ONCE // len(of_other), 1), dim=1):
                apart = (some[:, :, None] - points[:, None]) + moved[:, None, None]
                least, at = apart.square().sum(0).min(1)
                best.append(least)
                which.append(of_other[at])
            squared[k, way].view(-1)[of_own] = torch.cat(best)
            index[k, way].view(-1)[of_own] = torch.cat(which)
    return Found(squared, index)


def tiles_of(images: Tensor, side: int) -> Tensor:
    """Cut images (C, H, W) into T tiles of ``side`` x ``side`` pixels, row by row: (T, C, side^2), infinity beyond the border."""
    channels, h, w = images.shape
    rows, cols = -(-h // side), -(-w // side)
    whole = pad(images, (0, cols * side - w, 0, rows * side - h), value=torch.inf)
    split = whole.view(channels, rows, side, cols, side).permute(1, 3, 0, 2, 4)
    return split.reshape(rows * cols, channels, side * side)


def image_of(tiles: Tensor, size: tuple[int, int], side: int) -> Tensor:
    """Join tiles (..., T, side^2) to images (..., H, W); the inverse of :func:`tiles_of`."""
    rows, cols = (-(-n // side) for n in size)
    split = tiles.reshape(-1, rows, cols, side, side).transpose(2, 3)
    whole = split.reshape(*tiles.shape[:-2], rows * side, cols * side)
    return whole[..., : size[0], : size[1]]


def pixels_of(codes: Tensor, size: tuple[int, int], side: int) -> Tensor:
    """Turn codes, ``side^2`` times a tile's number plus the place in it, into int64 flat pixels of an image (H, W)."""
    cols = -(-size[1] // side)
    tile, place = codes.long() // side**2, codes.long() % side**2
    row, col = tile // cols * side + place // side, tile % cols * side + place % side
    return row * size[1] + col
