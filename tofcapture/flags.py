"""What a ToF camera's pixel should be known for; a leaf, so that formats and decoding name the same bits."""

from __future__ import annotations

from enum import IntFlag


class TofFlag(IntFlag):
    """Why a decoded ToF pixel should not be trusted; 0 is a good pixel. :data:`TOF_FLAG_DOCS` says what each means."""

    SATURATED = 1
    FLYING = 2
    LOW_CONFIDENCE = 4
    AMBIGUOUS = 8


TOF_FLAG_DOCS = {
    TofFlag.SATURATED: "a tap of a frame reached saturation; there is no depth",
    TofFlag.FLYING: "on both sides of it, in a row or a column, depth jumps by more than a surface at 80 degrees: a mixed pixel",
    TofFlag.LOW_CONFIDENCE: "shot and read noise make the depth uncertain by more than 20 mm (one standard deviation)",
    TofFlag.AMBIGUOUS: "the two frequencies disagree by more than a quarter of the high one's wrap: its number may be wrong",
}
