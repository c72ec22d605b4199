"""From recordings to a dataset: one shard per scene, then the manifest and the card.

Every shard is a function of its views, the rig, the config and this package's version; their digest is stored in it. A run
skips shards whose digest is right, so a run that was killed goes on where it was, and ends with the same bytes. So does one
whose scenes other processes, a Dask cluster or other calls of a batch system built.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tofcapture.dataset.card import write_card
from tofcapture.dataset.sample import SampleConfig, TruthError, pooled_error
from tofcapture.dataset.scene import WORK, SceneOutcome, SceneTask, build_scene, versions
from tofcapture.errors import ConfigError, DataError, TofError
from tofcapture.files.disk import check_writable, what_is
from tofcapture.files.layout import BOARD_SCENE
from tofcapture.files.manifest import Manifest, SceneEntry, assign_splits, write_manifest
from tofcapture.files.seal import PARTIAL
from tofcapture.files.shard import ShardReader
from tofcapture.files.view import find_views, read_depth_view
from tofcapture.pool import RETRIES, Pool
from tofcapture.rig import Rig, load_rig

Progress = Callable[[str, int, int], None]
"""Called with a scene, its views that are finished, its views in all."""
ENGINES = ("process", "dask")
_CONNECT = 10.0  # s


@dataclass(frozen=True)
class BuildResult:
    """Report what a build did.

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
    alone
        Why a view's truth is that of its own stereo camera, by scene and name, where a fused one was wanted.
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
    alone: Mapping[str, Mapping[str, str]]
    missing: tuple[str, ...]
    gt: TruthError | None
    peak_memory: int


def build_dataset(
    recordings: str | Path | Sequence[str | Path],
    out: str | Path,
    rig_path: str | Path | None = None,
    *,
    true_rig: bool = False,
    config: SampleConfig | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
    engine: str = "process",
    scheduler: str | None = None,
    part: tuple[int, int] | None = None,
    finish: bool = False,
) -> BuildResult:
    """Build or complete a dataset.

    Returns the outcome: a scene with a damaged view is a failure there; the others are built.

    Raises :class:`ConfigError`: no rig, a scene that is in two recordings, a part that is none, or an engine
    that is not there; :class:`DataError`: no scenes.

    Parameters
    ----------
    recordings
        Folder or folders that ``record`` filled; views of the board are left out.
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
    part
        ``(2, 8)``: build the second eighth of the scenes only. The call that finds all shards in place finishes the dataset.
    finish
        Build nothing, finish the dataset from the shards that are there.
    """
    config, out = config or SampleConfig(), Path(out)
    index, count = part or (1, 1)
    if not 1 <= index <= count:
        raise ConfigError(f"--part: expected I/N with 1 <= I <= N, got {index}/{count}", hint="--part 2/8")
    check_writable(out, "name another folder: --out")
    if (out / "views").is_dir():
        raise ConfigError(f"--out {out}: expected a folder of its own, got a recording", hint="--out dataset")
    folders = [recordings] if isinstance(recordings, str | Path) else recordings
    tasks = scene_tasks(folders, out, rig_path, true_rig=true_rig, config=config)
    mine = [] if finish else tasks[index - 1 :: count]
    outcomes = _run(mine, engine, default_jobs() if jobs is None else jobs, scheduler, progress)
    others = [t for t in tasks if t.scene not in outcomes]
    if finish or all(t.path.is_file() for t in others):
        outcomes |= {t.scene: build_scene(t, only_look=True) for t in others}
    return _result(out, tasks, outcomes, config, whole=part is None and not finish)


def default_jobs() -> int:
    """Return one process for each core that this one may use, at most four."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(4, cores)


def scene_tasks(
    recordings: Sequence[str | Path],
    out: str | Path,
    rig_path: str | Path | None = None,
    *,
    true_rig: bool = False,
    config: SampleConfig | None = None,
) -> list[SceneTask]:
    """List one task for each scene, by name; paths are absolute, for workers elsewhere. As for :func:`build_dataset`."""
    shards = Path(out).absolute() / "shards"
    chosen = None if rig_path is None else Path(rig_path).absolute()
    return [
        SceneTask(
            scene,
            views,
            _rig_for(recording, views[0], chosen, true_rig=true_rig),
            config or SampleConfig(),
            shards / f"{scene}.h5",
        )
        for scene, (recording, views) in sorted(find_scenes([Path(r).absolute() for r in recordings]).items())
    ]


def find_scenes(recordings: Sequence[Path]) -> dict[str, tuple[Path, tuple[Path, ...]]]:
    """Find the view files by scene: ``(recording, views in order)``, without the board's.

    Raises :class:`DataError`: a recording does not exist or holds no scene; :class:`ConfigError`: two
    recordings hold the same scene.
    """
    found: dict[str, tuple[Path, tuple[Path, ...]]] = {}
    for recording in recordings:
        folder = Path(recording) / "views"
        if not folder.is_dir():
            raise DataError(
                f"{recording}: expected a recording (a folder with views), got {what_is(Path(recording))}",
                hint="tofcapture record --scene NAME",
            )
        for scene, views in find_views(recording).items():
            if scene in found:
                raise ConfigError(
                    f"scene {scene} is in {found[scene][0]} and in {recording}", hint="rename one of them"
                )
            if scene != BOARD_SCENE:
                found[scene] = (Path(recording), views)
    if not found:
        raise DataError(
            f"no scene in {', '.join(map(str, recordings))}",
            hint="tofcapture record --scene NAME --out RECORDING",
        )
    return found


def _rig_for(recording: Path, first_view: Path, rig_path: Path | None, *, true_rig: bool) -> Rig:
    """Rig to build with: the given one, the simulator's, or the one that ``align`` wrote."""
    if true_rig:
        view, _ = read_depth_view(first_view)
        if view.truth is None:
            raise ConfigError(
                f"{first_view}: carries no true rig", hint="--true-rig is for simulated recordings"
            )
        return replace(view.rig, T_tof_stereo=view.truth.T_tof_stereo, T_flange_tof=view.truth.T_flange_tof)
    path = rig_path or recording / "rig.toml"
    if not path.is_file():
        raise ConfigError(
            f"{path}: expected the calibrated rig, found none", hint=f"tofcapture align {recording}"
        )
    return load_rig(path)


