"""Nearest neighbours of two clouds on one pixel grid: the brute-force oracle, and clouds cut into tiles.

Both engines cut clouds into square tiles of the grid. Pixels without a point lie at infinity, far from everything.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

_AT_ONCE = 1 << 22  # pairs that are compared at once


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Tensor, Tensor]:
    """Find the shift s of the least symmetric mean squared distance of P + s and Q, and its neighbours; all pairs are compared.

    Parameters
    ----------
    p, q
        (3, H, W) points, metres; finite where masked.
    p_mask, q_mask
        (H, W) bool: which pixels belong to the clouds; neither is empty.
    shifts
        (S, 3) metres.

    Returns
    -------
    index of the shift
    neighbours
        (2, H, W) int64 flat pixel of the nearest of every p + s in Q, and of every q in P + s; meaningless where masked.
    scores
        (S,) m^2: the distance of that shift, and for every other one a bound from below that is not less.
    """
    squared = torch.zeros((len(shifts), 2, *p_mask.shape), device=p.device)
    index = torch.zeros(squared.shape, dtype=torch.int64, device=p.device)
    of_p, of_q = (mask.flatten().nonzero()[:, 0] for mask in (p_mask, q_mask))
    for k, shift in enumerate(shifts.unbind()):
        ways = ((p, of_p, q, of_q, shift), (q, of_q, p, of_p, -shift))
        for way, (own, of_own, other, of_other, moved) in enumerate(ways):
            queries, points = own.flatten(1)[:, of_own], other.flatten(1)[:, of_other]
            found = [
                ((some[:, :, None] - points[:, None]) + moved[:, None, None]).square().sum(0).min(1)
                for some in torch.split(queries, max(_AT_ONCE // len(of_other), 1), dim=1)
            ]
            squared[k, way].view(-1)[of_own] = torch.cat([least for least, _ in found])
            index[k, way].view(-1)[of_own] = of_other[torch.cat([at for _, at in found])]
    return least_of(squared, index, p_mask, q_mask)


def least_of(squared: Tensor, index: Tensor, p_mask: Tensor, q_mask: Tensor) -> tuple[int, Tensor, Tensor]:
    """Choose the best of all shifts' squares and neighbours, each (S, 2, H, W): see :func:`nearest_of_best`."""
    masks = torch.stack([p_mask, q_mask])
    scores = (torch.where(masks, squared, 0.0).sum((2, 3)) / masks.sum((1, 2))).sum(1)
    best = int(scores.argmin())
    return best, index[best], scores


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
