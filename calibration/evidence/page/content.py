"""What the evidence page says, section by section."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from calibration.board.coverage import coverage
from calibration.evidence import covariance_of
from calibration.evidence.compare import Drift
from calibration.evidence.page import charts, checks
from calibration.evidence.page.samples import Samples, residual_from
from calibration.limits import LIMITS, Judged, worst
from tofcapture.poses import Float64

COMPONENTS = ("tx", "ty", "tz", "rx", "ry", "rz")


def page_content(
    evidence: Mapping[str, Any], samples: Samples, moved: Drift | None, old_name: str
) -> dict[str, Any]:
    """Everything that the template prints.

    Parameters
    ----------
    evidence
        ``evidence.json``.
    samples
        Residuals at its transform.
    moved, old_name
        Drift against an older rig and that rig's name; None and "" without ``--compare``.
    """
    covered = coverage(samples.poses, samples.camera, np.array(samples.outlines).reshape(-1, 32, 2))
    wave = _wave(evidence, samples)
    sections = [
        ("views", "Views and their spread", [Judged(**c) for c in evidence["checks"]]),
        ("residuals", "Residuals", checks.residual_checks(samples, None if wave is None else wave[1])),
        ("coverage", "Coverage", checks.coverage_checks(covered)),
    ]
    if moved is not None:
        sections.append(("drift", "Against the old calibration", checks.drift_checks(moved)))
    rows = [c for _, _, found in sections for c in found]
    return {
        "verdict": worst([c.verdict for c in rows]),
        "sections": [
            (key, title, worst([c.verdict for c in found]), found) for key, title, found in sections
        ],
        "problems": [c for c in rows if c.verdict != "PASS"],
        "simulated": bool(evidence.get("truth")),
        "backend": evidence.get("backend", "unknown"),
        "method": evidence.get("method", "averaged"),
        "used": evidence.get("used", 0),
        "views": evidence.get("views", 0),
        "pairs": [_pair(p) for p in evidence.get("pairs", ())],
        "spread_charts": _spread_charts(evidence),
        "residual_charts": _residual_charts(samples, wave),
        "covered": covered,
        "coverage_charts": _coverage_charts(samples, covered),
        "uncertainty": _uncertainty(evidence),
        "observability": _observability(evidence),
        "methods": _methods(evidence),
        "drift": _drift(moved, old_name),
        "transform": _transform(evidence),
        "limits": [(limit.words, limit.text, limit.cause) for limit in LIMITS.values()],
        "provenance": _provenance(evidence),
    }


def _pair(pair: Mapping[str, Any]) -> dict[str, Any]:
    keys = [("rmse_mm", 2), ("inliers", 0), ("fitness", 2), ("condition", 0)]
    keys += [("rotation_from_mean_deg", 3), ("translation_from_mean_mm", 2)]
    return {
        "name": PurePath(pair["view"]).stem,
        "accepted": bool(pair.get("accepted")),
        "reason": pair.get("reason") or "used",
        "cells": ["–" if pair.get(key) is None else f"{pair[key]:.{n}f}" for key, n in keys],
    }


def _spread_charts(evidence: Mapping[str, Any]) -> list[tuple[str, str]]:
    pairs = evidence.get("pairs", ())
    names = [PurePath(p["view"]).stem.removeprefix("view-") for p in pairs]
    good = [bool(p.get("accepted")) for p in pairs]
    rows = [("rotation_from_mean_deg", "deg from the mean"), ("translation_from_mean_mm", "mm from the mean")]
    return [(charts.bars(names, [p.get(k) for p in pairs], good, words), words) for k, words in rows]


def _wave(evidence: Mapping[str, Any], samples: Samples) -> tuple[Float64, Float64] | None:
    """Ranges and the error common to all views there, millimetres; None where the evidence has none."""
    if not evidence.get("range_residual") or len(samples.range) < 20:
        return None
    near, far = np.quantile(samples.range, (0.01, 0.99))
    r = np.linspace(float(near), float(far), 200)
    model = residual_from(evidence, samples.camera)
    return r, 1e3 * (model.terms(np.column_stack([0 * r, 0 * r, r])) @ model.coefficients)


def _residual_charts(samples: Samples, wave: tuple[Float64, Float64] | None) -> list[tuple[str, str]]:
    mm = 1e3 * samples.residual
    limit = 5.0
    out = [
        (charts.scatter(samples.range, mm, "range, m", "residual, mm", limit),
         "Over range. A wave is demodulation error (wiggling), a slope a wrong modulation frequency or wrong intrinsics, a step multipath."),
        (charts.scatter(samples.amplitude, mm, "amplitude, raw units", "residual, mm", limit, logarithmic=True),
         "Over amplitude. A bend at the dark end is scattered light, at the bright end saturation."),
    ]  # fmt: skip
    if len(mm):
        cells = checks.image_medians(samples)
        words = "Over the image, medians in mm, blue −3 to orange +3 (too far). Rings: intrinsics or lens; one side: scattered light or a bent board."
        out.append((charts.heat(cells, "median residual over the image", signed=True, limit=3.0), words))
    if len(samples.rims) >= 20:
        index = np.arange(len(samples.rims), dtype=np.float64) / len(samples.rims)
        words = "Rims across, in the order of the views. Off zero: the images do not fit sideways."
        out.append(
            (
                charts.scatter(index, 1e3 * samples.rims, "share of rim points", "rim distance, mm", limit),
                words,
            )
        )
    if wave is not None:
        words = "Range error common to all views, on the axis, as estimated and taken off: what the camera's own calibration leaves."
        high = max(1.0, float(np.abs(wave[1]).max()) * 1.2)
        out.append((charts.scatter(*wave, "range, m", "range error, mm", high), words))
    return [(svg, words) for svg, words in out if svg]


def _coverage_charts(samples: Samples, covered: Mapping[str, Any]) -> list[tuple[str, str]]:
    grid = np.array(covered["image"], dtype=np.float64)
    return [
        (charts.heat(grid, "views per cell", signed=False, limit=max(float(grid.max()), 1.0)),
         "How often the board covered each part of the ToF image."),
        (charts.polar(covered["tilt_deg"], covered["lean_deg"]),
         "Tilt of the board against the line of sight, and where its front leans to in the image."),
        (charts.bars([f"{i}" for i in range(len(samples.poses))], covered["distance_m"], [True] * len(samples.poses), "distance, m"),
         "Distance of each view."),
    ]  # fmt: skip


def _uncertainty(evidence: Mapping[str, Any]) -> dict[str, Any] | None:
    """1-sigma of the six components in mm and deg, and their correlations; None where the evidence has no covariance."""
    C = covariance_of(evidence)
    if C is None:
        return None
    sigma = np.sqrt(np.diag(C))
    stated = [f"{1e3 * s:.3f} mm" for s in sigma[:3]] + [f"{np.degrees(s):.4f} deg" for s in sigma[3:]]
    return {
        "sigma": list(zip(COMPONENTS, stated, strict=True)),
        "chart": charts.matrix(C / np.outer(sigma, sigma), COMPONENTS),
    }


def _observability(evidence: Mapping[str, Any]) -> dict[str, str] | None:
    found = evidence.get("observability")
    words = evidence.get("in_words")
    rows = {"in plain words": str(words)} if words else {}
    if isinstance(found, Mapping):
        rows |= {str(key).replace("_", " "): _text(value) for key, value in found.items()}
    return rows or None


def _text(value: Any) -> str:
    """Write any JSON value for a person."""
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {_text(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_text(v) for v in value) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _methods(evidence: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]] | None:
    """What each method found, its matrices left out; None where the evidence names no methods."""
    found = evidence.get("methods")
    if not isinstance(found, Mapping):
        return None
    return [
        (str(name), [(k.replace("_", " "), _text(v)) for k, v in values.items() if not _is_matrix(v)])
        for name, values in found.items()
        if isinstance(values, Mapping)
    ]


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], list)


def _drift(moved: Drift | None, old_name: str) -> dict[str, Any] | None:
    if moved is None:
        return None
    stated = [f"{1e3 * x:+.3f} mm" for x in moved.twist[:3]] + [
        f"{np.degrees(x):+.4f} deg" for x in moved.twist[3:]
    ]
    return {
        "old": old_name,
        "rotation": f"{np.degrees(moved.rotation):.4f} deg",
        "translation": f"{1e3 * moved.translation:.3f} mm",
        "components": list(zip(COMPONENTS, stated, strict=True)),
        "sigmas": f"{moved.sigmas:.2f}",
        "probability": f"{moved.probability:.2g}",
        "significant": moved.significant,
        "basis": moved.basis,
    }


def _transform(evidence: Mapping[str, Any]) -> list[str]:
    return ["  ".join(f"{x:+.7f}" for x in row) for row in evidence["T_tof_stereo"]]


def _provenance(evidence: Mapping[str, Any]) -> list[tuple[str, str]]:
    found = evidence.get("provenance") or {}
    rows = [(str(k), str(v)) for k, v in found.get("versions", {}).items()]
    return rows + [(str(k), str(v)) for k, v in found.get("inputs", {}).items()]
