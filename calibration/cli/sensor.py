"""``tofcapture calibrate lens | range | phase-order``: what the ToF camera itself does, found from recordings and raw frames."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcapture.cli import kit
from tofcapture.cli.kit import Outcome
from tofcapture.errors import DataError, FormatError, QualityError, UsageError
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from calibration.board.geometry import Board
    from calibration.lens import BoardLens, BoardSeen
    from calibration.phase_order.find import PhaseOrder
    from tofcapture.camera import Camera
    from tofcapture.frames import View
    from tofcapture.rig import Rig

CARELESS = 3.0  # times: an averaged alignment's error is mostly the range error itself, which its scatter does not show
IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp"}


def read_views(recording: Path, what: str) -> Iterator[tuple[Path, View]]:
    """Read the calibration views of a recording one by one, with progress; :class:`DataError` where there are none."""
    from calibration.registration.pairs import calibration_views
    from tofcapture.files.view import open_view

    paths = calibration_views(recording)
    with kit.progress() as progress:
        for i, path in enumerate(paths):
            progress(what, i, len(paths))
            yield path, open_view(path)
        progress(what, len(paths), len(paths))


def believed_rig(recording: Path, given: Path | None = None) -> Rig:
    """Return the rig to start from: the given one, what was aligned or calibrated before, else what the first view says."""
    from calibration.registration.pairs import calibration_views
    from tofcapture.files.view import open_view
    from tofcapture.rig import load_rig

    path = given or recording / "rig.toml"
    return load_rig(path) if given or path.exists() else open_view(calibration_views(recording)[0]).rig


def saved(args: argparse.Namespace, name: str, data: dict[str, Any], rig: Rig, text: str) -> Outcome:
    """Write a report and the rig it leads to into the recording, unless it is a dry run."""
    from calibration.evidence import write_json
    from tofcapture.files.seal import write_text
    from tofcapture.rig import dumps_rig

    if not args.dry_run:
        path = args.recording / "rig.toml"
        write_json(args.recording / name, data)
        write_text(path, dumps_rig(rig))
        data = {**data, "rig": str(path)}
    return Outcome(data=data, text=text)


def add_recording(parser: argparse.ArgumentParser, *, board: bool) -> None:
    """Declare the arguments that commands on a recording share."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder with calibration views")
    if board:
        parser.add_argument(
            "--board",
            default="default",
            metavar="BOARD",
            help="packaged board or a TOML file (default: default)",
        )
    parser.add_argument("--dry-run", action="store_true", help="print the result, write nothing")


def configure_lens(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_recording(parser, board=True)
    parser.add_argument(
        "--factory",
        type=Path,
        metavar="FILE",
        help="take the lens from the maker's calibration file (JSON, YAML)",
    )
    parser.add_argument("--camera", metavar="NAME", help="part of that file, where it holds several cameras")


def run_lens(args: argparse.Namespace) -> Outcome:
    """Fit the lens of a recording's ToF camera into ``rig.toml`` and ``lens.json``, that of a folder of images into ``lens.json``."""
    if args.factory:
        return _factory_lens(args)
    from calibration.board.fit import Model
    from calibration.board.geometry import load_board
    from calibration.lens import fit_lens

    board = load_board(args.board)
    if images := _images(args.recording):
        return _lens_of_images(args, board, images)
    rig = believed_rig(args.recording)

    def look(camera: Camera) -> tuple[list[BoardSeen], list[str]]:
        found, refused = [], []
        for path, view in read_views(args.recording, "board"):
            try:
                found.append(board_seen(view, camera, board))
            except QualityError as err:
                refused.append(f"{path.stem} {err}")
        return found, refused

    fit, refused = fit_lens(Model(board), look, rig.tof)
    data = {**lens_report(fit, rig.tof), "refused": refused}
    return saved(args, "lens.json", data, replace(rig, tof=fit.camera), lens_table(data))


def _factory_lens(args: argparse.Namespace) -> Outcome:
    from calibration.factory import factory_camera
    from calibration.lens import NAMES, lens_values

    rig = believed_rig(args.recording)
    camera = factory_camera(args.factory, (rig.tof.width, rig.tof.height), args.camera)
    pairs = zip(NAMES, lens_values(camera), lens_values(rig.tof), strict=True)
    lens = {n: {"value": float(v), "before": float(b)} for n, v, b in pairs}
    rows = [(n, f"{v['value']:.5g}", f"{v['before']:.5g}") for n, v in lens.items() if any(v.values())]
    data = {"format": "tofcapture-lens-calibration", "version": 1, "source": args.factory.name, "lens": lens}
    text = (
        kit.table(("", "value", "before"), rows, "  ")
        + "\nlook: run tofcapture align again: it stood on the lens before"
    )
    return saved(args, "lens.json", data, replace(rig, tof=camera), text)


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir() or (folder / "views").exists():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGES)


