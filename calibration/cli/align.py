"""``tofcapture align``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.command import Command, Outcome
from tofcapture.errors import ConfigError

if TYPE_CHECKING:
    from calibration.evidence.compare import OldRig

PLAIN_INTERVAL = 5.0  # s between progress lines where stderr is no terminal


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder that record --calibration filled"
    )
    parser.add_argument("--backend", default="open3d", help="open3d (default), kiss-icp or small-gicp")
    parser.add_argument(
        "--method",
        default="averaged",
        choices=("averaged", "weighted", "joint"),
        help="averaged (default, the paper's), weighted by information, or joint with the range errors",
    )
    parser.add_argument(
        "--initial", type=Path, metavar="RIG.toml", help="start from this rig, not from the views' own"
    )
    parser.add_argument(
        "--compare", type=Path, metavar="OLD_RIG.toml", help="say how far the cameras moved since this rig"
    )


def _run(args: argparse.Namespace) -> Outcome:
    from calibration.align import align
    from calibration.evidence.compare import drift, drift_table, drift_text, load_old
    from tofcapture.rig import load_rig, rig_to_dict

    initial = None if args.initial is None else load_rig(args.initial)
    old = None if args.compare is None else load_old(args.compare)  # before align replaces rig.toml
    with _progress() as progress:
        rig, evidence = align(args.recording, args.backend, initial, progress, args.method)
        page, absent = _page(args.recording, old, evidence, progress)
    paths = {"rig": str(args.recording / "rig.toml"), "evidence": str(args.recording / "evidence.json")}
    moved = None if old is None else drift(evidence, old)
    summary = {
        key: evidence[key] for key in ("backend", "views", "used", "spread", "standard_error", "pairs")
    }
    data = {
        **paths,
        **summary,
        **{key: evidence[key] for key in ("method", "sigma", "in_words") if key in evidence},
        **(evidence["truth"] or {}),
        "verdict": evidence["verdict"],
        "checks": evidence["checks"],
        "values": rig_to_dict(rig),
        "page": page,
        "drift": None if moved is None else drift_table(moved),
    }
    lines = [table(evidence), *([] if moved is None else [drift_text(moved)])]
    return Outcome(data=data, text="\n".join([*lines, *paths.values(), page or absent]))


def _page(
    recording: Path, old: OldRig | None, evidence: dict[str, Any], progress: Callable[[str, int, int], None]
) -> tuple[str | None, str]:
    """Write evidence.html; its path, or None and why there is none: rig and evidence stand without it."""
    from calibration.evidence.page import write_evidence_page

    try:
        return str(write_evidence_page(recording, old, evidence, progress)), ""
    except ConfigError as err:
        # An older page would speak of an older alignment.
        (recording / "evidence.html").unlink(missing_ok=True)
        return None, f"no evidence.html: {err.message}; {err.hint}"


def table(evidence: dict[str, Any]) -> str:
    """Lay the evidence out for a person: one line per pair, then spread, truth and verdict."""
    lines = ["view      rmse mm  inliers  rotation deg  translation mm  from the mean"]
    lines += [_row(pair) for pair in evidence["pairs"]]
    lines.append(
        f"used {evidence['used']} of {evidence['views']} views, backend {evidence['backend']}, {evidence.get('method', 'averaged')}"
    )
    for name in ("spread", "standard_error"):
        value = evidence[name]
        lines.append(
            f"{name.replace('_', ' '):16}{value['rotation_deg']:.3f} deg  {value['translation_mm']:.2f} mm"
        )
    if words := evidence.get("in_words"):
        lines.append(words)
    if truth := evidence["truth"]:
        error = f"{truth['rotation_error_deg']:.3f} deg  {truth['translation_error_mm']:.2f} mm"
        lines.append(f"{'true error':16}{error} at 0.8 m")
    lines.append(f"verdict: {evidence['verdict']}")
    for c in evidence["checks"]:
        if c["verdict"] != "PASS":
            lines.append(f"  {c['verdict']} {c['words']}: {c['value']} ({c['limits']}); likely: {c['cause']}")
    return "\n".join(lines)


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
