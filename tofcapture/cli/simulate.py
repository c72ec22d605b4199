"""``tofcapture simulate``: render one view of a world file."""

from __future__ import annotations

import argparse
from pathlib import Path

from tofcapture.command import Command, Outcome


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("world", type=Path, metavar="WORLD.toml", help="the world: meshes, albedos, cameras")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="VIEW.h5", help="view file to write; replaced if it exists"
    )
    parser.add_argument(
        "--ideal",
        action="store_true",
        help="no sensor imperfection, no quantisation; geometry, albedo and multipath stay",
    )
    parser.add_argument("--frames", type=int, default=None, help="frames in the burst (default 10, ideal 1)")


def _run(args: argparse.Namespace) -> Outcome:
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
    text = f"{args.out}: {frames} frame(s), {hit:.0%} of the image meets a surface"
    return Outcome(
        data={
            "view": str(args.out),
            "sha256": digest,
            "frames": frames,
            "ideal": args.ideal,
            "hit": hit,
            "depth_m": span,
        },
        text=text,
    )


COMMAND = Command(
    help="render one view of a world file with the simulated cameras",
    example="tofcapture simulate world.toml --out view.h5 --ideal",
    configure=_configure,
    run=_run,
)
