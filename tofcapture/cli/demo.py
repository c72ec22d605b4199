"""``tofcapture demo``: the whole way on the simulated station, by the very commands a user would type."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofcapture.cli.kit import Command, Outcome, table
from tofcapture.cli.setup import bundled_path
from tofcapture.errors import TofError

SCENES = ("random-8", "random-15", "bottle")
BOARD_VIEWS = 12
SCENE_VIEWS = 8
TRAINING_MINUTES = 3


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="folder (default: demo-out)")
    add("--seed", type=int, default=0, metavar="N", help="seed of the simulated station (default: 0)")
    instead = f"train a small network for {TRAINING_MINUTES} minutes instead of taking the bundled one"
    add("--train", action="store_true", help=instead)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class _Steps:
    """Runs commands one after the other, shows each as it would be typed, and keeps what it answered."""

    def __init__(self) -> None:
        self.started = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def run(self, title: str, *words: object) -> dict[str, Any]:
        line = [str(w) for w in words]
        _say(f"\n[{time.perf_counter() - self.started:5.0f} s] {title}\n  $ tofcapture {' '.join(line)}")
        start = time.perf_counter()
        command = [sys.executable, "-m", "tofcapture", *line, "--json"]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        self.seconds[title] = round(time.perf_counter() - start, 1)
        try:
            answer: dict[str, Any] = json.loads(done.stdout)
        except json.JSONDecodeError:
            message = f"no answer, exit code {done.returncode}"
            answer = {"error": {"message": message, "hint": "see the lines above"}}
        if done.returncode != 0:
            error = answer.get("error", {"message": json.dumps(answer)[:500]})
            failure = TofError(f"{title}: {error['message']}", hint=error.get("hint", ""))
            failure.exit_code = done.returncode
            raise failure
        return answer


def _run(args: argparse.Namespace) -> Outcome:
    out: Path = args.out
    recording, dataset, checked = out / "recording", out / "dataset", out / "dataset-true-rig"
    results, report, model = out / "results.json", out / "report.html", out / "model"
    out.mkdir(parents=True, exist_ok=True)
    trains = args.train or bundled_path() is None
    if trains and not args.train:
        _say(f"no trained network comes with this installation: training one for {TRAINING_MINUTES} minutes")
    steps = _Steps()
    to = ("--out", recording, "--seed", args.seed)
    steps.run("record the board with holes", "record", "--calibration", "--views", BOARD_VIEWS, *to)
    for scene in SCENES:
        steps.run(f"record {scene}", "record", "--scene", scene, "--views", SCENE_VIEWS, *to)
    views = [path for scene in SCENES for path in (recording / "views" / scene).glob("view-*.h5")]
    aligned = steps.run("align the two cameras", "align", recording)
    built = steps.run("build the shards", "build-dataset", recording, "--out", dataset)
    again = ("build-dataset", recording, "--out", checked, "--true-rig")
    true = steps.run("build once more with the true rig", *again)
    weights: tuple[object, ...] = ()
    if trains:
        how = ("--preset", "demo", "--minutes", TRAINING_MINUTES)
        steps.run("train a small network", "train", dataset, "--out", model, *how)
        weights = ("--weights", model)
    tables = _evaluate(steps, dataset, results, weights, every=not trains)
    view = recording / "views" / SCENES[-1] / "view-000.h5"
    steps.run("predict one frame", "predict", view, *weights, "--out", out / "prediction")
    evidence = ("--evidence", recording / "evidence.json")
    about = ("--dataset", dataset, "--results", results, *evidence, *weights)
    steps.run("write the report", "report", *about, "--out", report)
    data = {
        "views": len(views),
        "align": {k: aligned[k] for k in ("rotation_error_deg", "translation_error_mm")},
        "gt": true["gt"],
        "gt_aligned": built["gt"],
        "network": "trained" if trains else "bundled",
        **next(iter(tables.values())),
        "scenes": tables,
        "report": str(report),
        "prediction": str(out / "prediction"),
        "seconds": {**steps.seconds, "total": round(time.perf_counter() - steps.started, 1)},
    }
    return Outcome(data=data, text=_text(data, out))


def _evaluate(
    steps: _Steps, dataset: Path, results: Path, weights: tuple[object, ...], *, every: bool
) -> dict[str, dict[str, dict[str, float]]]:
    """Sensor and network by scenes; with ``every`` also on the split that a network trained here would have seen."""
    splits = {"test": ("evaluate on the held-out scene", results)}
    if every:
        splits["train"] = ("evaluate on the other scenes", results.with_name("results-other-scenes.json"))
    out = {}
    for split, (title, path) in splits.items():
        steps.run(title, "evaluate", dataset, *weights, "--split", split, "--out", path)
        found = json.loads(path.read_text(encoding="utf-8"))
        out[", ".join(found["scenes"])] = {name: _row(m) for name, m in found["methods"].items()}
    return out


def _row(method: dict[str, Any]) -> dict[str, float]:
    depth = method["depth"]["pixel"]
    row = {f"{name}_mm": 1e3 * depth[name] for name in ("mae", "rmse", "median")}
    return {**row, "normal_mean_deg": method["normal"]["pixel"]["mean_deg"]}


_NUMBERS = ("mae_mm", "rmse_mm", "median_mm", "normal_mean_deg")
_COLUMNS = ("", "MAE mm", "RMSE mm", "median mm", "normal deg")
_NAMES = {"bundled": "bundled network", "trained": "small network"}


def _text(data: Mapping[str, Any], out: Path) -> str:
    names = {"sensor": "ToF sensor", "model": _NAMES[data["network"]]}
    rows = [
        [f"{scenes}: {name}", *(f"{methods[key][column]:.2f}" for column in _NUMBERS)]
        for scenes, methods in data["scenes"].items()
        for key, name in names.items()
    ]
    align, truth, built = data["align"], data["gt"], data["gt_aligned"]
    return f"""
alignment: {align["rotation_error_deg"]:.3f} deg, {align["translation_error_mm"]:.2f} mm at 0.8 m off the true rig
ground truth with the true rig: median {truth["median_error_mm"]:.2f} mm, 99 % within {truth["p99_error_mm"]:.2f} mm
ground truth with the rig as aligned: median {built["median_error_mm"]:.2f} mm

{table(_COLUMNS, rows, "  ")}

report: {data["report"]}   ({data["seconds"]["total"] / 60:.1f} minutes in all)
points: {data["prediction"]}/cloud.ply   depth, normals and pictures beside it
""" + "\n".join(_next(data["network"], out))


def _next(network: str, out: Path) -> list[str]:
    recording, dataset = out / "recording", out / "dataset"
    record = f"  tofcapture record --scene mug --views 25 --out {recording}"
    if network == "bundled":
        return [
            "The bundled network was trained on other simulated scenes and has seen no real frame. Next:",
            record,
            f"  tofcapture predict {recording}/views/mug/view-000.h5 --out mug",
            f"  tofcapture train {dataset} --from bundled --out {out / 'fine-tuned'}",
        ]
    return [
        f"This network is small and saw two simulated scenes for {TRAINING_MINUTES} minutes; it shows the way, not the limit. Next:",
        record,
        f"  tofcapture build-dataset {recording} --out {dataset}",
        f"  tofcapture train {dataset} --out {out / 'model-compact'} --preset compact",
    ]


COMMAND = Command(
    help="the whole way on the simulated station: record, align, build, evaluate, predict, report; --train trains a network too",
    example="tofcapture demo --out demo-out",
    configure=_configure,
    run=_run,
)
