"""Say how far an alignment has moved since an older one, and whether that is more than both could be wrong."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.evidence import covariance_of
from calibration.limits import LIMITS, SIGNIFICANT, worst
from tofcapture.poses import Float64, check_transform, invert, rotation_log, transform_points
from tofcapture.rig import load_rig


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
