"""Seconds per view of the simulated station by stage: 10 ToF frames, a stereo point map, exact truth, multipath converged.

Full-size scenes of the tof100 suite are captured in one process per core, each of one thread, as ``simulate-dataset`` does.
Printed: CPU seconds per view of each stage, what a scene costs once, and wall-clock seconds per view over all processes with
the scene's share of a 25-view scene in it. CPU seconds are what to compare on a busy machine.

    python benchmarks/simulate.py [--jobs 2] [--views 6] [--suite tof100]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

_SCENE = ("scene", "poses")  # once a scene
_VIEWS = 25  # of a scene of the dataset


def capture(suite: str, index: int, views: int, folder: str) -> tuple[Counter[str], float]:
    """CPU seconds by stage, and wall-clock seconds, of one scene's views; the first scene of a process warms it up."""
    from tofcapture.suites.capture import Job, take_views
    from tofcapture.suites.make import make_scene
    from tofcapture.suites.scene import load_recipe

    recipe = load_recipe(suite)
    scene = make_scene(recipe, index, 0)
    job = Job(scene, 0, views, 10, recipe.sim, {})
    start = time.perf_counter()
    spent = take_views(job, Path(folder) / str(index) / str(views))
    return spent, time.perf_counter() - start


def warmed(suite: str, index: int, views: int, folder: str) -> tuple[Counter[str], float]:
    """:func:`capture` in a process whose libraries are loaded."""
    capture(suite, index, 1, folder)
    return capture(suite, index, views, folder)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--suite", default="tof100")
    args = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool,
    ):
        tasks = [pool.submit(warmed, args.suite, i, args.views, folder) for i in range(args.jobs)]
        results = [task.result() for task in tasks]
    total: Counter[str] = Counter()
    for spent, _ in results:
        total.update(spent)
    views = total.pop("views")
    once = {s: total.pop(s) / args.jobs for s in _SCENE}
    per_view = {s: t / views for s, t in total.items()}
    cpu = sum(per_view.values()) + sum(once.values()) / _VIEWS
    # Wall clock of a whole scene is that of these views, with the scene's own share stretched to 25 of them.
    slow = sum(wall for _, wall in results) / sum(sum(s.values()) - s["views"] for s, _ in results)
    for stage, seconds in sorted(per_view.items(), key=lambda item: -item[1]):
        print(f"{stage:<8} {seconds:6.3f} CPU s per view")
    for stage, seconds in once.items():
        print(f"{stage:<8} {seconds:6.3f} CPU s per scene, {seconds / _VIEWS:.3f} per view of {_VIEWS}")
    print(f"in all   {cpu:6.3f} CPU s per view; the machine gave a process {1 / slow:.0%} of a core")
    print(
        f"{args.jobs} processes: {cpu * slow / args.jobs:.2f} s per view ({cpu / args.jobs:.2f} s on free cores)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