def _run(
    tasks: Sequence[SceneTask], engine: str, jobs: int, scheduler: str | None, progress: Progress | None
) -> dict[str, SceneOutcome]:
    """Do the tasks with a named engine; outcomes by scene."""
    if engine not in ENGINES:
        raise ConfigError(f"--engine: expected {' or '.join(ENGINES)}, got {engine!r}")
    if (engine == "dask") != (scheduler is not None):
        raise ConfigError("expected --scheduler with --engine dask, and only there", hint="tcp://HOST:8786")
    tell = progress or (lambda _scene, _done, _views: None)
    if scheduler is not None:
        return _run_dask(tasks, scheduler, tell)
    return _run_processes(tasks, jobs, tell)


def _run_processes(tasks: Sequence[SceneTask], jobs: int, tell: Progress) -> dict[str, SceneOutcome]:
    """Do the tasks on this machine.

    As many scenes as can be shared out evenly are one task each. The views of those that remain, the smallest, are spread over
    all processes.
    """

    def alone(task: SceneTask, pool: Pool | None) -> SceneOutcome:
        return build_scene(task, pool, lambda done: tell(task.scene, done, len(task.views)))

    if jobs <= 1:
        return {t.scene: alone(t, None) for t in tasks}
    order = sorted(tasks, key=lambda t: (-len(t.views), t.scene))
    whole = len(order) - len(order) % jobs
    out: dict[str, SceneOutcome] = {}
    with Pool(jobs) as pool:
        for index, outcome in pool.run(build_scene, [(t,) for t in order[:whole]]):
            task = order[index]
            out[task.scene] = SceneOutcome(error=outcome) if isinstance(outcome, TofError) else outcome
            tell(task.scene, len(task.views), len(task.views))
        return out | {t.scene: alone(t, pool) for t in order[whole:]}


def _run_dask(tasks: Sequence[SceneTask], scheduler: str, tell: Progress) -> dict[str, SceneOutcome]:
    """Do the tasks on a Dask cluster whose workers see the same folders under the same names."""
    try:
        from distributed import Client, as_completed
    except ImportError as err:
        raise ConfigError(
            f"--engine dask: distributed does not load: {err}", hint="pip install 'tofcapture[cluster]'"
        ) from err
    try:
        client = Client(scheduler, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError) as err:
        raise DataError(
            f"--scheduler {scheduler}: expected a Dask scheduler there, got {err or 'no answer'}",
            hint="dask scheduler; dask worker tcp://HOST:8786 --nthreads 1",
        ) from err
    out: dict[str, SceneOutcome] = {}
    with client:
        futures = {client.submit(build_scene, t, pure=False, retries=RETRIES): t for t in tasks}
        for future in as_completed(list(futures), loop=client.loop):
            task, error = futures[future], future.exception()
            if error is None:
                out[task.scene] = future.result()
            else:  # its workers died, or it met something nobody foresaw
                message = f"{task.scene}: {type(error).__name__}: {error}"
                out[task.scene] = SceneOutcome(error=TofError(message, "see the worker's log"))
            tell(task.scene, len(task.views), len(task.views))
    return out


def _result(
    out: Path,
    tasks: Sequence[SceneTask],
    outcomes: Mapping[str, SceneOutcome],
    config: SampleConfig,
    *,
    whole: bool,
) -> BuildResult:
    there = {t.scene: t for t in tasks if t.scene in outcomes and outcomes[t.scene].sha256}
    known = {scene: _provenance(t.path) for scene, t in there.items()}
    objects = {scene: [str(name) for name in p.get("objects") or ()] for scene, p in known.items()}
    splits = assign_splits((t.scene for t in tasks), objects)
    entries = {
        scene: SceneEntry(f"shards/{scene}.h5", str(outcomes[scene].sha256), len(t.views), splits[scene])
        for scene, t in there.items()
    }
    failures = {scene: o.error for scene, o in outcomes.items() if o.error is not None}
    missing = tuple(t.scene for t in tasks if t.scene not in entries and t.scene not in failures)
    complete = not missing and (whole or not failures)
    bare = {
        scene: tuple(view["name"] for view in p["views"] if view["good_pixels"] == 0)
        for scene, p in known.items()
    }
    alone = {
        scene: {view["name"]: view["why"] for view in p["views"] if "why" in view}
        for scene, p in known.items()
    }
    return BuildResult(
        dataset=out,
        scenes=entries,
        skipped=tuple(scene for scene, o in sorted(outcomes.items()) if o.skipped),
        failures=dict(sorted(failures.items())),
        bare={scene: names for scene, names in bare.items() if names},
        alone={scene: why for scene, why in alone.items() if why},
        missing=missing,
        gt=_finish(out, entries, config) if complete else None,
        peak_memory=max((o.peak_memory for o in outcomes.values()), default=0),
    )


def _provenance(shard: Path) -> Mapping[str, Any]:
    with ShardReader(shard) as reader:
        return reader.provenance


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
