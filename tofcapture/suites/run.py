"""A whole simulated dataset, scene by scene; each scene is one task of one process, and the tasks meet in files only.

A run that was killed goes on at the next view that is missing, and ends with the same bytes.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError, TofError
from tofcapture.suites.make import Made, Wish, finished, make_one, scene_name

Progress = Callable[[int, int], None]
"""Called with views finished and views in all, about once a second."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_VIEW_BYTES, _SHARD_BYTES, _RESERVE_BYTES = 14e6, 8e6, 0.5e9  # of one full-size view
_POLL = 1.0  # s
_CAPTURE = 0.7  # share of a view's work that is done when it is captured; the rest is its ground truth


@dataclass(frozen=True)
class Simulated:
    """What a run did.

    Attributes
    ----------
    dataset
        The folder.
    made, kept
        Scenes of this run, and those that were there.
    splits
        Split by scene.
    gt
        Error of the ground truth (:meth:`TruthError.table`), ``None`` when no shard knows it.
    seconds
        Wall clock of the run.
    """

    dataset: Path
    made: tuple[Made, ...]
    kept: tuple[Made, ...]
    splits: Mapping[str, str]
    gt: Mapping[str, Any] | None
    seconds: float


def simulate_dataset(
    wish: Wish, out: Path, jobs: int | None = None, progress: Progress | None = None, split: str | None = None
) -> Simulated:
    """Simulate and build a dataset, or complete one.

    Parameters
    ----------
    wish
        What is wanted.
    out
        The dataset's folder.
    jobs
        Processes; by default one per core. ``1`` works in this process.
    progress
        Told about once a second.
    split
        Of all scenes, for a dataset that is only trained on or only evaluated on; ``None``: by their objects.

    Raises
    ------
    ConfigError
        Nothing is wanted, the folder holds something else, or the disk is too small.
    TofError
        A worker process died.
    """
    start = time.monotonic()
    _check(wish, out)
    jobs = jobs if jobs is not None else os.cpu_count() or 1
    done = _there(wish, out)
    todo = [i for i in range(wish.scenes) if i not in done]
    _check_space(wish, out, len(todo), min(jobs, len(todo)))
    made = dict(_run(wish, out, todo, jobs, lambda views: _tell(progress, wish, len(done), views)))
    splits, gt = _finish(out, [*done.values(), *made.values()], split)
    return Simulated(out, tuple(made.values()), tuple(done.values()), splits, gt, time.monotonic() - start)


def _there(wish: Wish, out: Path) -> dict[int, Made]:
    """Scenes that need not be made again; a folder with scenes of another wish is refused."""
    names = [scene_name(wish, i) for i in range(wish.scenes)]
    others = {p.stem for p in (out / "simulation").glob("*.json")} - set(names)
    if others:
        raise ConfigError(
            f"{out}: holds {len(others)} scenes that are not wanted: {', '.join(sorted(others)[:3])} ...",
            hint="the same --suite and --seed with at least as many --scenes as before, or another --out",
        )
    found = {i: finished(wish, out, i, name) for i, name in enumerate(names)}
    return {i: made for i, made in found.items() if made is not None}


def _tell(progress: Progress | None, wish: Wish, kept: int, views: int) -> None:
    if progress is not None:
        progress(kept * wish.views + views, wish.scenes * wish.views)


def _check(wish: Wish, out: Path) -> None:
    wish.recipe()
    if wish.suite == "noise" and wish.cameras > 1:
        raise ConfigError(
            "--cameras: the suite noise holds levels of one scene against each other, by one camera"
        )
    for name in ("scenes", "views", "frames", "cameras"):
        if getattr(wish, name) < 1:
            raise ConfigError(f"--{name}: expected at least 1, got {getattr(wish, name)}")
    if (out / "views").exists():
        raise ConfigError(f"{out}: this is a recording", hint="name another folder for the dataset")


def _check_space(wish: Wish, out: Path, scenes: int, jobs: int) -> None:
    """Refuse to begin what the disk cannot hold: all shards, and the views of the scenes at work."""
    out.mkdir(parents=True, exist_ok=True)
    if wish.sim or not scenes:
        return
    need = wish.views * (scenes * _SHARD_BYTES + jobs * (_VIEW_BYTES + _SHARD_BYTES)) + _RESERVE_BYTES
    free = shutil.disk_usage(out).free
    if free < need:
        raise ConfigError(
            f"{out}: expected {need / 1e9:.1f} GB of free disk, got {free / 1e9:.1f} GB",
            hint="free some space, or ask for fewer scenes",
        )


def _run(
    wish: Wish, out: Path, todo: Sequence[int], jobs: int, tell: Callable[[int], None]
) -> Iterator[tuple[int, Made]]:
    """Make scenes, here or in processes of one thread each."""
    if jobs <= 1 or len(todo) <= 1:
        for turn, index in enumerate(todo):
            tell(turn * wish.views)
            yield index, make_one(wish, out, index)
        tell(len(todo) * wish.views)
        return
    with _one_thread(), ProcessPoolExecutor(min(jobs, len(todo)), mp_context=get_context("spawn")) as pool:
        left = {pool.submit(make_one, wish, out, index): index for index in todo}
        try:
            yield from _collect(left, wish, out, tell)
        except BrokenProcessPool as err:
            raise TofError(
                "a worker process died",
                hint="run the same command again: it goes on; out of memory: --jobs 1",
            ) from err
        finally:
            for future in left:
                future.cancel()


def _collect(
    left: dict[Future[Made], int], wish: Wish, out: Path, tell: Callable[[int], None]
) -> Iterator[tuple[int, Made]]:
    done = 0
    while left:
        ready, _ = wait(left, timeout=_POLL, return_when=FIRST_COMPLETED)
        for future in ready:
            index = left.pop(future)
            yield index, future.result()
            done += wish.views
        taken = len(list((out / "simulation").glob("*.work/recording/views/*/view-*.h5")))
        tell(done + int(_CAPTURE * taken))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that start now use one thread each; this one keeps its own."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _finish(
    out: Path, scenes: Sequence[Made], split: str | None
) -> tuple[dict[str, str], dict[str, Any] | None]:
    """Write manifest and card over all scenes."""
    from tofcapture.dataset.card import write_card
    from tofcapture.dataset.split import assign_splits
    from tofcapture.dataset.truth import pooled_error
    from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest

    splits = assign_splits([m.scene for m in scenes], {m.scene: m.objects for m in scenes})
    splits = splits if split is None else dict.fromkeys(splits, split)
    entries = {
        m.scene: SceneEntry(f"shards/{m.scene}.h5", m.sha256, m.views, splits[m.scene])
        for m in sorted(scenes, key=lambda m: m.scene)
    }
    manifest = Manifest(entries, scenes[0].config, scenes[0].versions)
    gt = pooled_error(out / e.path for e in entries.values())
    table = None if gt is None else gt.table()
    write_manifest(out, manifest)
    write_card(out, manifest, table)
    return splits, table
