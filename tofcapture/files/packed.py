"""One scene of a cache: fixed-size records in a flat file, mapped into memory, read like a shard."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.files.hdf import Array
from tofcapture.files.info import tof_from
from tofcapture.files.seal import remember, remembered, verify
from tofcapture.files.shard import GroundTruth, Scale, ShardReader
from tofcapture.frames import TofInfo

SCALE: Scale = 2  # of the ground truth in a cache
AGAIN = "pack the split again"


class PackedScene:
    """Reads one scene of a cache; maps its file on first use, pickles as its path.

    Parameters
    ----------
    folder
        Of the cache.
    scene
        Name.
    entry
        What the index says of the scene.

    Raises
    ------
    DataError
        On first use, when the file is missing or not the one that was packed: it is hashed once per process.
    """

    def __init__(self, folder: Path, scene: str, entry: Mapping[str, Any]) -> None:
        self.path = Path(folder) / f"{scene}.bin"
        self.scene = scene
        self._entry = dict(entry)
        self._map: Array | None = None

    def __getstate__(self) -> dict[str, Any]:
        fresh: dict[str, Any] = {"path": self.path, "scene": self.scene, "_entry": self._entry, "_map": None}
        return {**fresh, "known": remembered(self.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        remember(state["path"], state.pop("known"))
        self.__dict__.update(state)

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Of one record."""
        return dtype_from(self._entry["dtype"])

    @cached_property
    def info(self) -> TofInfo:
        """The ToF camera that took the bursts."""
        return tof_from(self._entry["tof_info"], str(self.path))

    @property
    def camera(self) -> Camera:
        """Intrinsics of the ToF camera."""
        return self.info.camera

    @property
    def views(self) -> int:
        """Number of views."""
        return int(self._entry["views"])

    @property
    def frames(self) -> int:
        """Number of ToF frames per view."""
        return int(self.dtype["raw"].shape[0])

    @property
    def records(self) -> Array:
        """(views,) structured, read-only, mapped into memory: fields raw, celsius, depth, normals, mask."""
        if self._map is None:
            expected = self.views * self.dtype.itemsize
            found = self.path.stat().st_size if self.path.is_file() else None
            if found != expected:
                raise DataError(
                    f"{self.path}: expected {expected} bytes, {'no file' if found is None else found} found",
                    hint=AGAIN,
                )
            verify(self.path, self._entry["sha256"])
            self._map = np.memmap(self.path, self.dtype, mode="r")
        return self._map

    def _record(self, view: int) -> Any:
        if not 0 <= view < self.views:
            raise DataError(f"{self.path}: holds {self.views} views, asked for {view}")
        return self.records[view]

    def raw(self, view: int, frame: int) -> Array:
        """(K, H, W) phase images of one frame, mapped: bytes are read when they are touched."""
        if not 0 <= frame < self.frames:
            raise DataError(f"{self.path}: holds {self.frames} frames a view, asked for {frame}")
        return np.asarray(self._record(view)["raw"][frame])

    def celsius(self, view: int, frame: int) -> float:
        """Sensor temperature of one frame; NaN: not told."""
        return float(self._record(view)["celsius"][frame])

    def ground_truth(self, view: int, scale: Scale = SCALE) -> GroundTruth:
        """Depth, normals and mask at 2x of the ToF image, mapped."""
        if scale != SCALE:
            raise DataError(f"{self.path}: holds ground truth at 2x only, asked for {scale}x")
        record = self._record(view)
        return GroundTruth(*(np.asarray(record[name]) for name in ("depth", "normals", "mask")))

    def close(self) -> None:
        """Drop the mapping; the next use maps again."""
        self._map = None


def record_dtype(shard: ShardReader) -> np.dtype[Any]:
    """Record of one view; float64 first and everything whole, so that no field straddles its alignment."""
    raw, gt = shard.raw(0, 0), shard.ground_truth(0, SCALE)
    fields: list[tuple[str, Any, tuple[int, ...]]] = [("celsius", "<f8", (shard.frames,))]
    fields += [(name, getattr(gt, name).dtype.str, getattr(gt, name).shape) for name in ("depth", "normals")]
    fields += [("raw", raw.dtype.str, (shard.frames, *raw.shape)), ("mask", gt.mask.dtype.str, gt.mask.shape)]
    return np.dtype(fields, align=True)


def dtype_table(dtype: np.dtype[Any]) -> dict[str, Any]:
    """Describe a record as JSON that ``numpy.dtype`` takes."""
    assert dtype.fields is not None
    fields = list(dtype.fields.items())
    return {
        "names": [name for name, _ in fields],
        "formats": [[f[0].base.str, list(f[0].shape)] for _, f in fields],
        "offsets": [f[1] for _, f in fields],
        "itemsize": dtype.itemsize,
    }


def dtype_from(table: Mapping[str, Any]) -> np.dtype[Any]:
    """Read what :func:`dtype_table` wrote."""
    formats = [(base, tuple(shape)) for base, shape in table["formats"]]
    return np.dtype({**table, "formats": formats})  # type: ignore[call-overload,no-any-return]
