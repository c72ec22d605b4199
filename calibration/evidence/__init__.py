"""Define what an alignment rests on, as JSON: residuals of every pair, the spread, every number judged, and the error where the truth is known.

It also says how far an alignment has moved since an older one, and whether that is more than both could be wrong.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from calibration.alignment.methods import alignment_error, uncertainty_of
from calibration.alignment.rounds import Solution
from calibration.alignment.targetless import TargetlessSolution
from calibration.limits import LIMITS, SIGNIFICANT, Judged, judged, worst
from calibration.registration.pairs import Pair
from tofcapture.errors import DataError
from tofcapture.files.seal import write_text
from tofcapture.poses import Float64, check_transform, invert, rotation_angle, rotation_log, transform_points
from tofcapture.rig import load_rig, range_error_table

FORMAT = "tofcapture-evidence"
ASIDE = 0.1  # m from the working point at which the least certain motion is stated


def evidence_of(
    pairs: Sequence[Pair],
    solution: Solution,
    backend: str,
    initial: Float64,
    T_tof_stereo: Float64,
    found: Mapping[str, Any],
) -> dict[str, Any]:
    """Assemble ``evidence.json``.

    All are JSON types; lengths in metres but where a name ends in ``_mm``, angles in degrees. ``initial`` and ``T_tof_stereo``
    (4, 4) are the start and the result. What the method has ``found`` of itself, as its standard error, replaces the average's.
    """
    rows = [_pair(i, pair, solution) for i, pair in enumerate(pairs)]
    true = pairs[0].truth
    evidence = {
        "format": FORMAT,
        "version": 1,
        "backend": backend,
        "views": len(pairs),
        "used": len(solution.used),
        "T_tof_stereo": T_tof_stereo.tolist(),
        "initial_T_tof_stereo": initial.tolist(),
        "spread": _degrees_mm(*solution.average.spread),
        "standard_error": _degrees_mm(*solution.average.standard_error),
        "working_point_m": solution.working_point.tolist(),
        "range_residual": range_error_table(solution.residual),
        "pairs": rows,
        "truth": None if true is None else _degrees_mm(*alignment_error(T_tof_stereo, true), "_error"),
        "provenance": {
            "versions": _versions(backend),
            "inputs": {pair.name: pair.sha256 for pair in pairs},
        },
        **found,
    }
    return _with_verdict(evidence)


def evidence_of_scenes(
    inputs: Mapping[str, str], solution: TargetlessSolution, initial: Float64, true: Float64 | None
) -> dict[str, Any]:
    """Assemble the same of scenes without a board; ``inputs`` are the digests of the view files by name."""
    rows = [
        {
            "view": name,
            "accepted": bool(count),
            "reason": "" if count else solution.alone.get(k, "no silhouette beside which others see nothing"),
            "rmse_mm": _finite(1e3 * off),
            "inliers": int(count),
            "fitness": None,
            "condition": None,
            "rotation_from_mean_deg": None,
            "translation_from_mean_mm": None,
        }
        for k, (name, count, off) in enumerate(zip(inputs, solution.used, solution.off, strict=True))
    ]
    T = solution.T_tof_stereo
    return _with_verdict(
        {
            "format": FORMAT,
            "version": 1,
            "backend": "silhouettes",
            "method": "targetless",
            "views": len(rows),
            "used": int((solution.used > 0).sum()),
            "T_tof_stereo": T.tolist(),
            "initial_T_tof_stereo": initial.tolist(),
            "working_point_m": solution.centre.tolist(),
            **uncertainty_of(solution.influence, solution.covariance),
            "pairs": rows,
            "truth": None if true is None else _degrees_mm(*alignment_error(T, true), "_error"),
            "provenance": {"versions": _versions(), "inputs": dict(inputs)},
        }
    )


def _with_verdict(evidence: dict[str, Any]) -> dict[str, Any]:
    checks = judged_evidence(evidence)
    return {
        **evidence,
        "verdict": worst([c.verdict for c in checks]),
        "checks": [asdict(c) for c in checks],
    }


def judged_evidence(evidence: Mapping[str, Any]) -> list[Judged]:
    """Judge the views, their spread, the certainty, the start, and the error where the truth is known."""
    used = [p for p in evidence["pairs"] if p["accepted"]]
    out = [
        judged("used", evidence["used"]),
        judged("rmse", median([p["rmse_mm"] for p in used]) if used else None),
    ]
    if evidence.get("method") != "targetless":
        out.append(judged("condition", max((p["condition"] for p in used), default=None)))
    out += _both("spread", evidence["spread"]) + _both("error", evidence["standard_error"])
    if (C := covariance_of(evidence)) is not None:
        scale = np.repeat([1.0, ASIDE], 3)
        sigma = np.sqrt(np.linalg.eigvalsh(C * np.outer(scale, scale))[-1])
        out.append(judged("uncertain_motion", 1e3 * float(sigma)))
    moved = np.asarray(evidence["initial_T_tof_stereo"]) @ invert(np.asarray(evidence["T_tof_stereo"]))
    point = np.asarray(evidence["working_point_m"], dtype=np.float64)
    shift = float(np.linalg.norm(transform_points(moved, point) - point))
    out += _both("initial", _degrees_mm(rotation_angle(moved), shift))
    if truth := evidence["truth"]:
        out += _both("truth", truth, "_error")
    return out


def covariance_of(evidence: Mapping[str, Any]) -> Float64 | None:
    """Return the (6, 6) covariance that an evidence states, of (rho, phi) at the working point, m^2 and rad^2; None: it states none."""
    given = evidence.get("covariance")
    return None if given is None else np.asarray(given, dtype=np.float64)


def read_evidence(recording: Path) -> dict[str, Any]:
    """Read ``evidence.json`` of a recording; :class:`DataError` where it is missing, not JSON, or something else."""
    path = Path(recording) / "evidence.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise DataError(
            f"{path}: cannot read the evidence: {err}", hint=f"tofcapture align {recording}"
        ) from err
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise DataError(f"{path}: expected format {FORMAT}", hint=f"tofcapture align {recording}")
    return found


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a result; numbers keep every bit."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def _degrees_mm(rotation: float, translation: float, suffix: str = "") -> dict[str, float]:
    return {
        f"rotation{suffix}_deg": float(np.degrees(rotation)),
        f"translation{suffix}_mm": 1e3 * float(translation),
    }


def _both(key: str, found: Mapping[str, float], suffix: str = "") -> list[Judged]:
    return [
        judged(f"{key}_rotation", found[f"rotation{suffix}_deg"]),
        judged(f"{key}_translation", found[f"translation{suffix}_mm"]),
    ]


def _pair(i: int, pair: Pair, solution: Solution) -> dict[str, Any]:
    result, refusal, average = solution.registrations[i], solution.refusals[i], solution.average
    accepted = i in solution.used
    out = {
        "view": pair.name,
        "accepted": accepted,
        "reason": str(refusal) if refusal else ("" if accepted else "outlier"),
        "rmse_mm": _finite(1e3 * result.rmse),
        "inliers": result.inliers,
        "fitness": result.fitness,
        "condition": _finite(result.condition),
        "rotation_from_mean_deg": None,
        "translation_from_mean_mm": None,
    }
    if i in solution.passed:
        k = solution.passed.index(i)
        out["rotation_from_mean_deg"] = float(np.degrees(average.rotation_from_mean[k]))
        out["translation_from_mean_mm"] = 1e3 * float(average.translation_from_mean[k])
    return out


def _versions(backend: str = "") -> dict[str, str]:
    out = {}
    for name in (
        "tofcapture",
        "numpy",
        "scipy",
        *(("open3d-cpu", "open3d") if backend == "open3d" else (backend,) if backend else ()),
    ):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            continue
    return out


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


@dataclass(frozen=True)
class Drift:
    """New alignment against old."""

    #: Radians; metres at the working point
    rotation: float
    translation: float
    #: (6,) (rho, phi): displacement of the working point and rotation vector, ToF frame, new against
    #: old
    twist: Float64
    #: Square root of the Mahalanobis distance squared over its six degrees of freedom: about 1 where
    #: nothing moved
    sigmas: float
    probability: float  #: Of a drift as large by chance (chi-square, 6 degrees of freedom)
    basis: str  #: What the uncertainty was taken from

    @property
    def significant(self) -> bool:
        """Whether chance hardly gives as much."""
        return self.probability < SIGNIFICANT

    @property
    def verdict(self) -> str:
        """PASS where the drift is small or may be chance; else that of its size."""
        turned = LIMITS["drift_rotation"].verdict(float(np.degrees(self.rotation)))
        moved = LIMITS["drift_translation"].verdict(1e3 * self.translation)
        return worst([turned, moved]) if self.significant else "PASS"


@dataclass(frozen=True)
class OldRig:
    """An older alignment."""

    name: str  #: What it is called, usually a path
    T_tof_stereo: Float64  #: (4, 4)
    #: Of that alignment; without it the old is taken to be as uncertain as the new
    evidence: Mapping[str, Any] | None = None


def load_old(path: Path) -> OldRig:
    """Read an older ``rig.toml``, and the ``evidence.json`` beside it where that is of this rig.

    :class:`ConfigError` where the file is no rig.
    """
    T = load_rig(path).T_tof_stereo
    try:
        found: dict[str, Any] = json.loads((path.parent / "evidence.json").read_text(encoding="utf-8"))
        same = np.allclose(found["T_tof_stereo"], T, atol=1e-9)
    except (OSError, ValueError, KeyError, TypeError):
        same = False
    return OldRig(str(path), T, found if same else None)


def drift(evidence: Mapping[str, Any], old: OldRig) -> Drift:
    """Compare the evidence of an alignment with an older one."""
    from scipy.stats import chi2

    new = check_transform(evidence["T_tof_stereo"], "evidence: T_tof_stereo")
    point = np.asarray(evidence["working_point_m"], dtype=np.float64)
    before = transform_points(old.T_tof_stereo @ invert(new), point)
    phi = rotation_log((new @ invert(old.T_tof_stereo))[:3, :3])
    xi = np.concatenate([point - before, phi])
    C, basis = uncertainty(evidence)
    C_old, old_basis = C, "the old alignment taken as equally uncertain"
    if old.evidence is not None:
        C_old, words = uncertainty(old.evidence)
        old_basis = f"old: {words}"
    squared = float(xi @ np.linalg.pinv(C + C_old) @ xi)
    return Drift(
        float(np.linalg.norm(phi)),
        float(np.linalg.norm(xi[:3])),
        xi,
        float(np.sqrt(squared / 6)),
        float(chi2.sf(squared, 6)),
        f"new: {basis}; {old_basis}",
    )


def uncertainty(evidence: Mapping[str, Any]) -> tuple[Float64, str]:
    """Return the covariance (6, 6) of (rho, phi) at the working point, m^2 and rad^2, and what it rests on.

    Where the evidence states none, the standard errors are spread evenly over three axes each.
    """
    if (C := covariance_of(evidence)) is not None:
        return C, "its covariance"
    error = evidence["standard_error"]
    rho, phi = 1e-3 * error["translation_mm"], np.radians(error["rotation_deg"])
    return np.diag(np.repeat([rho**2 / 3, phi**2 / 3], 3)), "its standard errors, even over the axes"


def drift_table(moved: Drift) -> dict[str, Any]:
    """Return a drift as JSON types: degrees, millimetres."""
    return {
        "rotation_deg": float(np.degrees(moved.rotation)),
        "translation_mm": 1e3 * moved.translation,
        "sigmas": moved.sigmas,
        "probability": moved.probability,
        "significant": moved.significant,
        "verdict": moved.verdict,
        "basis": moved.basis,
    }


def drift_text(moved: Drift) -> str:
    """Return a drift as one line."""
    size = f"{np.degrees(moved.rotation):.3f} deg  {1e3 * moved.translation:.2f} mm"
    word = "significant" if moved.significant else "not significant"
    return f"{'since the old':16}{size}, {moved.sigmas:.1f} sigma: {word}, {moved.verdict}"
