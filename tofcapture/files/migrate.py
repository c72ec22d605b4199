"""Rewrite shards of an earlier version of the format as the present one.

A shard is replaced only by a verified whole one. A dataset's manifest and Croissant description follow shard by shard; killed
at any moment and run again, the rest is done.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tofcapture.errors import DataError
from tofcapture.files.hdf import Array, create, dumps, open_checked
from tofcapture.files.layout import SHARD, SHARD_1, TofFlag
from tofcapture.files.manifest import SceneEntry, load_manifest, manifest_path, manifest_text, write_manifest
from tofcapture.files.seal import (
    PARTIAL,
    partial_path,
    seal,
    sealed_digest,
    sha256_of,
    stored_digest,
    write_text,
)
from tofcapture.files.shard import ShardReader
from tofcapture.files.shard_writer import COMPRESSION
from tofcapture.ops.phase import Decoder

Progress = Callable[[Path], None]
_SAME = tuple(f.path for f in SHARD if f.path in {old.path for old in SHARD_1})


@dataclass(frozen=True)
class Migration:
    """What became of one shard.

    Attributes
    ----------
    path
        The shard.
    before
        Version of the format that it was of.
    sha256
        Digest of the file now.
    """

    path: Path
    before: int
    sha256: str

    @property
    def changed(self) -> bool:
        """Whether the shard was rewritten."""
        return self.before != SHARD.version


def migrate(path: Path, progress: Progress | None = None) -> list[Migration]:
    """Bring a shard, or all shards of a dataset, to the present version.

    Parameters
    ----------
    path
        A shard or a dataset's folder.
    progress
        Told each shard before it is looked at.

    Returns
    -------
    One entry per shard; those of the present version are left as they are.

    Raises
    ------
    DataError, FormatError
        A shard is missing, damaged or foreign; those before it are migrated and the manifest knows of them.
    """
    path, tell = Path(path), progress or (lambda _: None)
    if not path.is_dir():
        tell(path)
        return [migrate_shard(path)]
    manifest, done = load_manifest(path), []
    for name, entry in sorted(manifest.scenes.items()):
        tell(path / entry.path)
        found = migrate_shard(path / entry.path, entry.sha256)
        done.append(found)
        if found.sha256 != entry.sha256:
            manifest = replace(
                manifest, scenes={**manifest.scenes, name: replace(entry, sha256=found.sha256)}
            )
            write_manifest(path, manifest)
    if manifest_path(path).read_text(encoding="utf-8") != manifest_text(manifest):
        write_manifest(path, manifest)  # it was of the version that did not carry its own digest
    _describe(path / "croissant.json", dict(manifest.scenes))
    return done


def migrate_shard(path: Path, promised: str | None = None) -> Migration:
    """Bring one shard to the present version.

    Parameters
    ----------
    path
        The shard.
    promised
        Digest in the manifest; ``None``: only the one beside the shard counts.

    Raises
    ------
    DataError, FormatError
        It is missing, damaged, foreign, or not the shard that the manifest promises.
    """
    _finish(path)
    with ShardReader(path) as old:
        version, provenance = old.version, old.provenance
        digest = sealed_digest(path)
        if promised not in (None, digest, provenance.get("migrated", {}).get("sha256")):
            raise DataError(
                f"{path}: expected sha256 {str(promised)[:12]}... as in the manifest, got {digest[:12]}...",
                hint=f"restore it from a copy, or build it again; {manifest_path(path.parents[1])} names it",
            )
        if version == SHARD.version:
            return Migration(path, version, digest)
        provenance["migrated"] = {"version": version, "sha256": digest}
        partial = partial_path(path)
        try:
            digests = _rewrite(old, partial, provenance)
            _verify(partial, path, digests)
            return Migration(path, version, seal(partial, path))
        finally:
            partial.unlink(missing_ok=True)


def _finish(path: Path) -> None:
    """Rename what an earlier run had verified and sealed when it was killed: its digest already lies beside the shard."""
    partial = path.with_name(path.name + PARTIAL)
    if partial.is_file() and sha256_of(partial) == stored_digest(path):
        partial.replace(path)


def _rows(old: ShardReader, name: str, file: h5py.File) -> Iterator[Array]:
    if name != "tof/flags":
        yield from (np.asarray(row) for row in file[name])
        return
    decoder = Decoder(old.info)
    for view in range(old.views):
        decoded = decoder.burst(file["tof/raw"][view], float(np.mean(file["tof/celsius"][view])))
        # What was saturated stays so, whatever this decoder makes of the taps.
        yield (decoded.flags & ~np.uint8(TofFlag.SATURATED)) | old.flags(view)


def _rewrite(old: ShardReader, partial: Path, provenance: dict[str, Any]) -> dict[str, str]:
    """Write every dataset of the present layout; returns the digest of each one's bytes."""
    digests = {}
    with open_checked(old.path, SHARD_1) as source, h5py.File(partial, "w") as file:
        for field in SHARD:
            if field.path not in source and field.path in _SAME:
                continue  # optional; a missing one that is not would have been found by the digest
            like = source[field.path] if field.path in _SAME else source["tof/saturated"]
            dtype = like.dtype if field.path in _SAME else np.dtype(field.dtypes[0])
            dataset, digest = create(file, field, like.shape, dtype, COMPRESSION), hashlib.sha256()
            for i, row in enumerate(_rows(old, field.path, source)):
                dataset[i] = row
                digest.update(row.tobytes())
            digests[field.path] = digest.hexdigest()
        changed = {"version": SHARD.version, "provenance": dumps(provenance)}
        for name, _, _ in SHARD.attrs:
            file.attrs[name] = changed.get(name, source.attrs[name])
    return digests


def _verify(partial: Path, path: Path, digests: dict[str, str]) -> None:
    with open_checked(partial, SHARD) as file:
        for name, expected in digests.items():
            found = hashlib.sha256()
            for row in file[name]:
                found.update(np.asarray(row).tobytes())
            if found.hexdigest() != expected:
                raise DataError(
                    f"{path}: /{name} read back differs from what was written", hint="check the disk"
                )


def _describe(path: Path, scenes: dict[str, SceneEntry]) -> None:
    """Put the digests of the manifest into the Croissant description, where there is one."""
    if not path.is_file():
        return
    text = path.read_text(encoding="utf-8")
    table = json.loads(text)
    digests = {e.path: e.sha256 for e in scenes.values()}
    digests["manifest.json"] = sha256_of(manifest_path(path.parent))
    for entry in table.get("distribution", ()):
        entry["sha256"] = digests.get(entry.get("contentUrl"), entry.get("sha256"))
    old, new = (f"({SHARD.format} {version})" for version in (SHARD_1.version, SHARD.version))
    table["description"] = str(table.get("description", "")).replace(old, new)
    changed = json.dumps(table, indent=1) + "\n"
    if changed != text:
        write_text(path, changed)
