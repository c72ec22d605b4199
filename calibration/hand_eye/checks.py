"""Gates before hand-eye is solved: damaged numbers, too little motion, pairs that do not belong together."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.hand_eye.closed_form import nearest_rotation, relative_motions, rotation_vectors
from tofcapture.errors import DataError, QualityError
from tofcapture.poses import Float64

MIN_PAIRS = 3
PURE_TRANSLATION = np.radians(2.0)  # 95th percentile of the relative rotations
SMALL_ROTATIONS = np.radians(5.0)
SINGLE_AXIS = np.radians(2.0)  # RMS rotation across the main axis
MISMATCH = 0.4  # of the angle difference that random pairing has
REACH = 20.0  # m; no arm reaches farther, so longer translations are millimetres
ORTHONORMAL = 1e-3  # rotations printed with four digits pass, scaled or sheared ones do not
COUPLES = 120  # pairs whose couples are compared; more cost time and change no verdict

FAULTS = (
    ("NaN or infinity", "the target was probably not found there"),
    (
        "no rotation (its rows are not of length 1 and orthogonal)",
        "the matrix may hold a scale, be transposed with its translation, or not be a pose",
    ),
    ("a left-handed rotation (determinant -1)", "mirrored axes: one axis of this frame points the wrong way"),
    ("a last row other than 0 0 0 1", "the matrix may be transposed"),
)
MORE_ROTATION = "rotate the hand by 30 degrees and more about at least two different axes between views"


class Cause(StrEnum):
    """Why pairs were refused."""

    TOO_FEW = "too few pairs"
    PURE_TRANSLATION = "pure translation"
    SMALL_ROTATIONS = "rotations too small"
    SINGLE_AXIS = "single rotation axis"
    SHUFFLED = "shuffled or mismatched pairs"
    SHIFTED = "pairs shifted against each other"
    QUATERNION_ORDER = "quaternion order"
    ROTATION_INVERTED = "rotations inverted"
    EYE_CONFUSED = "eye-in-hand and eye-to-hand confused"
    TARGET_INVERTED = "target pose inverted"
    SWAPPED = "columns swapped or both inverted"
    MIRRORED = "mirrored axes"
    WRONG_UNITS = "wrong units"
    TARGET_SCALE = "wrong target size"
    CONVENTION = "the meaning of the numbers cannot be told"
    TWO_BOARDS = "two boards confused"
    MOVED = "something was moved"
    INCONSISTENT = "inconsistent pairs"
    TIME_OFFSET = "time offset not found"


class HandEyeRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Pairs that cannot give a good hand-eye calibration; the message begins with ``cause``."""

    def __init__(self, cause: Cause, message: str, hint: str = "") -> None:
        super().__init__(f"hand-eye refused, {cause}: {message}", hint)
        self.cause = cause


