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
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import DataError, FormatError
from tofcapture.files.info import tof_table
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import SceneEntry, load_manifest
from tofcapture.files.packed import AGAIN, SCALE, PackedScene, dtype_from, dtype_table, record_dtype
from tofcapture.files.seal import fsync, partial_path, sealed_digest, sha256_of, write_text
from tofcapture.files.shard import ShardReader
from tofcapture.files.signed import parse_json, parse_signed, signed_text

FORMAT, VERSION = "tofcapture-cache", 1
_INDEX = "index.json"


def pack(
    dataset: Path, split: str, out: Path, progress: Callable[[str, int, int], None] | None = None
) -> dict[str, PackedScene]:
    """Pack a split, or complete a cache that was begun.

    Parameters
    ----------
    dataset
        Folder with a manifest.
    split
        ``train``, ``val`` or ``test``.
    out
        The cache's folder; scenes in it that are as the manifest says are kept, others are written anew.
    progress
        Told scene, views done and views in all.

    Returns
    -------
    The scenes, as :func:`open_cache` gives them.

    Raises
    ------
    DataError
        The split is empty, or a shard is missing or damaged: its digest is checked before it is packed.
    FormatError
        ``out`` is a cache of another split.
    """
    dataset, out = Path(dataset), Path(out)
    entries = load_manifest(dataset).split(split) if split in SPLITS else {}
    if not entries:
        raise DataError(f"{dataset}: the split {split!r} is empty", hint=f"splits are {', '.join(SPLITS)}")
    index = _begun(out, split)
    for name, entry in entries.items():
        known = index["scenes"].get(name)
        if known is None or known["shard_sha256"] != entry.sha256 or not _whole(out, name, known):
            index["scenes"][name] = _pack_scene(dataset / entry.path, entry, out / f"{name}.bin", progress)
            write_text(out / _INDEX, signed_text(index))
    _forget(out, index, entries)
    return open_cache(out, dataset)


def _begun(out: Path, split: str) -> dict[str, Any]:
    if not (out / _INDEX).exists():
        out.mkdir(parents=True, exist_ok=True)
        return {"format": FORMAT, "version": VERSION, "split": split, "scenes": {}}
    index = _load_index(out)
    if index["split"] != split:
        raise FormatError(f"{out}: expected a cache of the split {split!r}, it is of {index['split']!r}")
    return index


def _whole(out: Path, name: str, known: Mapping[str, Any]) -> bool:
    path = out / f"{name}.bin"
    size = int(known["views"]) * dtype_from(known["dtype"]).itemsize
    return path.is_file() and path.stat().st_size == size


def _pack_scene(
    shard_path: Path, entry: SceneEntry, path: Path, progress: Callable[[str, int, int], None] | None
) -> dict[str, Any]:
    """Write one scene's records under a temporary name, fsync, rename; returns its entry of the index."""
    found = sealed_digest(shard_path)
    if found != entry.sha256:
        raise DataError(
            f"{shard_path}: is not the shard of the manifest", hint=f"tofcapture check {shard_path}"
        )
    partial, digest = partial_path(path), hashlib.sha256()
    with ShardReader(shard_path, entry.sha256) as shard, partial.open("wb") as file:
        dtype = record_dtype(shard)
        for view in range(shard.views):
            record = np.zeros((), dtype)
            record["raw"] = [shard.raw(view, frame) for frame in range(shard.frames)]
            record["celsius"] = [shard.celsius(view, frame) for frame in range(shard.frames)]
            gt = shard.ground_truth(view, SCALE)
            for name in ("depth", "normals", "mask"):
                record[name] = getattr(gt, name)
            data = record.tobytes()
            file.write(data)
            digest.update(data)
            if progress:
                progress(shard.scene, view + 1, shard.views)
        info, views = tof_table(shard.info), shard.views
    fsync(partial)
    partial.replace(path)
    fsync(path.parent)
    return {
        "views": views,
        "dtype": dtype_table(dtype),
        "sha256": digest.hexdigest(),
        "shard_sha256": entry.sha256,
        "tof_info": info,
    }


def _forget(out: Path, index: dict[str, Any], entries: Mapping[str, SceneEntry]) -> None:
    """Scenes that left the split leave the cache."""
    gone = index["scenes"].keys() - entries.keys()
    if not gone:
        return
    for name in gone:
        del index["scenes"][name]
    write_text(out / _INDEX, signed_text(index))
    for name in gone:
        (out / f"{name}.bin").unlink(missing_ok=True)


def _load_index(cache: Path) -> dict[str, Any]:
    path = Path(cache) / _INDEX
    try:
        data = path.read_bytes()
    except OSError as err:
        raise DataError(
            f"{path}: cannot read the cache's index: {err}", hint="tofcapture pack DATASET"
        ) from err
    index = parse_json(data, str(path), AGAIN)
    if (index.get("format"), index.get("version")) != (FORMAT, VERSION):
        raise FormatError(f"{path}: expected {FORMAT} version {VERSION}", hint=AGAIN)
    return parse_signed(data, str(path), AGAIN)


def is_cache(folder: Path) -> bool:
    """Whether a folder says that it is a cache, damaged or not."""
    path = folder / _INDEX
    return path.is_file() and FORMAT.encode() in path.read_bytes()


def open_cache(cache: Path, dataset: Path | None = None) -> dict[str, PackedScene]:
    """Scenes of a cache, by name, sorted.

    Parameters
    ----------
    cache
        Folder that :func:`pack` filled.
    dataset
        What it was packed from: with it, a cache that no longer agrees with the manifest is refused.

    Raises
    ------
    DataError
        The index is missing or damaged, or the cache is stale or incomplete.
    FormatError
        It is no cache, or of another version.
    """
    cache = Path(cache)
    index = _load_index(cache)
    try:
        scenes = {name: dict(entry) for name, entry in sorted(index["scenes"].items())}
        packed = {name: entry["shard_sha256"] for name, entry in scenes.items()}
        split = str(index["split"])
        for entry in scenes.values():
            dtype_from(entry["dtype"])
            int(entry["views"])
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise FormatError(f"{cache}: the index lacks or garbles a part: {err!r}", hint=AGAIN) from err
    if dataset is not None:
        now = {name: entry.sha256 for name, entry in load_manifest(dataset).split(split).items()}
        if now != packed:
            changed = sorted(k for k in now.keys() | packed.keys() if now.get(k) != packed.get(k))
            raise DataError(
                f"{cache}: is stale: {', '.join(changed)} changed in {dataset} since",
                hint=f"tofcapture pack {dataset} --split {split} --out {cache}",
            )
    return {name: PackedScene(cache, name, entry) for name, entry in scenes.items()}


def verify_cache(cache: Path) -> list[str]:
    """Names of scenes whose file is not the one that was packed; hashes every byte."""
    scenes = _load_index(cache)["scenes"]
    paths = {name: Path(cache) / f"{name}.bin" for name in sorted(scenes)}
    return [n for n, p in paths.items() if not p.is_file() or sha256_of(p) != scenes[n]["sha256"]]
