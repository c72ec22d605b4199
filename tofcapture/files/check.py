"""List every problem of a view, a shard, a recording, a dataset or a cache; never raise on bad data."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from tofcapture.files.cache import is_cache
from tofcapture.files.check_dataset import check_cache, check_dataset
from tofcapture.files.check_file import Problem, check_file, guarded
from tofcapture.files.manifest import manifest_path
from tofcapture.rig import load_rig

__all__ = ["Problem", "check", "check_file"]


def check(path: Path, progress: Callable[[Path], None] | None = None) -> list[Problem]:
    """List every problem.

    Parameters
    ----------
    path
        A view file, a shard, the folder of a recording, a dataset or a cache.
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
        yield from check_dataset(path, tell)
    if not recording and not dataset and is_cache(path):
        tell(path)
        yield from check_cache(path)
    elif not recording and not dataset:
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
