"""The commands ``train``, ``evaluate``, ``predict``, ``export`` and ``report``. Nothing heavy is imported before one runs."""

from __future__ import annotations

import argparse
import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from tofcapture.cli.kit import Command, Outcome, counted, progress
from tofcapture.errors import ConfigError, TofError
from tofcapture_model.config import Config, load_config, preset, presets
from tofcapture_model.evaluation.tables import SUITES

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h
_SURE = 0.99  # of a frame; a few strange pixels are no news
_WEIGHTS = "checkpoint, folder of a run, or 'bundled' (default: the bundled weights)"


def _share_cores() -> None:
    """Let idle OpenMP threads spin for microseconds only; must run before torch is imported.

    Measured on two cores, a step of six crops: 0.22 s alone, 0.65 s beside two busy processes, 1.7 s if threads spin ten times
    as long.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "2000")


def _keep_memory() -> None:
    """Have glibc keep what is freed: giving back blocks of some MB takes a sixth of a prediction's time."""
    with suppress(OSError, AttributeError, TypeError):  # another system, another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_MMAP_THRESHOLD, 32 << 20)  # its largest
        libc.mallopt(_TRIM_THRESHOLD, 1 << 30)


def _device(parser: argparse.ArgumentParser) -> None:
    text = "torch device, such as cpu or cuda (default: cpu)"
    parser.add_argument("--device", default="cpu", metavar="DEVICE", help=text)


def _checked_device(name: str) -> str:
    import torch

    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as err:
        said = str(err).splitlines()[0].partition(", ipu")[0]
        raise ConfigError(f"--device {name}: {said}", hint="--device cpu always works") from err
    return name


def _number(kind: type, expected: str, fine: Callable[[Any], bool]) -> Callable[[str], Any]:
    """Make an argument's type that refuses what is not fine."""

    def parsed(text: str) -> Any:
        if not fine(value := kind(text)):
            raise argparse.ArgumentTypeError(f"expected {expected}, got {text}")
        return value

    parsed.__name__ = expected  # argparse names it where the text is no number
    return parsed


_positive = _number(float, "a number > 0", lambda x: x > 0)
_count = _number(int, "a whole number > 0", lambda x: x > 0)
_not_negative = _number(int, "a whole number >= 0", lambda x: x >= 0)


def _configure_train(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "dataset",
        type=Path,
        nargs="+",
        metavar="DATASET",
        help="folders of build-dataset; the first one's split val validates",
    )
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the run; running again there goes on",
    )
    known = f"{', '.join(presets())} (default: compact)"
    add("--preset", choices=presets(), metavar="NAME", help=known)
    add("--config", type=Path, metavar="CONFIG.toml", help="TOML with differences from a preset")
    add("--epochs", type=_count, metavar="N", help="of every stage, instead of the configuration's")
    add("--minutes", type=_positive, metavar="M", help="train for so long; schedules follow the clock")
    add("--seed", type=_not_negative, metavar="N", help="of weights, order and crops")
    workers = "processes that read data (default: 0, in memory)"
    add("--workers", type=_not_negative, default=0, metavar="N", help=workers)
    origin = "fine-tune: start from a checkpoint, a run's folder, or 'bundled'; --preset is fine-tune then"
    add("--from", dest="start", metavar="WEIGHTS", help=origin)
    add("--cache", type=Path, metavar="DIR", help="read frames from what `tofcapture pack` wrote")
    _device(parser)


def _config(args: argparse.Namespace) -> Config:
    if args.config and args.preset:
        hint = 'write preset = "..." into the TOML'
        raise ConfigError("--config and --preset exclude each other", hint=hint)
    usual = "fine-tune" if args.start else "compact"
    config = load_config(args.config) if args.config else preset(args.preset or usual)
    return config if args.seed is None else replace(config, training=replace(config.training, seed=args.seed))


def _train(args: argparse.Namespace) -> Outcome:
    config = _config(args)
    _share_cores()
    with progress() as report:
        report("load", 0, 0)
        from tofcapture_model.networks.checkpoint import find_model
        from tofcapture_model.training.train import train

        done = train(
            config,
            args.dataset[0],
            args.out,
            epochs=args.epochs,
            minutes=args.minutes,
            device=_checked_device(args.device),
            workers=args.workers,
            cache=args.cache,
            start=None if args.start is None else find_model(None if args.start == "bundled" else args.start),
            also=args.dataset[1:],
            report=report,
        )
    data = {"weights": str(done.path), "steps": done.steps, "finished": done.finished, "losses": done.losses}
    following = f"tofcapture evaluate {args.dataset[0]} --weights {args.out}"
    return Outcome(data, f"{done.path}: trained for {counted(done.steps, 'step')}", following=following)


