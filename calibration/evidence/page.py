"""Write ``evidence.html``: what an alignment rests on, on one page that needs nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from calibration.alignment.rounds import free_of
from calibration.board.coverage import missing
from calibration.evidence import Drift, OldRig, covariance_of, drift, read_evidence
from calibration.limits import LIMITS, Judged, judged, worst
from calibration.registration.clouds import stereo_cloud, surface_points, tof_depth
from calibration.registration.gate import residuals
from calibration.registration.pairs import calibration_views
from calibration.registration.rims import rim_cloud, stereo_rims, tof_rims
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.colours import Scale
from tofcapture.frames import View
from tofcapture.poses import Float64, check_transform, invert, transform
from tofcapture.record.quality import CELLS, coverage
from tofcapture.rig import range_error_from
from tofcapture.viz import page as charts
from tofcapture.viz.page import write_page

Progress = Callable[[str, int, int], None]
MOST_VIEWS = 24  # views that are read for the page, evenly; each costs a second
MOST_POINTS = 6000  # surface points per view
COMPONENTS = ("tx", "ty", "tz", "rx", "ry", "rz")
FEWEST = 30  # points below which a cell of the image has no median
_LIMIT = 5.0  # mm, ends of the residuals' axes
_ERRORS = Scale("RdBu_r", -3.0, 3.0, "mm")
_IMAGE_WORDS = (
    "Over the image, medians in mm, blue too near, red too far. "
    "Rings: intrinsics or lens; one side: scattered light or a bent board."
)
_WAVE_WORDS = (
    "Range error common to all views, on the axis, as estimated and taken off: "
    "what the camera's own calibration leaves."
)


@dataclass(frozen=True)
class Samples:
    """Residuals of all views at the transform that was found, range residual taken off.

    Attributes
    ----------
    camera
        ToF intrinsics.
    pixel
        (N, 2) float64, u and v of each surface point in the ToF image.
    range, amplitude
        (N,) float64: metres along the ray; raw units at the highest modulation frequency.
    residual
        (N,) float64, metres, along the stereo surface's normal; positive where ToF measures too far.
    rims
        (M,) float64, metres, ToF rims across stereo rims, signed.
    poses, outlines
        Of the board in each view: (4, 4) ``T_tof_board`` (centroid, normal of the plane) and (32, 2) metres about it.
    """

    camera: Camera
    pixel: Float64
    range: Float64
    amplitude: Float64
    residual: Float64
    rims: Float64
    poses: list[Float64]
    outlines: list[Float64]


def write_evidence_page(
    recording: Path,
    old: OldRig | None = None,
    evidence: Mapping[str, Any] | None = None,
    progress: Progress = lambda _stage, _done, _total: None,
    out: Path | None = None,
) -> Path:
    """Write ``evidence.html`` into ``out``, by default the recording.

    Residuals are computed anew from the views, at the transform that the evidence states: that of ``evidence.json`` unless it is given.
    ``old`` is an older alignment to compare with. ``progress`` is called with a stage, steps done and steps in all. Same inputs, same
    bytes.

    :class:`ConfigError` where jinja2 or matplotlib is not installed, :class:`DataError` for no readable evidence or views.
    """
    found = read_evidence(recording) if evidence is None else evidence
    moved = None if old is None else drift(found, old)
    samples = sample_recording(recording, found, progress)
    content = page_content(found, samples, moved, "" if old is None else old.name)
    return write_page(
        Path(__file__).with_name("evidence.html.j2"), Path(out or recording) / "evidence.html", content
    )


def page_content(
    evidence: Mapping[str, Any], samples: Samples, moved: Drift | None, old_name: str
) -> dict[str, Any]:
    """Make everything that the template prints of an evidence and the residuals at its transform.

    Drift and name of an older rig are None and "" without ``--compare``.
    """
    covered = coverage(samples.poses, samples.camera, np.array(samples.outlines).reshape(-1, 32, 2))
    wave = _wave(evidence, samples)
    sections = [
        ("views", "Views and their spread", [Judged(**c) for c in evidence["checks"]]),
        ("residuals", "Residuals", _judge_residuals(samples, wave)),
        ("coverage", "Coverage", _judge_coverage(covered)),
    ]
    if moved is not None:
        sections.append(("drift", "Against the old calibration", _judge_drift(moved)))
    rows = [c for _, _, found in sections for c in found]
    made = evidence.get("provenance") or {}
    return {
        "evidence": evidence,
        "verdict": worst([c.verdict for c in rows]),
        "sections": {
            key: (title, worst([c.verdict for c in found]), found) for key, title, found in sections
        },
        "problems": [c for c in rows if c.verdict != "PASS"],
        "method": evidence.get("method", "averaged"),
        "pairs": evidence["pairs"],
        "spread_charts": _spread_charts(evidence["pairs"]),
        "residual_charts": _residual_charts(samples, wave),
        "missing": missing(covered),
        "coverage_charts": _coverage_charts(covered),
        "uncertainty": _uncertainty(evidence),
        "observability": _observability(evidence),
        "methods": _methods(evidence),
        "drift": None if moved is None else _drift(moved, old_name),
        "transform": "\n".join("  ".join(f"{x:+.7f}" for x in row) for row in evidence["T_tof_stereo"]),
        "limits": [[limit.words, limit.text, limit.cause] for limit in LIMITS.values()],
        "provenance": [*made.get("versions", {}).items(), *made.get("inputs", {}).items()],
    }


def _judge_residuals(samples: Samples, wave: tuple[Float64, Float64] | None) -> list[Judged]:
    """Judge what is left over range, amplitude and the image, the rims, and the common range error."""
    if len(samples.residual) < 200:
        return [judged("bias_range", None)]
    mm = 1e3 * samples.residual
    by_range, by_amplitude = (
        float(np.abs(charts.binned(x, mm, 12)[1][:, 1]).max()) for x in (samples.range, samples.amplitude)
    )
    out = [judged("bias_range", by_range), judged("bias_amplitude", by_amplitude)]
    out.append(judged("bias_image", float(np.nanquantile(np.abs(image_medians(samples)), 0.9))))
    out.append(judged("rims", float(np.median(np.abs(1e3 * samples.rims))) if len(samples.rims) else None))
    if wave is not None:
        out.append(judged("wiggle", float(np.sqrt(np.mean(np.square(wave[1]))))))
    return out


def image_medians(samples: Samples) -> Float64:
    """Median residual (9, 12) of each cell of the image, millimetres; NaN where there are too few points."""
    rows, columns = CELLS
    height, width = samples.camera.shape
    r = np.clip((samples.pixel[:, 1] + 0.5) * rows / height, 0, rows - 1).astype(int)
    c = np.clip((samples.pixel[:, 0] + 0.5) * columns / width, 0, columns - 1).astype(int)
    out = np.full(rows * columns, np.nan)
    for cell in range(rows * columns):
        inside = samples.residual[r * columns + c == cell]
        if len(inside) >= FEWEST:
            out[cell] = 1e3 * np.median(inside)
    return out.reshape(CELLS)


def _judge_coverage(covered: Mapping[str, Any]) -> list[Judged]:
    if not covered["views"]:
        return [judged("image", 0.0)]
    return [
        judged("image", covered["image_share"]),
        judged("sectors", sum(n > 0 for n in covered["sectors"].values())),
        judged("tilt", float(np.median(covered["tilt_deg"]))),
        judged("distances", max(covered["distance_m"]) / min(covered["distance_m"])),
    ]


def _judge_drift(moved: Drift) -> list[Judged]:
    """Judge a drift by its size; one that may be chance passes."""
    out = [
        judged("drift_rotation", float(np.degrees(moved.rotation))),
        judged("drift_translation", 1e3 * moved.translation),
    ]
    if moved.verdict == "PASS":
        return [Judged(c.words, c.value, c.limits, "PASS", "") for c in out]
    return out


def _spread_charts(pairs: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    names = [PurePath(p["view"]).stem.removeprefix("view-") for p in pairs]
    good = [p["accepted"] for p in pairs]
    rows = (("rotation_from_mean_deg", "deg from the mean"), ("translation_from_mean_mm", "mm from the mean"))
    return [(charts.bars(names, [p[key] for p in pairs], good, words), words) for key, words in rows]


def _wave(evidence: Mapping[str, Any], samples: Samples) -> tuple[Float64, Float64] | None:
    """Ranges and the error common to all views there, millimetres; None where the evidence has none."""
    if not evidence.get("range_residual") or len(samples.range) < 20:
        return None
    near, far = np.quantile(samples.range, (0.01, 0.99))
    r = np.linspace(float(near), float(far), 200)
    error = range_error_from(evidence["range_residual"])
    phase = 4 * np.pi * error.modulation_hz / SPEED_OF_LIGHT * r
    return r, 1e3 * error.at(phase, 0.0, error.reference_celsius)


def _residual_charts(samples: Samples, wave: tuple[Float64, Float64] | None) -> list[tuple[str, str]]:
    mm, rims = 1e3 * samples.residual, 1e3 * samples.rims
    index = np.arange(len(rims), dtype=np.float64) / max(len(rims), 1)
    out = [
        (charts.scatter(samples.range, mm, "range, m", "residual, mm", _LIMIT),
         "Over range. A wave is demodulation error (wiggling), a slope a wrong modulation frequency or wrong intrinsics, a step multipath."),
        (charts.scatter(samples.amplitude, mm, "amplitude, raw units", "residual, mm", _LIMIT, logarithmic=True),
         "Over amplitude. A bend at the dark end is scattered light, at the bright end saturation."),
        (charts.heat(image_medians(samples), _ERRORS, "median residual over the image") if len(mm) else "", _IMAGE_WORDS),
        (charts.scatter(index, rims, "share of rim points", "rim distance, mm", _LIMIT),
         "Rims across, in the order of the views. Off zero: the images do not fit sideways."),
    ]  # fmt: skip
    if wave is not None:
        high = max(1.0, float(np.abs(wave[1]).max()) * 1.2)
        out.append((charts.scatter(*wave, "range, m", "range error, mm", high), _WAVE_WORDS))
    return [(svg, words) for svg, words in out if svg]


def _coverage_charts(covered: Mapping[str, Any]) -> list[tuple[str, str]]:
    grid = np.array(covered["image"], dtype=np.float64)
    views = Scale("cividis", 0.0, max(float(grid.max()), 1.0), "views")
    names = [f"{i}" for i in range(covered["views"])]
    return [
        (charts.heat(grid, views, "views per cell"), "How often the board covered each part of the ToF image."),
        (charts.polar(covered["tilt_deg"], covered["lean_deg"]),
         "Tilt of the board against the line of sight, and where its front leans to in the image."),
        (charts.bars(names, covered["distance_m"], [True] * len(names), "distance, m"), "Distance of each view."),
    ]  # fmt: skip


def _uncertainty(evidence: Mapping[str, Any]) -> dict[str, Any] | None:
    """1-sigma of the six components in mm and deg, and their correlations; None where the evidence has no covariance."""
    C = covariance_of(evidence)
    if C is None:
        return None
    sigma = np.sqrt(np.diag(C))
    stated = [f"{1e3 * s:.3f} mm" for s in sigma[:3]] + [f"{np.degrees(s):.4f} deg" for s in sigma[3:]]
    correlation = Scale("RdBu_r", -1.0, 1.0, "correlation")
    chart = charts.heat(C / np.outer(sigma, sigma), correlation, "correlations", COMPONENTS)
    return {"sigma": [list(row) for row in zip(COMPONENTS, stated, strict=True)], "chart": chart}


def _observability(evidence: Mapping[str, Any]) -> list[list[str]]:
    rows = [["in plain words", str(evidence["in_words"])]] if evidence.get("in_words") else []
    return rows + _rows(evidence.get("observability") or {})


def _methods(evidence: Mapping[str, Any]) -> list[tuple[str, list[list[str]]]]:
    """Tell what each method found, its matrices left out."""
    found = evidence.get("methods") or {}
    return [
        (name, _rows({k: v for k, v in values.items() if not _is_matrix(v)}))
        for name, values in found.items()
    ]


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], list)


def _rows(table: Mapping[str, Any]) -> list[list[str]]:
    return [[str(key).replace("_", " "), _text(value)] for key, value in table.items()]


def _text(value: Any) -> str:
    """Write any JSON value for a person."""
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {_text(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_text(v) for v in value) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _drift(moved: Drift, old_name: str) -> dict[str, Any]:
    shifts = [f"{1e3 * x:+.3f} mm" for x in moved.twist[:3]]
    return {
        "old": old_name,
        "rotation": f"{np.degrees(moved.rotation):.4f} deg",
        "translation": f"{1e3 * moved.translation:.3f} mm",
        "components": [shifts + [f"{np.degrees(x):+.4f} deg" for x in moved.twist[3:]]],
        "names": COMPONENTS,
        "sigmas": f"{moved.sigmas:.2f}",
        "probability": f"{moved.probability:.2g}",
        "significant": moved.significant,
        "basis": moved.basis,
    }


def sample_recording(recording: Path, evidence: Mapping[str, Any], progress: Progress) -> Samples:
    """Measure the residuals of a recording's used views at the transform of an evidence, its range residual taken off.

    Raises :class:`DataError`: no views, or unreadable ones.
    """
    from tofcapture.files.view import open_view

    T_stereo_tof = invert(check_transform(evidence["T_tof_stereo"], "evidence: T_tof_stereo"))
    paths = calibration_views(recording)
    refused = {Path(p["view"]).name for p in evidence["pairs"] if not p["accepted"]}
    good = [p for p in paths if p.name not in refused] or paths
    some = np.unique(np.linspace(0, len(good) - 1, MOST_VIEWS).round().astype(int))
    parts: list[Samples] = []
    for i in some:
        progress("evidence page", len(parts), len(some))
        parts.append(_sample(open_view(good[i]), T_stereo_tof, evidence))
    joined = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _ARRAYS}
    poses, outlines = [T for p in parts for T in p.poses], [o for p in parts for o in p.outlines]
    return Samples(camera=parts[0].camera, **joined, poses=poses, outlines=outlines)


_ARRAYS = ("pixel", "range", "amplitude", "residual", "rims")


def _sample(view: View, T_stereo_tof: Float64, evidence: Mapping[str, Any]) -> Samples:
    camera = view.tof.info.camera
    phasor, depth = tof_depth(view.tof)
    raw = surface_points(view.tof, depth)
    raw = raw[:: max(1, len(raw) // MOST_POINTS)]
    stated = evidence.get("range_residual")
    points = free_of(range_error_from(stated), raw, camera) if stated else raw
    found = residuals(points, stereo_cloud(view.stereo), T_stereo_tof)
    kept = raw[found.source]
    pixel, _ = camera.project(kept)
    column, row = np.rint(pixel).astype(int).T
    held = rim_cloud(stereo_rims(view.stereo.points), T_stereo_tof[:3, 3])
    rims = tof_rims(phasor, depth, camera).points
    across = residuals(rims, held, T_stereo_tof).distance if len(held) and len(rims) else np.zeros(0)
    boards = [_stand_in(points)] if len(points) > 3 else []
    return Samples(
        camera,
        pixel,
        np.linalg.norm(kept, axis=1),
        np.abs(phasor[-1])[row, column],
        -found.distance,
        across,
        [pose for pose, _ in boards],
        [outline for _, outline in boards],
    )


def _stand_in(points: Float64) -> tuple[Float64, Float64]:
    """Pose and outline (32, 2) of a plane's points (N, 3): an ellipse that covers what they cover, normal towards the camera."""
    centre = points.mean(axis=0)
    _, singular, axes = np.linalg.svd(points - centre, full_matrices=False)
    x, z = axes[0], axes[2] if axes[2] @ centre < 0 else -axes[2]
    half = 2 * singular[:2] / np.sqrt(len(points))
    angle = 2 * np.pi * np.arange(32) / 32
    outline = half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), centre), outline
