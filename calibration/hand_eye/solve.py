"""Hand-eye calibration: where a camera sits on the hand, or beside the arm, and how well that is known.

``A_i`` is the hand in the base (T_base_flange), ``B_i`` the target in the camera (T_camera_target). Camera in the hand:
``A_i X B_i = Z`` with X = T_flange_camera and Z = T_base_target. Camera beside the arm: ``A_i^-1 X B_i = Z`` with
X = T_base_camera and Z = T_flange_target. A closed form starts it, :mod:`calibration.hand_eye.refine` ends it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.hand_eye.checks import check_motion, check_numbers, check_pairing, clean
from calibration.hand_eye.closed_form import consensus, distances, park_martin
from calibration.hand_eye.diagnosis import check_agreement, oriented, target_scale
from calibration.hand_eye.refine import refine
from tofcapture.poses import Float64

OUTLIER = 6.0  # sigma (6-D): 1 of 200,000 Gaussian pairs lies farther out
FEW = 10  # pairs below which a result is called doubtful
LOOSE = (0.005, np.radians(0.5))  # m, rad: standard deviations beyond which a result is called doubtful
SCALE_OFF = 0.005  # relative


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration of N pairs."""

    X: Float64  #: (4, 4) T_flange_camera, or T_base_camera when the camera stands beside the arm
    Z: Float64  #: (4, 4) T_base_target, or T_flange_target
    eye_to_hand: bool  #: Whether the camera stands beside the arm
    residual: Float64  #: (N, 6) metres and radians, camera frame: predicted minus seen target
    left_out: Float64  #: (N, 6) the same under the solution without that pair; NaN where undetermined
    outliers: NDArray[np.bool_]  #: (N,) pairs that lost their vote
    noise: tuple[float, float]  #: Standard deviation per axis of one pair: metres, radians
    covariance: Float64  #: (6, 6) of X: metres, then rotation vector in radians, left tangent space
    #: RMS relative rotation of the hand about its three principal axes, radians, descending
    motion: tuple[float, float, float]
    #: Factor that fits the target's distances to the arm's, and its standard deviation; (1, small) is right
    scale: tuple[float, float]
    closed_forms: dict[str, Float64]  #: X of each closed form, by name
    warnings: tuple[str, ...]  #: What a person should look at

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviation of X: translation (metres) and rotation (radians), each the root of the trace."""
        d = np.diag(self.covariance)
        return float(np.sqrt(d[:3].sum())), float(np.sqrt(d[3:].sum()))

    @property
    def leave_one_out(self) -> tuple[float, float] | None:
        """RMS length of the left-out residuals of the pairs that are no outliers: metres, radians; None if undetermined."""
        kept = self.left_out[~self.outliers]
        if not np.isfinite(kept).all():
            return None
        moved, turned = distances(kept)
        return float(np.sqrt(np.mean(moved**2))), float(np.sqrt(np.mean(turned**2)))


def solve_hand_eye(
    hand: ArrayLike, target: ArrayLike, *, eye_to_hand: bool = False, blocks: int | None = None
) -> HandEye:
    """Calibrate hand and eye from pairs of poses, or refuse by name.

    ``hand`` is (N, 4, 4) T_base_flange, ``target`` (N, 4, 4) T_camera_target of the same moments, metres. With ``eye_to_hand`` the
    camera stands beside the arm and sees a target on the flange. ``blocks`` are stretches of consecutive pairs that share their errors,
    for the covariance of streams; None for single shots.

    :class:`DataError` for NaN, mirrored or otherwise impossible poses and lists of different length, :class:`HandEyeRefused` for motion
    or pairs that give no calibration; its ``cause`` names why.
    """
    A, B = clean(hand, "hand poses"), clean(target, "target poses")
    check_numbers(A, B)
    motion = check_motion(A, B)
    check_pairing(A, B)
    P = oriented(A, eye_to_hand=eye_to_hand)
    start = consensus(P, B)
    check_agreement(A, B, start, eye_to_hand=eye_to_hand)
    found = refine(P, B, start.X, start.Z, start.noise, blocks, eye_to_hand=eye_to_hand)
    outliers = found.distance > OUTLIER
    scale = target_scale(P[~outliers], B[~outliers], found.X[:3, :3])
    covariance = found.covariance[:6, :6]
    return HandEye(
        found.X,
        found.Z,
        eye_to_hand,
        found.residual,
        found.left_out,
        outliers,
        found.noise,
        covariance,
        motion,
        scale,
        {"park-martin": park_martin(P[~outliers], B[~outliers]), "kronecker": start.X},
        _warnings(B, outliers, np.diag(covariance), scale),
    )


def _warnings(
    B: Float64, outliers: NDArray[np.bool_], variances: Float64, scale: tuple[float, float]
) -> tuple[str, ...]:
    moved, turned = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    bad, (factor, off) = np.flatnonzero(outliers).tolist(), scale
    behind = int((B[:, 2, 3] <= 0).sum())
    said = (
        (len(B) < FEW, f"only {len(B)} pairs: the error bars are themselves uncertain"),
        (
            moved > LOOSE[0] or turned > LOOSE[1],
            f"loosely determined: {1e3 * moved:.1f} mm, {np.degrees(turned):.2f} deg",
        ),
        (len(bad) > 0, f"{len(bad)} pairs do not fit and lost their vote: {bad}"),
        (
            abs(factor - 1) > max(SCALE_OFF, 4 * off),
            f"the target's distances fit best multiplied by {factor:.4f} +- {off:.4f}: check its size and the camera's focal length",
        ),
        (
            behind > len(B) / 2,
            f"the target lies behind the camera in {behind} pairs: columns swapped, or a camera frame whose z points back",
        ),
    )
    return tuple(text for says, text in said if says)


def to_dict(result: HandEye) -> dict[str, Any]:
    """Return the result as JSON types: the transforms in metres, summaries in mm and degrees."""
    moved, turned = distances(result.residual)
    loo = result.leave_one_out
    names = (
        ("T_base_camera", "T_flange_target") if result.eye_to_hand else ("T_flange_camera", "T_base_target")
    )
    return {
        "format": "tofcapture-hand-eye",
        "version": 1,
        "units": "m",
        "mount": "eye-to-hand" if result.eye_to_hand else "eye-in-hand",
        names[0]: result.X.tolist(),
        names[1]: result.Z.tolist(),
        "pairs": len(result.residual),
        "outliers": np.flatnonzero(result.outliers).tolist(),
        "noise": _both(*result.noise),
        "standard_error": _both(*result.sigma),
        "covariance": result.covariance.tolist(),
        "residual": {
            "median": _both(float(np.median(moved)), float(np.median(turned))),
            "max": _both(float(moved.max()), float(turned.max())),
        },
        "leave_one_out": None if loo is None else _both(*loo),
        "motion_deg": np.degrees(result.motion).tolist(),
        "target_scale": {"factor": result.scale[0], "standard_error": result.scale[1]},
        "closed_forms": {name: X.tolist() for name, X in result.closed_forms.items()},
        "warnings": list(result.warnings),
    }


def _both(metres: float, radians: float) -> dict[str, float]:
    return {"translation_mm": 1e3 * metres, "rotation_deg": float(np.degrees(radians))}
