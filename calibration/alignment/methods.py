"""Make a rig of the accepted pairs: by the plain average, the information-weighted fusion, or the joint solution.

The last two say how sure they are: one sigma of every motion, which motions the views hold, and which tilt would help most next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from calibration.alignment.averages import about, fuse, twist_about
from calibration.alignment.joint import JointSolution, joint_icp
from calibration.alignment.rounds import Solution
from calibration.alignment.views import TERMS, JointView
from calibration.range_error.terms import Terms, jackknife
from calibration.registration.pairs import Pair
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, invert, rotation_angle, transform_points
from tofcapture.rig import RangeError, Rig, range_error_table

METHODS = ("averaged", "weighted", "joint", "targetless")
TRUTH_POINT = (0.0, 0.0, 0.8)  # m, ToF frame: the middle of the working volume, where errors are stated

MOTIONS = ("along x", "along y", "along z", "about x", "about y", "about z")
RADIUS = 0.2  # m, half a board: a rotation counts by how far it moves a board's edge
WEAK_SIGMA = 0.002  # m; a motion known no better than this is not held at all by a board's views
TILTS_DEG = (20.0, 30.0, 40.0)
TURNS = 12
POINTS = 200  # that a suggested view is judged by
POINT_SIGMA = 0.011  # m, as if independent: 2 mm times the root of the neighbours that share its bias


def method_named(name: str) -> str:
    """Check a method's name; :class:`ConfigError` names those there are."""
    if name not in METHODS:
        raise ConfigError(f"method: expected one of {', '.join(METHODS)}, got {name!r}")
    return name


def apply_method(
    method: str, pairs: Sequence[Pair], views: Sequence[JointView | None], solution: Solution, start: Rig
) -> tuple[Rig, dict[str, Any]]:
    """Turn gated registrations into a rig.

    ``views`` are what the joint method takes of the pairs. The rig is the start rig with the new ``T_tof_stereo``; the joint method
    adds its range errors. Beside it comes what ``evidence.json`` gains.
    """
    averaged, weighted = invert(solution.average.T), _weighted(solution, solution.used)
    found, rig = {"averaged": averaged, "weighted": weighted}, start
    extra: dict[str, Any] = {}
    if method == "weighted":
        extra = uncertainty_of(*_left_out(solution, weighted))
    if method == "joint":
        used = [view for i in solution.used if (view := views[i])]
        joint = joint_icp(used, averaged)
        found["joint"] = joint.T_tof_stereo
        hz = used[0].modulation_hz
        rig = replace(start, range_errors=composed(used[0].factory, hz, joint.range_coefficients))
        extra = joint_evidence(joint, hz)
    methods = {name: _stated(T, pairs[0].truth) for name, T in found.items()}
    rig = replace(rig, T_tof_stereo=found[method])
    return rig, {"method": method, "methods": methods, **extra}


def alignment_error(T_tof_stereo: Float64, true: Float64) -> tuple[float, float]:
    """Compare an alignment (4, 4) with the true one.

    The rotation is in radians, the translation in metres: how far a point 0.8 m in front of the ToF camera lands from where it
    should.
    """
    moved = T_tof_stereo @ invert(true)
    shift = transform_points(moved, np.array(TRUTH_POINT)) - TRUTH_POINT
    return rotation_angle(moved), float(np.linalg.norm(shift))


def composed(
    factory: Sequence[RangeError], modulation_hz: Sequence[float], coefficients: Float64
) -> tuple[RangeError, ...]:
    """Add fitted range errors to the factory's, one per frequency.

    The factory's may lack frequencies (F,). Of the coefficients (U,) of :meth:`JointView.terms`, shares of scattered light have no
    place in a :class:`RangeError` and are left out.
    """
    known = {e.modulation_hz: e for e in factory}
    own = coefficients[: len(modulation_hz) * TERMS].reshape(-1, TERMS)
    return tuple(
        Terms(hz).added(known.get(hz, RangeError(hz)), x) for hz, x in zip(modulation_hz, own, strict=True)
    )


def joint_evidence(joint: JointSolution, modulation_hz: Sequence[float]) -> dict[str, Any]:
    """State covariance, observability, suggestion and range errors (beyond the factory's) of a joint solution as JSON types."""
    # What is believed is the covariance; the model's own information knows nothing of bias.
    information = np.asarray(np.linalg.inv(joint.covariance), dtype=np.float64)
    values, _ = observability(information)
    return {
        "working_point_m": joint.centre.tolist(),
        **uncertainty_of(joint.influence, joint.covariance),
        "observability": {
            "eigenvalues": values.tolist(),
            "sigma_mm": _sigma_mm(values).tolist(),
            "unconstrained": unconstrained(information),
            "suggestion": suggest_view(information, joint.centre),
        },
        "range_errors": [range_error_table(e) for e in composed((), modulation_hz, joint.range_coefficients)],
    }


def observability(information: Float64) -> tuple[Float64, Float64]:
    """Take an information (6, 6) of the twist (rho, phi) about the working point, ToF axes, apart.

    The eigenvalues (6,) are ascending, 1/m^2, rotations measured as motion at ``RADIUS``. The rows of (6, 6) are their unit motions,
    (x, y, z, then rotations times ``RADIUS``).
    """
    scale = np.repeat([1.0, 1 / RADIUS], 3)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    return np.maximum(values, 0), vectors.T


