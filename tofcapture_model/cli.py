"""The commands ``train``, ``evaluate``, ``predict`` and ``report``. Nothing heavy is imported before one of them runs."""

from __future__ import annotations

import argparse
import ctypes
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from tofcapture.command import Command, Outcome
from tofcapture.errors import ConfigError
from tofcapture_model.config import Config, load_config, preset, presets
from tofcapture_model.progress import progress
from tofcapture_model.tables import SUITES

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h


def _share_cores() -> None:
    """Let idle OpenMP threads spin for microseconds only; must run before torch is imported.

    Measured on two cores, a training step of six crops: 0.22 s alone (0.32 s if they never spin), 0.65 s beside two busy processes
    (1.7 s if they spin ten times as long).
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "2000")


def _keep_memory() -> None:
    """Have glibc keep what is freed: it gives blocks of some MB back and asks for zeroed pages again, a sixth of a prediction's time."""
    with suppress(OSError, AttributeError, TypeError):  # another system, another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_MMAP_THRESHOLD, 32 << 20)  # its largest
        libc.mallopt(_TRIM_THRESHOLD, 1 << 30)


def _device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="cpu", help="torch device, such as cpu or cuda (default: cpu)")


def _checked_device(name: str) -> str:
    import torch

    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as err:
        raise ConfigError(
            f"--device {name}: {str(err).splitlines()[0]}", hint="--device cpu always works"
        ) from err
    return name


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"expected a number > 0, got {text}")
    return value


def _count(text: str) -> int:
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number > 0, got {text}")
    return int(text)


def _configure_train(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "dataset",
        type=Path,
        nargs="+",
        help="folders that build-dataset wrote; validation is on the first one's split val",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the run; running again there goes on"
    )
    parser.add_argument(
        "--preset", choices=presets(), default=None, help="where to start from (default: compact)"
    )
    parser.add_argument("--config", type=Path, help="TOML with differences from a preset")
    parser.add_argument("--epochs", type=_count, help="of every stage, instead of the configuration's")
    parser.add_argument("--minutes", type=_positive, help="train for so long; schedules follow the clock")
    parser.add_argument("--seed", type=int, help="of weights, order and crops")
    parser.add_argument(
        "--workers", type=int, default=0, help="processes that read data (default: 0, data stays in memory)"
    )
    parser.add_argument(
        "--from",
        dest="start",
        metavar="WEIGHTS",
        help="fine-tune: start from a checkpoint, a run's folder, or 'bundled' (default preset: fine-tune)",
    )
    parser.add_argument("--cache", type=Path, help="read frames from what `tofcapture pack` wrote")
    _device(parser)


def _config(args: argparse.Namespace) -> Config:
    if args.config and args.preset:
        raise ConfigError(
            "--config and --preset exclude each other", hint='write preset = "..." into the TOML'
        )
    usual = "fine-tune" if args.start else "compact"
    config = load_config(args.config) if args.config else preset(args.preset or usual)
    return config if args.seed is None else replace(config, training=replace(config.training, seed=args.seed))


def _start(name: str | None) -> Path | None:
    if name is None:
        return None
    from tofcapture_model.checkpoint import find_model

    return find_model(None if name == "bundled" else Path(name))


def _train(args: argparse.Namespace) -> Outcome:
    config = _config(args)
    _share_cores()
    from tofcapture_model.train import train

    with progress() as report:
        done = train(
            config,
            args.dataset[0],
            args.out,
            epochs=args.epochs,
            minutes=args.minutes,
            device=_checked_device(args.device),
            workers=args.workers,
            cache=args.cache,
            start=_start(args.start),
            also=args.dataset[1:],
            report=report,
        )
    data: dict[str, Any] = {
        "weights": str(done.path),
        "steps": done.steps,
        "finished": done.finished,
        "losses": done.losses,
    }
    return Outcome(
        data,
        f"{done.path}: trained for {done.steps} steps\n  next: tofcapture evaluate {args.dataset[0]} --weights {args.out}",
    )


def _configure_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, help="folder that build-dataset wrote")
    parser.add_argument(
        "--weights",
        nargs="+",
        metavar="[NAME=]PATH",
        help="checkpoint or folder of a run (default: the bundled weights); with --suite, NAME=PATH of several",
    )
    parser.add_argument(
        "--suite",
        choices=(*SUITES, "all"),
        help="tables of several methods, written beside --out (docs/network.md)",
    )
    parser.add_argument("--scenes", default="", help="with --suite: only scenes whose name begins so")
    parser.add_argument("--out", type=Path, default=Path("results.json"), help="default: results.json")
    parser.add_argument("--split", choices=("train", "val", "test"), default="test", help="default: test")
    parser.add_argument(
        "--frames", type=int, help="frames of every view; 0 takes all (default: 1, with --suite all)"
    )
    _device(parser)


def _evaluate(args: argparse.Namespace) -> Outcome:
    _share_cores()
    if args.suite:
        return _suite(args)
    from tofcapture_model.evaluate import comparison, evaluate

    if args.weights and (len(args.weights) > 1 or "=" in args.weights[0]):
        raise ConfigError(
            "several --weights need a --suite", hint="tofcapture evaluate DATASET --suite main ..."
        )
    with progress() as report:
        results = evaluate(
            args.dataset,
            Path(args.weights[0]) if args.weights else None,
            args.out,
            split=args.split,
            frames=1 if args.frames is None else args.frames,
            device=_checked_device(args.device),
            progress=lambda done, total: report("evaluate", done / total),
        )
    return Outcome({**results, "results": str(args.out)}, f"{comparison(results)}\n{args.out}")


