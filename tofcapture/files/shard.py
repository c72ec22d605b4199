"""Shards: all views of one scene in one HDF5 file, ready for training.

::

    with ShardReader(dataset / "shards/mug.h5") as shard:
        raw = shard.raw(view=3, frame=0)               # (8, 180, 240)
        gt = shard.ground_truth(view=3, scale=2)       # depth, normals, mask at 360 x 480
        good = gt.mask == 0
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError, FormatError
from tofcapture.files.hdf import Array, attr, json_attr, open_checked, text_attr
from tofcapture.files.info import stereo_from, tof_from
from tofcapture.files.layout import SHARD, SHARD_1
from tofcapture.files.maps import ExactMaps, Float32, GroundTruth, Sample, TofMaps
from tofcapture.files.seal import remember, remembered, verify
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.normals import normals_from_depth
from tofcapture.poses import Float64
from tofcapture.rig import Rig, loads_rig

__all__ = ["ExactMaps", "GroundTruth", "Sample", "Scale", "ShardReader", "TofMaps"]

Scale = Literal[1, 2, 4]
_CHECK = "tofcapture check says what is damaged"


def scales_text(scales: Sequence[int]) -> str:
    """Scales in words: ``1x and 2x``."""
    *others, last = (f"{scale}x" for scale in scales)
    return f"{', '.join(others)} and {last}"


class ShardReader:
    """Reads one shard; opens on first use, keeps its handles, pickles as its path, reopens after a fork.

    Parameters
    ----------
    path
        Of the shard.
    sha256
        Its digest in the manifest; ``None``: the one beside it counts, if there is one. On first use the whole file is hashed,
        once per process and for the processes that it hands readers to (docs/decisions/0016).

    Raises
    ------
    DataError, FormatError
        On first use, when the file is missing, damaged, foreign or of another version.
    """

    def __init__(self, path: Path | str, sha256: str | None = None) -> None:
        self.path = Path(path)
        self._sha256 = sha256
        self._file: h5py.File | None = None
        self._datasets: dict[str, h5py.Dataset] = {}
        self._pid = -1

    def __getstate__(self) -> dict[str, Any]:
        fresh: dict[str, Any] = {
            "path": self.path,
            "_sha256": self._sha256,
            "_file": None,
            "_datasets": {},
            "_pid": -1,
        }
        return {**fresh, "known": remembered(self.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        remember(state["path"], state.pop("known"))
        self.__dict__.update(state)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; the next use opens it again."""
        if self._file is not None and self._pid == os.getpid():
            self._file.close()
        self._file, self._datasets = None, {}

    def _open(self) -> h5py.File:
        if self._file is None or self._pid != os.getpid():
            if self.path.is_file():
                verify(self.path, self._sha256)
            # A handle that crossed a fork shares its file offset with the parent: leave it alone and open anew.
            self._file, self._datasets, self._pid = open_checked(self.path, SHARD, SHARD_1), {}, os.getpid()
        return self._file

    def _dataset(self, name: str) -> h5py.Dataset:
        file = self._open()
        if name not in self._datasets:
            try:
                found = file.get(name)
            except (OSError, RuntimeError, ValueError, KeyError) as err:
                raise DataError(f"{self.path}: /{name} cannot be opened: {err}", hint=_CHECK) from err
            if not isinstance(found, h5py.Dataset):
                raise FormatError(f"{self.path}: expected the dataset /{name}, found none")
            self._datasets[name] = found
        return self._datasets[name]

    def _row(self, name: str, *index: int) -> Array:
        dataset = self._dataset(name)
        if not (
            0 <= index[0] < dataset.shape[0]
            and all(0 <= i < n for i, n in zip(index, dataset.shape, strict=False))
        ):
            raise DataError(f"{self.path}: /{name} has shape {dataset.shape}, asked for {index}")
        try:
            return np.asarray(dataset[index])
        except (OSError, RuntimeError, ValueError) as err:
            where = f"/{name}{list(index)}"
            raise DataError(
                f"{self.path}: {where} is damaged: {err}", hint=f"tofcapture check {self.path}"
            ) from err

    @cached_property
    def version(self) -> int:
        """Version of the format that the file is of."""
        return int(attr(self._open(), "version", self.path))

    @cached_property
    def scene(self) -> str:
        """Name of the scene."""
        return text_attr(self._open(), "scene", self.path)

    @cached_property
    def info(self) -> TofInfo:
        """The ToF camera that took the burst."""
        return tof_from(json_attr(self._open(), "tof_info", self.path), str(self.path))

    @cached_property
    def stereo_info(self) -> StereoInfo:
        """The stereo camera."""
        return stereo_from(json_attr(self._open(), "stereo_info", self.path), str(self.path))

    @cached_property
    def rig(self) -> Rig:
        """The rig that the ground truth was projected with."""
        return loads_rig(text_attr(self._open(), "rig", self.path), f"{self.path}: rig")

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Versions, digests of the inputs, config, ground-truth error where the truth is known."""
        return dict(json_attr(self._open(), "provenance", self.path))

    @property
    def camera(self) -> Camera:
        """Intrinsics of the ToF camera."""
        return self.rig.tof

    @cached_property
    def views(self) -> int:
        """Number of views."""
        return int(self._dataset("tof/raw").shape[0])

    @cached_property
    def frames(self) -> int:
        """Number of ToF frames per view."""
        return int(self._dataset("tof/raw").shape[1])

    def raw(self, view: int, frame: int) -> Array:
        """(K, H, W) phase images of one frame, the sensor's integers."""
        return self._row("tof/raw", view, frame)

    def celsius(self, view: int, frame: int) -> float:
        """Sensor temperature of one frame; NaN: not told."""
        return float(self._row("tof/celsius", view, frame))

    def time_ns(self, view: int, frame: int) -> int:
        """When a frame was taken, nanoseconds of the recording's monotonic clock."""
        return int(self._row("tof/time_ns", view, frame))

    def tof(self, view: int) -> TofMaps:
        """Decoded burst."""
        return TofMaps(self._row("tof/depth", view), self._row("tof/confidence", view), self.flags(view))

    def flags(self, view: int) -> NDArray[np.uint8]:
        """(H, W) uint8, bits of :class:`tofcapture.frames.TofFlag`; a shard of version 1 knows of saturation only."""
        name = "tof/flags" if self.version > SHARD_1.version else "tof/saturated"
        return self._row(name, view).astype(np.uint8, copy=False)

    @cached_property
    def scales(self) -> tuple[Scale, ...]:
        """Multiples of the ToF image's resolution that there is ground truth at: 1 and 2, and 4 where it was built."""
        return (1, 2, 4) if "gt/depth_4x" in self._open() else (1, 2)

    def ground_truth(self, view: int, scale: Scale) -> GroundTruth:
        """Depth, normals and mask at 1x, 2x or, where it was built, 4x of the ToF image.

        Raises
        ------
        DataError
            When the shard has none at that scale.
        """
        if scale not in (1, 2) and scale not in self.scales:
            raise DataError(
                f"{self.path}: expected ground truth at {scale}x, it is there at {scales_text(self.scales)}",
                hint="tofcapture build-dataset RECORDING --out DATASET --scales 1 2 4 builds 1x, 2x and 4x",
            )
        return GroundTruth(*(self._row(f"gt/{name}_{scale}x", view) for name in ("depth", "normals", "mask")))

    def native(self, view: int) -> Float32:
        """(SH, SW) float32 cropped and denoised stereo depth, stereo frame, metres; NaN: none."""
        return self._row("gt/native_depth", view)

    def T_base_tof(self, view: int) -> Float64:
        """(4, 4) ToF to base."""
        return self._row("views/T_base_tof", view)

    def index(self, view: int) -> int:
        """Number of the view in its recording."""
        return int(self._row("views/index", view))

    def truth(self, view: int) -> ExactMaps | None:
        """Exact maps of a simulated recording, otherwise ``None``."""
        if "truth" not in self._open():
            return None
        return ExactMaps(self._row("truth/depth_2x", view), self._row("truth/normals_2x", view))

    def tof_points(self, view: int) -> Float64:
        """(H, W, 3) points of the decoded burst, ToF frame, metres."""
        return self.camera.unproject(self.tof(view).depth)

    def tof_normals(self, view: int) -> Float32:
        """(H, W, 3) normals of the decoded burst, ToF frame."""
        return normals_from_depth(self.tof(view).depth, self.camera).astype(np.float32)

    def points(self, view: int, scale: Scale) -> Float64:
        """(sH, sW, 3) ground-truth points, ToF frame, metres."""
        return self.camera.scaled(scale).unproject(self.ground_truth(view, scale).depth)

    def native_points(self, view: int) -> Float64:
        """(SH, SW, 3) ground-truth points at the stereo camera's own resolution, stereo frame, metres."""
        return self.rig.stereo.unproject(self.native(view))

    def native_normals(self, view: int) -> Float32:
        """(SH, SW, 3) ground-truth normals at the stereo camera's own resolution, stereo frame."""
        return normals_from_depth(self.native(view), self.rig.stereo).astype(np.float32)