def _configure_evaluate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="folder that build-dataset filled")
    weights = (
        "checkpoint or folder of a run, with --suite NAME=PATH of several (default: the bundled weights)"
    )
    add("--weights", nargs="+", metavar="WEIGHTS", help=weights)
    suites = f"tables of several methods beside --out, resumable: {', '.join(SUITES)} or all"
    add("--suite", choices=(*SUITES, "all"), metavar="NAME", help=suites)
    add("--scenes", default="", metavar="PREFIX", help="only scenes whose name begins so")
    add(
        "--out",
        type=Path,
        default=Path("results.json"),
        metavar="FILE.json",
        help="table to write (default: results.json)",
    )
    add(
        "--split",
        choices=("train", "val", "test"),
        metavar="SPLIT",
        help="train, val or test (default: test, or what there is)",
    )
    add(
        "--frames",
        type=_not_negative,
        metavar="N",
        help="of every view; 0 takes all (default: 1, with --suite all)",
    )
    _device(parser)


def _evaluate(args: argparse.Namespace) -> Outcome:
    _share_cores()
    if args.suite:
        return _suite(args)
    weights = _one_network(args.weights)
    with progress() as report, _no_going_on():
        report("load", 0, 0)
        from tofcapture_model.evaluation.evaluate import comparison, evaluate

        results = evaluate(
            args.dataset,
            weights,
            args.out,
            split=args.split,
            frames=1 if args.frames is None else args.frames,
            scenes=args.scenes,
            device=_checked_device(args.device),
            progress=lambda done, total: report("evaluate", done, total),
        )
    following = f"tofcapture report --dataset {args.dataset} --results {args.out}"
    return Outcome(
        {**results, "results": str(args.out)}, f"{comparison(results)}\n{args.out}", following=following
    )


def _one_network(weights: Sequence[str] | None) -> Path | None:
    if not weights:
        return None
    if len(weights) > 1 or ("=" in weights[0] and not Path(weights[0]).exists()):
        raise ConfigError(
            f"--weights {' '.join(weights)}: several networks, or one with a name, need a --suite",
            hint="tofcapture evaluate DATASET --suite main --weights NAME=PATH ...",
        )
    return Path(weights[0])


class Interrupted(TofError):  # noqa: N818  the user's wish, not a fault
    """The user stopped what keeps nothing."""

    exit_code = 130


@contextmanager
def _no_going_on() -> Iterator[None]:
    """Say of an interruption that the same command will not go on where it was."""
    try:
        yield
    except KeyboardInterrupt as err:
        raise Interrupted("interrupted", hint="nothing was kept: the same command begins anew") from err


def _suite(args: argparse.Namespace) -> Outcome:
    from tofcapture_model.evaluation.evaluate import usual_split
    from tofcapture_model.evaluation.suite import read_weights, run_suite, seen_before
    from tofcapture_model.evaluation.tables import markdown
    from tofcapture_model.networks.checkpoint import find_model

    with progress() as report:
        results = run_suite(
            args.dataset,
            args.suite,
            read_weights(args.weights) if args.weights else {"bundled": [find_model(None)]},
            args.out,
            split=args.split or usual_split(args.dataset),
            frames=args.frames or 0,
            scenes=args.scenes,
            device=_checked_device(args.device),
            progress=lambda done, total: report("evaluate", done, total),
        )
    names = list(SUITES) if args.suite == "all" else [args.suite]
    text = f"{markdown(results, names)}\n{seen_before(results)}{args.out}"
    return Outcome({**results, "results": str(args.out)}, text)


