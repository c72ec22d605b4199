"""Hand-eye calibration: where a camera sits on the hand, or beside the arm, and how well that is known.

``A_i`` is the hand in the base (T_base_flange), ``B_i`` the target in the camera (T_camera_target). Camera in the hand:
``A_i X B_i = Z`` with X = T_flange_camera and Z = T_base_target. Camera beside the arm: ``A_i^-1 X B_i = Z`` with
X = T_base_camera and Z = T_flange_target. Closed forms start it, :mod:`calibration.hand_eye.refine` ends it. The target's size is
an unknown like others: where the pairs contradict the given one, they are solved with their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.hand_eye.checks import Cause, check_motion, check_numbers, check_pairing, clean
from calibration.hand_eye.closed_form import (
    SCALE,
    distances,
    nearest_rotation,
    park_martin,
    rotation_bound,
    scaled,
    scaled_consensus,
)
from calibration.hand_eye.diagnosis import check_agreement, oriented
from calibration.hand_eye.refine import Refined, refine
from tofcapture.poses import Float64, exp, invert, log, transform

OUTLIER = 6.0  # sigma (6-D): 1 of 200,000 Gaussian pairs lies farther out
FEW = 10  # pairs below which a result is called doubtful
LOOSE = (0.005, np.radians(0.5))  # m, rad: standard deviations beyond which a result is called doubtful
SCALE_SIGMAS, SCALE_OFF = 3.0, 0.01  # a size of the target that is farther off by both is wrong
TARGET_NEAR, TARGET_FAR, MOUNT = 0.1, 5.0, 0.6  # m: what cameras on arms see, and where they sit
SAME = (2e-4, np.radians(0.02))  # m, rad: an arm that came back stands where it stood
SEEN_SAME = (0.003, np.radians(0.5))  # m, rad: what a camera sees from there
KICKED, KICKS = 3, (0.1, 0.5)  # other starts, and by how much they are off: m, rad
ALIKE = (1e-4, 1e-4)  # m, rad: two starts that ended at one optimum


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration of N pairs."""

    X: Float64  #: (4, 4) T_flange_camera, or T_base_camera when the camera stands beside the arm
    Z: Float64  #: (4, 4) T_base_target, or T_flange_target
    eye_to_hand: bool  #: Whether the camera stands beside the arm
    residual: Float64  #: (N, 6) metres and radians, camera frame: predicted minus seen target
    left_out: Float64  #: (N, 6) the same under the solution without that pair; NaN where undetermined
    outliers: NDArray[np.bool_]  #: (N,) pairs that lost their vote
    repeats: int  #: Pairs that repeat others; they have no vote of their own
    noise: tuple[float, float]  #: Standard deviation per axis of one pair: metres, radians
    covariance: Float64  #: (6, 6) of X: metres, then rotation vector in radians, left tangent space
    #: RMS relative rotation of the hand about its three principal axes, radians, descending
    motion: tuple[float, float, float]
    #: Factor that fits the target's distances to the arm's, and its standard deviation; (1, small) is right
    scale: tuple[float, float]
    scale_used: float  #: Factor with which X was solved: one, the given one, or that of ``scale``
    closed_forms: dict[str, Float64]  #: X of each closed form, by name
    starts: tuple[int, int]  #: Starts that ended at X, of how many; the others ended at worse optima
    certified: float  #: No rotations farther than this (radians) fit the pairs as well, wherever one starts
    failures: tuple[str, ...]  #: Why the result must not be used as it is
    warnings: tuple[str, ...]  #: What a person should look at

    @property
    def verdict(self) -> str:
        """PASS, WARN or FAIL."""
        return "FAIL" if self.failures else "WARN" if self.warnings else "PASS"

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
    hand: ArrayLike,
    target: ArrayLike,
    *,
    eye_to_hand: bool = False,
    target_scale: float | None = None,
    free_scale: bool = False,
) -> HandEye:
    """Calibrate hand and eye from pairs of poses, or refuse by name.

    ``hand`` is (N, 4, 4) T_base_flange, ``target`` (N, 4, 4) T_camera_target of the same moments, metres. With ``eye_to_hand`` the
    camera stands beside the arm and sees a target on the flange. Pairs that repeat others count once,
    and consecutive ones that share their errors (streams) widen the error bars.

    The target's size is believed unless the pairs contradict it by three sigma. They are then solved with the size that fits, its
    error within the covariance, and the verdict is FAIL where that is 1 % off. ``free_scale`` accepts whatever size fits,
    ``target_scale`` is believed instead of what the pairs say: the factor of the target's distances, one for the size as given.

    :class:`DataError` for NaN, mirrored or otherwise impossible poses and lists of different length, :class:`HandEyeRefused` for motion
    or pairs that give no calibration; its ``cause`` names why.
    """
    A, B = clean(hand, "hand poses"), clean(target, "target poses")
    check_numbers(A, B)
    A, B, place = once(A, B)
    check_numbers(A, B, repeated=len(place) - len(A))
    motion = check_motion(A, B)
    check_pairing(A, B)
    P = oriented(A, eye_to_hand=eye_to_hand)
    start, size = scaled_consensus(P, B)
    check_agreement(A, scaled(B, size), start, eye_to_hand=eye_to_hand)

    def fit(X: Float64, Z: Float64, *, given: float = 1.0, free: bool = False) -> Refined:
        return refine(P, scaled(B, given), X, Z, start.noise, eye_to_hand=eye_to_hand, free_scale=free)

    own = fit(start.X, start.Z, given=size, free=True)
    factor = size * own.scale
    scale = factor, factor * float(np.sqrt(own.covariance[12, 12]))
    off = not free_scale and abs(factor - 1) > SCALE_SIGMAS * scale[1]
    free = free_scale or (target_scale is None and off)
    used = factor if free else target_scale or 1.0
    seen = scaled(B, used)
    closed = {"park-martin": park_martin(P[start.inliers], seen[start.inliers]), "kronecker": start.X}
    starts = [*closed.values(), *_kicked(start.X)]
    found, ended = _best(lambda X, Z: fit(X, Z, given=used, free=free), starts, P, seen)
    outliers = found.distance > OUTLIER
    mounted = found.Z if eye_to_hand else found.X
    looks = _warnings(
        found, seen, outliers[place], len(place) - len(A), float(np.linalg.norm(mounted[:3, 3]))
    )
    size_said = [f"{Cause.TARGET_SCALE}: {_size_in_words(scale)}"] if off else []
    failed = off and target_scale is None and abs(factor - 1) > SCALE_OFF
    return HandEye(
        found.X,
        found.Z,
        eye_to_hand,
        found.residual[place],
        found.left_out[place],
        outliers[place],
        len(place) - len(A),
        found.noise,
        found.covariance[:6, :6],
        motion,
        scale,
        used,
        closed,
        (ended, len(starts)),
        rotation_bound(P, B, found.X, found.Z, found.weight),
        tuple(size_said if failed else ()),
        tuple(looks if failed else looks + size_said),
    )


