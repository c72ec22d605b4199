"""Hold imported ground truth against the depth that the ToF image decodes to, and name what is turned, scaled or elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tofcapture.errors import DataError
from tofcapture.frames import NO_TRUTH, TofInfo, View
from tofcapture.importing.rules import Float32
from tofcapture.ops.phase import Decoder
from tofcapture.poses import Float64, transform_points

_WRONG = 0.03  # m of median difference from which a better reading is looked for
_BETTER = 3.0  # times smaller differences of another reading
_FAR_OFF = 0.25  # m of median difference that is told
_STEPS = (0.1, 0.125, 0.2, 0.25, 0.5)  # mm, of integers that other cameras and datasets write
_SPARSE = 0.05  # of the pixels; less is told
_LEAST = 0.01  # of the pixels


@dataclass(frozen=True)
class Overlap:
    """Tell how ground truth lies over a ToF image."""

    tof: Float32  #: (H, W) decoded depth, metres; NaN: none.
    truth: Float32  #: (H, W) ground truth seen by the ToF camera, nearest pixel, metres; NaN: none.
    amplitude: Float32  #: (H, W) of the highest frequency.
    model: str  #: What ground truth was made of.
    warnings: tuple[str, ...] = ()

    @property
    def share(self) -> float:
        """Share of the pixels that both measured."""
        return float((np.isfinite(self.tof) & np.isfinite(self.truth)).mean())

    @property
    def difference(self) -> float:
        """Median of truth less ToF, metres; NaN without ground truth."""
        both = self.truth - self.tof
        return float(np.nanmedian(both)) if np.isfinite(both).any() else float("nan")


def compare(view: View, where: str, model: str, *, placed: bool = True) -> Overlap:
    """Compare, where it is known how the cameras stand; :class:`DataError` for ground truth that misses the image, or that fits much better mirrored, turned or scaled."""
    decoded = Decoder(view.tof.info).burst(view.tof.raw, float(np.mean(view.tof.celsius)))
    tof = decoded.depth
    if model == NO_TRUTH or not placed:
        return Overlap(tof, np.full_like(tof, np.nan), decoded.confidence, model)
    truth = seen(view, view.rig.T_tof_stereo)
    found = Overlap(tof, truth, decoded.confidence, model)
    if np.isfinite(truth).mean() < _LEAST:
        inverse = np.isfinite(seen(view, view.rig.T_stereo_tof)).mean() > 10 * _LEAST
        raise DataError(
            f"{where}: expected ground truth in the ToF camera's image, it covers {np.isfinite(truth).mean():.1%} of it",
            hint="the inverse of T_tof_truth would: it maps from the truth's frame to the ToF frame"
            if inverse
            else "T_tof_truth maps the truth's frame to the ToF frame, in metres; are both cameras of this scene?",
        )
    off = float(np.nanmedian(np.abs(truth - tof))) if found.share else float("nan")
    if off > _WRONG and (better := _better(tof, truth, view, off)):
        raise DataError(
            f"{where}: expected ground truth that agrees with the ToF image, it is {1e3 * off:.0f} mm off",
            better,
        )
    if found.share < _SPARSE:
        text = f"{where}: ground truth and ToF have {found.share:.1%} of the image in common: build-dataset may find no surface there"
        return replace(found, warnings=(text,))
    if off > _FAR_OFF:
        text = f"{where}: ground truth and ToF depth differ by {1e3 * off:.0f} mm in the median: are channels, unit and T_tof_truth right?"
        return Overlap(tof, truth, decoded.confidence, model, (text,))
    return found


def seen(view: View, T: Float64) -> Float32:
    """Project the point map into the ToF image (H, W) by ``T``."""
    return view.tof.info.camera.nearest(transform_points(T, view.stereo.points.reshape(-1, 3)))


def _better(tof: Float32, truth: Float32, view: View, off: float) -> str:
    """Say how ground truth would have to be read to agree much better; nothing when no reading does."""
    lengths = view.tof.info.camera.ray_lengths
    readings: dict[str, Any] = {
        "it is mirrored left to right: flip it with np.fliplr": truth[:, ::-1],
        "it is upside down: flip it with np.flipud": truth[::-1],
        "it is turned by half a turn: np.rot90(depth, 2)": truth[::-1, ::-1],
        'it is along the rays: [truth] kind = "radial" in import.toml': truth / lengths,
        'it is in inches or feet: convert it, and say [truth] unit = "m"': truth * 0.3048,
    }
    for step in _STEPS:
        text = f"it is in steps of {step:g} mm: multiply it by {step:g}, and say [truth] unit = 'mm'"
        readings[text] = truth * step
    if truth.shape[0] == truth.shape[1]:
        readings['rows and columns have changed places: [truth] axes = "WH" in import.toml'] = truth.T
    scores = {words: float(np.nanmedian(np.abs(t - tof))) for words, t in readings.items()}
    for info in _other_phases(view.tof.info):
        depth = Decoder(info).burst(view.tof.raw, float(np.mean(view.tof.celsius))).depth
        score = float(np.nanmedian(np.abs(truth - depth)))
        if score < _WRONG:
            degrees = [round(float(d), 3) for d in np.degrees(info.phase_rad) % 360]
            scores[
                f"the phases run the other way or begin elsewhere: [tof] phase_deg = {degrees} in import.toml"
            ] = score
    words = min(scores, key=lambda w: scores[w])
    return words if scores[words] * _BETTER < off else ""


def _other_phases(info: TofInfo) -> Iterator[TofInfo]:
    """List what the phases of all channels may be where no frame can tell: the other way round, and begun a quarter later."""
    for sign in (1, -1):
        for start in range(4):
            if (sign, start) != (1, 0):
                phases = [(sign * p + start * np.pi / 2) % (2 * np.pi) for p in info.phase_rad]
                yield replace(info, phase_rad=tuple(phases))
