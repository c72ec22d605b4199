"""A whole simulated dataset, scene by scene; each scene is one task of one process, and the tasks meet in files only.

A run that was killed goes on at the next view that is missing, and ends with the same bytes.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError, TofError
from tofcapture.pool import Pool
from tofcapture.suites.make import DatasetSpec, Made, finished, make_one

Progress = Callable[[int, int], None]
"""Called with views finished and views in all, about once a second."""

_VIEW_BYTES, _SHARD_BYTES, _RESERVE_BYTES = 14e6, 8e6, 0.5e9  # of one full-size view
_CAPTURE = 0.7  # share of a view's work that is done when it is captured; the rest is its ground truth


@dataclass(frozen=True)
class Simulated:
    """Hold what a run did."""

    dataset: Path
    made: tuple[Made, ...]  #: Scenes of this run.
    kept: tuple[Made, ...]  #: Scenes that were there.
    splits: Mapping[str, str]  #: By scene.
    gt: Mapping[str, Any] | None  #: :meth:`TruthError.table`; ``None`` when no shard knows the truth.
    seconds: float  #: Wall clock of the run.


def simulate_dataset(
    spec: DatasetSpec,
    out: Path,
    jobs: int | None = None,
    progress: Progress | None = None,
    split: str | None = None,
) -> Simulated:
    """Simulate and build a dataset in the folder ``out``, or complete one.

    Raises :class:`ConfigError`: nothing is wanted, the folder holds something else, or the disk is too small.

    Parameters
    ----------
    spec, out, progress
        What is wanted; where; told about once a second.
    jobs
        Processes; by default one per core. ``1`` works in this process.
    split
        Of all scenes, for a dataset that is only trained on or only evaluated on; ``None``: by their objects.
    """
    start = time.monotonic()
    _check(spec, out)
    jobs = jobs if jobs is not None else os.cpu_count() or 1
    done = _there(spec, out)
    todo = [i for i in range(spec.scenes) if i not in done]
    _check_space(spec, out, len(todo), min(jobs, len(todo)))

    def tell(views: int) -> None:
        if progress is not None:
            progress(len(done) * spec.views + views, spec.scenes * spec.views)

    made = dict(_run(spec, out, todo, jobs, tell))
    splits, gt = _finish(out, [*done.values(), *made.values()], split)
    return Simulated(out, tuple(made.values()), tuple(done.values()), splits, gt, time.monotonic() - start)


def _there(spec: DatasetSpec, out: Path) -> dict[int, Made]:
    """Find scenes that need not be made again; a folder with scenes of another spec is refused."""
    names = [spec.scene(i).name for i in range(spec.scenes)]
    others = {p.stem for p in (out / "simulation").glob("*.json")} - set(names)
    if others:
        raise ConfigError(
            f"{out}: holds {len(others)} scenes that are not wanted: {', '.join(sorted(others)[:3])} ...",
            hint="the same --suite and --seed with at least as many --scenes as before, or another --out",
        )
    found = {i: finished(spec, out, i, name) for i, name in enumerate(names)}
    return {i: made for i, made in found.items() if made is not None}


def _check(spec: DatasetSpec, out: Path) -> None:
    spec.recipe()
    if spec.suite == "noise" and spec.cameras > 1:
        raise ConfigError(
            "--cameras: the suite noise holds levels of one scene against each other, by one camera"
        )
    for name in ("scenes", "views", "frames", "cameras"):
        if getattr(spec, name) < 1:
            raise ConfigError(f"--{name}: expected at least 1, got {getattr(spec, name)}")
    if (out / "views").exists():
        raise ConfigError(f"{out}: this is a recording", hint="name another folder for the dataset")


def _check_space(spec: DatasetSpec, out: Path, scenes: int, jobs: int) -> None:
    """Refuse to begin what the disk cannot hold: all shards, and the views of the scenes at work."""
    out.mkdir(parents=True, exist_ok=True)
    if spec.sim or not scenes:
        return
    need = spec.views * (scenes * _SHARD_BYTES + jobs * (_VIEW_BYTES + _SHARD_BYTES)) + _RESERVE_BYTES
    free = shutil.disk_usage(out).free
    if free < need:
        raise ConfigError(
            f"{out}: expected {need / 1e9:.1f} GB of free disk, got {free / 1e9:.1f} GB",
            hint="free some space, or ask for fewer scenes",
        )


def _run(
    spec: DatasetSpec, out: Path, todo: Sequence[int], jobs: int, tell: Callable[[int], None]
) -> Iterator[tuple[int, Made]]:
    """Make scenes, here or in processes of one thread each."""
    if jobs <= 1 or len(todo) <= 1:
        for turn, index in enumerate(todo):
            tell(turn * spec.views)
            yield index, make_one(spec, out, index)
        tell(len(todo) * spec.views)
        return
    done = 0

    def tick() -> None:
        taken = len(list((out / "simulation").glob("*.work/recording/views/*/view-*.h5")))
        tell(done + int(_CAPTURE * taken))

    with Pool(min(jobs, len(todo))) as pool:
        for turn, made in pool.run(make_one, [(spec, out, index) for index in todo], tick):
            if isinstance(made, TofError):
                raise made
            done += spec.views
            tick()
            yield todo[turn], made


def _finish(
    out: Path, scenes: Sequence[Made], split: str | None
) -> tuple[dict[str, str], dict[str, Any] | None]:
    """Write manifest and card over all scenes."""
    from tofcapture.dataset.card import write_card
    from tofcapture.dataset.sample import pooled_error
    from tofcapture.files.manifest import Manifest, SceneEntry, assign_splits, write_manifest

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
