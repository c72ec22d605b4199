"""List every problem of a view, a shard, a recording or a dataset; never raise on bad data."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py

from tofcapture.files.check_file import Problem, check_file, guarded
from tofcapture.files.manifest import SceneEntry, load_manifest, manifest_path, object_of
from tofcapture.rig import load_rig

__all__ = ["Problem", "check", "check_file"]


def check(path: Path, progress: Callable[[Path], None] | None = None) -> list[Problem]:
    """List every problem.

    Parameters
    ----------
    path
        A view file, a shard, a recording's or a dataset's folder.
    progress
        Told each HDF5 file before it is read.

    Returns
    -------
    Empty when everything is as it should be. Whatever the data, this does not raise.
    """
    path = Path(path)
    tell = progress or (lambda _: None)
    if path.is_dir():
        return guarded(path, lambda: _check_folder(path, tell))
    tell(path)
    return check_file(path)


def _check_folder(path: Path, tell: Callable[[Path], None]) -> Iterator[Problem]:
    recording, dataset = (path / "views").is_dir(), manifest_path(path).exists() or (path / "shards").is_dir()
    if recording:
        yield from _check_recording(path, tell)
    if dataset:
        yield from _check_dataset(path, tell)
    if not recording and not dataset:
        yield Problem(path, "", "expected a recording (views/) or a dataset (manifest.json), found neither")


def _check_recording(path: Path, tell: Callable[[Path], None]) -> Iterator[Problem]:
    promised, problems = _journal(path)
    yield from problems
    views = sorted((path / "views").glob("*/view-*.h5"))
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
    if (path / "rig.toml").exists():
        yield from guarded(path / "rig.toml", lambda: _parses(load_rig, path / "rig.toml"))
    if (path / "evidence.json").exists():
        yield from guarded(path / "evidence.json", lambda: _parses(_load_json, path / "evidence.json"))


def _parses(load: Callable[[Path], object], path: Path) -> Iterator[Problem]:
    load(path)
    yield from ()


def _load_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _journal(recording: Path) -> tuple[dict[tuple[str, str], str], list[Problem]]:
    """Digests that the journal promises, by (scene, file name)."""
    path = recording / "journal.sqlite"
    if not path.exists():
        return {}, []
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
            rows = db.execute("SELECT scene, \"index\", sha256 FROM views WHERE state = 'sealed'").fetchall()
    except sqlite3.Error as err:
        return {}, [
            Problem(path, "", f"cannot be read: {err}", "tofcapture record rebuilds it from the sealed views")
        ]
    return {(scene, f"view-{index:03d}.h5"): sha for scene, index, sha in rows if sha}, []


def _check_dataset(path: Path, tell: Callable[[Path], None]) -> Iterator[Problem]:
    manifest = load_manifest(path)
    if not manifest.scenes:
        yield Problem(manifest_path(path), "scenes", "expected scenes, found none")
    for name, entry in sorted(manifest.scenes.items()):
        tell(path / entry.path)
        problems = check_file(path / entry.path, entry.sha256)
        yield from problems or _check_entry(path, name, entry)
    yield from _leaks(path, manifest.scenes)
    croissant = path / "croissant.json"
    yield from guarded(croissant, lambda: _check_croissant(croissant, manifest.scenes))
    listed = {(path / e.path).resolve() for e in manifest.scenes.values()}
    for shard in sorted((path / "shards").glob("*.h5")):
        if shard.resolve() not in listed:
            yield Problem(
                shard, "", "not in the manifest", "run build-dataset with its recording, or delete it"
            )


def _check_croissant(path: Path, scenes: Mapping[str, SceneEntry]) -> Iterator[Problem]:
    """The Croissant description promises the same files as the manifest."""
    files = _load_json(path)["distribution"]
    promised = {f["contentUrl"]: f["sha256"] for f in files}
    if promised != {e.path: e.sha256 for e in scenes.values()}:
        yield Problem(
            path, "distribution", "its files or digests differ from the manifest's", "run build-dataset again"
        )


def _check_entry(dataset: Path, name: str, entry: SceneEntry) -> Iterator[Problem]:
    with h5py.File(dataset / entry.path, "r") as file:
        if file.attrs["scene"] != name:
            yield Problem(manifest_path(dataset), name, f"its shard holds the scene {file.attrs['scene']!r}")
        views = file["tof/raw"].shape[0]
        if views != entry.views:
            yield Problem(
                manifest_path(dataset), name, f"expected {entry.views} views, its shard holds {views}"
            )


def _leaks(dataset: Path, scenes: Mapping[str, SceneEntry]) -> Iterator[Problem]:
    splits: dict[str, set[str]] = {}
    for name, entry in scenes.items():
        splits.setdefault(object_of(name), set()).add(entry.split)
    for thing, where in sorted(splits.items()):
        if len(where) > 1:
            yield Problem(
                manifest_path(dataset),
                thing,
                f"the object is in {' and '.join(sorted(where))}",
                "run build-dataset again",
            )
