"""How far an alignment has moved since an older one, and whether that is more than both could be wrong."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.evidence.limits import LIMITS, SIGNIFICANT
from tofcapture.errors import DataError
from tofcapture.poses import Float64, check_transform, invert, rotation_log, transform_points
from tofcapture.rig import load_rig


@dataclass(frozen=True)
class Drift:
    """New alignment against old.

    Attributes
    ----------
    rotation, translation
        Radians; metres at the working point.
    twist
        (6,) (rho, phi): displacement of the working point and rotation vector, ToF frame, new against old.
    sigmas
        Square root of the Mahalanobis distance squared over its six degrees of freedom: about 1 where nothing moved.
    probability
        Of a drift as large by chance (chi-square, 6 degrees of freedom).
    basis
        What the uncertainty was taken from.
    """

    rotation: float
    translation: float
    twist: Float64
    sigmas: float
    probability: float
    basis: str

    @property
    def verdict(self) -> str:
        """PASS where the drift is small or may be chance; else that of its size."""
        found = {
            LIMITS["drift_rotation"].verdict(float(np.degrees(self.rotation))),
            LIMITS["drift_translation"].verdict(1e3 * self.translation),
        }
        size = next(v for v in ("FAIL", "WARN", "PASS") if v in found)
        return size if self.probability < SIGNIFICANT else "PASS"


@dataclass(frozen=True)
class OldRig:
    """An older alignment.

    Attributes
    ----------
    name
        What it is called, usually a path.
    T_tof_stereo
        (4, 4).
    evidence
        Of that alignment; without it the old is taken to be as uncertain as the new.
    """

    name: str
    T_tof_stereo: Float64
    evidence: Mapping[str, Any] | None = None


def load_old(path: Path) -> OldRig:
    """Read an older ``rig.toml`` and, where one lies beside it and belongs to it, its ``evidence.json``.

    Raises
    ------
    ConfigError
        The file is no rig.
    """
    T = load_rig(path).T_tof_stereo
    try:
        found: dict[str, Any] = json.loads((path.parent / "evidence.json").read_text(encoding="utf-8"))
        same = np.allclose(found["T_tof_stereo"], T, atol=1e-9)
    except (OSError, ValueError, KeyError, TypeError):
        same = False
    return OldRig(str(path), T, found if same else None)


def drift(evidence: Mapping[str, Any], old: OldRig) -> Drift:
    """Compare an alignment with an older one.

    Parameters
    ----------
    evidence
        Of the new alignment.
    old
        The older one.

    Raises
    ------
    DataError
        The evidence holds no uncertainty.
    """
    new = check_transform(evidence["T_tof_stereo"], "evidence: T_tof_stereo")
    point = np.asarray(evidence.get("working_point_m", (0.0, 0.0, 0.8)), dtype=np.float64)
    moved = new @ invert(old.T_tof_stereo)
    before = transform_points(old.T_tof_stereo @ invert(new), point)
    phi = rotation_log(moved[:3, :3])
    xi = np.concatenate([point - before, phi])
    C, basis = uncertainty(evidence)
    if old.evidence is None:
        C_old, old_basis = C, "the old alignment taken as equally uncertain"
    else:
        C_old, words = uncertainty(old.evidence)
        old_basis = f"old: {words}"
    squared = float(xi @ np.linalg.pinv(C + C_old) @ xi)
    from scipy.stats import chi2

    return Drift(
        float(np.linalg.norm(phi)),
        float(np.linalg.norm(xi[:3])),
        xi,
        float(np.sqrt(squared / 6)),
        float(chi2.sf(squared, 6)),
        f"new: {basis}; {old_basis}",
    )


def drift_table(moved: Drift) -> dict[str, Any]:
    """Return a drift as JSON types: degrees, millimetres."""
    return {
        "rotation_deg": float(np.degrees(moved.rotation)),
        "translation_mm": 1e3 * moved.translation,
        "sigmas": moved.sigmas,
        "probability": moved.probability,
        "significant": moved.probability < SIGNIFICANT,
        "verdict": moved.verdict,
        "basis": moved.basis,
    }


def drift_text(moved: Drift) -> str:
    """Return a drift as one line."""
    found = drift_table(moved)
    return (
        f"{'since the old':16}{found['rotation_deg']:.3f} deg  {found['translation_mm']:.2f} mm, "
        f"{found['sigmas']:.1f} sigma: {'significant' if found['significant'] else 'not significant'}, {found['verdict']}"
    )


def uncertainty(evidence: Mapping[str, Any]) -> tuple[Float64, str]:
    """Covariance (6, 6) of (rho, phi) at the working point, m^2 and rad^2, and what it rests on.

    Without a covariance the standard errors are spread evenly over three axes each.

    Raises
    ------
    DataError
        Neither is there.
    """
    given = covariance_of(evidence)
    if given is not None:
        return given, "its covariance"
    error = evidence.get("standard_error")
    if not error:
        raise DataError(
            "evidence: expected a covariance or a standard error", hint="run tofcapture align again"
        )
    rho, phi = 1e-3 * error["translation_mm"], np.radians(error["rotation_deg"])
    return np.diag(np.repeat([rho**2 / 3, phi**2 / 3], 3)), "its standard errors, even over the axes"


def covariance_of(evidence: Mapping[str, Any]) -> Float64 | None:
    """Return the (6, 6) covariance of an evidence, in whichever of its forms, or None."""
    given = evidence.get("covariance")
    if isinstance(given, Mapping):
        given = next((v for v in given.values() if isinstance(v, list) and len(v) == 6), None)
    try:
        C = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return C if C.shape == (6, 6) and np.isfinite(C).all() and (np.diag(C) > 0).all() else None
