"""The judged numbers of an alignment, each against its limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from calibration.evidence.compare import Drift, covariance_of
from calibration.evidence.limits import LIMITS
from calibration.evidence.page.charts import binned
from calibration.evidence.page.samples import Samples
from tofcapture.poses import Float64, invert, rotation_angle, transform_points

GRID = (9, 12)  # cells of the image, as in calibration.board.coverage
MOST_EMPTY = 30  # points below which a cell of the image has no median
VERDICTS = ("PASS", "WARN", "FAIL")


@dataclass(frozen=True)
class Check:
    """One row of the table: what, value as text, limits as text, PASS/WARN/FAIL, and the likely cause where it is not PASS."""

    words: str
    value: str
    limits: str
    verdict: str
    cause: str


def check(key: str, value: float | None) -> Check:
    """Judge one number by its limit."""
    limit = LIMITS[key]
    verdict = limit.verdict(value)
    text = "none" if value is None or np.isnan(value) else f"{value:.3g} {limit.unit}".rstrip()
    return Check(limit.words, text, limit.text, verdict, "" if verdict == "PASS" else limit.cause)


def worst(checks: Sequence[Check]) -> str:
    """Return the worst verdict; ``WARN`` where nothing was judged."""
    return max((c.verdict for c in checks), key=VERDICTS.index, default="WARN")


def pair_checks(evidence: Mapping[str, Any]) -> list[Check]:
    """Judge the views, their spread and the start; a key that an older evidence lacks is left out."""
    used = [p for p in evidence.get("pairs", ()) if p.get("accepted")]
    rmse = [p["rmse_mm"] for p in used if p.get("rmse_mm") is not None]
    condition = [p["condition"] for p in used if p.get("condition") is not None]
    out = [check("used", evidence.get("used", len(used)))]
    out += [check("rmse", median(rmse))] if rmse else []
    out += [check("condition", max(condition))] if condition else []
    for key, words in (("spread", "spread"), ("standard_error", "error")):
        if value := evidence.get(key):
            out.append(check(f"{words}_rotation", value.get("rotation_deg")))
            out.append(check(f"{words}_translation", value.get("translation_mm")))
    if (C := covariance_of(evidence)) is not None:
        out.append(check("uncertain_motion", 1e3 * least_certain(C)))
    return [*out, *_initial(evidence), *_truth(evidence)]


def least_certain(C: Float64) -> float:
    """1-sigma of the least certain motion of points 0.1 m around the working point, metres, from a covariance (6, 6)."""
    scale = np.repeat([1.0, 0.1], 3)  # rotations as the motion of a point 0.1 m aside
    return float(np.sqrt(np.linalg.eigvalsh(C * np.outer(scale, scale))[-1]))


def _initial(evidence: Mapping[str, Any]) -> list[Check]:
    if "initial_T_tof_stereo" not in evidence:
        return []
    T = np.asarray(evidence["T_tof_stereo"])
    moved = np.asarray(evidence["initial_T_tof_stereo"]) @ invert(T)
    point = np.asarray(evidence.get("working_point_m", (0, 0, 0.8)), dtype=np.float64)
    shift = float(np.linalg.norm(transform_points(moved, point) - point))
    return [
        check("initial_rotation", float(np.degrees(rotation_angle(moved)))),
        check("initial_translation", 1e3 * shift),
    ]


def _truth(evidence: Mapping[str, Any]) -> list[Check]:
    truth = evidence.get("truth")
    if not truth:
        return []
    return [
        check("truth_rotation", truth.get("rotation_error_deg")),
        check("truth_translation", truth.get("translation_error_mm")),
    ]


def residual_checks(samples: Samples, wave_mm: Float64 | None) -> list[Check]:
    """Judge what is left of the residuals over range, amplitude and the image, the rims, and the common range error."""
    if len(samples.residual) < 200:
        return [check("bias_range", None)]
    mm = 1e3 * samples.residual
    by_range = np.abs(binned(samples.range, mm, 12)[1][:, 1]).max()
    by_amplitude = np.abs(binned(samples.amplitude, mm, 12)[1][:, 1]).max()
    cells = np.abs(image_medians(samples))
    out = [check("bias_range", float(by_range)), check("bias_amplitude", float(by_amplitude))]
    out.append(check("bias_image", float(np.nanquantile(cells, 0.9))))
    out.append(check("rims", float(np.median(np.abs(1e3 * samples.rims))) if len(samples.rims) else None))
    if wave_mm is not None:
        out.append(check("wiggle", float(np.sqrt(np.mean(np.square(wave_mm))))))
    return out


def image_medians(samples: Samples) -> Float64:
    """Median residual (9, 12) of each cell of the image, millimetres; NaN where there are too few points."""
    rows, columns = GRID
    height, width = samples.camera.shape
    r = np.clip((samples.pixel[:, 1] + 0.5) * rows / height, 0, rows - 1).astype(int)
    c = np.clip((samples.pixel[:, 0] + 0.5) * columns / width, 0, columns - 1).astype(int)
    out = np.full(rows * columns, np.nan)
    for cell in range(rows * columns):
        inside = samples.residual[r * columns + c == cell]
        if len(inside) >= MOST_EMPTY:
            out[cell] = 1e3 * np.median(inside)
    return out.reshape(GRID)


def coverage_checks(covered: Mapping[str, Any]) -> list[Check]:
    """Judge a coverage of :func:`calibration.board.coverage.coverage`."""
    if not covered["views"]:
        return [check("image", 0.0)]
    return [
        check("image", covered["image_share"]),
        check("sectors", sum(n > 0 for n in covered["sectors"].values())),
        check("tilt", float(np.median(covered["tilt_deg"]))),
        check("distances", max(covered["distance_m"]) / min(covered["distance_m"])),
    ]


def drift_checks(moved: Drift) -> list[Check]:
    """Judge a drift by its size; one that may be chance passes."""
    out = [
        check("drift_rotation", float(np.degrees(moved.rotation))),
        check("drift_translation", 1e3 * moved.translation),
    ]
    if moved.verdict == "PASS":
        return [Check(c.words, c.value, c.limits, "PASS", "") for c in out]
    return out
