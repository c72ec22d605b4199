"""One split of a dataset as flat files for training: fixed-size records, mapped into memory, nothing to decompress.

::

    pack(dataset, "train", cache)
    scenes = open_cache(cache, dataset)           # PackedScene by name; reads like a ShardReader
    raw = scenes["mug"].raw(view=3, frame=0)

A record is one view: all raw frames, then ground truth at 2x. The shards stay the dataset; a cache can be deleted at any time,
and one whose shards have changed since is refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.errors import DataError, FormatError
from tofcapture.files.hdf import Array, tof_from, tof_table
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import SceneEntry, load_manifest, load_signed, signed_text
from tofcapture.files.seal import (
    remember,
    remembered,
    replacing,
    sealed_digest,
    sha256_of,
    verify,
    write_text,
)
from tofcapture.files.shard import GroundTruth, Scale, ShardReader
from tofcapture.frames import TofInfo

FORMAT, VERSION = "tofcapture-cache", 1
SCALE: Scale = 2  # of the ground truth in a cache
_INDEX = "index.json"
_AGAIN = "pack the split again: tofcapture pack DATASET --split SPLIT --out CACHE"
_MAPS = ("depth", "normals", "mask")
Progress = Callable[[str, int, int], None]
"""Called with a scene, its views that are packed, its views in all."""


class PackedScene:
    """Reads one scene of a cache, as the index describes it; maps its file on first use, pickles as its path.

    On first use it raises :class:`DataError` for a file that is missing or not the one that was packed: it is hashed once per
    process.
    """

    def __init__(self, folder: Path, scene: str, entry: Mapping[str, Any]) -> None:
        self.path = Path(folder) / f"{scene}.bin"
        self.scene = scene
        self._entry = dict(entry)
        self._map: Array | None = None

    def __getstate__(self) -> dict[str, Any]:
        fresh = {"path": self.path, "scene": self.scene, "_entry": self._entry, "_map": None}
        return {**fresh, "known": remembered(self.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        remember(state["path"], state.pop("known"))
        self.__dict__.update(state)

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Of one record."""
        return _dtype(self._entry["fields"])

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
            found = self.path.stat().st_size if self.path.is_file() else "no file"
            if found != expected:
                raise DataError(f"{self.path}: expected {expected} bytes, {found} found", hint=_AGAIN)
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
        return GroundTruth(*(np.asarray(record[name]) for name in _MAPS))

    def close(self) -> None:
        """Drop the mapping; the next use maps again."""
        self._map = None


def pack(dataset: Path, split: str, out: Path, progress: Progress | None = None) -> dict[str, PackedScene]:
    """Pack a split, or complete a cache that was begun.

    Returns the scenes, as :func:`open_cache` gives them.

    Raises :class:`DataError`: the split is empty, or a shard is missing or damaged: its digest is checked
    before it is packed; :class:`FormatError`: ``out`` is a cache of another split.

    Parameters
    ----------
    dataset
        Folder with a manifest.
    split
        ``train``, ``val`` or ``test``.
    out
        The cache's folder; scenes in it that are as the manifest says are kept, others are written anew.
    progress
        Told after each view.
    """
    dataset, out = Path(dataset), Path(out)
    entries = load_manifest(dataset).split(split) if split in SPLITS else {}
    if not entries:
        raise DataError(f"{dataset}: the split {split!r} is empty", hint=f"splits are {', '.join(SPLITS)}")
    index: dict[str, Any] = {"format": FORMAT, "version": VERSION, "split": split, "scenes": {}}
    if (out / _INDEX).exists():
        index = _load_index(out)
        if index["split"] != split:
            raise FormatError(f"{out}: expected a cache of the split {split!r}, it is of {index['split']!r}")
    for name, entry in entries.items():
        known = index["scenes"].get(name)
        if known is None or known["shard_sha256"] != entry.sha256 or not _whole(out, name, known):
            index["scenes"][name] = _pack_scene(dataset / entry.path, entry, out / f"{name}.bin", progress)
            write_text(out / _INDEX, signed_text(index))
    gone = index["scenes"].keys() - entries.keys()
    if gone:  # scenes that left the split leave the cache
        index["scenes"] = {name: index["scenes"][name] for name in entries}
        write_text(out / _INDEX, signed_text(index))
    for name in gone:
        (out / f"{name}.bin").unlink(missing_ok=True)
    return open_cache(out, dataset)


