"""List every problem of a view, a shard, a recording, a dataset or a cache; never raise on bad data."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import TofError
from tofcapture.files.cache import is_cache, open_cache, verify_cache
from tofcapture.files.check_file import Problem, check_file, guarded
from tofcapture.files.disk import is_there, read_rows
from tofcapture.files.hdf import json_attr, open_h5
from tofcapture.files.manifest import SceneEntry, load_manifest, manifest_path, object_of
from tofcapture.files.seal import digest_path, sha256_of
from tofcapture.files.view import list_views
from tofcapture.rig import load_rig

__all__ = ["Problem", "check"]

Tell = Callable[[Path], None]
Scenes = Mapping[str, SceneEntry]
UNFINISHED = "importing"
"""Folder of a recording in which scenes are imported; they lie among the views once they are whole."""
_AGAIN = "run build-dataset again"
_BESIDE = ("README", "LICENSE", "LICENCE", "CITATION", "CHANGELOG", "NOTICE")
_SEALED = "SELECT scene, \"index\", sha256 FROM views WHERE state = 'sealed'"
_OWN = ("manifest.json", "croissant.json", "shards", "simulation", "stats.html", "stats.json")


def check(path: Path, progress: Tell | None = None) -> list[Problem]:
    """List every problem of a view file, a shard, the folder of a recording, a dataset or a cache; none when all is well.

    ``progress`` is told each file before it is read. Whatever the data, this does not raise.
    """
    path, tell = Path(path), progress or (lambda _: None)
    if path.is_dir():
        return guarded(path, lambda: _check_folder(path, tell))
    tell(path)
    return check_file(path)


def _check_folder(path: Path, tell: Tell) -> Iterator[Problem]:
    recording = (path / "views").is_dir() or (path / UNFINISHED).is_dir()
    dataset = manifest_path(path).exists() or (path / "shards").is_dir()
    if recording:
        yield from _check_recording(path, tell)
    if dataset:
        yield from _check_dataset(path, tell)
    if not recording and not dataset and is_cache(path):
        tell(path)
        yield from _check_cache(path)
    elif not recording and not dataset:
        wanted = "expected a recording (views/) or a dataset (manifest.json), found neither"
        yield Problem(path, "", wanted, "give its own folder, or a view, a shard or a cache")


def _check_recording(path: Path, tell: Tell) -> Iterator[Problem]:
    promised, problems = _journal(path)
    yield from problems
    scenes, others = list_views(path)
    views = [view for scene in scenes.values() for view in scene]
    for other, why in others.items():
        yield Problem(other, "", f"passed over: {why}", "move it out of the recording")
    if not views:
        yield Problem(
            path, "", "expected views, found none", "tofcapture record --scene NAME --out RECORDING"
        )
    for view in views:
        tell(view)
        yield from check_file(view, promised.pop((view.parent.name, view.name), None))
    for scene, name in sorted(promised):
        yield Problem(
            path / "views" / scene / name, "", "sealed in the journal, but not there", "record again"
        )
    for left in sorted((path / UNFINISHED).glob("*")):
        yield Problem(
            left, "", "an import of this scene was not finished", "run the same import again, or delete it"
        )
    readers: dict[str, Callable[[Path], Any]] = {"rig.toml": load_rig, "evidence.json": _load_json}
    for name, read in readers.items():
        if (path / name).exists():
            yield from guarded(path / name, partial(_parses, read, path / name))


def _parses(read: Callable[[Path], Any], path: Path) -> Iterator[Problem]:
    read(path)
    yield from ()


def _load_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _journal(recording: Path) -> tuple[dict[tuple[str, str], str], list[Problem]]:
    """Digests that the journal promises, by (scene, file name)."""
    path = recording / "journal.sqlite"
    if not is_there(path):
        return {}, []
    again = "move it away: tofcapture record rebuilds it from the sealed views"
    try:
        rows = read_rows(path, _SEALED, "a journal", again)
        return {(scene, f"view-{int(index):03d}.h5"): sha for scene, index, sha in rows if sha}, []
    except TofError as err:
        return {}, [Problem(path, "", err.message.removeprefix(f"{path}: "), err.hint)]
    except (ValueError, TypeError) as err:
        return {}, [Problem(path, "", f"damaged: {err}", again)]


def _check_cache(cache: Path, dataset: Path | None = None) -> Iterator[Problem]:
    """Problems of a packed split: damaged files, strays, and, told the dataset, that it is stale."""
    scenes = open_cache(cache, dataset)
    for name in verify_cache(cache):
        yield Problem(cache / f"{name}.bin", "", "is not the file that was packed", "pack the split again")
    known = {"index.json", *(f"{name}.bin" for name in scenes)}
    for path in sorted(p for p in cache.iterdir() if p.name not in known):
        yield Problem(path, "", "the index does not know of it", "delete it")


def _check_dataset(path: Path, tell: Tell) -> Iterator[Problem]:
    """Problems of a dataset as a whole: manifest, shards, duplicates, leakage, strays, caches."""
    scenes, sound = load_manifest(path).scenes, dict[str, SceneEntry]()
    if not scenes:
        yield Problem(manifest_path(path), "scenes", "expected scenes, found none")
    for name, entry in sorted(scenes.items()):
        tell(path / entry.path)
        problems = check_file(path / entry.path, entry.sha256)
        if not problems:
            sound[name] = entry
        yield from problems or _check_entry(path, name, entry)
    yield from _duplicates(path, sound)
    yield from _leaks(path, scenes, sound)
    yield from guarded(path / "croissant.json", partial(_check_croissant, path / "croissant.json", scenes))
    yield from _strays(path, scenes)
    for folder in sorted(p for p in path.iterdir() if p.is_dir() and is_cache(p)):
        tell(folder)
        yield from guarded(folder, partial(_check_cache, folder, path))


def _check_entry(dataset: Path, name: str, entry: SceneEntry) -> Iterator[Problem]:
    with open_h5(dataset / entry.path) as file:
        scene, views = file.attrs["scene"], file["tof/raw"].shape[0]
    if scene != name:
        yield Problem(manifest_path(dataset), name, f"its shard holds the scene {scene!r}")
    if views != entry.views:
        yield Problem(manifest_path(dataset), name, f"expected {entry.views} views, its shard holds {views}")


def _duplicates(dataset: Path, scenes: Scenes) -> Iterator[Problem]:
    """Views that are there twice: noise makes a burst's first frame its own."""
    first: dict[str, tuple[str, int]] = {}
    for name, entry in scenes.items():
        with open_h5(dataset / entry.path) as file:
            raw = file["tof/raw"]
            prints = [hashlib.sha256(np.asarray(raw[v, 0]).tobytes()).hexdigest() for v in range(len(raw))]
        for view, mark in enumerate(prints):
            scene, other = first.setdefault(mark, (name, view))
            if (scene, other) != (name, view):
                yield Problem(
                    dataset / entry.path,
                    f"view {view}",
                    f"the same frames as view {other} of {scene}",
                    "leave one of them out of the recordings and build again",
                )


