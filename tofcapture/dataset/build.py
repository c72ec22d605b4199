"""From recordings to a dataset: one shard per scene, then the manifest and the card.

Every shard is a function of its views, the rig, the config and this package's version; their digest is stored in it. A run
skips shards whose digest is right, so a run that was killed goes on where it was, and ends with the same bytes.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.dataset.card import write_card
from tofcapture.dataset.engines import Progress, run
from tofcapture.dataset.recordings import find_scenes, rig_for
from tofcapture.dataset.sample import SampleConfig
from tofcapture.dataset.shard_task import WORK, SceneOutcome, SceneTask, look, versions
from tofcapture.dataset.split import assign_splits
from tofcapture.dataset.truth import TruthError, pooled_error
from tofcapture.errors import ConfigError, TofError
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest
from tofcapture.files.seal import PARTIAL
from tofcapture.files.shard import ShardReader


@dataclass(frozen=True)
class BuildResult:
    """What a build did.

    Attributes
    ----------
    dataset
        The folder.
    scenes
        Entry by scene, as in the manifest.
    skipped
        Scenes whose shard was already right.
    failures
        Error by scene that has no shard.
    bare
        Names of the views, by scene, that have no pixel of good ground truth: nothing can be learned from them.
    missing
        Scenes that are other calls' to build and are not there yet; then there is no manifest either.
    gt
        Error of the ground truth, pooled over all views; ``None`` when no view carries truth, or scenes are missing.
    peak_memory
        Largest resident size of a process that made a shard, bytes.
    """

    dataset: Path
    scenes: Mapping[str, SceneEntry]
    skipped: tuple[str, ...]
    failures: Mapping[str, TofError]
    bare: Mapping[str, tuple[str, ...]]
    missing: tuple[str, ...]
    gt: TruthError | None
    peak_memory: int


@dataclass(frozen=True)
class Share:
    """The part of a build that one call of a batch system does: ``index`` of ``count``, from 1."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Share:
        """Read ``2/8``; :class:`ConfigError` for anything else."""
        index, _, count = text.partition("/")
        if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
            raise ConfigError(f"--shard: expected I/N with 1 <= I <= N, got {text!r}", hint="--shard 2/8")
        return cls(int(index), int(count))


