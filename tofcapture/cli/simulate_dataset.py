"""``tofcapture simulate-dataset``: a simulated dataset by a documented recipe, in one command."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.command import Command, Outcome

if TYPE_CHECKING:
    from tofcapture.suites.run import Simulated

_EVERY = 5.0  # s between lines of progress
_FULL = 100  # scenes that figures are extrapolated to


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenes", type=int, required=True, metavar="N", help="scenes to simulate")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="the dataset's folder; completed when it exists",
    )
    parser.add_argument(
        "--suite",
        default="tof100",
        metavar="NAME",
        help="tof100, indoor, multipath or noise (default tof100; docs/simulator.md)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything (default 0)")
    parser.add_argument("--views", type=int, default=25, help="views of each scene (default 25)")
    parser.add_argument("--frames", type=int, default=10, help="ToF frames of each view (default 10)")
    parser.add_argument(
        "--cameras", type=int, default=1, metavar="N", help="rigs that the scenes take turns with (default 1)"
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        default=(),
        metavar="KIND",
        help="kinds of scenes, in turns, instead of the recipe's (tof100): object, combination, concave, corner, bright, dark, mesh",
    )
    parser.add_argument(
        "--meshes", type=Path, metavar="DIR", help="meshes for a tenth of the scenes (tof100)"
    )
    parser.add_argument("--mesh-unit", default="mm", help="unit of the meshes: m, cm or mm (default mm)")
    parser.add_argument(
        "--station", type=Path, metavar="TOML", help="take the simulator's constants from its [sim]"
    )
    parser.add_argument(
        "--split",
        choices=("train", "val", "test"),
        help="put every scene into this split (default: by their objects)",
    )
    parser.add_argument("--jobs", type=int, metavar="J", help="processes (default one per core)")


class _Lines:
    """Progress with an ETA: a line now and then, rewritten on a terminal."""

    def __init__(self) -> None:
        self._start = self._last = time.monotonic()
        self._first: int | None = None

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        self._first = done if self._first is None else self._first
        if now - self._last < (0.5 if sys.stderr.isatty() else _EVERY) and done < total:
            return
        self._last = now
        fresh = done - self._first
        eta = f"ETA {(now - self._start) / fresh * (total - done):.0f} s" if fresh else "ETA unknown"
        end = "\r" if sys.stderr.isatty() and done < total else "\n"
        print(f"simulate-dataset: {done} of {total} views, {eta:<20}", end=end, file=sys.stderr, flush=True)


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.devices.station import read_station
    from tofcapture.errors import UsageError
    from tofcapture.suites.make import Wish
    from tofcapture.suites.run import simulate_dataset
    from tofcapture.suites.tabletop import table_meshes

    if args.jobs is not None and args.jobs < 1:
        raise UsageError(f"--jobs: expected at least 1, got {args.jobs}")
    if args.seed < 0:
        raise UsageError(f"--seed: expected a whole number from 0 on, got {args.seed}")
    if args.meshes is not None and args.suite != "tof100":
        raise UsageError(f"--meshes: the suite {args.suite} takes no meshes", hint="--suite tof100")
    meshes = () if args.meshes is None else table_meshes(args.meshes, args.mesh_unit, args.seed)
    tables = {} if args.station is None else read_station(args.station).get("sim", {})
    wish = Wish(
        suite=args.suite,
        seed=args.seed,
        scenes=args.scenes,
        views=args.views,
        frames=args.frames,
        meshes=meshes,
        mesh_unit=args.mesh_unit,
        cameras=args.cameras,
        kinds=tuple(args.kinds),
        sim={name: table for name, table in tables.items() if isinstance(table, dict)},
    )
    result = simulate_dataset(wish, args.out, args.jobs, _Lines(), args.split)
    return Outcome(data=_data(result), text=_text(_data(result)))


def _data(result: Simulated) -> dict[str, Any]:
    made, every = result.made, (*result.made, *result.kept)
    views = sum(m.views for m in made)
    stages = sorted({s for m in made for s in m.cpu} - {"views"})
    cpu = {s: sum(m.cpu.get(s, 0.0) for m in made) / max(views, 1) for s in stages}
    per_scene = result.seconds / len(made) if made else 0.0
    size = sum(m.bytes for m in every)
    return {
        "dataset": str(result.dataset),
        "scenes": len(every),
        "views": sum(m.views for m in every),
        "kept": sorted(m.scene for m in result.kept),
        "splits": dict(sorted(result.splits.items())),
        "gt": result.gt,
        "seconds": round(result.seconds, 1),
        "seconds_per_view": round(result.seconds / views, 3) if views else None,
        "cpu_seconds_per_view": {s: round(v, 3) for s, v in cpu.items()},
        "bytes": size,
        "extrapolated": {
            "scenes": _FULL,
            "hours": round(_FULL * per_scene / 3600, 2) if made else None,
            "core_hours": round(_FULL * sum(cpu.values()) * views / len(made) / 3600, 2) if made else None,
            "gigabytes": round(_FULL * size / len(every) / 1e9, 1),
        },
    }


def _text(data: dict[str, Any]) -> str:
    lines = [
        f"{data['dataset']}: {data['scenes']} scenes, {data['views']} views, {data['bytes'] / 1e9:.2f} GB in {data['seconds']:.0f} s"
    ]
    if data["kept"]:
        lines.append(f"{len(data['kept'])} scenes were there already")
    if data["seconds_per_view"] is not None:
        stages = ", ".join(f"{s} {v:.2f}" for s, v in data["cpu_seconds_per_view"].items())
        lines.append(f"{data['seconds_per_view']:.2f} s per view; CPU seconds of it: {stages}")
        full = data["extrapolated"]
        lines.append(
            f"{full['scenes']} scenes like these: {full['hours']:.1f} hours here and now, {full['core_hours']:.1f} hours of one core, {full['gigabytes']:.1f} GB"
        )
    if data["gt"] is not None and data["gt"]["median_error_mm"] is not None:
        gt = data["gt"]
        lines.append(
            f"ground truth against the simulator: median {gt['median_error_mm']:.2f} mm, "
            f"99 % {gt['p99_error_mm']:.2f} mm, covers {gt['coverage']:.0%} of the objects"
        )
    return "\n".join(lines)


COMMAND = Command(
    help="simulate a whole dataset by recipe: ToF-100, indoor, multipath or noise; resumable",
    example="tofcapture simulate-dataset --scenes 4 --out datasets/simulated",
    configure=_configure,
    run=_run,
)
