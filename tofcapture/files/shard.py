"""Shards: all views of one scene in one HDF5 file, ready for training.

::

    with open_shard(dataset / "shards/mug.h5") as shard:
        raw = shard.raw(view=3, frame=0)               # (8, 180, 240)
        gt = shard.ground_truth(view=3, scale=2)       # depth, normals, mask at 360 x 480
        good = gt.mask == 0

    with ShardWriter(path, scene, rig, tof_info, stereo_info, views=25) as shard:
        for sample in samples:
            shard.add(sample)
        digest = shard.seal(provenance)
"""

from __future__ import annotations

import operator
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, SupportsIndex

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.hdf import (
    Array,
    create,
    find,
    json_attr,
    open_checked,
    open_h5,
    read,
    stereo_from,
    stereo_table,
    text_attr,
    tof_from,
    tof_table,
    write_attrs,
)
from tofcapture.files.layout import SHARD, VIEW
from tofcapture.files.seal import partial_path, remember, remembered, seal, verify
from tofcapture.files.view import check_scene_name
from tofcapture.frames import StereoInfo, TofFlag, TofInfo
from tofcapture.ops.normals import normals_from_depth
from tofcapture.poses import Float64
from tofcapture.rig import Rig, dumps_rig, loads_rig

Float32 = NDArray[np.float32]
Scale = Literal[1, 2, 4]


@dataclass(frozen=True)
class GroundTruth:
    """Hold stereo ground truth on the ToF plane at one scale.

    Attributes
    ----------
    depth
        (sH, sW) float32, metres; NaN exactly where the mask says ``NOT_HIT``.
    normals
        (sH, sW, 3) float32, ToF frame, unit, facing the camera; NaN where depth is.
    mask
        (sH, sW) uint8, bits of :class:`tofcapture.files.layout.MaskBit`; 0 is good ground truth.
    sigma
        (sH, sW) float32, metres, one standard deviation of depth; NaN: not known. ``None``: the shard was built of single views.
    views
        (sH, sW) int8, how many views the depth is made of; negative where the view's own stereo camera is not among them.
    """

    depth: Float32
    normals: Float32
    mask: NDArray[np.uint8]
    sigma: Float32 | None = None
    views: NDArray[np.int8] | None = None


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
        (H, W) uint8, bits of :class:`tofcapture.frames.TofFlag`; 0 is a good pixel.
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
    """Hold what only a simulator knows, on the ToF plane at 2x: depth (2H, 2W), metres, and normals (2H, 2W, 3)."""

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
        By scale: 1 and 2, and 4 where it is wanted.
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


def open_shard(path: str | Path) -> ShardReader:
    """Open a shard and look at it: what is wrong with it is raised here, as :class:`ShardReader` says."""
    shard = ShardReader(path)
    shard.scene  # noqa: B018  the whole file is hashed here
    return shard


def is_shard(path: Path) -> bool:
    """Whether a file says that it is a shard; one that cannot be opened says nothing."""
    try:
        with open_h5(path) as file:
            return str(file.attrs.get("format", "")) == "tofcapture-shard"
    except DataError:
        return False


def scales_text(scales: Sequence[int]) -> str:
    """Say scales in words: ``1x and 2x``."""
    *others, last = (f"{scale}x" for scale in scales)
    return f"{', '.join(others)} and {last}"


