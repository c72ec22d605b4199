"""What a range calibration says of itself: numbers as JSON types, a table, and words about what the views could not tell."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.limits import Limit
from calibration.range_error.fit import RangeFit
from calibration.range_error.terms import MIN_GREY, MIN_KELVIN, greys, warmed
from tofcapture.poses import Float64
from tofcapture.rig import image_places, range_error_table

BIN = 0.1  # m
CELLS = 3  # the image is judged in so many columns and rows
THROWN_BACK = 0.0015  # m of spread between views from which light from the surroundings is named
LEFT = Limit(
    "error left at views that were not fitted, RMS by view and part of the image",
    1.0,
    2.5,
    "mm",
    "light thrown back by the surroundings, too few views, or a sensor that was still warming up",
)


def report(fit: RangeFit, transform_known: str) -> dict[str, Any]:
    """Lay a fit out as JSON types.

    Parameters
    ----------
    fit
        The fit.
    transform_known
        What vouches for the rig transform: ``aligned``, ``averaged`` or ``nothing``.
    """
    rows = [_frequency(fit, i) for i in range(len(fit.terms))]
    far = np.concatenate([v.true for v in fit.views])
    return {
        "format": "tofcapture-range-calibration",
        "version": 1,
        "views": len(fit.views),
        "covered_m": [float(np.quantile(far, 0.001)), float(np.quantile(far, 0.999))],
        "transform": transform_known,
        "transform_moved": {
            "translation_mm": (1e3 * fit.moved[:3]).tolist(),
            "rotation_deg": np.degrees(fit.moved[3:]).tolist(),
        },
        "frequencies": rows,
        "verdict": _worst([r["verdict"] for r in rows]),
        "refused": fit.refused,
        "look": _words(fit, far, transform_known),
    }


def _worst(verdicts: list[str]) -> str:
    return next(v for v in ("FAIL", "WARN", "PASS") if v in verdicts)


def _frequency(fit: RangeFit, i: int) -> dict[str, Any]:
    terms = fit.terms[i]
    left = 1e3 * _by_view_and_cell(fit, fit.left_out, i)
    return {
        "modulation_hz": terms.modulation_hz,
        "range_error": range_error_table(fit.errors[i]),
        "found": {
            name: {"value": float(x), "sigma": float(s)}
            for name, x, s in zip(terms.names, fit.coefficients[i], fit.sigma[i], strict=True)
        },
        "before_mm": 1e3 * _by_view_and_cell(fit, fit.before, i),
        "after_mm": 1e3 * _by_view_and_cell(fit, fit.after, i),
        "left_out_mm": left,
        "views_differ_mm": 1e3 * float(fit.spread[i]),
        "by_range": _by_range(fit, i),
        "verdict": LEFT.verdict(left),
    }


def _by_view_and_cell(fit: RangeFit, left: list[Float64], i: int) -> float:
    """RMS of medians over every view's part of each cell of the image, metres: noise is averaged away, nothing else."""
    place = image_places(fit.terms[0].camera).reshape(-1, 2)
    medians = []
    for view, rest in zip(fit.views, left, strict=True):
        cell = np.minimum(((place[view.pixels] + 1) / 2 * CELLS).astype(int), CELLS - 1) @ [1, CELLS]
        medians += [float(np.median(rest[i][cell == c])) for c in np.unique(cell) if (cell == c).sum() > 30]
    return float(np.sqrt(np.mean(np.square(medians))))


def _by_range(fit: RangeFit, i: int) -> list[dict[str, float]]:
    far = np.concatenate([v.true for v in fit.views])
    before, after = (np.concatenate([r[i] for r in left]) for left in (fit.before, fit.left_out))
    own: NDArray[np.intp] = np.floor(far / BIN).astype(np.intp)
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


def _words(fit: RangeFit, far: Float64, transform_known: str) -> list[str]:
    out = []
    for i, terms in enumerate(fit.terms):
        if fit.spread[i] > THROWN_BACK:
            out.append(
                f"{terms.modulation_hz / 1e6:g} MHz: views of one range differ by {1e3 * fit.spread[i]:.1f} mm: the surroundings throw "
                "light back on the board, which lengthens ranges; its mean is in the offset. Cover table and walls with dark cloth, "
                "keep the board off them"
            )
    if transform_known == "nothing":
        out.append(
            "nobody vouches for the rig transform: the offset is known no better than the stereo camera's place along the optical axis. "
            "Run tofcapture align RECORDING --method joint first"
        )
    filled = np.unique(np.floor(far / BIN).astype(int))
    gaps = [k for k in range(filled.min(), filled.max()) if k not in filled]
    if gaps:
        out.append("no view covers " + ", ".join(f"{k * BIN:.1f} to {(k + 1) * BIN:.1f} m" for k in gaps))
    if not fit.terms[0].warmth:
        out.append(
            f"temperature varied by {warmed(fit.views):.1f} K between views, expected {MIN_KELVIN:g}: the maker's coefficient is kept. "
            "Record while the camera warms up to find it"
        )
    if not fit.terms[0].darkness:
        out.append(
            f"amplitude varied by a factor of {np.exp(greys(fit.views, 0)):.2f} at one range, expected {np.exp(MIN_GREY):.2f}: no term of "
            "dark surfaces. Put patches of different greys on the board to find it"
        )
    return out


def table(data: dict[str, Any]) -> str:
    """Lay a report out for a person."""
    near, far = data["covered_m"]
    lines = [f"{data['views']} views, ranges from {near:.2f} to {far:.2f} m"]
    for row in data["frequencies"]:
        lines.append(
            f"{row['modulation_hz'] / 1e6:g} MHz: {row['before_mm']:.2f} mm before, {row['after_mm']:.2f} after, "
            f"{row['left_out_mm']:.2f} at views that were not fitted; views differ by {row['views_differ_mm']:.2f} mm  {row['verdict']}"
        )
        lines.append("  from m   before mm   left mm")
        lines += [
            f"  {b['from_m']:6.1f}{b['before_mm']:12.2f}{b['left_out_mm']:10.2f}" for b in row["by_range"]
        ]
    moved = ", ".join(f"{t:.2f}" for t in data["transform_moved"]["translation_mm"])
    turned = ", ".join(f"{r:.3f}" for r in data["transform_moved"]["rotation_deg"])
    lines += [f"refused: {text}" for text in data["refused"]]
    lines.append(f"rig transform moved by {moved} mm and {turned} deg")
    return "\n".join([*lines, *(f"look: {text}" for text in data["look"]), f"verdict: {data['verdict']}"])
