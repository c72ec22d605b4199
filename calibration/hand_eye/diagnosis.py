"""Why pairs do not fit: every mistake people make is undone in turn, and the one that makes them fit is named."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from calibration.hand_eye.checks import Cause, HandEyeRefused, slide_mismatch, thinned
from calibration.hand_eye.closed_form import Consensus, consensus, scaled
from calibration.hand_eye.readings import Readings
from tofcapture.poses import Float64, invert_all

BETTER = 3.0  # times less noise: another reading of the numbers is believed
GOOD = 0.5  # score below which no mistake was made: the smallest motion let through leaves more when misread
LIMIT = (0.030, np.radians(3.0))  # m, rad per axis: noise beyond which pairs are no calibration
AGREE = 0.75  # share of the pairs that must agree
FAIR = 5.0  # fair stations' noise; roles are judged only where the fit is better
MOUNT = 0.5  # m; mounts on hands are shorter, ways to targets longer
SECOND = 0.6  # share of the remainder that must agree on a second board
SHOWN = 120  # pairs that a diagnosis looks at


class Mistake(NamedTuple):
    """One reading of the pairs that would be right if a certain mistake had been made."""

    cause: Cause
    hint: str
    A: Float64
    B: Float64


def oriented(A: Float64, *, eye_to_hand: bool) -> Float64:
    """Return hand poses as the P of :mod:`calibration.hand_eye.closed_form`."""
    return invert_all(A) if eye_to_hand else A


def check_agreement(A: Float64, B: Float64, found: Consensus, *, eye_to_hand: bool) -> None:
    """Refuse pairs that fit badly, or that fit much better once a mistake is undone, by the cause that explains them best.

    A and B are (N, 4, 4) hand and target poses as they were given, ``found`` is their consensus, ``eye_to_hand`` how they are read.
    """
    P = oriented(A, eye_to_hand=eye_to_hand)
    few = thinned(len(A), SHOWN)
    if found.score > GOOD:
        _check_mistakes(A[few], B[few], consensus(P[few], B[few]), eye_to_hand=eye_to_hand)
    _check_roles(A, B, found, eye_to_hand=eye_to_hand)
    noisy = found.noise[0] > LIMIT[0] or found.noise[1] > LIMIT[1]
    if not noisy and found.inliers.mean() >= AGREE:
        return
    _check_second(P, B, found)
    raise HandEyeRefused(
        Cause.INCONSISTENT if noisy else Cause.SHUFFLED,
        f"{int(found.inliers.sum())} of {len(P)} pairs agree, with {_in_words(found)}; expected {100 * AGREE:.0f} % within "
        f"{1e3 * LIMIT[0]:.0f} mm and {np.degrees(LIMIT[1]):.0f} deg "
        f"(slide along the screws differs by {1e3 * slide_mismatch(A, B):.1f} mm)",
        "check that the target is rigid and fully seen, that the arm stood still, and that pairs are of one moment",
    )


def _in_words(found: Consensus) -> str:
    return f"{1e3 * found.noise[0]:.1f} mm and {np.degrees(found.noise[1]):.2f} deg per axis"


def _check_mistakes(A: Float64, B: Float64, given: Consensus, *, eye_to_hand: bool) -> None:
    mistakes = list(_mistakes(A, B, eye_to_hand=eye_to_hand))
    penalties = [consensus(oriented(m.A, eye_to_hand=eye_to_hand), m.B).penalty for m in mistakes]
    best = int(np.argmin(penalties))
    if penalties[best] < given.penalty / BETTER:
        raise HandEyeRefused(
            mistakes[best].cause,
            f"read as given, the pairs leave {_in_words(given)}; "
            f"with this mistake undone {given.penalty / penalties[best]:.0f} times less",
            mistakes[best].hint,
        )


def _mistakes(A: Float64, B: Float64, *, eye_to_hand: bool) -> Iterator[Mistake]:
    yield _inverted(A, B, eye_to_hand=eye_to_hand)
    # A reflection of either frame differs from this one by a rotation, which the solution absorbs.
    S = np.diag([1.0, 1.0, -1.0, 1.0])
    left_handed = "one of the two systems is left-handed (an axis points the wrong way)"
    yield Mistake(Cause.MIRRORED, f"the target poses fit once mirrored: {left_handed}", A, S @ B @ S)
    for name, sign in zip("xyz", 1 - 2 * np.eye(3), strict=True):
        hint = f"translations have the wrong sign along {name}"
        yield Mistake(Cause.MIRRORED, f"the target {hint}", A, scaled(B, sign))
        yield Mistake(Cause.MIRRORED, f"the hand {hint}", scaled(A, sign), B)
    for name, metres in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        hint = "the {} translations are in {} while the others are in metres"
        yield Mistake(Cause.WRONG_UNITS, hint.format("target", name), A, scaled(B, metres))
        yield Mistake(Cause.WRONG_UNITS, hint.format("hand", name), scaled(A, metres), B)
    for name, cause, what in (
        ("wxyz", Cause.QUATERNION_ORDER, "were read as x, y, z, w and are w, x, y, z"),
        (
            "xyzw inverted",
            Cause.ROTATION_INVERTED,
            "are inverted while its translations are not: JPL or transposed",
        ),
    ):
        hand, target = _reread(A, name), _reread(B, name)
        yield Mistake(cause, f"the hand's rotations {what}", hand, B)
        yield Mistake(cause, f"the target's rotations {what}", A, target)
        yield Mistake(cause, f"the rotations of both {what}", hand, target)


def _reread(T: Float64, name: str) -> Float64:
    """Take quaternions that were read as x, y, z, w in another reading (:class:`Readings`)."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return Readings(T[:, :3, 3], quaternions, (name,)).poses(name, "m")


