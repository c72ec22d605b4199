"""Worker processes that may die: a task of a dead worker is given to a new one, the other workers never notice.

A pool of :mod:`concurrent.futures` stops all of its workers when one is killed, and their work is lost with it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Self

from tofcapture.errors import TofError

RETRIES = 2
_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold linear algebra to one thread: sums are then added in one order, and workers do not fight over cores."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:  # a worker is held by its environment already
        yield
        return
    with threadpool_limits(1):
        yield


@contextmanager
def _pinned_environment() -> Iterator[None]:
    """Environment that a process started now inherits."""
    before = {name: os.environ.get(name) for name in _POOLS}
    os.environ.update(dict.fromkeys(_POOLS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def _serve(pipe: Connection) -> None:
    """Answer ``(function, arguments)`` with ``(True, result)`` or ``(False, error)`` until told to stop."""
    while (task := pipe.recv()) is not None:
        function, arguments = task
        try:
            with one_thread():
                answer = (True, function(*arguments))
        except Exception as err:
            answer = (False, err)
        pipe.send(answer)


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    task: int | None = None


class Crew:
    """Processes that work on tasks; left, they are gone.

    Parameters
    ----------
    jobs
        Number of processes, each with one thread.
    retries
        How often a task is given to another worker after the one that had it died.
    """

    def __init__(self, jobs: int, retries: int = RETRIES) -> None:
        self._jobs, self._retries = jobs, retries
        self._context = get_context("spawn")
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.process.kill()  # idle or of no use any more: what they write has other names until it is whole
            worker.process.join()
            worker.pipe.close()
        self._workers = []

    def _start(self) -> _Worker:
        here, there = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(there,), daemon=True)
        with _pinned_environment():
            process.start()
        there.close()
        return _Worker(process, here)

    def run(
        self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        """Do all tasks.

        Parameters
        ----------
        function
            Importable by name.
        tasks
            Its arguments, picklable.

        Yields
        ------
        Index of the task and its result, as they come; a :class:`TofError` that it raised, or that says that its worker
        died too often, is a result. A worker gets its next task when its result is taken: results do not pile up in memory
        when they are used more slowly than they are made.
        """
        queue = list(range(len(tasks)))
        deaths = [0] * len(tasks)
        try:
            while queue or any(w.task is not None for w in self._workers):
                self._hand_out(function, tasks, queue)
                for worker, index in self._ready():
                    answer = self._receive(worker)
                    if answer is None:
                        deaths[index] += 1
                        if deaths[index] > self._retries:
                            yield index, _died(deaths[index])
                        else:
                            queue.insert(0, index)
                        continue
                    self._hand_out(function, tasks, queue)
                    yield index, _checked(*answer)
        finally:  # whoever takes no more results leaves workers that would answer the next run
            for worker in [w for w in self._workers if w.task is not None]:
                self._bury(worker)

    def _hand_out(
        self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], queue: list[int]
    ) -> None:
        while queue:
            worker = next((w for w in self._workers if w.task is None), None)
            if worker is None:
                if len(self._workers) >= self._jobs:
                    return
                worker = self._start()
                self._workers.append(worker)
            try:
                worker.pipe.send((function, tasks[queue[0]]))
            except OSError:  # died while idle
                self._bury(worker)
                continue
            worker.task = queue.pop(0)

    def _ready(self) -> list[tuple[_Worker, int]]:
        """Wait for busy workers that have answered or died; with the tasks that they had."""
        busy = {w.pipe: (w, w.task) for w in self._workers if w.task is not None}
        return [busy[pipe] for pipe in wait(list(busy)) if isinstance(pipe, Connection)]

    def _receive(self, worker: _Worker) -> tuple[bool, Any] | None:
        """Take an answer; ``None`` from a worker that died, which is buried."""
        try:
            answer: tuple[bool, Any] = worker.pipe.recv()
        except (EOFError, OSError):
            self._bury(worker)
            return None
        worker.task = None
        return answer

    def _bury(self, worker: _Worker) -> None:
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)


def _died(times: int) -> TofError:
    return TofError(
        f"the worker process died, {times} times",
        "out of memory? use fewer processes: --jobs 1; see also dmesg",
    )


def _checked(good: bool, result: Any) -> Any:
    """Raise what nobody foresaw; errors of this project are results."""
    if not good and not isinstance(result, TofError):
        raise result
    return result