def _whole(out: Path, name: str, known: Mapping[str, Any]) -> bool:
    path = out / f"{name}.bin"
    size = int(known["views"]) * _dtype(known["fields"]).itemsize
    return path.is_file() and path.stat().st_size == size


def _pack_scene(shard_path: Path, entry: SceneEntry, path: Path, progress: Progress | None) -> dict[str, Any]:
    """Write one scene's records; returns its entry of the index."""
    if sealed_digest(shard_path) != entry.sha256:
        raise DataError(
            f"{shard_path}: is not the shard of the manifest", hint=f"tofcapture check {shard_path}"
        )
    digest = hashlib.sha256()
    with ShardReader(shard_path, entry.sha256) as shard, replacing(path) as partial:
        fields = _record_fields(shard)
        with partial.open("wb") as file:
            for view in range(shard.views):
                record = np.zeros((), _dtype(fields))
                record["raw"] = [shard.raw(view, frame) for frame in range(shard.frames)]
                record["celsius"] = [shard.celsius(view, frame) for frame in range(shard.frames)]
                gt = shard.ground_truth(view, SCALE)
                for name in _MAPS:
                    record[name] = getattr(gt, name)
                file.write(record.tobytes())
                digest.update(record.tobytes())
                if progress:
                    progress(shard.scene, view + 1, shard.views)
        return {
            "views": shard.views,
            "fields": fields,
            "sha256": digest.hexdigest(),
            "shard_sha256": entry.sha256,
            "tof_info": tof_table(shard.info),
        }


def _record_fields(shard: ShardReader) -> list[Any]:
    """Name, format and shape of the fields of a record; float64 first, so that no field straddles its alignment."""
    raw, gt = shard.raw(0, 0), shard.ground_truth(0, SCALE)
    maps = {"depth": gt.depth, "normals": gt.normals, "raw": np.broadcast_to(raw, (shard.frames, *raw.shape))}
    maps["mask"] = gt.mask
    return [["celsius", "<f8", [shard.frames]]] + [[n, a.dtype.str, list(a.shape)] for n, a in maps.items()]


def _dtype(fields: list[Any]) -> np.dtype[Any]:
    return np.dtype([(name, kind, tuple(shape)) for name, kind, shape in fields], align=True)


def _load_index(cache: Path) -> dict[str, Any]:
    return load_signed(Path(cache) / _INDEX, "cache's index", (FORMAT, VERSION), _AGAIN)


def is_cache(folder: Path) -> bool:
    """Tell whether a folder says that it is a cache, damaged or not."""
    path = folder / _INDEX
    return path.is_file() and FORMAT.encode() in path.read_bytes()


def open_cache(cache: Path, dataset: Path | None = None) -> dict[str, PackedScene]:
    """Open the scenes of a cache, by name, sorted.

    :class:`DataError` when the index is missing or damaged or, told the dataset that it was packed from, when the cache no longer
    agrees with the manifest; :class:`FormatError` when it is no cache, or of another version.
    """
    cache = Path(cache)
    index = _load_index(cache)
    scenes = {name: PackedScene(cache, name, entry) for name, entry in sorted(index["scenes"].items())}
    if dataset is not None:
        packed = {name: entry["shard_sha256"] for name, entry in index["scenes"].items()}
        now = {name: entry.sha256 for name, entry in load_manifest(dataset).split(index["split"]).items()}
        changed = sorted(k for k in now.keys() | packed.keys() if now.get(k) != packed.get(k))
        if changed:
            raise DataError(
                f"{cache}: is stale: {', '.join(changed)} changed in {dataset} since",
                hint=f"tofcapture pack {dataset} --split {index['split']} --out {cache}",
            )
    return scenes


def verify_cache(cache: Path) -> list[str]:
    """Hash every file; names of the scenes whose file is not the one that was packed."""
    scenes = _load_index(cache)["scenes"]
    paths = {name: Path(cache) / f"{name}.bin" for name in sorted(scenes)}
    return [n for n, p in paths.items() if not p.is_file() or sha256_of(p) != scenes[n]["sha256"]]
