"""``tofcapture calibrate phase-order``: what each channel of unknown raw frames is."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.cli.kit import written
from tofcapture.command import Outcome
from tofcapture.errors import DataError, FormatError, UsageError

if TYPE_CHECKING:
    from calibration.phase_order.find import PhaseOrder


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "raw",
        type=Path,
        metavar="RAW",
        help="(frames, K, H, W) or (K, H, W), K = 4 per frequency: .npy, .npz, .h5, .raw, or a folder of images, one phase each",
    )
    parser.add_argument(
        "--mhz", default="20,100", metavar="F[,F]", help="modulation frequencies in MHz (default 20,100)"
    )
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="RADIAL.npy",
        help="(H, W) known distances along the rays, metres, NaN unknown",
    )
    parser.add_argument("--shape", metavar="H,W", help="image size of .raw files, rows of metadata included")
    parser.add_argument("--out", type=Path, metavar="RESULT.json", help="write the result here")


def run(args: argparse.Namespace) -> Outcome:
    """Find frequency, order, sign and start of the phases of raw frames."""
    from calibration.phase_order.find import find_phase_order
    from calibration.phase_order.raw_files import read_raw

    try:
        hz = [1e6 * float(f) for f in args.mhz.split(",")]
    except ValueError as err:
        raise UsageError(f"--mhz: expected numbers such as 20,100, got {args.mhz!r}") from err
    reference = None if args.reference is None else _array(args.reference)
    order = find_phase_order(read_raw(args.raw, 4 * len(hz), _size(args.shape)), hz, reference)
    data = {"format": "tofcapture-phase-order", "version": 1, **_order_dict(order)}
    return written(data, _order_table(order), args.out)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    try:
        height, width = (int(n) for n in text.split(","))
    except ValueError as err:
        raise UsageError(f"--shape: expected H,W such as 180,240, got {text!r}") from err
    return height, width


def _order_dict(order: PhaseOrder) -> dict[str, Any]:
    from dataclasses import asdict

    data = asdict(order)
    data["offset_rad"] = [x if x == x else None for x in order.offset_rad]  # noqa: PLR0124  NaN is not JSON
    return data


def _order_table(order: PhaseOrder) -> str:
    import math

    lines = ["channel   MHz   phase deg"]
    lines += [
        f"{k:7d}{f / 1e6:6g}{math.degrees(p):12.0f}"
        for k, (f, p) in enumerate(zip(order.modulation_hz, order.phase_rad, strict=True))
    ]
    lines.append(f"sign from {order.sign_from}, confidence {order.confidence:.2f}")
    lines.append(f"second harmonic {order.second_harmonic:.3f}, concentration {order.concentration:.3f}")
    if not order.start_known:
        lines.append(
            "look: the start tap is assumed; ranges hold up to a quarter period, pass --reference to settle it"
        )
    return "\n".join(lines)


def _array(path: Path) -> Any:
    import numpy as np

    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (ValueError, EOFError, OSError) as err:
        raise FormatError(f"{path}: expected an array in .npy format, got {err}") from err
