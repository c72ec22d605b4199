"""``tofcapture align``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tofcapture.command import Command, Outcome

GOOD_ERROR_DEG = 0.1  # standard errors that an alignment for ground truth may have
GOOD_ERROR_MM = 1.0
PLAIN_INTERVAL = 5.0  # s between progress lines where stderr is no terminal


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder that record --calibration filled"
    )
    parser.add_argument("--backend", default="open3d", help="open3d (default) or kiss-icp")
    parser.add_argument(
        "--initial", type=Path, metavar="RIG.toml", help="start from this rig, not from the views' own"
    )


def _run(args: argparse.Namespace) -> Outcome:
    from calibration.solve import align
    from tofcapture.rig import load_rig, rig_to_dict

    initial = None if args.initial is None else load_rig(args.initial)
    with _progress() as progress:
        rig, evidence = align(args.recording, args.backend, initial, progress)
    paths = {"rig": str(args.recording / "rig.toml"), "evidence": str(args.recording / "evidence.json")}
    summary = {
        key: evidence[key] for key in ("backend", "views", "used", "spread", "standard_error", "pairs")
    }
    data = {
        **paths,
        **summary,
        **(evidence["truth"] or {}),
        "verdict": verdict(evidence),
        "values": rig_to_dict(rig),
    }
    return Outcome(data=data, text=f"{table(evidence)}\n{paths['rig']}\n{paths['evidence']}")


def verdict(evidence: dict[str, Any]) -> str:
    """Say in a few words what the standard error of an alignment allows."""
    error = evidence["standard_error"]
    if error["rotation_deg"] <= GOOD_ERROR_DEG and error["translation_mm"] <= GOOD_ERROR_MM:
        return "good"
    return f"doubtful: expected at most {GOOD_ERROR_DEG} deg and {GOOD_ERROR_MM} mm; record more tilted board views"


def table(evidence: dict[str, Any]) -> str:
    """Lay the evidence out for a person: one line per pair, then spread, truth and verdict."""
    lines = ["view      rmse mm  inliers  rotation deg  translation mm  from the mean"]
    lines += [_row(pair) for pair in evidence["pairs"]]
    lines.append(f"used {evidence['used']} of {evidence['views']} views, backend {evidence['backend']}")
    for name in ("spread", "standard_error"):
        value = evidence[name]
        lines.append(
            f"{name.replace('_', ' '):16}{value['rotation_deg']:.3f} deg  {value['translation_mm']:.2f} mm"
        )
    if truth := evidence["truth"]:
        error = f"{truth['rotation_error_deg']:.3f} deg  {truth['translation_error_mm']:.2f} mm"
        lines.append(f"{'true error':16}{error} at 0.8 m")
    return "\n".join([*lines, f"verdict: {verdict(evidence)}"])


def _row(pair: dict[str, Any]) -> str:
    def number(value: float | None, width: int, digits: int) -> str:
        return "-".rjust(width) if value is None else f"{value:{width}.{digits}f}"

    return (
        f"{Path(pair['view']).stem:10}{number(pair['rmse_mm'], 7, 2)}{pair['inliers']:9d}"
        f"{number(pair['rotation_from_mean_deg'], 14, 3)}{number(pair['translation_from_mean_mm'], 16, 2)}"
        f"  {'ok' if pair['accepted'] else pair['reason']}"
    )


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show progress with the time left on stderr: a bar on a terminal, now and then a line elsewhere."""
    if not sys.stderr.isatty():
        yield _plain_progress()
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done)

        yield show


def _plain_progress() -> Callable[[str, int, int], None]:
    began: dict[str, float] = {}
    last = time.monotonic()

    def show(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        start = began.setdefault(stage, now)
        if done and now - last > PLAIN_INTERVAL:
            last = now
            left = (now - start) / done * (total - done)
            print(f"{stage} {done}/{total}, about {left:.0f} s left", file=sys.stderr)

    return show


ALIGN = Command(
    help="align the two cameras by averaged ICP over the calibration views: rig.toml and evidence.json",
    example="tofcapture align recording",
    configure=_configure,
    run=_run,
)
