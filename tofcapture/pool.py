"""One pool of worker processes for the whole project, on :mod:`concurrent.futures`.

::

    with Pool(jobs) as pool:
        for index, result in pool.run(function, [(a, b), (c, d)]):
            ...

Every worker is spawned, without running the script that opened the pool again, and computes with one thread: sums are added in one order, and workers do not fight over cores. A task
whose worker is killed is tried again. Workers end with the pool, and with the process that opened it, however that ends.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from types import ModuleType, TracebackType
from typing import Any, Self

from tofcapture.errors import TofError

RETRIES = 2
TICK = 1.0  # s
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold linear algebra of this process to one thread, for as long as the context lasts."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:  # a worker is held by its environment already
        yield
        return
    with threadpool_limits(1):
        yield


class Pool:
    """Worker processes for tasks; they are started when they are needed and are gone when the context is left.

    Parameters
    ----------
    jobs
        Number of processes.
    pinned
        Hold the workers to one core. Open3D and kiss-icp sum in parallel through TBB, in an order that changes from run to run.
        On one core there is one order. TBB counts the cores when it is loaded, so a worker is pinned before it imports either;
        this process, which may have imported anything, cannot be.
    retries
        How often a task is tried again after its worker died.
    """

    def __init__(self, jobs: int, *, pinned: bool = False, retries: int = RETRIES) -> None:
        self._jobs, self._pinned, self._retries = jobs, pinned, retries
        self._context = multiprocessing.get_context("spawn")
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        # A worker reads from this pipe until nobody can write to it any more, and then ends.
        self._lifeline, self._held = self._context.Pipe(duplex=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.close()  # what workers still write has other names until it is whole
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
        self._executor = None
        self._lifeline.close()

    def run(
        self,
        function: Callable[..., Any],
        tasks: Sequence[tuple[Any, ...]],
        tick: Callable[[], None] | None = None,
    ) -> Iterator[tuple[int, Any]]:
        """Do all tasks.

        A worker gets its next task when its result is taken, so that results do not pile up in memory. When a worker dies, all
        tasks that were being done are suspects. They are tried again one at a time, so that the guilty one condemns no other.

        Parameters
        ----------
        function
            Importable by name.
        tasks
            Its arguments, picklable.
        tick
            Called about once a second while results are awaited.

        Yields
        ------
        tuple
            Index of a task and its result, as they come. The result is a :class:`TofError` where the task raised one or its
            worker died too often. Any other error is raised.
        """
        queue, deaths = deque(range(len(tasks))), [0] * len(tasks)
        busy: dict[Future[Any], tuple[int, ProcessPoolExecutor]] = {}

        def fits(index: int) -> bool:
            suspicious = deaths[index] or any(deaths[i] for i, _ in busy.values())
            return not busy or (len(busy) < self._jobs and not suspicious)

        def hand_out() -> None:
            while queue and fits(queue[0]):
                future, executor = self._submit(function, tasks[queue[0]])
                busy[future] = queue.popleft(), executor

        try:
            hand_out()
            while busy:
                ready, _ = wait(busy, TICK if tick else None, FIRST_COMPLETED)
                if tick:
                    tick()
                for future in ready:
                    index, executor = busy.pop(future)
                    result = future.exception() or future.result()
                    if isinstance(result, BrokenProcessPool):
                        self._forget(executor)
                        deaths[index] += 1
                        if deaths[index] <= self._retries:
                            queue.appendleft(index)
                            continue
                        result = _died(deaths[index])
                    elif isinstance(result, BaseException) and not isinstance(result, TofError):
                        raise result
                    hand_out()
                    yield index, result
                hand_out()
        finally:
            for future in busy:
                future.cancel()

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Do one task in a worker; what it raises is raised here, :class:`TofError` where its worker died too often."""
        ((_, result),) = self.run(function, [arguments])
        if isinstance(result, TofError):
            raise result
        return result

    def _submit(
        self, function: Callable[..., Any], arguments: tuple[Any, ...]
    ) -> tuple[Future[Any], ProcessPoolExecutor]:
        while True:
            if self._executor is None:
                self._executor = ProcessPoolExecutor(
                    self._jobs, self._context, _begin, (self._lifeline, self._pinned)
                )
            try:
                with _environment(), _without_script(function):
                    return self._executor.submit(_work, function, arguments), self._executor
            except BrokenProcessPool:  # a worker died while it had nothing to do
                self._forget(self._executor)

    def _forget(self, executor: ProcessPoolExecutor) -> None:
        if self._executor is executor:
            self._executor = None


@contextmanager
def _environment() -> Iterator[None]:
    """Set what a process that is started now inherits."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


@contextmanager
def _without_script(function: Callable[..., Any]) -> Iterator[None]:
    """Keep a process that is started now from running the user's script again, which may have no guard against that.

    Only a function that is defined in the script itself needs it there.
    """
    script = sys.modules["__main__"]
    if function.__module__ != "__main__":
        sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _begin(lifeline: Connection, pinned: bool) -> None:
    """Prepare a worker, before any library is loaded."""
    # Ctrl-C reaches whoever opened the pool, who ends the workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if pinned and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    threading.Thread(target=_end_with_pool, args=(lifeline,), daemon=True).start()


def _end_with_pool(lifeline: Connection) -> None:
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


def _work(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    with one_thread():
        return function(*arguments)


def _died(times: int) -> TofError:
    return TofError(
        f"the worker process died, {times} times",
        "out of memory? use fewer processes: --jobs 1; see also dmesg",
    )
