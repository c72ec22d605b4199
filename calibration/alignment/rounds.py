"""Register, gate and average cloud pairs, and take off the range error that they share.

A demodulation that is not a pure sine makes planes wavy by millimetres even after a factory calibration, and ICP tilts to follow
the waves. The error is common to all views, so that the residuals of all pairs determine it together (method.md 0.4, 6):
``e = o + p rho + sum_m a_m cos(m k r) + b_m sin(m k r)``, with r the distance along the ray, ``k = 4 pi f / c`` and rho the
pixel's distance to the principal point. The offset o is told from a translation along the optical axis by the rims.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.alignment.averages import Average, average_transforms
from calibration.range_error.terms import SIMPLE, Terms
from calibration.registration.gate import (
    COARSE_TO_FINE,
    FINE,
    Refusal,
    Registration,
    check_clouds,
    check_registration,
    register,
    residuals,
    tukey_weights,
)
from calibration.registration.pairs import Pair
from calibration.registration.search import clear_answer, same_answer
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.errors import QualityError, TofError
from tofcapture.pool import Pool
from tofcapture.poses import Float64, invert, transform_points
from tofcapture.rig import RangeError

MIN_PAIRS = 3  # below this no pair can be told from an outlier
REFINEMENTS = 2  # rounds of range residual and registration after the first; a third changes 0.1 mm
# One sigma of what a factory calibration leaves: m, m/px, and m for each wave.
PRIOR = np.array([0.002, 3e-5, *[0.003] * (len(SIMPLE) - 2)])
NOISE = 0.011  # m, one sigma of a residual as if independent: 2 mm times the root of ~30 neighbours that share their bias
STRIDE = 4  # source points skipped; thousands per view remain

Progress = Callable[[str, int, int], None]


class RefusedPairsError(QualityError):
    """Too few pairs passed the gate; ``refusals`` says why which did not."""

    def __init__(self, message: str, hint: str, refusals: Sequence[Refusal | None]) -> None:
        super().__init__(message, hint)
        self.refusals = list(refusals)


def free_of(error: RangeError, points: Float64, camera: Camera) -> Float64:
    """Move points (N, 3) of the ToF frame along their rays to where they would be without a range error."""
    radial, radius = _range_and_radius(points, camera)
    phase = 4 * np.pi * error.modulation_hz / SPEED_OF_LIGHT * radial
    out: Float64 = points * (1 - error.at(phase, radius, error.reference_celsius) / radial)[:, None]
    return out


def _range_and_radius(points: Float64, camera: Camera) -> tuple[Float64, Float64]:
    """Ranges (N,) of points (N, 3), metres, and their pixels' distances (N,) to the principal point."""
    radius = np.linalg.norm(points[:, :2] / points[:, 2:] * [camera.fx, camera.fy], axis=-1)
    return np.linalg.norm(points, axis=-1), radius


def find_start(pairs: Sequence[Pair], pool: Pool) -> Float64:
    """Find ``T_stereo_tof`` (4, 4) without a guess: what two views, each clear by itself, say alike.

    :class:`QualityError` where no two do.
    """
    found: list[Float64] = []
    for pair in pairs:
        empty = check_clouds(pair.source, pair.target) is not None
        T: Float64 | None = None if empty else pool.call(clear_answer, pair.source, pair.target)
        if T is not None and any(same_answer(T, other) for other in found):
            return T
        found += [] if T is None else [T]
    raise QualityError(
        f"no start without a guess: of {len(pairs)} views {len(found)} tell one answer by themselves, and no two the same",
        hint="pass --initial rig.toml with the bracket's drawing, good to 5 degrees and 5 cm",
    )


@dataclass(frozen=True)
class Solution:
    """An alignment after a round."""

    #: One per pair; refusal None where the gate let the pair through
    registrations: list[Registration]
    refusals: list[Refusal | None]
    average: Average  #: Of the pairs that passed, ``T_stereo_tof``
    passed: list[int]  #: Indices of the pairs that passed the gate, in the order of ``average``
    working_point: Float64  #: (3,) ToF frame, metres: mean of the centroids of the matched points
    residual: RangeError  #: Range error that was taken off the ToF points of this round

    @property
    def used(self) -> list[int]:
        """Indices of the pairs in the average."""
        return [i for i, kept in zip(self.passed, self.average.kept, strict=True) if kept]


