"""Train all that the tables need, each with the same budget, and measure them: the paper's tables II to IV on one dataset.

    python benchmarks/tables.py DATASET --out tables --minutes 60 --device cuda [--seeds 3] [--suite main ablation inputs]

Runs are kept in ``OUT/runs/NAME-SEED`` and resumed; finished ones are not trained again. The compared networks get the same data,
crops, batches and minutes; ``--width`` and ``--crop`` shrink everything for a try.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from tofcapture_model.config import Config, Stage, preset
from tofcapture_model.progress import progress


def recipes() -> dict[str, dict[str, Config]]:
    """Configurations by suite and by the name that the suite's table prints."""
    fair = preset("compact").training
    paper = replace(preset("paper"), training=replace(preset("su2018").training, frames=fair.frames))
    network, losses = paper.network, paper.losses
    one_pass = (Stage("depth", 230), Stage("normal", 460))
    main = {name: preset(name) for name in ("su2018", "guo2018", "coarse-fine", "compact")} | {"paper": paper}
    ablation = {
        "paper": paper,
        "without-chamfer": replace(paper, losses=replace(losses, chamfer=0.0)),
        "without-reweighting": replace(paper, losses=replace(losses, reweight=False)),
        "without-refinement": replace(paper, network=replace(network, refine_iterations=0), stages=one_pass),
        "without-multi-input": replace(paper, network=replace(network, inputs=("raw",))),
        "without-upsampling": replace(paper, network=replace(network, learned_upsampling=False)),
    }
    inputs = {
        f"inputs-{'-'.join(some)}": replace(paper, network=replace(network, inputs=some))
        for some in (("raw",), ("depth",), ("raw", "confidence"), ("raw", "depth"))
    }
    return {"main": main, "ablation": ablation, "inputs": {"paper": paper, **inputs}}


def shrunk(config: Config, width: int, crop: int) -> Config:
    """The same with small networks and crops."""
    small = replace(config.network, width=width, levels=3) if width else config.network
    cut = replace(config.training, crop=(crop, crop), batch=2) if crop else config.training
    return replace(config, network=small, training=cut)


def main() -> None:
    """Train what is missing, then write the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, required=True, help="of training, for each run")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--suite", nargs="+", choices=list(recipes()), default=list(recipes()))
    parser.add_argument("--frames", type=int, default=0, help="of every view that are measured; 0: all")
    parser.add_argument("--width", type=int, default=0)
    parser.add_argument("--crop", type=int, default=0)
    args = parser.parse_args()
    from tofcapture_model.suite import run_suite
    from tofcapture_model.train import train

    wanted = {name: c for suite in args.suite for name, c in recipes()[suite].items()}
    runs: dict[str, list[Path]] = {}
    with progress() as report:
        for name, recipe in wanted.items():
            for seed in range(args.seeds):
                out = args.out / "runs" / f"{name}-{seed}"
                config = shrunk(
                    replace(recipe, training=replace(recipe.training, seed=seed, validate_every=0)),
                    args.width,
                    args.crop,
                )
                done = train(
                    config,
                    args.dataset,
                    out,
                    minutes=args.minutes,
                    device=args.device,
                    report=lambda w, f, t, n=name, s=seed: report(f"{n}-{s} {w}", f, t),
                )
                runs.setdefault(name, []).append(out)
                print(json.dumps({"run": str(out), "steps": done.steps}), flush=True)
        for suite in args.suite:
            chosen = {n: r for n, r in runs.items() if n in recipes()[suite]}
            run_suite(
                args.dataset,
                suite,
                chosen,
                args.out / suite / "results.json",
                frames=args.frames,
                device=args.device,
            )
            print((args.out / suite / "tables.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
