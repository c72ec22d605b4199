"""Who does the tasks: this process, a pool of processes, or a Dask cluster. The shards do not depend on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from tofcapture.dataset.shard_task import SceneOutcome, SceneTask, build_scene
from tofcapture.errors import ConfigError, DataError, TofError
from tofcapture.pool import RETRIES, Pool

Progress = Callable[[str, int, int], None]
"""Called with a scene, its views that are finished, its views in all."""
ENGINES = ("process", "dask")
_CONNECT = 10.0  # s


def run_processes(
    tasks: Sequence[SceneTask], jobs: int, progress: Progress | None = None
) -> dict[str, SceneOutcome]:
    """Do the tasks on this machine.

    As many scenes as can be shared out evenly are one task each; the views of those that remain, the smallest, are spread
    over all processes.

    Parameters
    ----------
    tasks
        What to do.
    jobs
        Processes; 1: this one.
    progress
        Told after each view, or after each scene.

    Returns
    -------
    Outcome by scene.
    """
    if jobs <= 1:
        return {t.scene: build_scene(t, None, _views(t, progress)) for t in tasks}
    order = sorted(tasks, key=lambda t: (-len(t.views), t.scene))
    whole = len(order) - len(order) % jobs
    out: dict[str, SceneOutcome] = {}
    with Pool(jobs) as pool:
        out |= _scenes(pool, order[:whole], progress)
        out |= {t.scene: build_scene(t, pool, _views(t, progress)) for t in order[whole:]}
    return out


def _scenes(pool: Pool, tasks: Sequence[SceneTask], progress: Progress | None) -> dict[str, SceneOutcome]:
    out: dict[str, SceneOutcome] = {}
    for index, outcome in pool.run(build_scene, [(t,) for t in tasks]):
        task = tasks[index]
        out[task.scene] = SceneOutcome(None, error=outcome) if isinstance(outcome, TofError) else outcome
        if progress:
            progress(task.scene, len(task.views), len(task.views))
    return out


def _views(task: SceneTask, progress: Progress | None) -> Callable[[int], None] | None:
    if progress is None:
        return None
    return lambda done: progress(task.scene, done, len(task.views))


def run_dask(
    tasks: Sequence[SceneTask], scheduler: str, progress: Progress | None = None
) -> dict[str, SceneOutcome]:
    """Do the tasks on a Dask cluster whose workers see the same folders under the same names.

    Parameters
    ----------
    tasks
        What to do.
    scheduler
        Its address, ``tcp://host:8786``.
    progress
        Told after each scene.

    Returns
    -------
    Outcome by scene.

    Raises
    ------
    ConfigError
        ``distributed`` is not installed.
    DataError
        No scheduler answers there.
    """
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
            out[task.scene] = future.result() if error is None else _failed(task, error)
            if progress:
                progress(task.scene, len(task.views), len(task.views))
    return out


def _failed(task: SceneTask, error: BaseException) -> SceneOutcome:
    """Outcome of a task whose workers died, or that met something nobody foresaw."""
    return SceneOutcome(
        None, error=TofError(f"{task.scene}: {type(error).__name__}: {error}", "see the worker's log")
    )


def run(
    tasks: Sequence[SceneTask], engine: str, jobs: int, scheduler: str | None, progress: Progress | None
) -> Mapping[str, SceneOutcome]:
    """Do the tasks with a named engine of :data:`ENGINES`.

    Raises
    ------
    ConfigError
        An unknown engine, or a scheduler missing or too much.
    """
    if engine not in ENGINES:
        raise ConfigError(f"--engine: expected {' or '.join(ENGINES)}, got {engine!r}")
    if (engine == "dask") != (scheduler is not None):
        raise ConfigError("expected --scheduler with --engine dask, and only there", hint="tcp://HOST:8786")
    if scheduler is not None:
        return run_dask(tasks, scheduler, progress)
    return run_processes(tasks, jobs, progress)
