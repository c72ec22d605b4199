"""List every problem of a dataset as a whole: manifest, shards, duplicates, leakage, strays, caches."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tofcapture.files.cache import is_cache, open_cache, verify_cache
from tofcapture.files.check_file import Problem, check_file, guarded
from tofcapture.files.hdf import json_attr
from tofcapture.files.manifest import SceneEntry, load_manifest, manifest_path, manifest_text, object_of
from tofcapture.files.seal import digest_path, sha256_of

_AGAIN = "run build-dataset again"
_BESIDE = ("README", "LICENSE", "LICENCE", "CITATION", "CHANGELOG", "NOTICE")
_OWN = ("manifest.json", "croissant.json", "shards", "simulation", "stats.html", "stats.json")
Tell = Callable[[Path], None]


def check_dataset(path: Path, tell: Tell) -> Iterator[Problem]:
    """Problems of a dataset; raises what :func:`load_manifest` raises."""
    manifest = load_manifest(path)
    if manifest_path(path).read_bytes() != manifest_text(manifest).encode():
        yield Problem(
            manifest_path(path), "", "does not carry its own digest (version 1)", f"tofcapture migrate {path}"
        )
    if not manifest.scenes:
        yield Problem(manifest_path(path), "scenes", "expected scenes, found none")
    sound: dict[str, SceneEntry] = {}
    for name, entry in sorted(manifest.scenes.items()):
        tell(path / entry.path)
        problems = check_file(path / entry.path, entry.sha256)
        if not problems:
            sound[name] = entry
        yield from problems or _check_entry(path, name, entry)
    yield from _duplicates(path, sound)
    yield from _leaks(path, manifest.scenes, sound)
    croissant = path / "croissant.json"
    yield from guarded(croissant, lambda: _check_croissant(croissant, manifest.scenes))
    yield from _strays(path, manifest.scenes)
    for folder in sorted(p for p in path.iterdir() if p.is_dir()):
        if is_cache(folder):
            tell(folder)
            yield from guarded(folder, partial(check_cache, folder, path))


def check_cache(cache: Path, dataset: Path | None = None) -> Iterator[Problem]:
    """Problems of a packed split: damaged files, strays, and, told the dataset, that it is stale."""
    scenes = open_cache(cache, dataset)
    for name in verify_cache(cache):
        yield Problem(cache / f"{name}.bin", "", "is not the file that was packed", "pack the split again")
    known = {"index.json", *(f"{name}.bin" for name in scenes)}
    for path in sorted(p for p in cache.iterdir() if p.name not in known):
        yield Problem(path, "", "the index does not know of it", "delete it")


def _check_entry(dataset: Path, name: str, entry: SceneEntry) -> Iterator[Problem]:
    with h5py.File(dataset / entry.path, "r") as file:
        if file.attrs["scene"] != name:
            yield Problem(manifest_path(dataset), name, f"its shard holds the scene {file.attrs['scene']!r}")
        views = file["tof/raw"].shape[0]
        if views != entry.views:
            yield Problem(
                manifest_path(dataset), name, f"expected {entry.views} views, its shard holds {views}"
            )


def _prints(path: Path) -> Iterator[tuple[int, str]]:
    """Fingerprint of each view: noise makes a burst's first frame its own."""
    with h5py.File(path, "r") as file:
        for view in range(file["tof/raw"].shape[0]):
            yield view, hashlib.sha256(np.asarray(file["tof/raw"][view, 0]).tobytes()).hexdigest()


def _duplicates(dataset: Path, scenes: Mapping[str, SceneEntry]) -> Iterator[Problem]:
    first: dict[str, tuple[str, int]] = {}
    for name, entry in scenes.items():
        for view, mark in _prints(dataset / entry.path):
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
        with h5py.File(dataset / entry.path, "r") as file:
            said += json_attr(file, "provenance", dataset / entry.path).get("objects") or []
    if note.is_file():
        said += json.loads(note.read_text(encoding="utf-8")).get("objects") or []
    return {object_of(name), *map(str, said)}


def _leaks(
    dataset: Path, scenes: Mapping[str, SceneEntry], sound: Mapping[str, SceneEntry]
) -> Iterator[Problem]:
    where: dict[str, dict[str, str]] = {}
    for name, entry in sorted(scenes.items()):
        for thing in _objects(dataset, name, entry, sound=name in sound):
            where.setdefault(thing, {}).setdefault(entry.split, name)
    for thing, splits in sorted(where.items()):
        if len(splits) > 1:
            text = " and ".join(f"{split} ({scene})" for split, scene in sorted(splits.items()))
            yield Problem(manifest_path(dataset), thing, f"the object is in {text}", _AGAIN)


def _check_croissant(path: Path, scenes: Mapping[str, SceneEntry]) -> Iterator[Problem]:
    """The Croissant description promises the same files as the manifest, and the manifest itself."""
    files = json.loads(path.read_text(encoding="utf-8"))["distribution"]
    promised = {f["contentUrl"]: f["sha256"] for f in files}
    expected = {e.path: e.sha256 for e in scenes.values()}
    if "manifest.json" in promised:
        expected["manifest.json"] = sha256_of(manifest_path(path.parent))
    if promised != expected:
        yield Problem(path, "distribution", "its files or digests differ from the manifest's", _AGAIN)


def _strays(dataset: Path, scenes: Mapping[str, SceneEntry]) -> Iterator[Problem]:
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