def _suite(args: argparse.Namespace) -> Outcome:
    from tofcapture_model.suite import read_weights, run_suite, seen_before
    from tofcapture_model.tables import markdown

    with progress() as report:
        results = run_suite(
            args.dataset,
            args.suite,
            read_weights(args.weights or []),
            args.out,
            split=args.split,
            frames=args.frames or 0,
            scenes=args.scenes,
            device=_checked_device(args.device),
            progress=lambda done, total: report("evaluate", done / total),
        )
    names = list(SUITES) if args.suite == "all" else [args.suite]
    text = f"{markdown(results, names)}\n{seen_before(results)}{args.out}"
    return Outcome({**results, "results": str(args.out)}, text)


def _configure_predict(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input", type=Path, help="view file or shard (.h5), or raw (8, H, W) or (F, 8, H, W) (.npy)"
    )
    parser.add_argument("--out", type=Path, default=Path("prediction"), help="folder (default: prediction)")
    parser.add_argument(
        "--weights", type=Path, help="checkpoint or folder of a run (default: the bundled weights)"
    )
    parser.add_argument("--view", type=int, default=0, help="of a shard (default: 0)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--frame", type=int, default=0, help="of the burst (default: 0)")
    which.add_argument(
        "--average", action="store_true", help="take the mean of the burst instead of one frame"
    )
    parser.add_argument("--rig", type=Path, help="rig.toml for a .npy (default: nominal intrinsics)")
    parser.add_argument(
        "--backend",
        choices=("torch", "onnx"),
        default="torch",
        help="onnx: the model.onnx beside the weights (default: torch)",
    )
    _device(parser)


def _predict(args: argparse.Namespace) -> Outcome:
    _keep_memory()
    from tofcapture_model.predict import predict

    result = predict(
        args.input,
        args.out,
        weights=args.weights,
        view=args.view,
        frame=None if args.average else args.frame,
        rig=args.rig,
        device=_checked_device(args.device),
        backend=args.backend,
    )
    size = " x ".join(str(n) for n in reversed(result["shape"]))
    text = f"{args.out}: depth, normals and expected error at {size}, network took {result['inference_ms']:.0f} ms"
    if result["assumed"]:
        text += f"\nassumed: {result['assumed']}; --rig brings those of your camera"
    return Outcome(result, text)


def _configure_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--weights", type=Path, help="checkpoint or folder of a run (default: the bundled weights)"
    )
    parser.add_argument(
        "--out", type=Path, help="default: beside the weights, or here for the bundled ones, .onnx or .pt2"
    )
    parser.add_argument(
        "--format", choices=("onnx", "torch"), default="onnx", help="torch: torch.export (default: onnx)"
    )
    parser.add_argument(
        "--size",
        type=_count,
        nargs=2,
        metavar=("HEIGHT", "WIDTH"),
        default=(180, 240),
        help="of the sensor (default: 180 240)",
    )


def _export(args: argparse.Namespace) -> Outcome:
    _share_cores()
    from tofcapture_model.checkpoint import find_model
    from tofcapture_model.export import export

    beside = (
        find_model(args.weights) if args.weights else Path("model")
    )  # the bundled weights are no place to write to
    out = args.out or beside.with_suffix(".onnx" if args.format == "onnx" else ".pt2")
    result = export(args.weights, out, kind=args.format, size=(args.size[0], args.size[1]))
    worst = max(result["differences"].values())
    return Outcome(
        result, f"{out}: {result['bytes'] / 1e6:.1f} MB, differs from torch by {worst:.1g} at most"
    )


def _configure_report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dataset", type=Path, help="folder that build-dataset wrote")
    parser.add_argument("--results", type=Path, help="results.json of evaluate")
    parser.add_argument("--evidence", type=Path, help="evidence.json of align")
    parser.add_argument(
        "--weights", type=Path, help="checkpoint or folder of a run (default: the bundled weights)"
    )
    parser.add_argument("--out", type=Path, default=Path("report.html"), help="default: report.html")


def _report(args: argparse.Namespace) -> Outcome:
    _share_cores()
    from tofcapture_model.report import run

    return run(args)


TRAIN = Command(
    "train a network on a dataset",
    "tofcapture train dataset --out run --preset demo --minutes 3",
    _configure_train,
    _train,
)
EVALUATE = Command(
    "measure the sensor and a network against ground truth",
    "tofcapture evaluate dataset --weights run",
    _configure_evaluate,
    _evaluate,
)
PREDICT = Command(
    "estimate depth and normals of one frame",
    "tofcapture predict recording/views/mug/view-000.h5 --out prediction",
    _configure_predict,
    _predict,
)
EXPORT = Command(
    "write a trained model for other runtimes",
    "tofcapture export --weights run --out model.onnx",
    _configure_export,
    _export,
)
REPORT = Command(
    "write one HTML page with tables and pictures",
    "tofcapture report --dataset dataset --results results.json --out report.html",
    _configure_report,
    _report,
)