def _inverted(A: Float64, B: Float64, *, eye_to_hand: bool) -> Mistake:
    """One of the two sides the wrong way round.

    ``A X B = Z`` and ``A^-1 Z B^-1 = X`` are one equation, so data cannot tell an inverted hand (which is the other mount) from
    an inverted target; that a camera looks at its target can.
    """
    other = "eye-in-hand (without --eye-to-hand)" if eye_to_hand else "eye-to-hand (--eye-to-hand)"
    back = invert_all(B)
    eye = f"the data are {other}, or the hand poses are given as T_flange_base"
    target = "expected the target in the camera, T_camera_target; these look like T_target_camera (--inverted-target)"
    if (_in_view(back), -_off_axis(back)) > (_in_view(B), -_off_axis(B)):
        return Mistake(Cause.TARGET_INVERTED, f"{target}. Otherwise {eye}", A, back)
    return Mistake(Cause.EYE_CONFUSED, f"{eye}. Otherwise {target}", invert_all(A), B)


def _in_view(T: Float64) -> float:
    """Share of target poses (N, 4, 4) within 45 degrees of the optical axis of a camera with z forward."""
    t = T[:, :3, 3]
    return float(np.mean(t[:, 2] > np.hypot(t[:, 0], t[:, 1])))


def _off_axis(T: Float64) -> float:
    t = T[:, :3, 3]
    return float(np.median(np.hypot(t[:, 0], t[:, 1]) / np.maximum(t[:, 2], 1e-9)))


def _check_roles(A: Float64, B: Float64, found: Consensus, *, eye_to_hand: bool) -> None:
    """Refuse swapped columns: algebra accepts them and merely exchanges X and Z, so geometry must tell.

    A camera looks at its target. With a camera in the hand, moreover, a mount is shorter than the way to the target; with one
    beside the arm the exchange leaves the lengths alone when columns are swapped, and reverses them when both are inverted.
    """
    mounted, beside = (found.Z, found.X) if eye_to_hand else (found.X, found.Z)
    long, short = (float(np.linalg.norm(T[:3, 3])) for T in (mounted, beside))
    if found.score > FAIR:
        return
    back, reversed_roles = invert_all(B), long > MOUNT > short
    swapped = _in_view(A) >= 0.95 and _in_view(B) < 0.5 and (eye_to_hand or long > short)
    swapped |= not eye_to_hand and reversed_roles and _better_view(A, B)
    inverted = reversed_roles and _better_view(back, B)
    if swapped or inverted:
        got = "the columns are swapped" if swapped else "both poses are inverted"
        raise HandEyeRefused(
            Cause.SWAPPED,
            f"{got}: the target is in view of the camera in {100 * _in_view(B):.0f} % of the pairs and the mount on the hand is "
            f"{long:.2f} m long; read the other way {100 * _in_view(A if swapped else back):.0f} % and {short:.2f} m",
            "expected [hand in base, target in camera]: T_base_flange and T_camera_target",
        )


def _better_view(other: Float64, B: Float64) -> bool:
    return _in_view(other) >= 0.95 and _off_axis(other) < 0.8 * _off_axis(B)


def _check_second(P: Float64, B: Float64, found: Consensus) -> None:
    """Name a second board, or a moved one, when the pairs that disagree agree among themselves."""
    rest = np.flatnonzero(~found.inliers)
    if len(rest) < 5:
        return
    second = consensus(P[rest], B[rest])
    limit = min(LIMIT[0], 5 * found.noise[0] + 1e-3)
    if second.inliers.mean() < SECOND or second.noise[0] > limit or second.noise[1] > LIMIT[1]:
        return
    changes = np.flatnonzero(np.diff(found.inliers.astype(int)))
    if len(changes) == 1:
        cut = int(changes[0])
        raise HandEyeRefused(
            Cause.MOVED,
            f"pairs 0 to {cut} agree among themselves, and so do pairs {cut + 1} to {len(P) - 1}, but not with each other",
            "the target, the camera or the arm's base was moved in between: calibrate from one part",
        )
    others = rest[second.inliers]
    listed = ", ".join(map(str, others[:8])) + (f" and {len(others) - 8} more" if len(others) > 8 else "")
    raise HandEyeRefused(
        Cause.TWO_BOARDS,
        f"{int(found.inliers.sum())} pairs agree on one target pose, {len(others)} others (pairs {listed}) on another",
        "two targets were seen, or one that looks the same when turned: use a target that is unique in every view",
    )