def _lens_of_images(args: argparse.Namespace, board: Board, paths: list[Path]) -> Outcome:
    """Fit the lens of the camera that took these images of a printed board."""
    from calibration.board.fit import Model
    from calibration.board.printed import printed_pose, read_corners, start_camera
    from calibration.lens import BoardSeen, fit_lens_to_board
    from calibration.limits import worst
    from tofcapture.rig import camera_table

    with kit.progress() as progress:
        size, seen, refused = read_corners(paths, board, progress)
    start = start_camera(list(seen.values()), size)
    views = [BoardSeen(pixels, printed_pose(pixels, at, board, start), at) for pixels, at in seen.values()]
    fit = fit_lens_to_board(Model(board), views, start)
    data = {**lens_report(fit, start), "images": [p.name for p in seen], "refused": refused}
    data["look"] = [text for text in data["look"] if "rig transform" not in text]
    data |= {"camera": camera_table(fit.camera), "verdict": worst(list(data["verdicts"].values()))}
    if args.dry_run:
        return Outcome(data, lens_table(data))
    return kit.written(data, lens_table(data), args.recording / "lens.json")


def board_seen(view: View, camera: Camera, board: Board) -> BoardSeen:
    """Find the board with the believed lens, or say why not; keep its rims or corners as pixels, which no lens has touched."""
    from calibration.board.seen import seen_by_tof
    from calibration.lens import BoardSeen

    found = seen_by_tof(view.tof, board, camera)
    return BoardSeen(found.pixels, found.fit.T, found.at)


def lens_report(fit: BoardLens, before: Camera) -> dict[str, Any]:
    """Lay a fit out as JSON types."""
    from calibration.lens import NAMES, lens_values
    from calibration.limits import LENS, worst

    judged = {
        "rms": fit.rms,
        "left_out": float(np.sqrt(np.mean(np.square(fit.left_out)))),
        "pixel_sigma": fit.pixel_sigma,
        "coverage": float(fit.coverage.min()),
    }
    verdicts = {k: LENS[k].verdict(v) for k, v in judged.items()}
    values = zip(NAMES, lens_values(fit.camera), fit.sigma, lens_values(before), strict=True)
    return {
        "format": "tofcapture-lens-calibration",
        "version": 1,
        "views": len(fit.left_out),
        "model": fit.model,
        "lens": {n: {"value": float(v), "sigma": float(s), "before": float(b)} for n, v, s, b in values},
        **judged,
        "left_out_px": fit.left_out.tolist(),
        "growth_px": fit.growth,
        "verdicts": verdicts,
        "verdict": worst(list(verdicts.values())),
        "look": [f"{k} {v}: {LENS[k].cause}" for k, v in verdicts.items() if v != "PASS"]
        + ["the rig transform was aligned with the lens before: run tofcapture align again"],
    }


