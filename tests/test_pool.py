"""Worker processes may die: their tasks are done by others, and nobody else's are harmed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests import PATIENCE, alive, until
from tofcapture.errors import TofError
from tofcapture.pool import Pool

DIE = "__import__('os').kill(__import__('os').getpid(), 9)"


def test_a_task_that_kills_its_workers_is_an_error_and_the_others_are_done():
    """Three deaths are told, with what to try; neighbours have their results; the pool goes on working."""
    with Pool(2) as pool:
        found = dict(pool.run(eval, [("6 * 7",), (DIE,), ("1 / 2",), ("3",), ("4",)]))
        poison = found.pop(1)
        assert found == {0: 42, 2: 0.5, 3: 3, 4: 4}
        assert isinstance(poison, TofError)
        assert "3 times" in poison.message
        assert "--jobs 1" in poison.hint
        assert dict(pool.run(eval, [("2 + 2",)])) == {0: 4}
        with pytest.raises(TofError, match="3 times"):
            pool.call(eval, DIE)
        with pytest.raises(ZeroDivisionError):
            list(pool.run(eval, [("1 / 0",)]))
        assert pool.call(eval, "5") == 5


def test_a_task_is_tried_again_after_its_worker_died(tmp_path):
    """The first worker dies with the task in hand, another one finishes it."""
    flag = str(tmp_path / "flag")
    once = f"'done' if __import__('os').path.exists({flag!r}) else (open({flag!r}, 'w').close(), {DIE})"
    with Pool(1) as pool:
        assert dict(pool.run(eval, [(once,), ("1",)])) == {0: "done", 1: 1}


def test_errors_of_the_project_are_results():
    """A foreseen error belongs to its task; the caller of one task has it raised."""
    task = "(_ for _ in ()).throw(__import__('tofcapture.errors').errors.DataError('bad view', hint='look'))"
    with Pool(1) as pool:
        found = dict(pool.run(eval, [(task,), ("1",)]))
        assert (found[0].message, found[0].hint, found[1]) == ("bad view", "look", 1)
        with pytest.raises(TofError, match="bad view"):
            pool.call(eval, task)


def test_results_wait_for_whoever_takes_them(tmp_path):
    """A slow taker finds as many tasks begun as there are workers and results in hand, not all of them."""
    with Pool(1) as pool:
        tasks = [(f"__import__('pathlib').Path({str(tmp_path)!r}, '{i}').touch()",) for i in range(20)]
        results = pool.run(eval, tasks)
        next(results)
        time.sleep(1)
        assert len(list(tmp_path.iterdir())) <= 2
        assert len(list(results)) == 19


def test_workers_compute_with_one_thread_and_may_be_pinned():
    """The environment of a worker, not of this process; one core where that is asked for."""
    before = os.environ.get("OMP_NUM_THREADS")
    with Pool(1, pinned=True) as pool:
        assert pool.call(os.getenv, "OMP_NUM_THREADS") == "1"
        if hasattr(os, "sched_getaffinity"):
            assert len(pool.call(os.sched_getaffinity, 0)) == 1
    assert os.environ.get("OMP_NUM_THREADS") == before


def test_somebody_is_told_while_results_are_awaited():
    """About once a second, also when nothing comes."""
    told = []
    with Pool(1) as pool:
        list(pool.run(time.sleep, [(1.5,)], tick=lambda: told.append(1)))
    assert told


ORPHANS = """
import os, sys, time
from tofcapture.pool import Pool
if __name__ == "__main__":
    with Pool(2) as pool:
        print(pool.call(os.getpid), flush=True)
        pool.call(time.sleep, 600)
"""


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="asks /proc whether a process lives")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_whoever_opened_the_pool(tmp_path, end):
    """Killed or interrupted in the middle of a task, the process leaves no worker behind, and no worker complains."""
    script = tmp_path / "script.py"
    script.write_text(ORPHANS)
    owner = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    worker = int(owner.stdout.readline())
    assert alive(worker)
    owner.send_signal(end)
    said = owner.communicate(timeout=PATIENCE)[1]
    assert "Process Spawn" not in said
    until(lambda: not alive(worker))