def clean(T: ArrayLike, name: str) -> Float64:
    """Coerce to rigid transforms (N, 4, 4), rounded rotations made exact.

    :class:`DataError` for a wrong shape, NaN or infinity, a mirrored or scaled rotation, a wrong last row. It names the first bad pair.
    """
    out = np.array(T, dtype=np.float64)
    if out.ndim != 3 or out.shape[1:] != (4, 4):
        raise DataError(f"{name}: expected (N, 4, 4) transforms, got shape {out.shape}")
    R = out[:, :3, :3]
    with np.errstate(invalid="ignore"):
        defect = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
        bad = (
            ~np.isfinite(out).all(axis=(1, 2)),
            defect > ORTHONORMAL,
            np.linalg.det(R) < 0,
            np.abs(out[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-6,
        )
    for where, (got, hint) in zip(np.stack(bad), FAULTS, strict=True):
        if where.any():
            count = f"in pair {int(np.argmax(where))} ({int(where.sum())} of {len(where)} pairs)"
            raise DataError(f"{name}: expected rigid transforms, got {got} {count}", hint)
    out[:, :3, :3] = nearest_rotation(R)
    return out


def check_numbers(A: Float64, B: Float64, repeated: int = 0) -> None:
    """Refuse unequal numbers of poses (:class:`DataError`), too few of them and lengths that cannot be metres (by name)."""
    if len(A) != len(B):
        raise DataError(
            f"hand-eye: expected as many target poses as hand poses, got {len(B)} and {len(A)}",
            hint="every pair needs both; drop the views without a target on both sides",
        )
    if len(A) < MIN_PAIRS:
        got = f"expected at least {MIN_PAIRS}, better 15 to 30, got {len(A)}"
        got += f" and {repeated} that repeat them" if repeated else ""
        raise HandEyeRefused(Cause.TOO_FEW, got, "record more views")
    for name, T in (("hand", A), ("target", B)):
        size = float(np.median(np.linalg.norm(T[:, :3, 3], axis=1)))
        if size > REACH:
            raise HandEyeRefused(
                Cause.WRONG_UNITS,
                f"expected metres, got a median {name} distance of {size:.0f}",
                "the translations look like millimetres: divide them by 1000",
            )


def check_motion(A: Float64, B: Float64) -> tuple[float, float, float]:
    """Refuse motion of hand and target poses (N, 4, 4) that does not determine the answer.

    Returns the RMS rotation of the relative motions of the hand about their three principal axes, radians, descending.

    :class:`HandEyeRefused` for pure translation, rotations too small, a single rotation axis; mismatched pairs when only the hand turns.
    """
    (largest, sigma), (largest_seen, sigma_seen) = (_spread(M) for M in _couples(A, B))
    degrees = np.degrees(sigma)
    if largest < PURE_TRANSLATION:
        raise HandEyeRefused(
            Cause.PURE_TRANSLATION,
            f"expected rotations between the poses, got at most {np.degrees(largest):.2f} deg",
            f"without rotation the camera's translation is free: {MORE_ROTATION}",
        )
    if largest < SMALL_ROTATIONS:
        raise HandEyeRefused(
            Cause.SMALL_ROTATIONS,
            f"expected 30 deg between the poses, at least 5, got at most {np.degrees(largest):.1f} deg",
            MORE_ROTATION,
        )
    if sigma[1] < SINGLE_AXIS:
        raise HandEyeRefused(
            Cause.SINGLE_AXIS,
            f"expected rotations about two axes, got {degrees[0]:.0f} deg about one axis and {degrees[1]:.2f} deg across it",
            f"the translation along that axis is free: {MORE_ROTATION}",
        )
    if largest_seen < PURE_TRANSLATION or sigma_seen[1] < SINGLE_AXIS:
        raise HandEyeRefused(
            Cause.SHUFFLED,
            f"the hand turns about two axes, the target poses by at most {np.degrees(largest_seen):.1f} deg "
            f"({np.degrees(sigma_seen[1]):.1f} deg across their main axis)",
            "the target poses may belong to another recording, or a tracker has frozen",
        )
    return float(sigma[0]), float(sigma[1]), float(sigma[2])


def check_pairing(A: Float64, B: Float64) -> None:
    """Refuse pairs whose screws are not congruent in angle: shifted against each other, or shuffled."""
    mismatch = _angle_mismatch(A, B)
    if mismatch <= MISMATCH:
        return
    for k in (1, -1, 2, -2, 3, -3):
        shifted = A[max(0, -k) : len(A) - max(0, k)], B[max(0, k) : len(B) - max(0, -k)]
        if _angle_mismatch(*shifted) < min(MISMATCH, 0.5 * mismatch):
            raise HandEyeRefused(
                Cause.SHIFTED,
                f"hand pose i belongs to target pose i {'+' if k > 0 else '-'} {abs(k)}",
                "one list misses or repeats poses at its beginning",
            )
    raise HandEyeRefused(
        Cause.SHUFFLED,
        "the rotation angles of hand and target agree no better than at random "
        f"({100 * mismatch:.0f} % of the difference that random pairs have, expected below {100 * MISMATCH:.0f} %)",
        "pair i of both lists must be the same moment; check the order of the files, or pass time-stamped streams",
    )


def slide_mismatch(A: Float64, B: Float64) -> float:
    """Return the median difference (metres) of the translations along the screw axes of hand and target."""
    (a, along_a), (_, along_b) = (_screws(M) for M in _couples(A, B))
    turned = (a > SMALL_ROTATIONS) & (a < np.radians(170))
    return float(np.median(np.abs(along_a - along_b)[turned])) if turned.any() else float("nan")


def thinned(count: int, most: int) -> NDArray[np.intp]:
    """Choose at most so many indices, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))


def _couples(A: Float64, B: Float64) -> tuple[Float64, Float64]:
    few = thinned(len(A), COUPLES)
    return relative_motions(A[few], B[few])


def _spread(M: Float64) -> tuple[float, Float64]:
    """95th percentile of the rotations of motions, and their RMS about three principal axes, radians."""
    phi = rotation_vectors(M[:, :3, :3])
    sigma = np.linalg.svd(phi, compute_uv=False) / np.sqrt(len(phi))
    return float(np.quantile(np.linalg.norm(phi, axis=1), 0.95)), sigma


def _screws(M: Float64) -> tuple[Float64, Float64]:
    """Rotation angle (N,) and translation along the axis (N,) of motions, which hand and eye must share."""
    phi = rotation_vectors(M[:, :3, :3])
    angle = np.linalg.norm(phi, axis=1)
    axis = phi / np.maximum(angle, 1e-12)[:, None]
    return angle, np.einsum("ni,ni->n", axis, M[:, :3, 3])


def _angle_mismatch(A: Float64, B: Float64) -> float:
    """Tell how much the rotation angles of hand and target differ, as a share of what random pairing would give.

    A rigid mount makes the screws of ``A_ij`` and ``B_ij`` congruent: same angle, same translation along the axis (Chen,
    CVPR 1991). The angle is free of units, of mirroring and of inversion, so what breaks it is the pairing.
    """
    if len(A) < MIN_PAIRS:
        return np.inf
    a, b = (_screws(M)[0] for M in _couples(A, B))
    random = np.median(np.abs(a[:, None] - b[None, :: max(1, len(b) // 500)]))
    return float(np.median(np.abs(a - b)) / max(float(random), 1e-9))
