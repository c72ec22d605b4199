"""``tofcapture align``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tofcapture.cli import kit
from tofcapture.cli.kit import Command, Outcome
from tofcapture.errors import ConfigError

if TYPE_CHECKING:
    from calibration.evidence import OldRig
    from tofcapture.rig import Rig


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder that record --calibration filled"
    )
    out = "folder of rig.toml and evidence (default: the recording, which must then be writable)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)
    parser.add_argument(
        "--backend",
        default="open3d",
        metavar="BACKEND",
        help="open3d, kiss-icp or small-gicp (default: open3d)",
    )
    parser.add_argument(
        "--method",
        default="averaged",
        choices=("averaged", "weighted", "joint", "targetless"),
        metavar="METHOD",
        help="averaged as in the paper, weighted by information, joint with range errors, or targetless by scenes (default: averaged)",
    )
    parser.add_argument(
        "--initial",
        type=Path,
        metavar="RIG.toml|none",
        help="start from this rig, not from the views' own; none: without a guess",
    )
    parser.add_argument(
        "--compare", type=Path, metavar="RIG.toml", help="say how far the cameras moved since this rig"
    )


def _run(args: argparse.Namespace) -> Outcome:
    from calibration.align import align
    from calibration.evidence import drift, drift_table, drift_text, load_old
    from tofcapture.rig import load_rig, rig_to_dict

    initial: Rig | Literal["none"] | None = None
    if args.initial is not None:
        initial = "none" if str(args.initial) == "none" else load_rig(args.initial)
    old = None if args.compare is None else load_old(args.compare)  # before align replaces rig.toml
    with kit.progress() as progress:
        out = args.out or args.recording
        rig, evidence = align(args.recording, args.backend, initial, progress, args.method, out)
        page, absent = _page(args.recording, out, old, evidence, progress)
    paths = {"rig": str(out / "rig.toml"), "evidence": str(out / "evidence.json")}
    moved = None if old is None else drift(evidence, old)
    kept = ("backend", "views", "used", "spread", "standard_error", "pairs", "verdict", "checks")
    data = {
        **paths,
        **{key: evidence[key] for key in kept},
        **{key: evidence[key] for key in ("method", "sigma", "in_words") if key in evidence},
        **(evidence["truth"] or {}),
        "values": rig_to_dict(rig),
        "page": page,
        "drift": None if moved is None else drift_table(moved),
    }
    lines = [table(evidence), *([] if moved is None else [drift_text(moved)])]
    following = f"tofcapture build-dataset {args.recording} --out dataset"
    return Outcome(data, "\n".join([*lines, *paths.values(), page or absent]), following=following)


def _page(
    recording: Path,
    out: Path,
    old: OldRig | None,
    evidence: dict[str, Any],
    progress: Callable[[str, int, int], None],
) -> tuple[str | None, str]:
    """Write evidence.html; its path, or None and why there is none: rig and evidence stand without it."""
    from calibration.evidence.page import write_evidence_page

    if evidence.get("method") == "targetless":
        (out / "evidence.html").unlink(missing_ok=True)
        return None, "no evidence.html: it shows views of the board; evidence.json has all"
    try:
        return str(write_evidence_page(recording, old, evidence, progress, out)), ""
    except ConfigError as err:
        # An older page would speak of an older alignment.
        (out / "evidence.html").unlink(missing_ok=True)
        return None, f"no evidence.html: {err.message}; {err.hint}"


def table(evidence: dict[str, Any]) -> str:
    """Lay the evidence out for a person: one line per pair, then spread, truth and verdict."""
    header = ("view", "rmse mm", "inliers", "rotation deg", "translation mm", "from the mean")
    lines = [kit.table(header, [_cells(pair) for pair in evidence["pairs"]])]
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
    lines += [
        f"  {c['verdict']} {c['words']}: {c['value']} ({c['limits']}); likely: {c['cause']}"
        for c in evidence["checks"]
        if c["verdict"] != "PASS"
    ]
    return "\n".join(lines)


def _cells(pair: dict[str, Any]) -> tuple[str, ...]:
    digits = {"rmse_mm": 2, "inliers": 0, "rotation_from_mean_deg": 3, "translation_from_mean_mm": 2}
    numbers = ("-" if pair[key] is None else f"{pair[key]:.{n}f}" for key, n in digits.items())
    return Path(pair["view"]).stem, *numbers, "ok" if pair["accepted"] else str(pair["reason"])


ALIGN = Command(
    help="align the two cameras by averaged ICP over the calibration views: rig.toml and evidence.json",
    example="tofcapture align recording",
    configure=_configure,
    run=_run,
)
