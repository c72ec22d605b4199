"""Gates before hand-eye is solved: damaged numbers, too little motion, pairs that do not belong together."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.hand_eye.closed_form import nearest_rotation, relative_motions, rotation_vectors, screws
from calibration.hand_eye.refusal import Cause, HandEyeRefused
from tofcapture.errors import DataError
from tofcapture.poses import Float64

MIN_PAIRS = 3
PURE_TRANSLATION = np.radians(2.0)  # 95th percentile of the relative rotations
SMALL_ROTATIONS = np.radians(5.0)
SINGLE_AXIS = np.radians(2.0)  # RMS rotation across the main axis
MISMATCH = 0.4  # of the angle difference that random pairing has
REACH = 20.0  # m; no arm reaches farther, so longer translations are millimetres
ORTHONORMAL = 1e-3  # rotations printed with four digits pass, scaled or sheared ones do not
COUPLES = 120  # pairs whose couples are compared; more cost time and change no verdict

MORE_ROTATION = "rotate the hand by 30 degrees and more about at least two different axes between views"


def clean(T: ArrayLike, name: str) -> Float64:
    """Coerce to rigid transforms (N, 4, 4), rounded rotations made exact.

    Raises
    ------
    DataError
        Wrong shape, NaN or infinity, mirrored or scaled rotation, wrong last row; the index of the first bad pair is named.
    """
    out = np.array(T, dtype=np.float64)
    if out.ndim != 3 or out.shape[1:] != (4, 4):
        raise DataError(f"{name}: expected (N, 4, 4) transforms, got shape {out.shape}")
    _refuse_first(
        np.asarray(~np.isfinite(out).all(axis=(1, 2))),
        name,
        "NaN or infinity",
        "the target was probably not found there",
    )
    R = out[:, :3, :3]
    defect = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    _refuse_first(
        defect > ORTHONORMAL,
        name,
        "no rotation (its rows are not of length 1 and orthogonal)",
        "the matrix may hold a scale, be transposed with its translation, or not be a pose",
    )
    _refuse_first(
        np.linalg.det(R) < 0,
        name,
        "a left-handed rotation (determinant -1)",
        "mirrored axes: one axis of this frame points the wrong way",
    )
    _refuse_first(
        np.abs(out[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-6,
        name,
        "a last row other than 0 0 0 1",
        "the matrix may be transposed",
    )
    out[:, :3, :3] = nearest_rotation(R)
    return out


def _refuse_first(bad: NDArray[np.bool_], name: str, got: str, hint: str) -> None:
    if bad.any():
        i = int(np.argmax(bad))
        raise DataError(
            f"{name}: expected rigid transforms, got {got} in pair {i} ({int(bad.sum())} of {len(bad)} pairs)",
            hint,
        )


def check_numbers(A: Float64, B: Float64) -> None:
    """Refuse unequal or too few pairs and lengths that cannot be metres.

    Raises
    ------
    DataError
        Unequal numbers of poses.
    HandEyeRefused
        Too few pairs; wrong units.
    """
    if len(A) != len(B):
        raise DataError(
            f"hand-eye: expected as many target poses as hand poses, got {len(B)} and {len(A)}",
            hint="every pair needs both; drop the views without a target on both sides",
        )
    if len(A) < MIN_PAIRS:
        raise HandEyeRefused(
            Cause.TOO_FEW,
            f"expected at least {MIN_PAIRS}, better 15 to 30, got {len(A)}",
            "record more views",
        )
    for name, T in (("hand", A), ("target", B)):
        size = float(np.median(np.linalg.norm(T[:, :3, 3], axis=1)))
        if size > REACH:
            raise HandEyeRefused(
                Cause.WRONG_UNITS,
                f"expected metres, got a median {name} distance of {size:.0f}",
                "the translations look like millimetres: divide them by 1000",
            )


def check_motion(A: Float64, B: Float64) -> tuple[float, float, float]:
    """Refuse motion that does not determine the answer.

    Parameters
    ----------
    A, B
        (N, 4, 4) hand and target poses.

    Returns
    -------
    RMS rotation of the relative motions of the hand about their three principal axes, radians, descending.

    Raises
    ------
    HandEyeRefused
        Pure translation, rotations too small, a single rotation axis; mismatched pairs when only the hand turns.
    """
    thin = _thinned(len(A))
    moves = dict(zip(("hand", "target"), relative_motions(A[thin], B[thin]), strict=True))
    spread = {name: _spread(M) for name, M in moves.items()}
    _check_hand(spread["hand"])
    largest, sigma = spread["target"]
    if largest < PURE_TRANSLATION or sigma[1] < SINGLE_AXIS:
        raise HandEyeRefused(
            Cause.SHUFFLED,
            f"the hand turns about two axes, the target poses by at most {np.degrees(largest):.1f} deg "
            f"({np.degrees(sigma[1]):.1f} deg across their main axis)",
            "the target poses may belong to another recording, or a tracker has frozen",
        )
    hand = spread["hand"][1]
    return float(hand[0]), float(hand[1]), float(hand[2])


def _spread(M: Float64) -> tuple[float, Float64]:
    phi = rotation_vectors(M[:, :3, :3])
    sigma = np.linalg.svd(phi, compute_uv=False) / np.sqrt(len(phi))
    return float(np.quantile(np.linalg.norm(phi, axis=1), 0.95)), sigma


def _check_hand(spread: tuple[float, Float64]) -> None:
    largest, sigma = spread
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
            f"expected rotations about two axes, got {np.degrees(sigma[0]):.0f} deg about one axis "
            f"and {np.degrees(sigma[1]):.2f} deg across it",
            f"the translation along that axis is free: {MORE_ROTATION}",
        )


def angle_mismatch(A: Float64, B: Float64) -> float:
    """How much the rotation angles of hand and target differ, as a share of what random pairing would give.

    A rigid mount makes the screws of ``A_ij`` and ``B_ij`` congruent: same angle, same translation along the axis (Chen,
    CVPR 1991). The angle is free of units, of mirroring and of inversion, so what breaks it is the pairing.
    """
    if len(A) < MIN_PAIRS:
        return np.inf
    thin = _thinned(len(A))
    A_ij, B_ij = relative_motions(A[thin], B[thin])
    a, b = screws(A_ij)[0], screws(B_ij)[0]
    random = np.median(np.abs(a[:, None] - b[None, :: max(1, len(b) // 500)]))
    return float(np.median(np.abs(a - b)) / max(float(random), 1e-9))


def slide_mismatch(A: Float64, B: Float64) -> float:
    """Median difference (metres) of the translations along the screw axes of hand and target."""
    thin = _thinned(len(A))
    (a, along_a), (_, along_b) = (screws(M) for M in relative_motions(A[thin], B[thin]))
    turned = (a > SMALL_ROTATIONS) & (a < np.radians(170))
    return float(np.median(np.abs(along_a - along_b)[turned])) if turned.any() else float("nan")


def check_pairing(A: Float64, B: Float64) -> None:
    """Refuse pairs whose screws are not congruent in angle.

    Raises
    ------
    HandEyeRefused
        Pairs shifted against each other, or shuffled.
    """
    mismatch = angle_mismatch(A, B)
    if mismatch <= MISMATCH:
        return
    for cause, got, hint, A_try, B_try in _shifts(A, B):
        if angle_mismatch(A_try, B_try) < min(MISMATCH, 0.5 * mismatch):
            raise HandEyeRefused(cause, got, hint)
    raise HandEyeRefused(
        Cause.SHUFFLED,
        "the rotation angles of hand and target agree no better than at random "
        f"({100 * mismatch:.0f} % of the difference that random pairs have, expected below {100 * MISMATCH:.0f} %)",
        "pair i of both lists must be the same moment; check the order of the files, or pass time-stamped streams",
    )


Trial = tuple[Cause, str, str, Float64, Float64]


def _shifts(A: Float64, B: Float64) -> Iterator[Trial]:
    for k in (1, -1, 2, -2, 3, -3):
        yield (
            Cause.SHIFTED,
            f"hand pose i belongs to target pose i {'+' if k > 0 else '-'} {abs(k)}",
            "one list misses or repeats poses at its beginning",
            A[max(0, -k) : len(A) - max(0, k)],
            B[max(0, k) : len(B) - max(0, -k)],
        )


def _thinned(count: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, count - 1, min(count, COUPLES)).round().astype(np.intp))


def listed(indices: NDArray[np.integer]) -> str:
    """Name at most eight pairs."""
    shown = ", ".join(str(int(i)) for i in indices[:8])
    return shown + (f" and {len(indices) - 8} more" if len(indices) > 8 else "")
