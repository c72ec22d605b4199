"""Shards: all views of one scene in one HDF5 file, ready for training.

::

    with ShardReader(dataset / "shards/mug.h5") as shard:
        raw = shard.raw(view=3, frame=0)               # (8, 180, 240)
        gt = shard.ground_truth(view=3, scale=2)       # depth, normals, mask at 360 x 480
        good = gt.mask == 0
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
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
from tofcapture.files.layout import SHARD, SHARD_1, TofFlag
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.normals import normals_from_depth
from tofcapture.poses import Float64
from tofcapture.rig import Rig, loads_rig

Float32 = NDArray[np.float32]
Scale = Literal[1, 2]


@dataclass(frozen=True)
class GroundTruth:
    """Stereo ground truth on the ToF plane at one scale.

    Attributes
    ----------
    depth
        (sH, sW) float32, metres; NaN exactly where the mask says ``NOT_HIT``.
    normals
        (sH, sW, 3) float32, ToF frame, unit, facing the camera; NaN where depth is.
    mask
        (sH, sW) uint8, bits of :class:`tofcapture.files.layout.MaskBit`; 0 is good ground truth.
    """

    depth: Float32
    normals: Float32
    mask: NDArray[np.uint8]


@dataclass(frozen=True)
class TofMaps:
    """The sensor's own answer for a burst, averaged as I and Q.

    Attributes
    ----------
    depth
        (H, W) float32, metres; NaN: none.
    confidence
        (H, W) float32, amplitude of the highest frequency, raw units.
    flags
        (H, W) uint8, bits of :class:`tofcapture.flags.TofFlag`; 0 is a good pixel. An array of bool says which are saturated.
    """

    depth: Float32
    confidence: Float32
    flags: NDArray[np.uint8]

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """(H, W) bool, a tap of a frame reached saturation."""
        out: NDArray[np.bool_] = (self.flags & np.uint8(TofFlag.SATURATED)) != 0
        return out


@dataclass(frozen=True)
class ExactMaps:
    """What only a simulator knows, on the ToF plane at 2x: depth (2H, 2W), metres, and normals (2H, 2W, 3)."""

    depth: Float32
    normals: Float32


@dataclass(frozen=True)
class Sample:
    """One view of a shard: what :func:`tofcapture.dataset.sample.make_sample` makes and the writer stacks.

    Attributes
    ----------
    index
        Number of the view in its recording.
    raw
        (F, K, H, W) phase images as the sensor gave them.
    celsius, time_ns
        (F,).
    tof
        Decoded burst.
    native_depth
        (SH, SW) float32, cropped and denoised stereo depth, stereo frame; NaN: none.
    ground_truth
        By scale, 1 and 2.
    T_base_tof
        (4, 4), from the measured joints.
    truth
        Only from a simulator.
    """

    index: int
    raw: Array
    celsius: Float64
    time_ns: NDArray[np.int64]
    tof: TofMaps
    native_depth: Float32
    ground_truth: Mapping[int, GroundTruth]
    T_base_tof: Float64
    truth: ExactMaps | None = None


class ShardReader:
    """Reads one shard; opens on first use, keeps its handles, pickles as its path, reopens after a fork.

    Parameters
    ----------
    path
        Of the shard.

    Raises
    ------
    DataError, FormatError
        On first use, when the file is missing, damaged, foreign or of another version.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._datasets: dict[str, h5py.Dataset] = {}
        self._pid = -1

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "_file": None, "_datasets": {}, "_pid": -1}

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
            # A handle that crossed a fork shares its file offset with the parent: leave it alone and open anew.
            self._file, self._datasets, self._pid = open_checked(self.path, SHARD, SHARD_1), {}, os.getpid()
        return self._file

    def _dataset(self, name: str) -> h5py.Dataset:
        file = self._open()
        if name not in self._datasets:
            found = file.get(name)
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
        except (OSError, RuntimeError) as err:
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

    def tof(self, view: int) -> TofMaps:
        """Decoded burst."""
        return TofMaps(self._row("tof/depth", view), self._row("tof/confidence", view), self.flags(view))

    def flags(self, view: int) -> NDArray[np.uint8]:
        """(H, W) uint8, bits of :class:`tofcapture.flags.TofFlag`; a shard of version 1 knows of saturation only."""
        name = "tof/flags" if self.version > SHARD_1.version else "tof/saturated"
        return self._row(name, view).astype(np.uint8, copy=False)

    def ground_truth(self, view: int, scale: Scale) -> GroundTruth:
        """Depth, normals and mask at 1x or 2x of the ToF image."""
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