def _configure_predict(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="INPUT",
        help="view or shard (.h5), raw (K, H, W) or (F, K, H, W) (.npy, .npz), or a recording, a dataset, a folder of such files",
    )
    add("--out", type=Path, default=Path("prediction"), metavar="DIR", help="folder (default: prediction)")
    add("--weights", type=Path, metavar="WEIGHTS", help=_WEIGHTS)
    add(
        "--view",
        type=_not_negative,
        metavar="N",
        help="only this one of a shard or of every scene (default: all)",
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--frame", type=int, default=0, metavar="N", help="of the burst (default: 0)")
    which.add_argument("--average", action="store_true", help="take the mean of the burst instead")
    add(
        "--rig",
        type=Path,
        metavar="RIG.toml",
        help="rig or camera of an array: RIG.toml, fx,fy,cx,cy or a file (default: nominal)",
    )
    saturation = "at which the sensor of an array saturates (default: 4095, 12 bits)"
    add("--saturation", type=_positive, metavar="COUNTS", help=saturation)
    backend = "torch, or onnx: the model.onnx beside the weights (default: torch)"
    add("--backend", choices=("torch", "onnx"), default="torch", metavar="BACKEND", help=backend)
    add("--benchmark", action="store_true", help="answer ten times and tell the median time")
    _device(parser)


def _predict(args: argparse.Namespace) -> Outcome:
    _keep_memory()
    with progress() as report:
        report("load the network", 0, 0)
        from tofcapture_model.inference.predict import predict

        result = predict(
            args.input,
            args.out,
            weights=args.weights,
            view=args.view,
            frame=None if args.average else args.frame,
            rig=args.rig,
            device=_checked_device(args.device),
            backend=args.backend,
            saturation=args.saturation,
            benchmark=args.benchmark,
            report=report,
        )
    rows = result.get("predictions", {"": result})
    for told in dict.fromkeys(w for row in rows.values() for w in (row["warning"], _outside(row)) if w):
        print(f"tofcapture: {told}", file=sys.stderr)
    if "predictions" not in result:
        return Outcome(result, _told(result, args.out, args.device), following=f"tofcapture view {args.out}")
    lines = [f"{args.out}: {counted(len(rows), 'prediction')}, each in a folder of its own"]
    lines += [f"FAILED {name}: {error['message']}" for name, error in result["failed"].items()]
    shown = next(iter(rows), "")
    following = f"tofcapture view {args.out / shown}"
    return Outcome(result, "\n".join(lines), 5 if result["failed"] else 0, following)


def _outside(row: dict[str, Any]) -> str:
    if not row["outside"]:
        return ""
    return f"the network has not learned from such frames: {row['outside']}. Its answer may be far off; fine-tune it: train --from"


def _told(result: dict[str, Any], out: Path, device: str) -> str:
    """Say in words what was predicted, and from what; how fast where that was asked for."""
    size = " x ".join(str(n) for n in reversed(result["shape"]))
    errors = result["median_expected_error"] is not None
    what = "depth, normals and expected error" if errors else "depth and normals"
    timed = "network" if device == "cpu" else "decoding and network"
    took = "" if result["inference_ms"] is None else f", {timed} took {result['inference_ms']:.0f} ms"
    lines = [f"{out}: {what} at {size}{took}"]
    if not errors:
        lines.append(f"no expected error: {result['network']} predicts none")
    here, there = result["median_sensor_depth"], result["median_depth"]
    lines.append(
        f"median depth {there:.3f} m, of the sensor itself {here:.3f} m; {out}/picture.png shows both"
    )
    if result["filled"]:
        share = f"{result['measured']:.1%} of the pixels were measured"
        lines.append(f"{share}, the others filled (measured.npy says which)")
    if (trusted := result["trusted"]) is not None and trusted < _SURE:
        lines.append(
            f"{1 - trusted:.1%} is unlike what the network learned from: the sensor's depth stands there (trust.npy)"
        )
    if result["assumed"]:
        lines.append(f"assumed: {result['assumed']}; --rig brings those of your camera")
    return "\n".join(lines)


def _configure_export(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--weights", type=Path, metavar="WEIGHTS", help=_WEIGHTS)
    beside = "model to write (default: beside the weights, or here for the bundled ones)"
    add("--out", type=Path, metavar="FILE", help=beside)
    kinds = "onnx, or torch: torch.export (default: onnx)"
    add("--format", choices=("onnx", "torch"), default="onnx", metavar="FORMAT", help=kinds)
    size = "of the sensor (default: 180 240)"
    add("--size", type=_count, nargs=2, metavar=("H", "W"), default=(180, 240), help=size)


def _export(args: argparse.Namespace) -> Outcome:
    _share_cores()
    from tofcapture_model.inference.export import SUFFIX, export
    from tofcapture_model.networks.checkpoint import find_model, names_bundled

    # the bundled weights are no place to write to
    beside = Path("model") if names_bundled(args.weights) else find_model(args.weights)
    out = args.out or beside.with_suffix(SUFFIX[args.format])
    with progress() as report:
        report("export and compare", 0, 0)
        result = export(args.weights, out, kind=args.format, size=(args.size[0], args.size[1]))
    worst = max(result["differences"].values())
    size = f"{result['bytes'] / 1e6:.1f} MB"
    return Outcome(result, f"{out}: {size}, differs from torch by {worst:.1g} at most")


def _configure_report(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--dataset", type=Path, metavar="DATASET", help="folder that build-dataset filled")
    add("--results", type=Path, metavar="FILE.json", help="results.json of evaluate")
    add("--evidence", type=Path, metavar="FILE.json", help="evidence.json of align")
    add("--weights", type=Path, metavar="WEIGHTS", help=_WEIGHTS)
    page = "page to write (default: report.html)"
    add("--out", type=Path, default=Path("report.html"), metavar="FILE.html", help=page)


def _report(args: argparse.Namespace) -> Outcome:
    _share_cores()
    from tofcapture_model.report import run

    with progress() as report:
        report("draw the report", 0, 0)
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
    "estimate depth and normals of a frame, or of all views of a folder",
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
