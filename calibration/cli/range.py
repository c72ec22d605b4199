"""``tofcapture calibrate range``: the ToF camera's range errors from board views at many distances."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.command import Outcome
from tofcapture.errors import UsageError
from tofcapture.poses import Float64
from tofcapture.rig import Rig

CARELESS = (
    3.0  # an averaged alignment's error is mostly the range error itself, which its scatter does not show
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    parser.add_argument(
        "--rig", type=Path, metavar="RIG.toml", help="rig transform to start from (default: the recording's)"
    )
    parser.add_argument("--orders", default="1,2,4", help="of the harmonics (default 1,2,4)")
    parser.add_argument("--dry-run", action="store_true", help="print the result, write nothing")


def run(args: argparse.Namespace) -> Outcome:
    """Fit the range errors, write them into ``rig.toml`` and ``range.json``."""
    from calibration.range_error.fit import fit_ranges
    from calibration.range_error.report import report, table
    from tofcapture.files.seal import write_text
    from tofcapture.rig import dumps_rig

    recording = Path(args.recording)
    orders = parse_orders(args.orders)
    seen, carried = _seen(recording)
    rig, sigma, centre, known = transform_of(recording, args.rig, carried)
    fit = fit_ranges(seen, rig.T_tof_stereo, sigma, orders, centre)
    data = report(fit, known)
    if not args.dry_run:
        write_text(recording / "range.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
        found = replace(rig, T_tof_stereo=fit.T_tof_stereo, range_errors=fit.errors)
        write_text(recording / "rig.toml", dumps_rig(found))
        data |= {"rig": str(recording / "rig.toml")}
    return Outcome(data=data, text=table(data))


def parse_orders(text: str) -> tuple[int, ...]:
    """Read ``1,2,4``; :class:`UsageError` for what no harmonic is."""
    try:
        orders = tuple(sorted({int(m) for m in text.split(",")}))
    except ValueError as err:
        raise UsageError(f"--orders: expected whole numbers such as 1,2,4, got {text!r}") from err
    if orders[0] < 1 or orders[-1] > 16:
        raise UsageError(f"--orders: expected harmonics from 1 to 16, got {text!r}")
    return orders


def _seen(recording: Path) -> tuple[list[Any], Rig]:
    from calibration.cli.align import _progress
    from calibration.range_error.views import seen_of
    from calibration.registration.pairs import calibration_views
    from tofcapture.files.view import read_view

    paths, out = calibration_views(recording), []
    with _progress() as progress:
        for i, path in enumerate(paths):
            progress("reading", i, len(paths))
            view = read_view(path)
            out.append(seen_of(view, path.relative_to(recording).as_posix()))
    return out, view.rig


def transform_of(
    recording: Path, given: Path | None, carried: Rig
) -> tuple[Rig, Float64, Float64 | None, str]:
    """Rig to start from, what its transform is known to, about which point, and what vouches for it.

    ``evidence.json`` vouches for the ``rig.toml`` it was written with; any other rig is known to millimetres only.
    """
    from calibration.range_error.fit import LOOSE
    from tofcapture.rig import load_rig

    own = recording / "rig.toml"
    rig = load_rig(given or own) if given or own.exists() else carried
    path = recording / "evidence.json"
    evidence = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if not evidence or not np.allclose(evidence["T_tof_stereo"], rig.T_tof_stereo, atol=1e-9):
        return rig, LOOSE, None, "nothing"
    centre = np.asarray(evidence["working_point_m"], dtype=np.float64)
    if stated := evidence.get("sigma"):
        sigma = np.r_[1e-3 * np.array(stated["translation_mm"]), np.radians(stated["rotation_deg"])]
        return rig, np.maximum(sigma, 1e-6), centre, "aligned"
    error = evidence["standard_error"]
    one = np.r_[[1e-3 * error["translation_mm"]] * 3, [np.radians(error["rotation_deg"])] * 3]
    return rig, np.maximum(CARELESS * one, 1e-6), centre, "averaged"
