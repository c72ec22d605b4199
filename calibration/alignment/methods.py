"""What ``align`` makes of its accepted pairs: the plain average, the information-weighted fusion, or the joint solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.alignment.fusion import about, fuse, jackknife, twist_about
from calibration.alignment.joint_icp import JointSolution, joint_icp
from calibration.alignment.joint_views import JointView, joint_view_of
from calibration.alignment.observability import observability, suggest_view
from calibration.evidence.evidence import alignment_error
from calibration.range_error.error import ORDERS, TERMS, composed
from calibration.registration.pairs import Pair
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, invert
from tofcapture.rig import RangeError, Rig

if TYPE_CHECKING:
    from calibration.align import Solution

METHODS = ("averaged", "weighted", "joint")


@dataclass(frozen=True)
class Aligned:
    """Result of one method.

    Attributes
    ----------
    rig
        The start rig with the new ``T_tof_stereo``; the joint method adds its range errors.
    evidence
        What ``evidence.json`` gains.
    """

    rig: Rig
    evidence: dict[str, Any]


def method_named(name: str) -> str:
    """Check a method's name.

    Raises
    ------
    ConfigError
        Unknown name.
    """
    if name not in METHODS:
        raise ConfigError(f"method: expected one of {', '.join(METHODS)}, got {name!r}")
    return name


def apply_method(
    method: str, recording: Path, pairs: Sequence[Pair], solution: Solution, start: Rig
) -> Aligned:
    """Turn gated registrations into a rig.

    Parameters
    ----------
    method
        One of ``METHODS``.
    recording
        Folder of the views; the joint method reads those that were accepted again.
    pairs, solution
        What was registered, and the averaged solution.
    start
        Rig that the result keeps everything else of.
    """
    averaged = invert(solution.average.T)
    weighted = _weighted(solution)
    found = {"averaged": averaged, "weighted": weighted}
    extra: dict[str, Any] = {}
    rig = start
    if method == "weighted":
        influence, covariance = _left_out(solution, weighted)
        extra = {"covariance": covariance.tolist(), **stated_uncertainty(influence, covariance)}
    if method == "joint":
        views = [_read(recording, pairs[i]) for i in solution.used]
        joint = joint_icp(views, averaged)
        found["joint"] = joint.T_tof_stereo
        hz = views[0].modulation_hz
        errors = composed(views[0].factory, hz, joint.range_coefficients)
        rig = replace(start, range_errors=errors)
        extra = joint_evidence(joint, hz, errors)
    true = pairs[0].truth
    return Aligned(
        replace(rig, T_tof_stereo=found[method]),
        {"method": method, "methods": {k: _stated(T, true) for k, T in found.items()}, **extra},
    )


def joint_evidence(
    joint: JointSolution, modulation_hz: Sequence[float], errors: Sequence[RangeError]
) -> dict[str, Any]:
    """Covariance, observability, suggestion and range errors of a joint solution as JSON types."""
    # What is believed is the covariance; the model's own information knows nothing of bias.
    information = np.asarray(np.linalg.inv(joint.covariance), dtype=np.float64)
    seen = observability(information)
    own = joint.range_coefficients
    return {
        "working_point_m": joint.centre.tolist(),
        "covariance": joint.covariance.tolist(),
        **stated_uncertainty(joint.influence, joint.covariance),
        "observability": {
            "eigenvalues": seen.eigenvalues.tolist(),
            "sigma_mm": seen.sigma_mm.tolist(),
            "unconstrained": list(seen.unconstrained),
            "suggestion": suggest_view(information, joint.centre),
        },
        "range_errors": [
            {
                "modulation_hz": hz,
                "offset": float(own[i * TERMS]),
                "per_pixel_radius": float(own[i * TERMS + 1]),
                "harmonics": [
                    [m, *own[i * TERMS + 2 + 2 * k : i * TERMS + 4 + 2 * k].tolist()]
                    for k, m in enumerate(ORDERS)
                ],
                "with_factory_offset": errors[i].offset,
            }
            for i, hz in enumerate(modulation_hz)
        ],
    }


def stated_uncertainty(influence: Float64, covariance: Float64) -> dict[str, Any]:
    """What a method's own covariance says, as JSON types.

    Parameters
    ----------
    influence
        (N, 6) of :func:`calibration.alignment.fusion.jackknife`.
    covariance
        (6, 6) of the twist about the working point, ToF axes.

    Returns
    -------
    dict
        ``spread`` of single views, ``standard_error``, ``sigma`` of each component, and the same ``in_words``.
    """
    sigma = np.sqrt(np.diag(covariance))
    return {
        "spread": _lengths(np.square(influence).sum(axis=0) / (len(influence) - 1)),
        "standard_error": _lengths(np.square(sigma)),
        "sigma": {
            "translation_mm": (1e3 * sigma[:3]).tolist(),
            "rotation_deg": np.degrees(sigma[3:]).tolist(),
        },
        "in_words": _in_words(sigma),
    }


def _lengths(variances: Float64) -> dict[str, float]:
    moved, turned = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return {"rotation_deg": float(np.degrees(turned)), "translation_mm": float(1e3 * moved)}


def _in_words(sigma: Float64) -> str:
    moved = ", ".join(f"{1e3 * s:.2f} mm along {a}" for a, s in zip("xyz", sigma[:3], strict=True))
    turned = ", ".join(f"{np.degrees(s):.3f} deg about {a}" for a, s in zip("xyz", sigma[3:], strict=True))
    return (
        f"The stereo camera's place in the ToF camera's axes is believed to {moved}, and to {turned} (one sigma: two times in "
        "three the error is smaller), as seen at the working point."
    )


def _left_out(solution: Solution, fused: Float64) -> tuple[Float64, Float64]:
    """Influence and covariance of the weighted fusion from leaving out each pair in turn."""
    used = solution.used
    back = invert(fused)
    twists = [
        twist_about(_weighted(solution, [i for i in used if i != out]) @ back, solution.working_point)
        for out in used
    ]
    return jackknife(np.stack(twists))


def _weighted(solution: Solution, used: Sequence[int] | None = None) -> Float64:
    chosen = [solution.registrations[i] for i in (solution.used if used is None else used)]
    informations = [about(r.information, r.centre) for r in chosen]
    return fuse([invert(r.T_target_source) for r in chosen], informations).T


def _read(recording: Path, pair: Pair) -> JointView:
    from tofcapture.files.view import read_view

    return joint_view_of(read_view(recording / pair.name), pair.name)


def _stated(T_tof_stereo: Float64, true: Float64 | None) -> dict[str, Any]:
    out: dict[str, Any] = {"T_tof_stereo": T_tof_stereo.tolist()}
    if true is not None:
        rotation, translation = alignment_error(T_tof_stereo, true)
        out |= {"rotation_error_deg": float(np.degrees(rotation)), "translation_error_mm": 1e3 * translation}
    return out
