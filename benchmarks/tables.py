"""Train all that the tables need, each with the same budget, and measure them: the paper's tables II to IV on one dataset.

    python benchmarks/tables.py DATASET --out tables --minutes 60 --device cuda [--seeds 3] [--suite main ablation inputs]
    python benchmarks/tables.py DATASET --out tables --minutes 60 --width 16 --precision bfloat16 --threads 2 --test OTHER

Runs are kept in ``OUT/runs/NAME-SEED`` and resumed; finished ones are not trained again, and one that two tables need is trained once.
All networks get the same frames, crops, batches, schedule and minutes; ``--width`` and ``--crop`` shrink everything, for a try or for a
machine without a GPU. Which row is which run: docs/paper-map.md.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from tofcapture.cli.kit import Report, progress
from tofcapture_model.config import BASELINES, OURS, Config, Training, preset


def recipes() -> dict[str, dict[str, Config]]:
    """Configurations by suite and by the name of the run; :data:`tofcapture_model.evaluation.tables.SUITES` has the tables' words for them."""
    paper = preset("paper")
    network, losses = paper.network, paper.losses
    one_pass = tuple(stage for stage in paper.stages if stage.name != "refine")
    published = {name: preset(name) for name in ("su2018", "guo2018", "coarse-fine")}
    raw_only = _reading(paper, "raw")
    ablation = {
        "inputs-raw": raw_only,
        "without-chamfer": replace(paper, losses=replace(losses, chamfer=0.0)),
        "without-error-map": replace(paper, losses=replace(losses, reweight=False, error=0.0)),
        "without-refinement": replace(paper, network=replace(network, refine_iterations=0), stages=one_pass),
    }
    inputs = {
        "inputs-confidence": _reading(paper, "confidence"),
        "inputs-raw": raw_only,
        "inputs-depth": _reading(paper, "depth"),
        "inputs-raw-depth": _reading(paper, "raw", "depth"),
    }
    return {
        "main": {**published, "paper": paper, "compact": preset("compact")},
        "ablation": {**ablation, "paper": paper},
        "inputs": {**inputs, "paper": paper},
    }


def _reading(config: Config, *inputs: str) -> Config:
    return replace(config, network=replace(config.network, inputs=inputs))


def on_equal_terms(recipe: Config, args: argparse.Namespace, seed: int) -> Config:
    """The same network and losses with the training that all get: that of compact, of which the command line may change some."""
    fair: Training = replace(
        preset("compact").training, seed=seed, validate_every=0, precision=args.precision
    )
    if args.crop:
        fair = replace(fair, crop=(args.crop, args.crop), batch=2)
    network = replace(recipe.network, width=args.width, levels=3) if args.width else recipe.network
    rate = args.rate.get(network.kind)
    stages = tuple(replace(stage, learning_rate=rate or stage.learning_rate) for stage in recipe.stages)
    return replace(recipe, network=network, training=fair, stages=stages)


def _rate(pair: str) -> tuple[str, float]:
    """Read ``KIND=RATE``."""
    kind, _, rate = pair.partition("=")
    if kind not in OURS + BASELINES:
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(OURS + BASELINES)}, got {kind!r}")
    return kind, float(rate)  # argparse says what is wrong with a rate that is no number


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("dataset", type=Path)
    add("--out", type=Path, required=True)
    add("--minutes", type=float, required=True, help="of training, for each run")
    add("--device", default="cpu")
    add("--seeds", type=int, default=1)
    add("--suite", nargs="+", choices=list(recipes()), default=list(recipes()))
    add("--cache", type=Path, help="what `tofcapture pack` made of the train split")
    add("--test", type=Path, help="dataset whose test split is measured (default: DATASET)")
    add("--add", nargs="+", default=[], metavar="NAME=RUN", help="rows of the main table trained elsewhere")
    add("--frames", type=int, default=0, help="of every view that are measured; 0: all")
    add("--width", type=int, default=0, help="of the networks that have one, with three levels")
    add("--crop", type=int, default=0, help="square, in batches of two")
    add(
        "--rate",
        nargs="+",
        type=_rate,
        default=[],
        metavar="KIND=RATE",
        help="learning rates instead of the presets', for budgets far below the published epochs",
    )
    add("--precision", choices=("float32", "bfloat16"), default="float32", help="of the training")
    add("--threads", type=int, default=0, help="of the CPU (default: as many as PyTorch takes)")
    args = parser.parse_args()
    args.rate = dict(args.rate)
    if args.add and "main" not in args.suite:
        parser.error("--add makes rows of the table main, which --suite leaves out")
    return args


def _titled(run: str, report: Report) -> Report:
    return lambda what, done, total, text="": report(f"{run} {what}", done, total, text)


def _train_all(args: argparse.Namespace, wanted: Mapping[str, Config]) -> dict[str, list[Path]]:
    """Train what is missing; folders of runs by name."""
    from tofcapture_model.training.train import train

    runs: dict[str, list[Path]] = {}
    for name, seed in [(name, seed) for name in wanted for seed in range(args.seeds)]:
        out = args.out / "runs" / f"{name}-{seed}"
        with progress() as report:
            done = train(
                on_equal_terms(wanted[name], args, seed),
                args.dataset,
                out,
                minutes=args.minutes,
                device=args.device,
                cache=args.cache,
                report=_titled(out.name, report),
            )
        runs.setdefault(name, []).append(out)
        print(json.dumps({"run": str(out), "steps": done.steps}), flush=True)
    return runs


def main() -> None:
    """Train what is missing, measure every run once, write the tables."""
    args = _arguments()
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")  # before torch: idle threads soon sleep
    import torch

    from tofcapture_model.evaluation.suite import FREE, measure_runs, read_weights, write_suite

    if args.threads:
        torch.set_num_threads(args.threads)
    added = read_weights(args.add)
    wanted = {name: c for suite in args.suite for name, c in recipes()[suite].items()}
    taken = wanted.keys() & added.keys()
    if taken:
        raise SystemExit(f"--add: {', '.join(sorted(taken))} is trained here, choose another name")
    runs = _train_all(args, wanted) | added
    with progress() as report:
        results = measure_runs(
            args.test or args.dataset,
            runs,
            frames=args.frames,
            device=args.device,
            kept=args.out / "results.runs.json",
            progress=lambda done, total: report("measure", done, total),
        )
    for suite in args.suite:
        names = {*FREE, *recipes()[suite], *(added if suite == "main" else ())}
        write_suite(results, suite, args.out / suite / "results.json", names)
        print((args.out / suite / "tables.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
