"""``tofcapture build-dataset``: recordings to shards, manifest and card."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.kit import Command, Outcome, counted, progress
from tofcapture.errors import ConfigError

if TYPE_CHECKING:
    from tofcapture.dataset.build import BuildResult


def _configure(parser: argparse.ArgumentParser) -> None:
    add, rig = parser.add_argument, parser.add_mutually_exclusive_group()
    batch = parser.add_mutually_exclusive_group()
    add("recordings", nargs="+", type=Path, metavar="RECORDING", help="folders that record filled")
    add("--out", type=Path, required=True, metavar="DIR", help="the dataset's folder")
    which = "rig to use (default: RECORDING/rig.toml, written by align)"
    rig.add_argument("--rig", type=Path, metavar="RIG.toml", help=which)
    which = "use the rig that the simulator knows (simulated recordings)"
    rig.add_argument("--true-rig", action="store_true", help=which)
    radius = "object within this radius, metres (default: 0.35)"
    add("--crop-radius", type=float, metavar="M", help=radius)
    add("--far", type=float, metavar="M", help="deepest ground truth, metres (default: 2.0)")
    scales = "resolutions of the ground truth, in ToF images: 1 2 4 adds 4x (default: 1 2)"
    add("--scales", nargs="+", type=int, choices=(1, 2, 4), default=(1, 2), metavar="S", help=scales)
    truth = (
        "fused of all views of a scene where their poses allow, or each view's single one (default: single)"
    )
    add("--truth", choices=("fused", "single"), default="single", metavar="TRUTH", help=truth)
    add("--jobs", type=int, metavar="N", help="processes (default: one per core, at most 4)")
    engine = "who builds: process or dask (default: process)"
    add("--engine", choices=("process", "dask"), default="process", metavar="ENGINE", help=engine)
    add("--scheduler", metavar="ADDRESS", help="of a Dask cluster, for example tcp://host:8786")
    part = "build part I of N of the scenes; the last to end finishes the dataset"
    batch.add_argument("--part", metavar="I/N", help=part)
    finish = "build nothing, write manifest and card of the shards that are there"
    batch.add_argument("--finish", action="store_true", help=finish)


def _positive(value: float | None, name: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not value > 0:
        raise ConfigError(f"--{name.replace('_', '-')}: expected a positive number, got {value}")
    return {name: value}


def _part(text: str | None) -> tuple[int, int] | None:
    """Read ``2/8``."""
    if text is None:
        return None
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal()):
        raise ConfigError(f"--part: expected I/N with 1 <= I <= N, got {text!r}", hint="--part 2/8")
    return int(index), int(count)


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.dataset.build import build_dataset, find_scenes
    from tofcapture.dataset.sample import SCALES, SampleConfig

    config = SampleConfig(
        **_positive(args.crop_radius, "crop_radius"),
        **_positive(args.far, "far"),
        scales=tuple(sorted({*SCALES, *args.scales})),
        truth=args.truth,
    )
    _positive(args.jobs, "jobs")
    start = time.monotonic()
    total = sum(len(views) for _, views in find_scenes(args.recordings).values())
    done: dict[str, int] = {}
    with progress() as report:

        def tell(scene: str, view: int, views: int) -> None:
            done[scene] = view
            report("build", sum(done.values()), total, f"{scene}: view {view} of {views}")

        result = build_dataset(
            args.recordings,
            args.out,
            args.rig,
            true_rig=args.true_rig,
            config=config,
            jobs=args.jobs,
            progress=tell,
            engine=args.engine,
            scheduler=args.scheduler,
            part=_part(args.part),
            finish=args.finish,
        )
    return _outcome(result, time.monotonic() - start, complete=args.part is None)


def _outcome(result: BuildResult, seconds: float, *, complete: bool) -> Outcome:
    views = sum(e.views for e in result.scenes.values())
    data = {
        "dataset": str(result.dataset),
        "scenes": len(result.scenes),
        "views": views,
        "skipped": list(result.skipped),
        "splits": {name: entry.split for name, entry in sorted(result.scenes.items())},
        "gt": None if result.gt is None else result.gt.table(),
        "failures": {scene: {"message": e.message, "hint": e.hint} for scene, e in result.failures.items()},
        "bare": {scene: list(names) for scene, names in result.bare.items()},
        "alone": {scene: dict(why) for scene, why in result.alone.items()},
        "missing": list(result.missing),
        "peak_memory_bytes": result.peak_memory,
        "seconds": round(seconds, 2),
    }
    bad = result.failures or (complete and result.missing)
    following = f"tofcapture train {result.dataset} --out run"
    return Outcome(data, _text(result, views, seconds), 5 if bad else 0, following)


def _text(result: BuildResult, views: int, seconds: float) -> str:
    from tofcapture.dataset.sample import error_in_words

    lines = [
        f"{name:<24} {entry.split:<6} {counted(entry.views, 'view')}"
        for name, entry in sorted(result.scenes.items())
    ]
    lines.append(
        f"{result.dataset}: {counted(len(result.scenes), 'scene')}, {counted(views, 'view')} in {seconds:.1f} s, "
        f"at most {result.peak_memory / 2**30:.2f} GiB a process"
    )
    if result.skipped:
        lines.append(f"{counted(len(result.skipped), 'scene')} already built")
    if result.gt is not None:
        lines.append(f"ground truth against the simulator: {error_in_words(result.gt.table())}")
    lines += [
        f"no good ground truth in {scene}: {', '.join(names)}; they stay in the shard, fully masked"
        for scene, names in result.bare.items()
    ]
    lines += [
        f"not fused, {scene} {counted(list(why.values()).count(reason), 'view')}: {reason}: "
        f"{', '.join(name for name, said in why.items() if said == reason)}"
        for scene, why in result.alone.items()
        for reason in dict.fromkeys(why.values())
    ]
    if result.missing:
        lines.append(
            f"{len(result.missing)} scenes are not there yet: {', '.join(result.missing[:5])}; no manifest is written"
        )
    lines += [f"FAILED {scene}: {error.message}" for scene, error in result.failures.items()]
    return "\n".join(lines)


COMMAND = Command(
    help="build the shards of a dataset from recordings",
    example="tofcapture build-dataset recordings/first --out datasets/first",
    configure=_configure,
    run=_run,
)
