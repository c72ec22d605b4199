"""Why an alignment failed: wrong units, a swapped transform, mirrored axes, blind cameras, views that do not belong together.

Asked only after a failure, so it may read views again and try registrations that nobody would start with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.registration.clouds import WORKING_DEPTH, Cloud
from calibration.registration.gate import Refusal, Registration, check_registration
from calibration.registration.pairs import Pair
from tofcapture.errors import ConfigError, DataError, QualityError, TofError
from tofcapture.frames import View
from tofcapture.poses import Float64, invert

Register = Callable[[Pair, Float64], Registration]

APART = 1.0  # m between two cameras on one bracket; a rig in millimetres is far beyond
MILLIMETRES = 50.0  # m; no calibration board stands there
TRIED = 3  # pairs that a suspicion is tried on
MIRRORS = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0)}
CAUSES = {
    Refusal.EMPTY: "no board between 0.2 and 1.8 m in the views: too far, dark, saturated, or hidden",
    Refusal.NO_OVERLAP: "the cameras did not look at the same board at the same time, or the initial guess is far off",
    Refusal.PLANAR: "no rims in sight: use a board with cut-outs, 4 cm or more in front of what is behind it",
    Refusal.DIVERGED: "the initial guess is far off, or ToF and stereo images come from different views or different boards",
    Refusal.NOT_CONVERGED: "ToF and stereo images come from different views or different boards, or the board moved",
    Refusal.POOR_FIT: "ToF and stereo images come from different views or different boards, or the board moved",
}


def check_start(T_tof_stereo: Float64) -> None:
    """Refuse an initial guess that no rig can have.

    Raises
    ------
    ConfigError
        Not finite, or cameras farther apart than a metre.
    """
    apart = float(np.linalg.norm(T_tof_stereo[:3, 3]))
    if np.isfinite(T_tof_stereo).all() and apart < APART:
        return
    raise ConfigError(
        f"initial T_tof_stereo: expected cameras less than {APART:g} m apart, got {apart:.4g} m",
        hint="rig.toml is in metres; is this one in millimetres?",
    )


def explained(
    error: QualityError,
    recording: Path,
    pairs: Sequence[Pair],
    refusals: Sequence[Refusal | None],
    guess: Float64,
    register: Register,
) -> TofError:
    """Find the likely cause of a failed alignment.

    Parameters
    ----------
    error
        What was raised.
    recording, pairs, refusals
        What was aligned, and why which pair was refused.
    guess
        (4, 4) ``T_stereo_tof`` that it started from.
    register
        Registers a pair from a start.

    Returns
    -------
    TofError
        :class:`DataError` or :class:`ConfigError` where one cause is certain, else ``error`` with its likely cause.
    """
    from tofcapture.files.view import read_view

    failed = [p for p, refusal in zip(pairs, refusals, strict=True) if refusal is not None]
    for pair in failed[:TRIED]:
        if (found := unusable(read_view(recording / pair.name), pair.name)) is not None:
            return found
    full = [p for p in failed if len(p.source) and len(p.target)][:TRIED]
    if full and _fits(full, invert(guess), register):
        return ConfigError(
            f"{error.message}; from the inverse of the initial transform the views fit",
            hint="the initial transform is swapped: T_tof_stereo maps stereo points into the ToF frame",
        )
    for axis, signs in MIRRORS.items():
        if full and _fits([_mirrored(p, np.array(signs)) for p in full], guess, register):
            return DataError(
                f"{error.message}; with {axis} of the stereo points turned round the views fit",
                hint=f"the stereo driver's {axis} axis is mirrored: expected x right, y down, z forward",
            )
    common = Counter(r for r in refusals if r is not None).most_common(1)
    return QualityError(error.message, hint=f"likely cause: {CAUSES[common[0][0]]}") if common else error


def unusable(view: View, name: str) -> DataError | None:
    """Say what makes a view useless whatever the rig: blind cameras, millimetres, points behind the camera."""
    z = view.stereo.points[..., 2]
    finite = z[np.isfinite(z)]
    if not len(finite):
        return DataError(
            f"{name}: the stereo camera gave no point at all",
            hint="expected points in metres, NaN only where nothing was measured; is the projector on, the exposure right?",
        )
    median = float(np.median(finite))
    if abs(median) > MILLIMETRES:
        return DataError(
            f"{name}: expected stereo points in metres, got a median depth of {median:.0f}",
            hint="the driver gives millimetres: divide by 1000",
        )
    if median < 0:
        return DataError(
            f"{name}: the stereo points lie behind the camera, median z {median:.3f} m",
            hint="expected x right, y down, z forward; the driver has y up and z backward",
        )
    if not (view.tof.raw.max(axis=(0, 2, 3)) > view.tof.raw.min(axis=(0, 2, 3))).any():
        return DataError(
            f"{name}: the ToF frames show nothing, every pixel reads the same",
            hint="is the illuminator on, and the lens cap off?",
        )
    near, far = WORKING_DEPTH
    if not ((finite > near) & (finite < far)).any():
        return DataError(
            f"{name}: expected a board {near} to {far} m away, got a median depth of {median:.2f} m",
            hint="move the board nearer, or check the unit of the stereo points",
        )
    return None


def _mirrored(pair: Pair, signs: Float64) -> Pair:
    return replace(pair, target=Cloud(pair.target.points * signs, pair.target.normals * signs))


def _fits(pairs: Sequence[Pair], start: Float64, register: Register) -> bool:
    """Tell whether most pairs pass the gate from another start."""
    good = [check_registration(register(p, start), p.source, p.target, start) is None for p in pairs]
    return 2 * sum(good) > len(good)
