"""Export a dataset or a shard in the forms that others read, and read back with others' libraries.

Exports go scene by scene, are resumed, and every file is whole or not there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.dataset.export.clouds import export_ply
from tofcapture.dataset.export.mcap_files import export_mcap
from tofcapture.dataset.export.pictures import export_bop, export_nerfstudio, export_png, finish_bop
from tofcapture.dataset.export.scene import SceneExport
from tofcapture.dataset.export.tables import (
    export_huggingface,
    export_lerobot,
    finish_huggingface,
    finish_lerobot,
)
from tofcapture.errors import ConfigError, FormatError
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import load_manifest, load_signed, signed_text
from tofcapture.files.seal import sealed_digest, sha256_of, write_text
from tofcapture.files.shard import ShardReader

FORMAT, VERSION = "tofcapture-export", 1
INDEX = "export.json"
UNIT = 1 / 8000  # m, of PNG depth: 8.19 m, which holds the 7.5 m that 20 MHz measures; 0.1 mm would not
_AGAIN = "choose another --out, or delete it"


@dataclass(frozen=True)
class Form:
    """One format.

    Attributes
    ----------
    write
        Writes one scene, returns its files.
    finish
        Writes what stands once in the folder, told all scenes.
    numbered
        Files say the scene's number or split: the folder holds one dataset, and a scene whose place changes is written again.
    """

    write: Callable[[SceneExport], list[Path]]
    finish: Callable[[Path, Sequence[SceneExport]], list[Path]] | None = None
    numbered: bool = False


FORMS: Mapping[str, Form] = {
    "ply": Form(export_ply),
    "png16": Form(export_png),
    "mcap": Form(export_mcap),
    "bop": Form(export_bop, finish_bop, numbered=True),
    "nerfstudio": Form(export_nerfstudio),
    "lerobot": Form(export_lerobot, finish_lerobot, numbered=True),
    "huggingface": Form(export_huggingface, finish_huggingface, numbered=True),
}


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
        One of :data:`FORMS`.
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
        ``out`` holds an export of another kind or unit, or, where scenes are numbered, of another dataset.
    """
    if kind not in FORMS or not unit > 0:
        raise ConfigError(f"expected a format of {', '.join(FORMS)} and a positive unit, got {kind}, {unit}")
    out, form = Path(out), FORMS[kind]
    scenes = _scenes(Path(path), out, unit)
    index = _begun(out / INDEX, kind, unit)
    if form.numbered and (others := index["scenes"].keys() - {s.name for s in scenes}):
        raise FormatError(
            f"{out}: expected scenes of {path}, got also {', '.join(sorted(others))}", hint=_AGAIN
        )
    written = []
    for done, scene in enumerate(sorted(scenes, key=lambda s: s.name)):
        entry: dict[str, Any] = {"shard_sha256": scene.sha256}
        if form.numbered:
            entry |= {
                "split": scene.split,
                "place": scene.place,
                "number": scene.number,
                "first": scene.first,
            }
        if not _whole(out, index["scenes"].get(scene.name), entry):
            index.setdefault("left", []).extend(index["scenes"].get(scene.name, {"files": ()})["files"])
            with scene.shard:
                files = form.write(scene)
            index["scenes"][scene.name] = {**entry, "files": _entries(out, files)}
            write_text(out / INDEX, signed_text(index))
            written.append(scene.name)
        if progress:
            progress(scene.name, done + 1, len(scenes))
    once = form.finish(out, scenes) if form.finish else []
    held = [f for s in index["scenes"].values() for f in s["files"]]
    for name in set(index.pop("left", ())) - set(held):  # of scenes that have moved
        (out / name).unlink(missing_ok=True)
    write_text(out / INDEX, signed_text(index))
    sizes = [f["bytes"] for s in index["scenes"].values() for f in s["files"].values()]
    sizes += [p.stat().st_size for p in once]
    return Exported(tuple(sorted(index["scenes"])), tuple(written), len(sizes), sum(sizes))


def _scenes(path: Path, out: Path, unit: float) -> list[SceneExport]:
    """Scenes by split and name, each with its place."""
    if not path.is_dir():
        with ShardReader(path) as shard:
            return [SceneExport(shard.scene, shard, out, unit, sealed_digest(path), views=shard.views)]
    found = load_manifest(path).scenes
    scenes: list[SceneExport] = []
    first = 0
    for split in SPLITS:
        for place, name in enumerate(sorted(n for n, e in found.items() if e.split == split)):
            entry = found[name]
            shard = ShardReader(path / entry.path, entry.sha256)
            scenes.append(
                SceneExport(
                    name, shard, out, unit, entry.sha256, split, place, len(scenes), first, entry.views
                )
            )
            first += entry.views
    return scenes


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


def _whole(out: Path, known: Mapping[str, Any] | None, wanted: Mapping[str, Any]) -> bool:
    """Whether a scene's files are there, byte for byte, of the shard that is there now, and of its place."""
    if known is None or any(known.get(name) != value for name, value in wanted.items()):
        return False
    return all(
        (out / name).is_file() and sha256_of(out / name) == entry["sha256"]
        for name, entry in known["files"].items()
    )
