"""Views per second of build-dataset, whole: reading, decoding, ground truth, compression, verification, fsync.

    python -m benchmarks.build RECORDING... [--jobs 2] [--truth fused] [--scales 1 2 4] [--peer-views 2] [--skip-peer]

Simulated recordings, with the true rig. Printed: views/s of the build by wall clock and by CPU time (all processes), the largest
process, seconds per stage of one view (CPU, median over views, of its own truth), and the same of a plain Open3D script (build_peer.py) on the
first views of the same recording in the same run, with both errors of ground truth: over our pixels, where both have depth.
Compilation happens once a machine and is left out by building one scene first.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import build_peer
from tofcapture.dataset.build import build_dataset, scene_tasks
from tofcapture.dataset.sample import SampleConfig, decoder_for, make_sample, view_error
from tofcapture.files.seal import sealed_digest
from tofcapture.files.shard import ShardWriter
from tofcapture.files.view import read_depth_view


def cpu() -> float:
    """CPU seconds of this process and its finished children."""
    return sum(
        r.ru_utime + r.ru_stime
        for r in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


class Stages:
    """CPU seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {}

    def __call__(self, name: str, function: Callable, *args, **kwargs):
        """Call a function and note its time."""
        start = time.process_time()
        out = function(*args, **kwargs)
        self.seconds.setdefault(name, []).append(time.process_time() - start)
        return out


def stages(paths: list[Path], rig, folder: Path) -> Stages:
    """Every stage of some views, one after the other, in this process."""
    run, config = Stages(), SampleConfig()
    decoder = run("tables of the decoder", decoder_for, read_depth_view(paths[0])[0], rig)
    for path in paths:
        run("digest of the view", sealed_digest, path)
        view, depth = run("read the view", read_depth_view, path)
        run("decode ToF", decoder.burst, view.tof.raw, 40.0)
        rng = np.random.default_rng(view.index)
        sample = run("all of make_sample", make_sample, view, rig, config, rng, decoder, depth)
        with ShardWriter(folder / "s.h5", view.scene, rig, view.tof.info, view.stereo.info, 1) as shard:
            run("write", shard.add, sample, path)
            run("verify, fsync", shard.seal, {})
    return run


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--truth", default="single")
    parser.add_argument("--scales", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--peer-views", type=int, default=2)
    parser.add_argument("--skip-peer", action="store_true")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp())
    config = SampleConfig(truth=args.truth, scales=tuple(args.scales))
    try:
        tasks = scene_tasks(args.recordings, folder / "dataset", true_rig=True)
        rig, views = tasks[0].rig, [v for t in tasks for v in t.views]
        stages(views[:1], rig, folder)  # compiles
        found = stages(views[:: max(1, len(views) // 6)], rig, folder)
        for name, seconds in found.seconds.items():
            print(f"  {name:<20} {1e3 * statistics.median(seconds):7.1f} ms of CPU")
        wall, used = time.perf_counter(), cpu()
        result = build_dataset(
            args.recordings, folder / "dataset", true_rig=True, config=config, jobs=args.jobs
        )
        wall, used = time.perf_counter() - wall, cpu() - used
        ours = len(views) / wall
        print(f"ours: {len(views)} views, {ours:.2f} views/s by the clock with {args.jobs} processes, start included; "
              f"{used / len(views):.3f} s of CPU a view, {args.jobs * len(views) / used:.2f} views/s where {args.jobs} cores "
              f"are free; largest process {result.peak_memory / 2**30:.2f} GiB")  # fmt: skip
        print(f"ours: {result.gt}")
        if not args.skip_peer:
            peer(
                views[:: max(1, len(views) // args.peer_views)][: args.peer_views],
                rig,
                folder,
                ours,
                used / len(views),
            )
    finally:
        shutil.rmtree(folder)


def peer(paths: list[Path], rig, folder: Path, ours: float, our_cpu: float) -> None:
    """The plain script on some views; ratios."""
    wall, used, both = time.perf_counter(), time.process_time(), []
    both += [build_peer.build(path, rig, folder / f"{path.stem}.npz") for path in paths]
    wall, used = time.perf_counter() - wall, time.process_time() - used
    theirs = len(paths) / wall
    print(f"plain script: {theirs:.3f} views/s by the clock, {used / len(paths):.2f} s of CPU a view; "
          f"ours is {ours / theirs:.1f} times as fast, {used / len(paths) / our_cpu:.1f} times by CPU")  # fmt: skip
    errors = {"ours": [], "plain, its ICP": [], "plain, true rig": []}
    for arrays, view in both:
        sample = make_sample(
            view, rig, SampleConfig(), np.random.default_rng(view.index), decoder_for(view, rig)
        )
        errors["ours"].append(view_error(sample, view).errors)
        good = sample.ground_truth[2].mask == 0
        for name, key in (("plain, its ICP", "icp"), ("plain, true rig", "rig")):
            wrong = np.abs(arrays[f"{key}_depth_2x"] - view.truth.depth)[good]
            errors[name].append(wrong[np.isfinite(wrong)])
    for name, parts in errors.items():
        median, p99 = np.percentile(np.concatenate(parts), [50, 99]) * 1e3
        print(f"  error, {name:<16} median {median:.3f} mm, p99 {p99:.3f} mm")


if __name__ == "__main__":
    main()
