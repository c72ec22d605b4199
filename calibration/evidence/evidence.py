"""What an alignment rests on, as JSON: residuals of every pair, the spread, and the error where the truth is known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.alignment.range_residual import ORDERS
from calibration.registration.pairs import Pair
from tofcapture.files.seal import write_text
from tofcapture.poses import Float64, invert, rotation_angle, transform_points

if TYPE_CHECKING:
    from calibration.align import Solution

TRUTH_POINT = (0.0, 0.0, 0.8)  # m, ToF frame: the middle of the working volume, where errors are stated


def evidence_of(
    pairs: Sequence[Pair], solution: Solution, backend: str, initial: Float64, T_tof_stereo: Float64
) -> dict[str, Any]:
    """Assemble ``evidence.json``.

    Parameters
    ----------
    pairs, solution
        What was aligned, and the result.
    backend
        Name of the registration backend.
    initial
        (4, 4) ``T_tof_stereo`` at the start.
    T_tof_stereo
        (4, 4) the result.

    Returns
    -------
    dict
        JSON types only; lengths in metres but where a name ends in ``_mm``, angles in degrees. Spread and standard error are the
        average's; methods with a covariance of their own put theirs in their place.
    """
    return {
        "format": "tofcapture-evidence",
        "version": 1,
        "backend": backend,
        "views": len(pairs),
        "used": len(solution.used),
        "T_tof_stereo": T_tof_stereo.tolist(),
        "initial_T_tof_stereo": initial.tolist(),
        "spread": _degrees_mm(*solution.average.spread),
        "standard_error": _degrees_mm(*solution.average.standard_error),
        "working_point_m": solution.working_point.tolist(),
        "range_residual": _range_residual(solution),
        "pairs": _pairs(pairs, solution),
        "truth": _truth(pairs, T_tof_stereo),
        "provenance": _provenance(pairs, backend),
    }


def alignment_error(T_tof_stereo: Float64, true: Float64) -> tuple[float, float]:
    """Error of an alignment.

    Parameters
    ----------
    T_tof_stereo, true
        (4, 4), estimated and true.

    Returns
    -------
    rotation
        Radians.
    translation
        Metres, how far a point 0.8 m in front of the ToF camera lands from where it should.
    """
    point = np.array(TRUTH_POINT)
    moved = transform_points(T_tof_stereo @ invert(true), point) - point
    return rotation_angle(T_tof_stereo @ invert(true)), float(np.linalg.norm(moved))


def write_evidence(path: Path, evidence: dict[str, Any]) -> None:
    """Write ``evidence.json``; numbers keep every bit."""
    write_text(path, json.dumps(evidence, indent=1, allow_nan=False) + "\n")


def _degrees_mm(rotation: float, translation: float) -> dict[str, float]:
    return {"rotation_deg": float(np.degrees(rotation)), "translation_mm": 1e3 * translation}


def _range_residual(solution: Solution) -> dict[str, Any]:
    offset, per_pixel_radius, *waves = solution.residual.coefficients.tolist()
    return {
        "modulation_hz": solution.residual.modulation_hz,
        "offset": offset,
        "per_pixel_radius": per_pixel_radius,
        "harmonics": [[m, *waves[2 * i : 2 * i + 2]] for i, m in enumerate(ORDERS)],
    }


def _pairs(pairs: Sequence[Pair], solution: Solution) -> list[dict[str, Any]]:
    place = {i: k for k, i in enumerate(solution.passed)}
    rows = []
    for i, (pair, result, refusal) in enumerate(
        zip(pairs, solution.registrations, solution.refusals, strict=True)
    ):
        k = place.get(i)
        accepted = k is not None and bool(solution.average.kept[k])
        rows.append(
            {
                "view": pair.name,
                "accepted": accepted,
                "reason": str(refusal) if refusal else ("" if accepted else "outlier"),
                "rmse_mm": _finite(1e3 * result.rmse),
                "inliers": result.inliers,
                "fitness": result.fitness,
                "condition": _finite(result.condition),
                "rotation_from_mean_deg": None
                if k is None
                else float(np.degrees(solution.average.rotation_from_mean[k])),
                "translation_from_mean_mm": None
                if k is None
                else 1e3 * float(solution.average.translation_from_mean[k]),
            }
        )
    return rows


def _truth(pairs: Sequence[Pair], T_tof_stereo: Float64) -> dict[str, float] | None:
    true = pairs[0].truth
    if true is None:
        return None
    rotation, translation = alignment_error(T_tof_stereo, true)
    return {"rotation_error_deg": float(np.degrees(rotation)), "translation_error_mm": 1e3 * translation}


def _provenance(pairs: Sequence[Pair], backend: str) -> dict[str, Any]:
    libraries = (
        "tofcapture",
        "numpy",
        "scipy",
        *(("open3d-cpu", "open3d") if backend == "open3d" else (backend,)),
    )
    return {
        "versions": {name: found for name in libraries if (found := _version(name)) is not None},
        "inputs": {pair.name: pair.sha256 for pair in pairs},
    }


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
