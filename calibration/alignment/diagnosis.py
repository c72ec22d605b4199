"""Say why an alignment failed: wrong units, a swapped transform, mirrored axes, blind cameras, views that do not belong together.

Asked only after a failure, so it may read views again and try registrations that nobody would start with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from calibration.alignment.rounds import RefusedPairsError, find_start
from calibration.registration.clouds import WORKING_DEPTH, Cloud
from calibration.registration.gate import Refusal, check_registration, register
from calibration.registration.pairs import Pair
from tofcapture.errors import ConfigError, DataError, QualityError, TofError
from tofcapture.files.view import open_view
from tofcapture.frames import View
from tofcapture.pool import Pool
from tofcapture.poses import Float64, invert, rotation_angle

APART = 1.0  # m between two cameras on one bracket; a rig in millimetres is far beyond
MILLIMETRES = 50.0  # m; no calibration board stands there
TRIED = 3  # pairs that a suspicion is tried on
MIRRORS = {"x": (-1, 1, 1), "y": (1, -1, 1)}
_MIXED = "ToF and stereo images come from different views or different boards, or the board moved"
CAUSES = {
    Refusal.EMPTY: "no board between 0.2 and 1.8 m in the views: too far, dark, saturated, or hidden",
    Refusal.NO_OVERLAP: "the cameras did not look at the same board at the same time, or the initial guess is far off",
    Refusal.PLANAR: "no rims in sight: use a board with cut-outs, 4 cm or more in front of what is behind it",
    Refusal.DIVERGED: "the initial guess is far off, or ToF and stereo images come from different views or different boards",
    Refusal.CONTRADICTED: "the initial guess is far off, the board looks alike when turned, or it moved between the two cameras",
    Refusal.UNCLEAR: "the initial guess is far off, or the board looks alike when turned",
    Refusal.NOT_CONVERGED: _MIXED,
    Refusal.POOR_FIT: _MIXED,
}


def check_start(T_tof_stereo: Float64) -> None:
    """Refuse an initial guess that no rig can have: not finite, or cameras farther apart than a metre (:class:`ConfigError`)."""
    apart = float(np.linalg.norm(T_tof_stereo[:3, 3]))
    if np.isfinite(T_tof_stereo).all() and apart < APART:
        return
    raise ConfigError(
        f"initial T_tof_stereo: expected cameras less than {APART:g} m apart, got {apart:.4g} m",
        hint="rig.toml is in metres; is this one in millimetres?",
    )


def explained(
    error: RefusedPairsError, recording: Path, pairs: Sequence[Pair], backend: str, T_tof_stereo: Float64
) -> TofError:
    """Find the likely cause of a failed alignment.

    It is a :class:`DataError` or :class:`ConfigError` where one cause is certain, else ``error`` with its likely cause.
    ``T_tof_stereo`` (4, 4) is what the alignment started from.
    """
    failed = [p for p, refusal in zip(pairs, error.refusals, strict=True) if refusal is not None]
    for pair in failed[:TRIED]:
        if (found := unusable(open_view(recording / pair.name), pair.name)) is not None:
            return found
    full = [p for p in failed if len(p.source) and len(p.target)][:TRIED]
    with Pool(1, pinned=True) as pool:

        def fits(signs: Sequence[int], start: Float64) -> bool:
            """Tell whether most pairs, their stereo points mirrored by ``signs``, pass the gate from another start."""
            good = 0
            for p in full:
                mirror = np.array(signs)
                target = Cloud(p.target.points * mirror, p.target.normals * mirror)
                result = pool.call(register, backend, p.source, target, start)
                good += check_registration(result, p.source, target, start) is None
            return 2 * good > len(full)

        if fits((1, 1, 1), T_tof_stereo):
            return ConfigError(
                f"{error.message}; from the inverse of the initial transform the views fit",
                hint="the initial transform is swapped: T_tof_stereo maps stereo points into the ToF frame",
            )
        for axis, signs in MIRRORS.items():
            if fits(signs, invert(T_tof_stereo)):
                return DataError(
                    f"{error.message}; with {axis} of the stereo points turned round the views fit",
                    hint=f"the stereo driver's {axis} axis is mirrored: expected x right, y down, z forward",
                )
        off = _free_start(pool, full, T_tof_stereo)
    if off:
        return QualityError(error.message, hint=off)
    common = Counter(r for r in error.refusals if r is not None).most_common(1)
    return QualityError(error.message, hint=f"likely cause: {CAUSES[common[0][0]]}") if common else error


def _free_start(pool: Pool, pairs: Sequence[Pair], T_tof_stereo: Float64) -> str:
    """Say how far the initial guess is from where the views fit without it; empty where they do not."""
    with suppress(QualityError):
        moved = find_start(pairs, pool) @ T_tof_stereo
        turned, shift = np.degrees(rotation_angle(moved)), 1e3 * np.linalg.norm(moved[:3, 3])
        return (
            f"likely cause: the initial guess is far off. Without one the views fit {turned:.0f} degrees and {shift:.0f} mm away "
            "from it: --initial none"
        )
    return ""


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
