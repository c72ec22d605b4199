"""Frames of a dataset as they were taken, from its shards or from a cache."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from tofcapture.errors import DataError
from tofcapture.files.cache import open_cache
from tofcapture.files.manifest import load_manifest
from tofcapture.files.packed import PackedScene
from tofcapture.files.shard import ShardReader


@dataclass(frozen=True)
class SampleId:
    """Which frame: scene name, view, frame."""

    scene: str
    view: int
    frame: int


class RawSample(NamedTuple):
    """One frame as it was taken, and the ground truth of its view at twice the resolution.

    Attributes
    ----------
    raw
        (K, H, W) uint16 phase images.
    celsius
        () float64 sensor temperature; NaN: not told.
    depth
        (2H, 2W) float32, metres; NaN where the mask says ``NOT_HIT``.
    normals
        (2H, 2W, 3) float32, unit, facing the camera; NaN where depth is.
    mask
        (2H, 2W) uint8, bits of :class:`tofcapture.files.layout.MaskBit`; 0 is good ground truth.
    """

    raw: Tensor
    celsius: Tensor
    depth: Tensor
    normals: Tensor
    mask: Tensor


def open_scenes(folder: Path, split: str, cache: Path | None = None) -> dict[str, ShardReader | PackedScene]:
    """Readers of a split's scenes, by name, sorted: of the shards, or of a cache that must still agree with them.

    Nothing is opened before it is read, each process opens for itself, and readers pickle as paths: workers may be forked or
    spawned.

    Raises
    ------
    DataError
        The manifest or the cache is missing or damaged, the cache is stale or of another split.
    """
    entries = load_manifest(folder).split(split)
    if cache is None:
        return {name: ShardReader(Path(folder) / entry.path, entry.sha256) for name, entry in entries.items()}
    packed = open_cache(cache, folder)
    if packed.keys() != entries.keys():
        raise DataError(
            f"{cache}: is not of the split {split}", hint=f"tofcapture pack {folder} --split {split}"
        )
    return dict(packed)


def all_samples(readers: Mapping[str, ShardReader | PackedScene], frames: int) -> list[SampleId]:
    """Every frame of every view, or the first ``frames`` of each; 0: all."""
    return [
        SampleId(name, view, frame)
        for name, reader in readers.items()
        for view in range(reader.views)
        for frame in range(min(frames or reader.frames, reader.frames))
    ]


def _empty(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Tensor:
    """Memory for a batch: in a loader's worker that which the trainer maps, so that it is not copied again."""
    kind = torch.from_numpy(np.empty(0, dtype)).dtype
    if torch.utils.data.get_worker_info() is None:
        return torch.empty(shape, dtype=kind)
    storage = torch.UntypedStorage._new_shared(math.prod(shape) * dtype.itemsize)  # type: ignore[no-untyped-call]  # noqa: SLF001
    return torch.empty(0, dtype=kind).set_(storage).view(shape)


class ShardDataset(Dataset[RawSample]):
    """All frames of a split as they were taken: a map-style dataset for any training code of one's own.

    Every item is a copy, read at random: one frame's chunk and its view's ground truth, nothing else of the burst. A list of
    indices gives a whole batch at half the cost, which a loader asks for with
    ``DataLoader(data, batch_size=None, sampler=BatchSampler(RandomSampler(data), 8, drop_last=True), num_workers=2)``.

    Parameters
    ----------
    folder
        The dataset.
    split
        ``train``, ``val`` or ``test``.
    cache
        Folder that ``tofcapture pack`` filled with this split; ``None`` reads the shards.
    frames
        Use only the first so many frames of every view; 0: all.

    Raises
    ------
    DataError
        The split is empty, or the cache is not of it.
    """

    def __init__(self, folder: Path, split: str, cache: Path | None = None, frames: int = 0) -> None:
        self.readers = open_scenes(folder, split, cache)
        self.samples = all_samples(self.readers, frames)
        if not self.samples:
            raise DataError(f"{folder}: the split {split} is empty", hint="record more scenes")

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, i: int | Sequence[int]) -> RawSample:
        if not isinstance(i, int):
            return self._batch([self._arrays(k) for k in i])
        # A cache's arrays are its file: they are copied, so that nobody can write into it.
        own = (a if a.flags.owndata and a.flags.writeable else a.copy() for a in self._arrays(i))
        return RawSample(*(torch.from_numpy(a) for a in own))

    def _arrays(self, i: int) -> tuple[NDArray[Any], ...]:
        sample = self.samples[i]
        reader = self.readers[sample.scene]
        gt = reader.ground_truth(sample.view, 2)
        celsius = np.array(reader.celsius(sample.view, sample.frame))
        return reader.raw(sample.view, sample.frame), celsius, gt.depth, gt.normals, gt.mask

    def _batch(self, items: Sequence[tuple[NDArray[Any], ...]]) -> RawSample:
        """Stack samples; the only copy goes where the trainer will find it."""
        columns = list(zip(*items, strict=True))
        out = [_empty((len(items), *column[0].shape), column[0].dtype) for column in columns]
        for tensor, column in zip(out, columns, strict=True):
            np.stack(column, out=tensor.numpy())
        return RawSample(*out)

    def close(self) -> None:
        """Close the files; the next use opens them again."""
        for reader in self.readers.values():
            reader.close()