def _objects(dataset: Path, name: str, entry: SceneEntry, *, sound: bool) -> set[str]:
    """Objects of a scene: of its name, and what provenance or the simulation's note says."""
    note = dataset / "simulation" / f"{name}.json"
    said: list[Any] = []
    if sound:
        with open_h5(dataset / entry.path) as file:
            said += json_attr(file, "provenance", dataset / entry.path).get("objects") or []
    if note.is_file():
        said += _load_json(note).get("objects") or []
    return {object_of(name), *map(str, said)}


def _leaks(dataset: Path, scenes: Scenes, sound: Scenes) -> Iterator[Problem]:
    where: dict[str, dict[str, str]] = {}
    for name, entry in sorted(scenes.items()):
        for thing in _objects(dataset, name, entry, sound=name in sound):
            where.setdefault(thing, {}).setdefault(entry.split, name)
    for thing, splits in sorted(where.items()):
        if len(splits) > 1:
            text = " and ".join(f"{split} ({scene})" for split, scene in sorted(splits.items()))
            yield Problem(manifest_path(dataset), thing, f"the object is in {text}", _AGAIN)


def _check_croissant(path: Path, scenes: Scenes) -> Iterator[Problem]:
    """The Croissant description promises the same files as the manifest, and the manifest itself."""
    promised = {f["contentUrl"]: f["sha256"] for f in _load_json(path)["distribution"]}
    expected = {e.path: e.sha256 for e in scenes.values()}
    if "manifest.json" in promised:
        expected["manifest.json"] = sha256_of(manifest_path(path.parent))
    if promised != expected:
        yield Problem(path, "distribution", "its files or digests differ from the manifest's", _AGAIN)


def _strays(dataset: Path, scenes: Scenes) -> Iterator[Problem]:
    shards = {(dataset / e.path).resolve() for e in scenes.values()}
    known = shards | {digest_path(p) for p in shards}
    for path in sorted((dataset / "shards").glob("*")):
        if path.resolve() not in known:
            hint = "run build-dataset with its recording, or delete it"
            yield Problem(path, "", "not in the manifest", hint)
    if (dataset / "views").is_dir():
        return  # a recording lives here as well
    for path in sorted(dataset.iterdir()):
        ours = path.name in _OWN or path.name.startswith((".", *_BESIDE)) or path.resolve() in known
        if not ours and not (path.is_dir() and is_cache(path)):
            yield Problem(path, "", "is no part of a dataset", "move it elsewhere")