def once(A: Float64, B: Float64) -> tuple[Float64, Float64, NDArray[np.intp]]:
    """Keep the first of pairs (N, 4, 4) that are alike; also the place (N,) of each given pair among those kept.

    Pictures taken twice from one pose share the arm's error and show nothing new, whatever their own noise.
    """
    kept: list[int] = []
    place = np.zeros(len(A), dtype=np.intp)
    for i in range(len(A)):
        alike = np.ones(len(kept), dtype=bool)
        for T, (metres, radians) in ((A, SAME), (B, SEEN_SAME)):
            far = np.linalg.norm(T[kept] - T[i], axis=1)  # (K, 4): of each column
            alike &= (far[:, 3] < metres) & (np.linalg.norm(far[:, :3], axis=1) < np.sqrt(2) * radians)
        place[i] = int(np.argmax(alike)) if alike.any() else len(kept)
        kept += [] if alike.any() else [i]
    return A[kept], B[kept], place


def _best(
    fit: Callable[[Float64, Float64], Refined], starts: list[Float64], P: Float64, B: Float64
) -> tuple[Refined, int]:
    """Refine from every start of X (4, 4) and take the likeliest; also how many starts ended there."""
    ends = [fit(X, _beside(P, X, B)) for X in starts]
    best = max(ends, key=lambda e: e.log_likelihood)
    gaps = distances(np.stack([log(invert(e.X) @ best.X) for e in ends]))
    return best, int(np.sum((gaps[0] < ALIKE[0]) & (gaps[1] < ALIKE[1])))