def lens_table(data: dict[str, Any]) -> str:
    """Lay a report out for a person."""
    lens = data["lens"]
    held = data["model"] == "pinhole" and any(lens[k]["value"] for k in lens if k[0] in "kp")
    model = "distortion as before" if held else data["model"]
    rows = [
        (name, f"{v['value']:.5g}", f"{v['sigma']:.2g}", f"{v['before']:.5g}")
        for name, v in lens.items()
        if v["sigma"] or v["value"]
    ]
    lines = [
        f"{data['views']} views, {len(data['refused'])} refused; lens: {model}",
        kit.table(("", "value", "+-", "before"), rows, "  "),
        f"rims lie {data['rms']:.2f} px off the edges, {data['left_out']:.2f} at views left out",
        f"a ray is known to {data['pixel_sigma']:.2f} px; {100 * data['coverage']:.0f} % of the image covered",
        *data["refused"],
        *(f"look: {t}" for t in data["look"]),
        f"verdict: {data['verdict']}",
    ]
    return "\n".join(lines)


def configure_range(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_recording(parser, board=False)
    parser.add_argument(
        "--rig", type=Path, metavar="RIG.toml", help="rig transform to start from (default: the recording's)"
    )
    parser.add_argument("--orders", default="1,2,4", metavar="K,K", help="of the harmonics (default: 1,2,4)")


def run_range(args: argparse.Namespace) -> Outcome:
    """Fit the range errors, write them into ``rig.toml`` and ``range.json``."""
    from calibration.range_error.fit import fit_ranges
    from calibration.range_error.report import range_report
    from calibration.range_error.views import seen_of

    orders, rig = _orders(args.orders), believed_rig(args.recording, args.rig)
    seen = [
        seen_of(view, path.relative_to(args.recording).as_posix())
        for path, view in read_views(args.recording, "reading")
    ]
    sigma, centre, known = _vouched(args.recording, rig)
    fit = fit_ranges(seen, rig.T_tof_stereo, sigma, orders, centre)
    data = range_report(fit, known)
    found = replace(rig, T_tof_stereo=fit.T_tof_stereo, range_errors=fit.errors)
    return saved(args, "range.json", data, found, range_table(data))


def _orders(text: str) -> tuple[int, ...]:
    orders = sorted(set(_listed("--orders", text, int, "whole numbers such as 1,2,4")))
    if orders[0] < 1 or orders[-1] > 16:
        raise UsageError(f"--orders: expected harmonics from 1 to 16, got {text!r}")
    return tuple(orders)


def _listed(flag: str, text: str, kind: type, expected: str, count: int | None = None) -> list[Any]:
    """Read numbers between commas, ``count`` of them where that is given."""
    try:
        found = [kind(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or len(found) != (count or len(found)):
        raise UsageError(f"{flag}: expected {expected}, got {text!r}")
    return found


def _vouched(recording: Path, rig: Rig) -> tuple[Float64, Float64 | None, str]:
    """Tell what the rig's transform is known to, about which point, and what vouches for it.

    ``evidence.json`` vouches for the ``rig.toml`` it was written with; any other rig is known to millimetres only.
    """
    from calibration.range_error.fit import LOOSE

    path = recording / "evidence.json"
    evidence = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if not evidence or not np.allclose(evidence["T_tof_stereo"], rig.T_tof_stereo, atol=1e-9):
        return LOOSE, None, "nothing"
    centre = np.asarray(evidence["working_point_m"], dtype=np.float64)
    if stated := evidence.get("sigma"):
        sigma = np.r_[1e-3 * np.array(stated["translation_mm"]), np.radians(stated["rotation_deg"])]
        return np.maximum(sigma, 1e-6), centre, "aligned"
    error = evidence["standard_error"]
    one = np.r_[[1e-3 * error["translation_mm"]] * 3, [np.radians(error["rotation_deg"])] * 3]
    return np.maximum(CARELESS * one, 1e-6), centre, "averaged"


def range_table(data: dict[str, Any]) -> str:
    """Lay a report out for a person."""
    near, far = data["covered_m"]
    lines = [f"{data['views']} views; the correction is valid from {near:.2f} to {far:.2f} m"]
    for row in data["frequencies"]:
        lines.append(
            f"{row['modulation_hz'] / 1e6:g} MHz: {row['before_mm']:.2f} mm before, {row['after_mm']:.2f} after, "
            f"{row['left_out_mm']:.2f} at views that were not fitted; views differ by {row['views_differ_mm']:.2f} mm  {row['verdict']}"
        )
        bins = [
            (f"{b['from_m']:.1f}", f"{b['before_mm']:.2f}", f"{b['left_out_mm']:.2f}")
            for b in row["by_range"]
        ]
        lines.append(kit.table(("from m", "before mm", "left mm"), bins, "  "))
    moved = ", ".join(f"{t:.2f}" for t in data["transform_moved"]["translation_mm"])
    turned = ", ".join(f"{r:.3f}" for r in data["transform_moved"]["rotation_deg"])
    lines += [f"refused: {text}" for text in data["refused"]]
    lines.append(f"rig transform moved by {moved} mm and {turned} deg")
    return "\n".join([*lines, *(f"look: {text}" for text in data["look"]), f"verdict: {data['verdict']}"])


def configure_phase_order(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "raw",
        type=Path,
        metavar="RAW",
        help="(frames, K, H, W) or (K, H, W): .npy, .npz, .h5, .raw, or a folder of images, one phase each",
    )
    parser.add_argument(
        "--mhz", default="20,100", metavar="F[,F]", help="modulation frequencies in MHz (default: 20,100)"
    )
    parser.add_argument(
        "--phases", metavar="N[,N]", help="phases of each frequency (default: shared out evenly)"
    )
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="RADIAL.npy",
        help="(H, W) known distances along the rays, metres, NaN unknown",
    )
    parser.add_argument("--shape", metavar="H,W", help="image size of .raw files, rows of metadata included")
    parser.add_argument("--out", type=Path, metavar="RESULT.json", help="write the result here")


def run_phase_order(args: argparse.Namespace) -> Outcome:
    """Find frequency, order, sign and start of the phases of raw frames."""
    from calibration.phase_order.find import find_phase_order
    from tofcapture.importing.raw import read_raw

    hz = [1e6 * f for f in _listed("--mhz", args.mhz, float, "numbers such as 20,100")]
    reference = None if args.reference is None else _array(args.reference)
    size = args.shape and _listed("--shape", args.shape, int, "H,W such as 180,240", 2)
    shape = (size[0], size[1]) if size else None
    phases = args.phases and _listed("--phases", args.phases, int, "whole numbers such as 4,3")
    phases = phases and (phases if len(phases) > 1 else phases * len(hz))
    # Four phases are the usual: a folder of twelve images at one frequency is three frames of them.
    counts = [sum(phases)] if phases else [n * len(hz) for n in (4, 3, 5, 6, 2)]
    order = find_phase_order(read_raw(args.raw, counts, shape), hz, reference, phases)
    data = {"format": "tofcapture-phase-order", "version": 1, **asdict(order)}
    data["offset_rad"] = [None if np.isnan(x) else x for x in order.offset_rad]  # NaN is not JSON
    return kit.written(data, _order_table(order), args.out)


def _order_table(order: PhaseOrder) -> str:
    channels = enumerate(zip(order.modulation_hz, order.phase_rad, strict=True))
    rows = [(k, f"{f / 1e6:g}", f"{np.degrees(p):.0f}") for k, (f, p) in channels]
    lines = [
        kit.table(("channel", "MHz", "phase deg"), rows),
        f"sign from {order.sign_from}, confidence {order.confidence:.2f}",
        f"other harmonics {order.harmonics:.3f}, concentration {order.concentration:.3f}",
    ]
    if order.blocks_from != "data":
        lines.append("look: which channels are of which near frequency is taken from the order of --mhz")
    if not order.start_known:
        lines.append(
            "look: where the phases start is not known: the first channel of each frequency is taken for 0, ranges hold up to a constant; "
            "pass --reference to settle it"
        )
    return "\n".join(lines)


def _array(path: Path) -> Any:
    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (ValueError, EOFError, OSError) as err:
        raise FormatError(f"{path}: expected an array in .npy format, got {err}") from err