class ShardReader:
    """Reads one shard; opens on first use, keeps its handles, pickles as its path.

    A reader in use may cross a fork: HDF5 reads by position, so that processes share no offset. It is a sequence of the scene's
    views, each a :class:`Sample`. Views and frames are counted from the end where they are negative.

    Raises :class:`DataError`, :class:`FormatError`: on first use: a file that is missing, damaged, foreign or
    of another version.

    ``sha256`` is its digest in the manifest; without, the one beside it counts, if there is one. On first use the whole file
    is hashed, once per process and for the processes that it hands readers to (docs/decisions/0016).
    """

    def __init__(self, path: Path | str, sha256: str | None = None) -> None:
        self.path = Path(path)
        self._sha256 = sha256
        self._closed()

    def _closed(self) -> None:
        self._file: h5py.File | None = None
        self._datasets: dict[str, h5py.Dataset] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "sha256": self._sha256, "known": remembered(self.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        remember(state["path"], state["known"])
        self.path, self._sha256 = state["path"], state["sha256"]
        self._closed()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; the next use opens it again."""
        if self._file is not None:
            self._file.close()
        self._closed()

    def _open(self) -> h5py.File:
        if self._file is None:
            if self.path.is_file():
                verify(self.path, self._sha256)
            self._file = open_checked(self.path, SHARD)
        return self._file

    def _dataset(self, name: str) -> h5py.Dataset:
        file = self._open()
        if name not in self._datasets:
            self._datasets[name] = find(file, SHARD[name], self.path)
        return self._datasets[name]

    def _row(self, name: str, *index: int) -> Array:
        dataset = self._dataset(name)
        if not all(-n <= i < n for i, n in zip(index, dataset.shape, strict=False)):
            raise DataError(f"{self.path}: /{name} has shape {dataset.shape}, asked for {index}")
        return read(dataset, self.path, tuple(i % n for i, n in zip(index, dataset.shape, strict=False)))

    def __repr__(self) -> str:
        held = "not opened yet" if self._file is None else f"{self.scene}, {self.views} views"
        return f"ShardReader({str(self.path)!r}, {held})"

    def __len__(self) -> int:
        return self.views

    def __bool__(self) -> bool:
        return True  # whatever it holds; asking must not open the file

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(self.views))

    def __getitem__(self, view: SupportsIndex) -> Sample:
        at = operator.index(view)
        if not -self.views <= at < self.views:
            raise IndexError(f"{self!r}: no view {at}")
        return Sample(
            index=self.index(at),
            raw=self.burst(at),
            celsius=self._row("tof/celsius", at),
            time_ns=self._row("tof/time_ns", at),
            tof=self.tof(at),
            native_depth=self.native(at),
            ground_truth={scale: self.ground_truth(at, scale) for scale in self.scales},
            T_base_tof=self.T_base_tof(at),
            truth=self.truth(at),
        )

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
        try:
            return loads_rig(text_attr(self._open(), "rig", self.path), f"{self.path}: rig")
        except ConfigError as err:  # this rig is no configuration of somebody's: the file is damaged
            raise FormatError(err.message, hint=f"tofcapture check {self.path}") from err

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

    def burst(self, view: int) -> Array:
        """(F, K, H, W) phase images of all frames of a view."""
        return self._row("tof/raw", view)

    def celsius(self, view: int, frame: int) -> float:
        """Sensor temperature of one frame; NaN: not told."""
        return float(self._row("tof/celsius", view, frame))

    def time_ns(self, view: int, frame: int) -> int:
        """When a frame was taken, nanoseconds of the recording's monotonic clock."""
        return int(self._row("tof/time_ns", view, frame))

    def tof(self, view: int) -> TofMaps:
        """Decoded burst."""
        return TofMaps(*(self._row(f"tof/{name}", view) for name in ("depth", "confidence", "flags")))

    @cached_property
    def scales(self) -> tuple[Scale, ...]:
        """Multiples of the ToF image's resolution that there is ground truth at: 1 and 2, and 4 where it was built."""
        return (1, 2, 4) if "gt/depth_4x" in self._open() else (1, 2)

    @cached_property
    def fused(self) -> bool:
        """Whether the ground truth is of all views of the scene, with the standard deviation of every pixel."""
        return "fused" in self._open()

    def ground_truth(self, view: int, scale: Scale) -> GroundTruth:
        """Depth, normals and mask at 1x, 2x or, where it was built, 4x of the ToF image; else :class:`DataError`."""
        if scale not in (1, 2) and scale not in self.scales:
            raise DataError(
                f"{self.path}: expected ground truth at {scale}x, it is there at {scales_text(self.scales)}",
                hint="tofcapture build-dataset RECORDING --out DATASET --scales 1 2 4 builds 1x, 2x and 4x",
            )
        maps = [f"gt/{name}_{scale}x" for name in ("depth", "normals", "mask")]
        maps += [f"fused/{name}_{scale}x" for name in ("sigma", "views")] if self.fused else []
        return GroundTruth(*(self._row(name, view) for name in maps))

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


def _rows(sample: Sample) -> dict[str, Array]:
    """One row of every dataset of a shard, by its path."""
    rows: dict[str, Any] = {
        "tof/raw": sample.raw,
        "tof/celsius": sample.celsius,
        "tof/time_ns": sample.time_ns,
        "tof/depth": sample.tof.depth,
        "tof/confidence": sample.tof.confidence,
        "tof/flags": np.asarray(sample.tof.flags, dtype=np.uint8),
        "gt/native_depth": sample.native_depth,
        "views/T_base_tof": sample.T_base_tof,
        "views/index": np.int64(sample.index),
    }
    for scale, gt in sample.ground_truth.items():
        rows |= {f"gt/{name}_{scale}x": getattr(gt, name) for name in ("depth", "normals", "mask")}
        if gt.sigma is not None:
            rows |= {f"fused/{name}_{scale}x": getattr(gt, name) for name in ("sigma", "views")}
    if sample.truth is not None:
        rows |= {"truth/depth_2x": sample.truth.depth, "truth/normals_2x": sample.truth.normals}
    return {path: np.asarray(row) for path, row in rows.items()}


def _copied(view_file: Path, target: h5py.Dataset, row: int) -> bool:
    """Copy a view's burst as it is packed: unpacking aside, this is a fifth of the time that a view costs.

    ``False``, and nothing done, where the two are not stored alike.
    """
    with open_checked(view_file, VIEW) as file:
        source = find(file, VIEW["tof/raw"], view_file)
        kinds = ("dtype", "compression", "shuffle", "fletcher32")
        alike = all(getattr(source, kind) == getattr(target, kind) for kind in kinds)
        if not alike or source.chunks != target.chunks[1:] or source.shape[1:] != source.chunks[1:]:
            return False
        for frame in range(len(source)):
            mask, packed = source.id.read_direct_chunk((frame, 0, 0, 0))
            target.id.write_direct_chunk((row, frame, 0, 0, 0), packed, mask)
    return True


def _checksum(row: Array) -> int:
    return zlib.crc32(np.ascontiguousarray(row).data)


class ShardWriter:
    """Streams samples into ``NAME.h5.partial`` and seals it; left without :meth:`seal`, nothing remains.

    ``path`` is its final name, ``views`` the number of samples that will be added; the others become root attributes.
    """

    def __init__(
        self, path: Path, scene: str, rig: Rig, tof_info: TofInfo, stereo_info: StereoInfo, views: int
    ) -> None:
        self._path, self._scene = Path(path), check_scene_name(scene)
        self._rig, self._tof, self._stereo = rig, tof_info, stereo_info
        self._views = views
        self._written: dict[str, list[int]] = {}  # checksums of the rows, by dataset
        self._added = 0
        self._partial = partial_path(self._path)
        self._file: h5py.File | None = None

    def __enter__(self) -> Self:
        self._file = h5py.File(self._partial, "w", locking=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._file is not None:
                self._file.close()
        finally:
            self._partial.unlink(missing_ok=True)

    def _create(self, file: h5py.File, rows: Mapping[str, Array]) -> None:
        F, K = rows["tof/raw"].shape[:2]
        (H, W), (SH, SW) = self._rig.tof.shape, self._rig.stereo.shape
        sizes = {"N": self._views, "F": F, "K": K, "H": H, "W": W, "SH": SH, "SW": SW}
        for field in SHARD:
            if field.path in rows:
                create(file, field, field.shape(sizes), rows[field.path].dtype)
                self._written[field.path] = []
            elif not field.optional:
                raise FormatError(f"sample: expected /{field.path}, got none")

    def add(self, sample: Sample, view_file: Path | None = None) -> None:
        """Append one sample; :class:`FormatError` when a row is missing or has another shape or dtype than the shard's.

        Told the view that it was made of, the writer copies that one's packed phase images.
        """
        if self._file is None or self._added >= self._views:
            raise FormatError(f"{self._path}: expected {self._views} samples in an open writer, got one more")
        rows = _rows(sample)
        if not self._added:
            self._create(self._file, rows)
        if rows.keys() != self._written.keys():
            raise FormatError(
                f"{self._path}: samples disagree on {sorted(rows.keys() ^ self._written.keys())}"
            )
        for name, row in rows.items():
            dataset = self._file[name]
            if row.shape != dataset.shape[1:] or row.dtype != dataset.dtype:
                got = f"{row.dtype} {row.shape}"
                raise FormatError(
                    f"/{name}: expected {dataset.dtype} {dataset.shape[1:]} per view, got {got}"
                )
            if name != "tof/raw" or view_file is None or not _copied(view_file, dataset, self._added):
                dataset[self._added] = row
            dataset.flush()  # now, not when the last handle goes, which a debugger or profiler may hold: the same bytes
            self._written[name].append(_checksum(row))
        self._added += 1

    def seal(self, provenance: Mapping[str, Any]) -> str:
        """Write the attributes, verify every row, make the shard permanent; its SHA-256, hexadecimal.

        :class:`FormatError` when samples are missing, :class:`DataError` when what is read back is not what was written.
        """
        if self._file is None or self._added != self._views:
            raise FormatError(f"{self._path}: expected {self._views} samples, got {self._added}")
        attrs = {
            "scene": self._scene,
            "rig": dumps_rig(self._rig),
            "tof_info": tof_table(self._tof),
            "stereo_info": stereo_table(self._stereo),
            "provenance": dict(provenance),
        }
        write_attrs(self._file, SHARD, attrs)
        self._file.close()
        self._file = None
        with open_checked(self._partial, SHARD) as file:
            for name, sums in self._written.items():
                if any(_checksum(file[name][i]) != expected for i, expected in enumerate(sums)):
                    raise DataError(
                        f"{self._path}: /{name} read back differs from what was written",
                        hint="check the disk",
                    )
        return seal(self._partial, self._path)
