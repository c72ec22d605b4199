"""Names of everything that hand-eye calibration refuses, and the errors that carry them."""

from __future__ import annotations

from enum import StrEnum

from tofcapture.errors import QualityError


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
    TWO_BOARDS = "two boards confused"
    MOVED = "something was moved"
    INCONSISTENT = "inconsistent pairs"
    TIME_OFFSET = "time offset not found"


class HandEyeRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Pairs that cannot give a good hand-eye calibration.

    Parameters
    ----------
    cause
        The name of the refusal; the message begins with it.
    message
        Expected and got.
    hint
        What to try next.
    """

    def __init__(self, cause: Cause, message: str, hint: str = "") -> None:
        super().__init__(f"hand-eye refused, {cause}: {message}", hint)
        self.cause = cause
