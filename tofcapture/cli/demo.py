"""``tofcapture demo``: the whole way on the simulated station, by the very commands a user would type."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tofcapture.command import Command, Outcome

SCENES = ("random-8", "random-15", "bottle")
BOARD_VIEWS = 12
SCENE_VIEWS = 8
TRAINING_MINUTES = 3


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path("demo-out"), metavar="DIR", help="folder to fill (default demo-out)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulated station (default 0)")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class _Steps:
    """Runs commands one after the other, shows each as it would be typed, and keeps what it answered."""

    def __init__(self) -> None:
        self.started = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def run(self, title: str, *words: object) -> dict[str, Any]:
        from tofcapture.errors import TofError

        line = [str(w) for w in words]
        _say(f"\n[{time.perf_counter() - self.started:5.0f} s] {title}\n  $ tofcapture {' '.join(line)}")
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "tofcapture", *line, "--json"],
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        self.seconds[title] = round(time.perf_counter() - start, 1)
        try:
            answer: dict[str, Any] = json.loads(done.stdout)
        except json.JSONDecodeError:
            answer = {
                "error": {"message": f"no answer, exit code {done.returncode}", "hint": "see the lines above"}
            }
        if done.returncode != 0:
            error = answer.get("error", {"message": json.dumps(answer)[:500], "hint": ""})
            failure = TofError(f"{title}: {error['message']}", hint=error.get("hint", ""))
            failure.exit_code = done.returncode
            raise failure
        return answer


def _run(args: argparse.Namespace) -> Outcome:
    out: Path = args.out
    recording, dataset, checked = out / "recording", out / "dataset", out / "dataset-true-rig"
    model, results, report = out / "model", out / "results.json", out / "report.html"
    out.mkdir(parents=True, exist_ok=True)
    steps = _Steps()
    seed = ("--seed", args.seed)
    steps.run(
        "record the board with holes",
        "record",
        "--calibration",
        "--views",
        BOARD_VIEWS,
        "--out",
        recording,
        *seed,
    )
    recorded = 0
    for scene in SCENES:
        steps.run(
            f"record {scene}", "record", "--scene", scene, "--views", SCENE_VIEWS, "--out", recording, *seed
        )
        recorded += len(list((recording / "views" / scene).glob("view-*.h5")))
    aligned = steps.run("align the two cameras", "align", recording)
    built = steps.run("build the shards", "build-dataset", recording, "--out", dataset)
    true = steps.run(
        "build once more with the true rig", "build-dataset", recording, "--out", checked, "--true-rig"
    )
    steps.run(
        "train a small network",
        "train",
        dataset,
        "--out",
        model,
        "--preset",
        "demo",
        "--minutes",
        TRAINING_MINUTES,
    )
    steps.run("evaluate on the held-out scene", "evaluate", dataset, "--weights", model, "--out", results)
    table = json.loads(results.read_text(encoding="utf-8"))["methods"]
    steps.run(
        "write the report",
        *("report", "--dataset", dataset, "--results", results, "--evidence", recording / "evidence.json"),
        *("--weights", model, "--out", report),
    )
    data = {
        "views": recorded,
        "align": {k: aligned[k] for k in ("rotation_error_deg", "translation_error_mm")},
        "gt": true["gt"],
        "gt_aligned": built["gt"],
        **{name: _row(table[name]) for name in ("sensor", "model")},
        "report": str(report),
        "seconds": {**steps.seconds, "total": round(time.perf_counter() - steps.started, 1)},
    }
    return Outcome(data=data, text=_text(data, recording, dataset, model))


def _row(method: dict[str, Any]) -> dict[str, float]:
    depth, normal = method["depth"]["pixel"], method["normal"]["pixel"]
    return {
        "mae_mm": 1e3 * depth["mae"],
        "rmse_mm": 1e3 * depth["rmse"],
        "median_mm": 1e3 * depth["median"],
        "normal_mean_deg": normal["mean_deg"],
    }


def _text(data: dict[str, Any], recording: Path, dataset: Path, model: Path) -> str:
    number: Callable[[float], str] = "{:9.2f}".format
    rows = [
        f"  {name:<24}"
        + "".join(number(data[key][k]) for k in ("mae_mm", "rmse_mm", "median_mm", "normal_mean_deg"))
        for name, key in (("ToF sensor", "sensor"), ("small network", "model"))
    ]
    return "\n".join(
        [
            "",
            f"alignment: {data['align']['rotation_error_deg']:.3f} deg, {data['align']['translation_error_mm']:.2f} mm at 0.8 m off the true rig",
            f"ground truth with the true rig: median {data['gt']['median_error_mm']:.2f} mm, 99 % within {data['gt']['p99_error_mm']:.2f} mm",
            f"ground truth with the rig as aligned: median {data['gt_aligned']['median_error_mm']:.2f} mm",
            "",
            "  held-out scene           MAE mm  RMSE mm median mm  normal deg",
            *rows,
            "",
            f"report: {data['report']}   ({data['seconds']['total'] / 60:.1f} minutes in all)",
            f"This network is small and saw two simulated scenes for {TRAINING_MINUTES} minutes; it shows the way, not the limit. Next:",
            f"  tofcapture record --scene bottle --views 25 --out {recording}",
            f"  tofcapture build-dataset {recording} --out {dataset}",
            f"  tofcapture train {dataset} --out {model}-compact --preset compact",
        ]
    )


COMMAND = Command(
    help="the whole way on the simulated station: record, align, build, train, evaluate, report (under 10 minutes)",
    example="tofcapture demo --out demo-out",
    configure=_configure,
    run=_run,
)
