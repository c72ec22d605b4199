"""A worker process whose libraries give the same bits every time.

Open3D and kiss-icp sum in parallel through TBB, in an order that changes from run to run. On one core there is one order; but
TBB counts the cores when it is loaded, so the process must be pinned before it imports either. A spawned worker can be, the
caller's process, which may have imported anything, cannot.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from tofcapture.errors import TofError


def pin_to_one_core() -> None:
    """Restrict this process to the first core it may use; a no-op where the system has no such call."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@contextmanager
def pinned_worker() -> Iterator[ProcessPoolExecutor]:
    """Open a pool of one spawned, pinned worker.

    Yields
    ------
    ProcessPoolExecutor
        Functions and arguments must pickle. Errors raised in the worker are raised again by ``result()``.

    Raises
    ------
    TofError
        When the worker dies: most often because the calling script starts work at import.
    """
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=pin_to_one_core)
    try:
        yield pool
    except BrokenProcessPool as err:
        raise TofError(
            "the registration worker died without an answer",
            hint="a script that calls align() needs: if __name__ == '__main__'; else look for lack of memory",
        ) from err
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