def _beside(P: Float64, X: Float64, B: Float64) -> Float64:
    """Find the Z (4, 4) that most pairs mean by an X."""
    each = P @ X @ B
    return transform(nearest_rotation(np.median(each[:, :3, :3], axis=0)), np.median(each[:, :3, 3], axis=0))


def _kicked(X: Float64) -> list[Float64]:
    rng = np.random.default_rng(0)
    return [X @ exp(rng.normal(0, np.repeat(KICKS, 3))) for _ in range(KICKED)]


def _warnings(
    found: Refined, B: Float64, outliers: NDArray[np.bool_], repeats: int, mounted: float
) -> list[str]:
    moved, turned = (float(np.linalg.norm(h)) for h in np.sqrt(np.diag(found.covariance)[:6]).reshape(2, 3))
    bad, n = np.flatnonzero(outliers).tolist(), len(found.residual)
    behind, far = int((B[:, 2, 3] <= 0).sum()), float(np.median(np.linalg.norm(B[:, :3, 3], axis=1)))
    said = (
        (n < FEW, f"only {n} pairs: the error bars are themselves uncertain"),
        (repeats > 0, f"{repeats} pairs repeat others and count once: move the hand between pictures"),
        (
            moved > LOOSE[0] or turned > LOOSE[1],
            f"loosely determined: {1e3 * moved:.1f} mm, {np.degrees(turned):.2f} deg",
        ),
        (
            found.noise[0] > SCALE[0] or found.noise[1] > SCALE[1],
            (
                f"noise of {1e3 * found.noise[0]:.1f} mm, {np.degrees(found.noise[1]):.2f} deg per axis; arm and camera should leave below "
                f"{1e3 * SCALE[0]:.0f} mm, {np.degrees(SCALE[1]):.1f} deg: check how rotations and lengths are written"
            ),
        ),
        (len(bad) > 0, f"{len(bad)} pairs do not fit and lost their vote: {bad}"),
        (
            behind > len(B) / 2,
            f"the target lies behind the camera in {behind} pairs: columns swapped, or a camera frame whose z points back",
        ),
        (
            not TARGET_NEAR < far < TARGET_FAR,
            f"implausible size: the target is {far:.3g} m from the camera, expected {TARGET_NEAR:g} to {TARGET_FAR:g} m: check the units",
        ),
        (
            mounted > MOUNT,
            f"implausible size: what the flange carries is {mounted:.2f} m from it, expected below {MOUNT:g} m: check the units",
        ),
    )
    return [text for says, text in said if says]


def _size_in_words(scale: tuple[float, float]) -> str:
    factor, off = scale
    sizes = ", ".join(f"{mm} mm given become {mm * factor:.2f}" for mm in (20, 25, 30))
    return (
        f"the target's distances fit best multiplied by {factor:.4f} +- {off:.4f}: its squares would have to be that much larger "
        f"({sizes} mm); measure them, or check the camera's focal length"
    )


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
        "repeats": result.repeats,
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
        "target_scale": {
            "factor": result.scale[0],
            "standard_error": result.scale[1],
            "used": result.scale_used,
        },
        "optimum": {
            "starts": result.starts[1],
            "ended_here": result.starts[0],
            "certified_rotation_deg": float(np.degrees(result.certified)),
        },
        "closed_forms": {name: X.tolist() for name, X in result.closed_forms.items()},
        "failures": list(result.failures),
        "warnings": list(result.warnings),
        "verdict": result.verdict,
    }


def _both(metres: float, radians: float) -> dict[str, float]:
    return {"translation_mm": 1e3 * metres, "rotation_deg": float(np.degrees(radians))}