def unconstrained(information: Float64) -> list[str]:
    """Name the motions that are not held, known to no better than 2 mm."""
    values, motions = observability(information)
    return [motion_name(v) for v in motions[values < 1 / WEAK_SIGMA**2]]


def motion_name(motion: Float64) -> str:
    """Name a unit motion (6,) by its largest parts, largest first."""
    order = np.argsort(-np.abs(motion))
    parts = [f"{MOTIONS[i]} ({abs(motion[i]):.2f})" for i in order if abs(motion[i]) > 0.35]
    return " with ".join(parts)


def plane_information(normal: Float64, centre: Float64, working_point: Float64) -> Float64:
    """Compute the information (6, 6) of a board without rims, seen at ``centre`` (3,) with ``normal`` (3,), ToF frame, metres."""
    a = np.cross(normal, [0.0, 1.0, 0.0])
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    side = np.linspace(-RADIUS, RADIUS, 9)
    points = centre + (side[:, None, None] * a + side[None, :, None] * b).reshape(-1, 3)
    J = np.concatenate([np.tile(normal, (len(points), 1)), np.cross(points - working_point, normal)], axis=1)
    out: Float64 = J.T @ J * POINTS / len(points) / POINT_SIGMA**2
    return out


def suggest_view(information: Float64, working_point: Float64) -> dict[str, Any]:
    """Name the tilt of the board that lowers the largest uncertainty most.

    Every candidate adds the information of a tilted plane at the working point. The best has the smallest largest eigenvalue of
    the covariance, and among equals the smallest trace.

    The answer holds ``tilt_deg``, ``towards_deg`` (direction in the image in which the board's normal leans, 0 right, 90 down),
    ``motion`` that is weakest now, ``sigma_mm`` of it before and ``expected_sigma_mm`` after.
    """

    def after(tilt_deg: float, towards_deg: float) -> Float64:
        t, d = np.radians(tilt_deg), np.radians(towards_deg)
        normal = np.array([np.sin(t) * np.cos(d), np.sin(t) * np.sin(d), -np.cos(t)])
        added = plane_information(normal, working_point, working_point)
        return np.maximum(observability(information + added)[0], 1e-6)

    def cost(tilt: tuple[float, float]) -> tuple[float, float]:
        values = after(*tilt)
        return round(float(1 / values[0]), 12), float((1 / values).sum())

    best = min(product(TILTS_DEG, (360.0 * k / TURNS for k in range(TURNS))), key=cost)
    values, motions = observability(information)
    return {
        "tilt_deg": best[0],
        "towards_deg": best[1],
        "motion": motion_name(motions[0]),
        "sigma_mm": float(_sigma_mm(values)[0]),
        "expected_sigma_mm": float(_sigma_mm(after(*best))[0]),
    }


def _sigma_mm(eigenvalues: Float64) -> Float64:
    return np.asarray(1e3 / np.sqrt(np.maximum(eigenvalues, 1e-12)))


def uncertainty_of(influence: Float64, covariance: Float64) -> dict[str, Any]:
    """Covariance (6, 6) about the working point and what it means, as JSON types; ``influence`` as of :func:`jackknife`."""
    sigma = np.sqrt(np.diag(covariance))
    moved = ", ".join(f"{1e3 * s:.2f} mm along {a}" for a, s in zip("xyz", sigma[:3], strict=True))
    turned = ", ".join(f"{np.degrees(s):.3f} deg about {a}" for a, s in zip("xyz", sigma[3:], strict=True))
    return {
        "covariance": covariance.tolist(),
        "spread": _lengths(np.square(influence).sum(axis=0) / (len(influence) - 1)),
        "standard_error": _lengths(np.square(sigma)),
        "sigma": {
            "translation_mm": (1e3 * sigma[:3]).tolist(),
            "rotation_deg": np.degrees(sigma[3:]).tolist(),
        },
        "in_words": (
            f"The stereo camera's place in the ToF camera's axes is believed to {moved}, and to {turned} (one sigma: two times "
            "in three the error is smaller), as seen at the working point."
        ),
    }


def _lengths(variances: Float64) -> dict[str, float]:
    moved, turned = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return {"rotation_deg": float(np.degrees(turned)), "translation_mm": float(1e3 * moved)}


def _left_out(solution: Solution, fused: Float64) -> tuple[Float64, Float64]:
    """Influence and covariance of the weighted fusion from leaving out each pair in turn."""
    used, back = solution.used, invert(fused)
    without = [_weighted(solution, [i for i in used if i != out]) for out in used]
    return jackknife(np.stack([twist_about(T @ back, solution.working_point) for T in without]))


def _weighted(solution: Solution, used: Sequence[int]) -> Float64:
    chosen = [solution.registrations[i] for i in used]
    # A registration's information is of a motion in target axes, on the left of the transform; that of its inverse is on the right.
    informations = [about(r.information, r.centre) for r in chosen]
    return fuse([invert(r.T_target_source) for r in chosen], informations)


def _stated(T_tof_stereo: Float64, true: Float64 | None) -> dict[str, Any]:
    out: dict[str, Any] = {"T_tof_stereo": T_tof_stereo.tolist()}
    if true is not None:
        rotation, translation = alignment_error(T_tof_stereo, true)
        out |= {"rotation_error_deg": float(np.degrees(rotation)), "translation_error_mm": 1e3 * translation}
    return out