def solve(
    pairs: Sequence[Pair],
    backend: str,
    T_tof_stereo: Float64,
    progress: Progress = lambda _stage, _done, _total: None,
) -> Solution:
    """Align cloud pairs: register, gate, average; then take off the common range error and do it again, twice.

    ``T_tof_stereo`` (4, 4) is the initial guess; ``progress`` is called with a stage, steps done and steps in all.
    :class:`RefusedPairsError` where fewer than three pairs pass the gate or survive as inliers.
    """
    guess = T = invert(T_tof_stereo)
    residual, camera = RangeError(pairs[0].modulation_hz), pairs[0].rig.tof
    distances: Sequence[float] = COARSE_TO_FINE
    with Pool(1, pinned=True) as pool:
        for n in range(1 + REFINEMENTS):
            corrected = [replace(p, source=free_of(residual, p.source, camera)) for p in pairs]
            found = _registered(pool, backend, corrected, T, distances, progress, n * len(pairs))
            gated = zip(found, corrected, strict=True)
            refusals = [check_registration(r, p.source, p.target, guess) for r, p in gated]
            solution = _averaged(found, refusals, residual)
            if n < REFINEMENTS:
                used = solution.used
                residual = fit_range_residual(
                    [corrected[i] for i in used], [found[i] for i in used], residual
                )
            T, distances = solution.average.T, FINE
    return solution


def _registered(
    pool: Pool,
    backend: str,
    pairs: Sequence[Pair],
    T_start: Float64,
    distances: Sequence[float],
    progress: Progress,
    done: int,
) -> list[Registration]:
    tasks = [(backend, p.source, p.target, T_start, distances) for p in pairs]
    found: dict[int, Registration] = {}
    for i, result in pool.run(register, tasks):
        if isinstance(result, TofError):
            raise result
        progress("registering", done + len(found), len(pairs) * (1 + REFINEMENTS))
        found[i] = result
    return [found[i] for i in range(len(pairs))]


def _averaged(results: list[Registration], refusals: list[Refusal | None], residual: RangeError) -> Solution:
    passed = [i for i, refusal in enumerate(refusals) if refusal is None]
    demand_pairs(len(passed), refusals)
    chosen = [results[i] for i in passed]
    c = np.mean([transform_points(invert(r.T_target_source), r.centre) for r in chosen], axis=0)
    average = average_transforms([r.T_target_source for r in chosen], c)
    demand_pairs(int(average.kept.sum()), refusals)
    return Solution(results, refusals, average, passed, c, residual)


def demand_pairs(good: int, refusals: Sequence[Refusal | None]) -> None:
    """Raise :class:`RefusedPairsError` where fewer than three pairs are good."""
    if good >= MIN_PAIRS:
        return
    reasons = Counter(str(r) for r in refusals if r is not None).most_common()
    listed = ", ".join(f"{count} {reason}" for reason, count in reasons) or "no other failed the gate"
    raise RefusedPairsError(
        f"expected at least {MIN_PAIRS} good calibration pairs, got {good} of {len(refusals)}: {listed}",
        "record more board views, tilted 15 to 40 degrees in all directions, or pass a better --initial rig.toml",
        refusals,
    )


def fit_range_residual(
    pairs: Sequence[Pair], registrations: Sequence[Registration], start: RangeError
) -> RangeError:
    """Estimate the range error from pairs, already corrected by ``start``, and their registrations.

    One linear least-squares problem in the shared coefficients and in a small motion of every pair, without which a pair's
    wrong pose would be explained by waves. Robust by Tukey's weights; a Gaussian prior keeps what the ranges at hand do not
    determine at zero.
    """
    H = np.diag((NOISE / PRIOR) ** 2)
    waves = [x for _, *amplitudes in start.harmonics for x in amplitudes] or [0.0] * (len(SIMPLE) - 2)
    g = -H @ np.array([start.offset, start.per_pixel_radius, *waves])
    terms = Terms(start.modulation_hz)
    for pair, result in zip(pairs, registrations, strict=True):
        source = pair.source[::STRIDE]
        found = residuals(source, pair.target, result.T_target_source)
        points = source[found.source]
        rays = points / np.linalg.norm(points, axis=-1)[:, None] @ result.T_target_source[:3, :3].T
        columns = terms.columns(*_range_and_radius(points, pair.rig.tof))
        error = columns * (found.normals * rays).sum(axis=-1)[:, None]
        J, weights = found.jacobian(result.centre), tukey_weights(found.distance)[:, None]
        # Schur complement: what the pair's own motion explains is taken out.
        motion = np.linalg.pinv((J * weights).T @ J)
        cross = (error * weights).T @ J
        H += (error * weights).T @ error - cross @ motion @ cross.T
        g += (error * weights).T @ found.distance - cross @ motion @ ((J * weights).T @ found.distance)
    return terms.added(start, np.linalg.solve(H, g))
