"""Read a dataset view by view, as any map-style data set: ``len``, an index, iteration; no torch is needed for that."""

from __future__ import annotations

import operator
from bisect import bisect_right
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import load_manifest
from tofcapture.files.shard import Scale, ShardReader
from tofcapture.poses import Float64

Float32 = NDArray[np.float32]


class DatasetView(NamedTuple):
    """One view of a dataset: what went into the sensor's burst, what it answered, and what is true.

    Everything is an array, a number or text, so that torch's ``DataLoader`` makes batches of it as it is. H, W are the sensor's
    rows and columns, s is the scale of the ground truth. Frame: ToF camera, x right, y down, z forward.
    """

    scene: str
    view: int  #: its number in the recording
    raw: NDArray[Any]  #: (F, K, H, W) phase images, the sensor's integers
    celsius: Float64  #: (F,) temperature of the sensor; NaN: not told
    tof_depth: Float32  #: (H, W) metres, the sensor's own, of the mean burst; NaN: none
    confidence: Float32  #: (H, W) amplitude, raw units
    flags: NDArray[np.uint8]  #: (H, W) bits of :class:`tofcapture.frames.TofFlag`
    depth: Float32  #: (sH, sW) metres, ground truth; NaN: none
    normals: Float32  #: (sH, sW, 3) unit, facing the camera; NaN: none
    mask: NDArray[
        np.uint8
    ]  #: (sH, sW) bits of :class:`tofcapture.files.layout.MaskBit`; 0 is good ground truth
    sigma: Float32  #: (sH, sW) metres, one standard deviation of depth; NaN: not known, as where the truth is not fused
    intrinsics: Float64  #: (4,) fx, fy, cx, cy of the sensor's image, pixels
    T_base_tof: Float64  #: (4, 4) ToF camera to the arm's base


class Dataset:
    """All views of a dataset, or of one of its splits, by scene and number.

    Raises :class:`DataError`: the manifest is missing or damaged; at an index, a shard is;
    :class:`ConfigError`: there is no such split.

    Parameters
    ----------
    folder
        What ``build-dataset`` filled.
    split
        ``train``, ``val`` or ``test``; ``None``: all scenes.
    scale
        Of the ground truth: 1, 2 or, where it was built, 4 times the sensor's resolution.

    Attributes
    ----------
    shards
        :class:`tofcapture.files.shard.ShardReader` by scene. Each opens on first use and pickles as its path.
    """

    def __init__(self, folder: str | Path, split: str | None = None, scale: Scale = 2) -> None:
        if split is not None and split not in SPLITS:
            raise ConfigError(f"expected a split of {', '.join(SPLITS)}, or None, got {split!r}")
        manifest = load_manifest(Path(folder))
        entries = dict(sorted(manifest.scenes.items())) if split is None else manifest.split(split)
        self.folder, self.split, self.scale = Path(folder), split, scale
        self.shards = {
            name: ShardReader(self.folder / entry.path, entry.sha256) for name, entry in entries.items()
        }
        self._ends = list(accumulate(entry.views for entry in entries.values()))

    def __repr__(self) -> str:
        which = "all splits" if self.split is None else self.split
        return f"Dataset({str(self.folder)!r}, {which}: {len(self.shards)} scenes, {len(self)} views)"

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: SupportsIndex) -> DatasetView:
        asked = operator.index(index)
        at = asked + len(self) if asked < 0 else asked
        if not 0 <= at < len(self):
            raise IndexError(f"{self!r}: no view {asked}")
        which = bisect_right(self._ends, at)
        scene, shard = list(self.shards.items())[which]
        view = at - (self._ends[which - 1] if which else 0)
        camera, tof, truth = shard.camera, shard.tof(view), shard.ground_truth(view, self.scale)
        return DatasetView(
            scene,
            shard.index(view),
            shard.burst(view),
            np.array([shard.celsius(view, frame) for frame in range(shard.frames)]),
            tof.depth,
            tof.confidence,
            tof.flags,
            truth.depth,
            truth.normals,
            truth.mask,
            np.full(truth.depth.shape, np.nan, np.float32) if truth.sigma is None else truth.sigma,
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            shard.T_base_tof(view),
        )

    def __iter__(self) -> Iterator[DatasetView]:
        return (self[i] for i in range(len(self)))
