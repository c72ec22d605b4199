"""Writes a shard view by view, verifies it, seals it.

::

    with ShardWriter(path, scene, rig, tof_info, stereo_info, views=25) as shard:
        for sample in samples:
            shard.add(sample)
        digest = shard.seal(provenance)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np

from tofcapture.errors import DataError, FormatError
from tofcapture.files.chunks import ChunkWriter
from tofcapture.files.hdf import Array, create, open_checked, write_attrs
from tofcapture.files.info import stereo_table, tof_table
from tofcapture.files.layout import SHARD, VIEW
from tofcapture.files.seal import partial_path, seal
from tofcapture.files.shard import Sample
from tofcapture.files.view import check_scene_name
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.rig import Rig, dumps_rig

_RAW = "tof/raw"
COMPRESSION = 1  # half a per cent more bytes than 4, written and read a third faster (docs/decisions/0012)


def sample_arrays(sample: Sample) -> dict[str, Array]:
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
    if sample.truth is not None:
        rows |= {"truth/depth_2x": sample.truth.depth, "truth/normals_2x": sample.truth.normals}
    return {path: np.asarray(row) for path, row in rows.items()}


class ShardWriter:
    """Streams samples into ``NAME.h5.partial`` and seals it; left without :meth:`seal`, nothing remains.

    Parameters
    ----------
    path
        Final name of the shard.
    scene, rig, tof_info, stereo_info
        Root attributes.
    views
        Number of samples that will be added.
    """

    def __init__(
        self, path: Path, scene: str, rig: Rig, tof_info: TofInfo, stereo_info: StereoInfo, views: int
    ) -> None:
        self._path = Path(path)
        self._scene = check_scene_name(scene)
        self._rig, self._tof, self._stereo = rig, tof_info, stereo_info
        self._views, self._added = views, 0
        self._names: set[str] = set()
        self._chunks = ChunkWriter()
        self._partial = partial_path(self._path)
        self._file: h5py.File | None = None

    def __enter__(self) -> Self:
        self._file = h5py.File(self._partial, "w")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def _create(self, file: h5py.File, rows: Mapping[str, Array]) -> None:
        F, K = rows["tof/raw"].shape[:2]
        (H, W), (SH, SW) = self._rig.tof.shape, self._rig.stereo.shape
        sizes = {"N": self._views, "F": F, "K": K, "H": H, "W": W, "SH": SH, "SW": SW}
        for field in SHARD:
            if field.path in rows:
                create(file, field, field.shape(sizes), rows[field.path].dtype, COMPRESSION)
                self._names.add(field.path)
            elif not field.optional:
                raise FormatError(f"sample: expected /{field.path}, got none")

    def add(self, sample: Sample, view_file: Path | None = None) -> None:
        """Append one sample.

        Parameters
        ----------
        sample
            What to append.
        view_file
            View that it was made of; its packed phase images are copied as they are.

        Raises
        ------
        FormatError
            When a row is missing, or its shape or dtype is not the shard's.
        """
        if self._file is None or self._added >= self._views:
            raise FormatError(f"{self._path}: expected {self._views} samples in an open writer, got one more")
        rows = sample_arrays(sample)
        if not self._added:
            self._create(self._file, rows)
        if rows.keys() != self._names:
            raise FormatError(f"{self._path}: samples disagree on {sorted(rows.keys() ^ self._names)}")
        for name, row in rows.items():
            dataset = self._file[name]
            if row.shape != dataset.shape[1:] or row.dtype != dataset.dtype:
                got = f"{row.dtype} {row.shape}"
                raise FormatError(
                    f"/{name}: expected {dataset.dtype} {dataset.shape[1:]} per view, got {got}"
                )
            if name != _RAW or view_file is None or not self._copy(dataset, row, view_file):
                self._chunks.put(dataset, row, self._added)
            dataset.flush()  # now, not when the last handle goes, which a debugger or profiler may hold: the same bytes
        self._added += 1

    def _copy(self, dataset: h5py.Dataset, row: Array, view_file: Path) -> bool:
        with open_checked(view_file, VIEW) as file:
            return self._chunks.copy(dataset, row, self._added, file[_RAW])

    def seal(self, provenance: Mapping[str, Any]) -> str:
        """Write the attributes, verify every row, make the shard permanent.

        Returns
        -------
        SHA-256 of the file, hexadecimal.

        Raises
        ------
        FormatError
            When fewer samples were added than promised.
        DataError
            When what was read back is not what was written.
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
        self._verify()
        return seal(self._partial, self._path)

    def _verify(self) -> None:
        with open_checked(self._partial, SHARD) as file:
            name = self._chunks.differing(file)
            if name is not None:
                raise DataError(f"{self._path}: {name} read back differs from what was written")
