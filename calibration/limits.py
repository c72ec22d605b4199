"""Judge a calibration: every threshold in one table, and what a bad value most likely means.

The gate of a single pair has its own constants in :mod:`calibration.registration.gate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

VERDICTS = ("PASS", "WARN", "FAIL")


@dataclass(frozen=True)
class Judged:
    """One judged number as text: what it is, its value and limits, PASS, WARN or FAIL, and the likely cause where it is not PASS."""

    words: str
    value: str
    limits: str
    verdict: str
    cause: str


@dataclass(frozen=True)
class Limit:
    """Hold what one number may be."""

    words: str  #: What it is
    #: PASS up to good, WARN up to bearable, FAIL beyond; downwards where ``good`` is the larger
    good: float
    bearable: float
    unit: str  #: As printed
    cause: str  #: What a bad value most likely means, and what to do

    def verdict(self, value: float | None) -> str:
        """Say PASS, WARN or FAIL; a value that does not exist fails."""
        if value is None or value != value:  # noqa: PLR0124  NaN
            return "FAIL"
        sign = 1 if self.good <= self.bearable else -1
        if sign * value <= sign * self.good:
            return "PASS"
        return "WARN" if sign * value <= sign * self.bearable else "FAIL"

    @property
    def text(self) -> str:
        """Put both limits in words."""
        word = "to" if self.good <= self.bearable else "from"
        return f"PASS {word} {self.good:g}, WARN {word} {self.bearable:g} {self.unit}".rstrip()


_MORE = "record more board views, tilted 15 to 40 deg in all directions"
_RANGE = "range errors of the ToF camera: let it warm up, calibrate its ranges, see the plots over range and amplitude"
_MOVED = "something moved between the views (board, bracket, arm still swinging), or single views are bad: see the spread by view"

LIMITS: dict[str, Limit] = {
    "used": Limit("board views used", 8, 3, "", f"views were refused or too few were taken: {_MORE}"),
    "rmse": Limit("median residual of the used views", 4.0, 5.0, "mm", _RANGE),
    "condition": Limit(
        "worst condition of a used view", 100, 500, "",
        "few rims in sight: keep the whole board in both images, 4 cm or more in front of what is behind it",
    ),
    "spread_rotation": Limit("spread of the views, rotation", 0.15, 0.5, "deg", _MOVED),
    "spread_translation": Limit("spread of the views, translation", 1.5, 5.0, "mm", _MOVED),
    "error_rotation": Limit("standard error of the mean, rotation", 0.05, 0.2, "deg", _MORE),
    "error_translation": Limit("standard error of the mean, translation", 0.5, 2.0, "mm", _MORE),
    "initial_rotation": Limit(
        "turned from the initial guess", 3.0, 10.0, "deg", "the drawing or the old rig.toml is not of this rig",
    ),
    "initial_translation": Limit(
        "moved from the initial guess", 30.0, 100.0, "mm", "the drawing or the old rig.toml is not of this rig, or in mm",
    ),
    "bias_range": Limit("largest median residual over range", 1.0, 2.5, "mm", _RANGE),
    "bias_amplitude": Limit(
        "largest median residual over amplitude", 1.0, 2.5, "mm",
        "dark or saturated pixels bend the plane: change exposure, use a matt board",
    ),
    "bias_image": Limit(
        "largest median residual in a tenth of the image", 1.5, 3.0, "mm",
        "wrong intrinsics or lens distortion (radial pattern), light scattered in the lens, or a bent board",
    ),
    "rims": Limit(
        "median distance of ToF rims to stereo rims", 0.6, 1.5, "mm",
        "the images do not fit each other sideways: wrong intrinsics, a moving board, or a background too near",
    ),
    "wiggle": Limit(
        "range error common to all views, RMS over the range", 4.0, 12.0, "mm",
        "the ToF camera's factory calibration does not hold: warm it up or calibrate its ranges",
    ),
    "image": Limit("share of the image that the board has covered", 0.6, 0.35, "", f"see the coverage: {_MORE}"),
    "sectors": Limit("directions of tilt of 8 that were used", 6, 4, "", f"see the coverage: {_MORE}"),
    "tilt": Limit("median tilt of the board", 15, 8, "deg", "tilt the board, or the camera, 15 to 40 deg"),
    "distances": Limit("farthest over nearest view", 1.4, 1.15, "", "take views from 0.5 to 1 m"),
    "uncertain_motion": Limit(
        "1-sigma of the least certain motion, at the working point", 1.0, 3.0, "mm", f"{_MORE}, also along the motion named below",
    ),
    "truth_rotation": Limit("against the true rig, rotation", 0.1, 0.3, "deg", _RANGE),
    "truth_translation": Limit("against the true rig, a point at 0.8 m", 1.0, 3.0, "mm", _RANGE),
    "drift_rotation": Limit(
        "turned since the old calibration", 0.05, 0.2, "deg", "a knock, a loose screw, or warming: check the bracket, calibrate anew",
    ),
    "drift_translation": Limit(
        "moved since the old calibration, at the working point", 0.5, 2.0, "mm",
        "a knock, a loose screw, or warming: check the bracket, calibrate anew",
    ),
}  # fmt: skip

LENS = {
    "rms": Limit(
        "distance of rims to the board's edges", 0.4, 0.8, "px",
        "a bent board, another board's file, or a camera that moved during the exposure",
    ),
    "left_out": Limit("the same at views left out", 0.5, 1.0, "px", "too few views for this lens, or one bad view"),
    "pixel_sigma": Limit(
        "1-sigma of a ray", 0.3, 1.0, "px", "more views, tilted 20 to 40 degrees in all directions, at several distances",
    ),
    "coverage": Limit(
        "share of width and height covered", 0.75, 0.5, "", "views with the board's edge in every corner of the image",
    ),
}  # fmt: skip
RANGE_LEFT = Limit(
    "error left at views that were not fitted, RMS by view and part of the image", 1.0, 2.5, "mm",
    "light thrown back by the surroundings, too few views, or a sensor that was still warming up",
)  # fmt: skip

SIGNIFICANT = 0.01  # probability of a drift as large by chance below which it counts as real


def judged(key: str, value: float | None) -> Judged:
    """Judge one number by the limit of that name."""
    limit = LIMITS[key]
    verdict = limit.verdict(value)
    text = "none" if value is None or value != value else f"{value:.3g} {limit.unit}".rstrip()  # noqa: PLR0124  NaN
    return Judged(limit.words, text, limit.text, verdict, "" if verdict == "PASS" else limit.cause)


def worst(verdicts: Sequence[str]) -> str:
    """Return the worst verdict; ``WARN`` where nothing was judged."""
    return max(verdicts, key=VERDICTS.index, default="WARN")