def default_jobs() -> int:
    """One process for each core that this one may use, at most four."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(4, cores)


def scene_tasks(
    recordings: Sequence[Path],
    out: Path,
    rig_path: Path | None = None,
    *,
    true_rig: bool = False,
    config: SampleConfig | None = None,
) -> list[SceneTask]:
    """One task for each scene, sorted by name; paths are absolute, for workers elsewhere. As for :func:`build_dataset`."""
    config = config or SampleConfig()
    out = Path(out).absolute()
    found = find_scenes([Path(r).absolute() for r in recordings])
    return [
        SceneTask(
            scene,
            views,
            rig_for(
                recording, views[0], None if rig_path is None else rig_path.absolute(), true_rig=true_rig
            ),
            config,
            out / "shards" / f"{scene}.h5",
        )
        for scene, (recording, views) in sorted(found.items())
    ]


def build_dataset(
    recordings: Sequence[Path],
    out: Path,
    rig_path: Path | None = None,
    *,
    true_rig: bool = False,
    config: SampleConfig | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
    engine: str = "process",
    scheduler: str | None = None,
    share: Share | None = None,
    finish: bool = False,
) -> BuildResult:
    """Build or complete a dataset.

    Parameters
    ----------
    recordings
        Folders that ``record`` filled; views of the board are left out.
    out
        The dataset's folder.
    rig_path
        Rig to use instead of each recording's ``rig.toml``.
    true_rig
        Use the rig that the simulator knows.
    config
        Constants of the ground truth.
    jobs
        Processes; by default one per core, at most four; each takes half a gigabyte.
    progress
        Told after each view, or each scene.
    engine, scheduler
        ``process``, or ``dask`` with the address of a scheduler.
    share
        Build only this part of the scenes; the call that finds all shards in place finishes the dataset.
    finish
        Build nothing, finish the dataset from the shards that are there.

    Returns
    -------
    BuildResult
        A scene with a damaged view is a failure there; the others are built.

    Raises
    ------
    ConfigError
        No rig, a scene that is in two recordings, or an engine that is not there.
    DataError
        No scenes.
    """
    config = config or SampleConfig()
    out = Path(out)
    tasks = scene_tasks(recordings, out, rig_path, true_rig=true_rig, config=config)
    mine = [] if finish else tasks[share.index - 1 :: share.count] if share else tasks
    outcomes = dict(run(mine, engine, default_jobs() if jobs is None else jobs, scheduler, progress))
    others = [t for t in tasks if t.scene not in outcomes]
    if finish or all(t.path.is_file() for t in others):
        outcomes |= {t.scene: look(t) for t in others}
    return _result(out, tasks, outcomes, config, whole=share is None and not finish)


def _result(
    out: Path,
    tasks: Sequence[SceneTask],
    outcomes: Mapping[str, SceneOutcome],
    config: SampleConfig,
    *,
    whole: bool,
) -> BuildResult:
    there = {t.scene: t.path for t in tasks if outcomes.get(t.scene, SceneOutcome(None)).sha256}
    known = {scene: _provenance(path) for scene, path in there.items()}
    splits = assign_splits((t.scene for t in tasks), {scene: _objects(p) for scene, p in known.items()})
    entries: dict[str, SceneEntry] = {}
    failures: dict[str, TofError] = {}
    for task in tasks:
        outcome = outcomes.get(task.scene, SceneOutcome(None))
        if outcome.error is not None:
            failures[task.scene] = outcome.error
        elif outcome.sha256 is not None:
            entries[task.scene] = SceneEntry(
                f"shards/{task.scene}.h5", outcome.sha256, len(task.views), splits[task.scene]
            )
    missing = tuple(t.scene for t in tasks if t.scene not in entries and t.scene not in failures)
    gt = None
    if not missing and (whole or not failures):
        gt = _finish(out, entries, config)
    skipped = tuple(scene for scene, o in sorted(outcomes.items()) if o.skipped)
    peak = max((o.peak_memory for o in outcomes.values()), default=0)
    bare = {scene: names for scene, p in known.items() if (names := _bare(p))}
    return BuildResult(out, entries, skipped, failures, bare, missing, gt, peak)


def _provenance(shard: Path) -> Mapping[str, Any]:
    with ShardReader(shard) as reader:
        return reader.provenance


def _objects(provenance: Mapping[str, Any]) -> list[str]:
    """Objects that a shard says it shows; none when it does not know."""
    return [str(name) for name in provenance.get("objects") or ()]


def _bare(provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of a shard's views without good ground truth."""
    return tuple(view["name"] for view in provenance.get("views", ()) if view["good_pixels"] == 0)


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Wait until no other call finishes this dataset."""
    import fcntl

    out.mkdir(parents=True, exist_ok=True)
    with (out / ".finish.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _finish(out: Path, entries: Mapping[str, SceneEntry], config: SampleConfig) -> TruthError | None:
    """Write the manifest last but for the card: a dataset with a manifest is whole."""
    with _alone(out):
        for stray in out.glob(f"**/*{PARTIAL}"):
            stray.unlink(missing_ok=True)
        for work in (out / "shards").glob(f"{WORK}*"):
            shutil.rmtree(work, ignore_errors=True)
        gt = pooled_error(out / e.path for e in entries.values())
        manifest = Manifest(entries, config.table(), versions())
        write_manifest(out, manifest)
        write_card(out, manifest, None if gt is None else gt.table())
    (out / ".finish.lock").unlink(missing_ok=True)
    return gt
