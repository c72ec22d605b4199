"""Say what a range calibration found, what it left, and what its views could not tell, as JSON types."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.limits import RANGE_LEFT, worst
from calibration.range_error.fit import MIN_GREY, MIN_KELVIN, RangeFit, greys, warmed
from tofcapture.poses import Float64
from tofcapture.rig import image_places, range_error_table

BIN = 0.1  # m of range that one line of a report is about
CELLS = 3  # the image is judged in so many columns and rows
THROWN_BACK = 0.0015  # m of spread between views from which light from the surroundings is named


def range_report(fit: RangeFit, transform_known: str) -> dict[str, Any]:
    """Lay a fit out as JSON types; ``aligned``, ``averaged`` or ``nothing`` vouches for the rig transform."""
    rows = [_frequency(fit, i) for i in range(len(fit.terms))]
    far, covered = np.concatenate([v.true for v in fit.views]), fit.errors[0].fitted_m or (0.0, 0.0)
    return {
        "format": "tofcapture-range-calibration",
        "version": 1,
        "views": len(fit.views),
        "covered_m": list(covered),
        "transform": transform_known,
        "transform_moved": {
            "translation_mm": (1e3 * fit.moved[:3]).tolist(),
            "rotation_deg": np.degrees(fit.moved[3:]).tolist(),
        },
        "frequencies": rows,
        "verdict": worst([r["verdict"] for r in rows]),
        "refused": fit.refused,
        "look": _range_words(fit, far, transform_known),
    }


def _frequency(fit: RangeFit, i: int) -> dict[str, Any]:
    terms = fit.terms[i]
    left = 1e3 * _by_view_and_cell(fit, fit.left_out, i)
    found = zip(terms.names, fit.coefficients[i], fit.sigma[i], strict=True)
    return {
        "modulation_hz": terms.modulation_hz,
        "range_error": range_error_table(fit.errors[i]),
        "found": {name: {"value": float(x), "sigma": float(s)} for name, x, s in found},
        "before_mm": 1e3 * _by_view_and_cell(fit, fit.before, i),
        "after_mm": 1e3 * _by_view_and_cell(fit, fit.after, i),
        "left_out_mm": left,
        "views_differ_mm": 1e3 * float(fit.spread[i]),
        "by_range": _by_range(fit, i),
        "verdict": RANGE_LEFT.verdict(left),
    }


def _by_view_and_cell(fit: RangeFit, left: list[Float64], i: int) -> float:
    """RMS of medians over every view's part of each cell of the image, metres: noise is averaged away, nothing else."""
    place = image_places(fit.camera).reshape(-1, 2)
    medians = []
    for view, rest in zip(fit.views, left, strict=True):
        cell = np.minimum(((place[view.pixels] + 1) / 2 * CELLS).astype(int), CELLS - 1) @ [1, CELLS]
        medians += [float(np.median(rest[i][cell == c])) for c in np.unique(cell) if (cell == c).sum() > 30]
    return float(np.sqrt(np.mean(np.square(medians))))


def _by_range(fit: RangeFit, i: int) -> list[dict[str, float]]:
    far = np.concatenate([v.true for v in fit.views])
    before, after = (np.concatenate([r[i] for r in left]) for left in (fit.before, fit.left_out))
    own = np.floor(far / BIN).astype(np.intp)
    return [
        {
            "from_m": float(k * BIN),
            "pixels": int((own == k).sum()),
            "before_mm": 1e3 * float(np.median(before[own == k])),
            "left_out_mm": 1e3 * float(np.median(after[own == k])),
        }
        for k in np.unique(own)
        if (own == k).sum() > 100
    ]


def _range_words(fit: RangeFit, far: Float64, transform_known: str) -> list[str]:
    """Tell what the views could not tell."""
    out = [
        f"{terms.modulation_hz / 1e6:g} MHz: views of one range differ by {1e3 * spread:.1f} mm: the surroundings throw "
        "light back on the board, which lengthens ranges; its mean is in the offset. Cover table and walls with dark cloth, "
        "keep the board off them"
        for terms, spread in zip(fit.terms, fit.spread, strict=True)
        if spread > THROWN_BACK
    ]
    if transform_known == "nothing":
        out.append(
            "nobody vouches for the rig transform: the offset is known no better than the stereo camera's place along the optical axis. "
            "Run tofcapture align RECORDING --method joint first"
        )
    filled = np.unique(np.floor(far / BIN).astype(int))
    gaps = [k for k in range(filled.min(), filled.max()) if k not in filled]
    if gaps:
        out.append("no view covers " + ", ".join(f"{k * BIN:.1f} to {(k + 1) * BIN:.1f} m" for k in gaps))
    if "temperature" not in fit.terms[0].names:
        out.append(
            f"temperature varied by {warmed(fit.views):.1f} K between views, expected {MIN_KELVIN:g}: the maker's coefficient is kept. "
            "Record while the camera warms up to find it"
        )
    if "darkness" not in fit.terms[0].names:
        out.append(
            f"amplitude varied by a factor of {np.exp(greys(fit.views, 0)):.2f} at one range, expected {np.exp(MIN_GREY):.2f}: no term of "
            "dark surfaces. Put patches of different greys on the board to find it"
        )
    return out
