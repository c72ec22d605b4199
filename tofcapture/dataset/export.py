"""A dataset, or one shard, in forms that other programs read; scene by scene, resumed, every file whole or not there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.dataset.exporters import export_mcap, export_ply, export_png
from tofcapture.errors import ConfigError, FormatError
from tofcapture.files.manifest import load_manifest, load_signed, signed_text
from tofcapture.files.seal import sealed_digest, sha256_of, write_text
from tofcapture.files.shard import ShardReader

FORMAT, VERSION = "tofcapture-export", 1
INDEX = "export.json"
UNIT = 1 / 8000  # m, of PNG depth: 8.19 m, which holds the 7.5 m that 20 MHz measures; 0.1 mm would not
_AGAIN = "choose another --out, or delete it"
Exporter = Callable[[ShardReader, Path, float], list[Path]]
"""Writes one scene below a folder, PNG depth in steps of so many metres; returns its files."""
EXPORTERS: Mapping[str, Exporter] = {"ply": export_ply, "png16": export_png, "mcap": export_mcap}


@dataclass(frozen=True)
class Exported:
    """Report what an export did.

    Attributes
    ----------
    scenes
        All scenes that are in the folder now.
    written
        Those that this call wrote.
    files, size
        Number of files and bytes, of all scenes.
    """

    scenes: tuple[str, ...]
    written: tuple[str, ...]
    files: int
    size: int


def export(
    path: Path,
    kind: str,
    out: Path,
    *,
    unit: float = UNIT,
    progress: Callable[[str, int, int], None] | None = None,
) -> Exported:
    """Export a dataset or a shard, or complete an export that was begun.

    Parameters
    ----------
    path
        A dataset's folder, or a shard.
    kind
        ``ply``, ``png16`` or ``mcap``.
    out
        Folder; scenes in it that come from the same shards and whose files are whole are kept.
    unit
        Metres per step of PNG depth; the others do not use it.
    progress
        Told scene, scenes done and scenes in all.

    Raises
    ------
    ConfigError
        An unknown kind, a unit that is not positive, or a library is missing.
    DataError
        A shard is missing or damaged, or a depth does not fit into 16 bits.
    FormatError
        ``out`` holds an export of another kind or unit.
    """
    if kind not in EXPORTERS or not unit > 0:
        raise ConfigError(
            f"expected a format of {', '.join(EXPORTERS)} and a positive unit, got {kind}, {unit}"
        )
    out, shards = Path(out), _shards(Path(path))
    index = _begun(out / INDEX, kind, unit)
    written = []
    for done, (scene, (shard_path, promised)) in enumerate(sorted(shards.items())):
        digest = promised or sealed_digest(shard_path)
        if not _whole(out, index["scenes"].get(scene), digest):
            with ShardReader(shard_path, promised) as shard:
                files = EXPORTERS[kind](shard, out / scene, unit)
            index["scenes"][scene] = {"shard_sha256": digest, "files": _entries(out, files)}
            write_text(out / INDEX, signed_text(index))
            written.append(scene)
        if progress:
            progress(scene, done + 1, len(shards))
    sizes = [f["bytes"] for s in index["scenes"].values() for f in s["files"].values()]
    return Exported(tuple(sorted(index["scenes"])), tuple(written), len(sizes), sum(sizes))


def _shards(path: Path) -> dict[str, tuple[Path, str | None]]:
    """Shard and promised digest of each scene."""
    if path.is_dir():
        return {name: (path / e.path, e.sha256) for name, e in load_manifest(path).scenes.items()}
    with ShardReader(path) as shard:
        return {shard.scene: (path, None)}


def _begun(path: Path, kind: str, unit: float) -> dict[str, Any]:
    wanted = {"format": FORMAT, "version": VERSION, "kind": kind, "unit": unit}
    if not path.exists():
        return {**wanted, "scenes": {}}
    index = load_signed(path, "export's index", (FORMAT, VERSION), _AGAIN)
    found = {name: index.get(name) for name in wanted}
    if found != wanted:
        raise FormatError(f"{path}: expected {wanted}, got {found}", hint=_AGAIN)
    return index


def _entries(out: Path, files: list[Path]) -> dict[str, dict[str, Any]]:
    return {
        f.relative_to(out).as_posix(): {"bytes": f.stat().st_size, "sha256": sha256_of(f)}
        for f in sorted(files)
    }


def _whole(out: Path, known: Mapping[str, Any] | None, digest: str) -> bool:
    """Whether a scene's files are there, byte for byte, and of the shard that is there now."""
    if known is None or known["shard_sha256"] != digest:
        return False
    return all(
        (out / name).is_file() and sha256_of(out / name) == entry["sha256"]
        for name, entry in known["files"].items()
    )
