"""``tofcapture simulate`` and ``simulate-dataset``: one view of a world file, or a dataset by a documented recipe."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.kit import Command, Outcome, counted, progress

if TYPE_CHECKING:
    from tofcapture.suites.run import Simulated

_FULL = 100  # scenes that figures are extrapolated to


def _configure_view(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("world", type=Path, metavar="WORLD.toml", help="the world: meshes, albedos, cameras")
    file = "view file to write; replaced if it exists"
    add("--out", type=Path, required=True, metavar="VIEW.h5", help=file)
    text = "no sensor imperfection, no quantisation; geometry, albedo and multipath stay"
    add("--ideal", action="store_true", help=text)
    add("--frames", type=int, metavar="N", help="frames in the burst (default: 10, ideal 1)")


def _run_view(args: argparse.Namespace) -> Outcome:
    import numpy as np

    from tofcapture.devices.sim.world import simulate
    from tofcapture.errors import UsageError
    from tofcapture.files.view import write_view

    frames = args.frames if args.frames is not None else (1 if args.ideal else 10)
    if frames < 1:
        raise UsageError(f"--frames: expected at least 1, got {frames}")
    view = simulate(args.world, ideal=args.ideal, frames=frames)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    digest = write_view(args.out, view)
    assert view.truth is not None
    depth = view.truth.depth
    hit = float(np.isfinite(depth).mean())
    span = [float(np.nanmin(depth)), float(np.nanmax(depth))] if hit else [None, None]
    data = {"view": str(args.out), "sha256": digest, "frames": frames, "ideal": args.ideal}
    return Outcome(
        data={**data, "hit": hit, "depth_m": span},
        text=f"{args.out}: {frames} frame(s), {hit:.0%} of the image meets a surface",
    )


def _configure_dataset(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    folder = "the dataset's folder; completed when it exists"
    add("--out", type=Path, required=True, metavar="DIR", help=folder)
    add(
        "--suite",
        default="tof100",
        metavar="NAME",
        help="tof100, indoor, multipath or noise (default: tof100)",
    )
    for name, default, text in (
        ("--scenes", None, "scenes to simulate"),
        ("--seed", 0, "seed of everything (default: 0)"),
        ("--views", 25, "views of each scene (default: 25)"),
        ("--frames", 10, "ToF frames of each view (default: 10)"),
        ("--cameras", 1, "rigs that the scenes take turns with (default: 1)"),
        ("--jobs", None, "processes (default: one per core)"),
    ):
        add(name, type=int, metavar="N", default=default, required=name == "--scenes", help=text)
    kinds = "object, combination, concave, corner, bright, dark, mesh, black, white"
    text = f"kinds of scenes, in turns, instead of the recipe's (tof100): {kinds}"
    add("--kinds", nargs="+", default=(), metavar="KIND", help=text)
    add("--meshes", type=Path, metavar="DIR", help="meshes for a tenth of the scenes (tof100)")
    add("--mesh-unit", default="mm", metavar="UNIT", help="of the meshes: m, cm or mm (default: mm)")
    add("--station", type=Path, metavar="STATION.toml", help="take the simulator's constants from its [sim]")
    add(
        "--split",
        metavar="SPLIT",
        choices=("train", "val", "test"),
        help="train, val or test, of every scene (default: by their objects)",
    )


def _run_dataset(args: argparse.Namespace) -> Outcome:
    from tofcapture.devices.station import read_station
    from tofcapture.errors import UsageError
    from tofcapture.suites.make import DatasetSpec
    from tofcapture.suites.run import simulate_dataset
    from tofcapture.suites.tabletop import table_meshes

    if args.jobs is not None and args.jobs < 1:
        raise UsageError(f"--jobs: expected at least 1, got {args.jobs}")
    if args.seed < 0:
        raise UsageError(f"--seed: expected a whole number from 0 on, got {args.seed}")
    if args.meshes is not None and args.suite != "tof100":
        raise UsageError(f"--meshes: the suite {args.suite} takes no meshes", hint="--suite tof100")
    meshes, unfit = ((), ()) if args.meshes is None else table_meshes(args.meshes, args.mesh_unit, args.seed)
    tables = {} if args.station is None else read_station(args.station).get("sim", {})
    same = {
        k: getattr(args, k) for k in ("suite", "seed", "scenes", "views", "frames", "mesh_unit", "cameras")
    }
    sim = {name: table for name, table in tables.items() if isinstance(table, dict)}
    spec = DatasetSpec(**same, meshes=meshes, kinds=tuple(args.kinds), sim=sim)
    with progress() as report:
        result = simulate_dataset(
            spec, args.out, args.jobs, lambda done, total: report("views", done, total), args.split
        )
    data = _data(result) | {"left_out": [path.name for path in unfit]}
    return Outcome(data, _text(data), following=f"tofcapture train {args.out} --out run")


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
    from tofcapture.dataset.sample import error_in_words

    lines = [
        f"{data['dataset']}: {counted(data['scenes'], 'scene')}, {counted(data['views'], 'view')}, {data['bytes'] / 1e9:.2f} GB in {data['seconds']:.0f} s"
    ]
    if data["left_out"]:
        lines.append(f"left out, not of 3 to 30 cm or damaged: {', '.join(data['left_out'])}")
    if data["kept"]:
        lines.append(f"{len(data['kept'])} scenes were there already")
    if data["seconds_per_view"] is not None:
        stages = ", ".join(f"{s} {v:.2f}" for s, v in data["cpu_seconds_per_view"].items())
        lines.append(f"{data['seconds_per_view']:.2f} s per view; CPU seconds of it: {stages}")
        full = data["extrapolated"]
        lines.append(
            f"{full['scenes']} scenes like these: {full['hours']:.1f} hours here and now, {full['core_hours']:.1f} hours of one core, {full['gigabytes']:.1f} GB"
        )
    if data["gt"] is not None:
        lines.append(f"ground truth against the simulator: {error_in_words(data['gt'])}")
    return "\n".join(lines)


SIMULATE = Command(
    help="render one view of a world file with the simulated cameras",
    example="tofcapture simulate world.toml --out view.h5 --ideal",
    configure=_configure_view,
    run=_run_view,
)
SIMULATE_DATASET = Command(
    help="simulate a whole dataset by recipe: ToF-100, indoor, multipath or noise; resumable",
    example="tofcapture simulate-dataset --scenes 4 --out datasets/simulated",
    configure=_configure_dataset,
    run=_run_dataset,
)
