"""Exact nearest neighbours on a GPU, compiled, with the questions and answers of :mod:`tofcapture_model.losses.chamfer.trees`."""

from __future__ import annotations

import os
from shutil import which

import torch
from torch import Tensor
from torch.nn.functional import pad

from tofcapture_model.losses.chamfer.neighbours import Found
from tofcapture_model.losses.chamfer.tiles import TILE


def usable(device: torch.device) -> bool:
    """Whether the compiled search runs there: on a GPU with Triton, which PyTorch's wheels for GPUs bring along, and a C compiler, which Triton asks for."""
    if device.type != "cuda" or not any(which(c) for c in (os.environ.get("CC", "gcc"), "gcc", "clang")):
        return False
    try:
        from tofcapture_model.losses.chamfer import nearest_tiles  # noqa: F401
    except ImportError:
        return False
    return True


@torch.no_grad()
def nearest(p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor) -> list[Found]:
    """Find the nearest neighbours of every p + s in Q and of every q in P + s, exactly: :func:`tofcapture_model.losses.chamfer.trees.nearest` on a GPU."""
    return _Clouds(p, q, p_mask, q_mask).found(shifts)


@torch.no_grad()
def nearest_of_best(
    p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor, shifts: Tensor
) -> tuple[int, Found, Tensor]:
    """Find the shift of the least symmetric mean squared distance, and its neighbours, exactly (arguments as :func:`nearest`).

    All shifts are measured; who the neighbours are is asked for the best one only.

    Returns
    -------
    index of the shift, its Found, (S,) m^2: all distances
    """
    clouds = _Clouds(p, q, p_mask, q_mask)
    squared, _ = clouds.search(shifts, with_codes=False)
    points = torch.stack([p_mask.sum(), q_mask.sum()])
    distances = (squared.clamp_min(0).flatten(2).sum(2) / points).sum(1)
    best = int(distances.argmin())
    return best, clouds.found(shifts[best : best + 1])[0], distances


class _Clouds:
    """Two clouds cut into T tiles of 8 x 8 pixels: points (2, T, 3, 64), infinite where masked, and their boxes (2, 6, T)."""

    def __init__(self, p: Tensor, q: Tensor, p_mask: Tensor, q_mask: Tensor) -> None:
        self.size = (p_mask.shape[0], p_mask.shape[1])
        self.rows, self.cols = (-(-n // TILE) for n in self.size)
        self.points = torch.stack([self._tiled(p, p_mask), self._tiled(q, q_mask)])
        least = self.points.amin(-1)
        most = torch.where(self.points < torch.inf, self.points, -torch.inf).amax(-1)
        self.boxes = torch.cat([least, most], dim=2).transpose(1, 2).contiguous()

    def _tiled(self, cloud: Tensor, mask: Tensor) -> Tensor:
        """(T, 3, 64) of (3, H, W)."""
        beyond = (0, self.cols * TILE - self.size[1], 0, self.rows * TILE - self.size[0])
        whole = pad(torch.where(mask, cloud.float(), torch.inf), beyond, value=torch.inf)
        split = whole.view(3, self.rows, TILE, self.cols, TILE).permute(1, 3, 0, 2, 4)
        return split.reshape(self.rows * self.cols, 3, TILE * TILE)

    def search(self, shifts: Tensor, *, with_codes: bool) -> tuple[Tensor, Tensor]:
        """(S, 2, T, 64) squared distances, -1 where masked, and int32 ``64 tile + place`` of the nearest, if asked for."""
        from tofcapture_model.losses.chamfer import nearest_tiles as kernel

        tiles, shifts = self.rows * self.cols, shifts.float().contiguous()
        shape = (len(shifts), 2, tiles, kernel.POINTS)
        squared = torch.empty(shape, device=shifts.device)
        codes = torch.empty(shape if with_codes else 0, device=shifts.device, dtype=torch.int32)
        # Triton launches on the current GPU, whichever the tensors are on
        with torch.cuda.device_of(self.points):  # type: ignore[no-untyped-call]
            kernel.search[(tiles, 2 * len(shifts))](
                self.points, self.boxes, shifts, squared, codes, tiles,
                WITH_CODES=with_codes, POINTS=kernel.POINTS, PART=kernel.PART, BLOCK=kernel.BLOCK, num_warps=1,
            )  # fmt: skip
        return squared, codes

    def found(self, shifts: Tensor) -> list[Found]:
        """Answers of all shifts."""
        squared, codes = self.search(shifts, with_codes=True)
        tile, place = codes.long() // TILE**2, codes.long() % TILE**2
        row, col = tile // self.cols * TILE + place // TILE, tile % self.cols * TILE + place % TILE
        index = row * self.size[1] + col
        return [Found(*both) for both in zip(self._image(squared), self._image(index), strict=True)]

    def _image(self, tiled: Tensor) -> Tensor:
        """(S, 2, H, W) of (S, 2, T, 64)."""
        split = tiled.view(len(tiled), 2, self.rows, self.cols, TILE, TILE).transpose(3, 4)
        whole = split.reshape(len(tiled), 2, self.rows * TILE, self.cols * TILE)
        return whole[..., : self.size[0], : self.size[1]]
