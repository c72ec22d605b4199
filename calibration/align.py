"""``align``: from the board views of a recording to ``rig.toml``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.alignment.averaged_icp import Average, average_transforms
from calibration.alignment.diagnosis import check_start, explained
from calibration.alignment.methods import apply_method, method_named
from calibration.alignment.range_residual import RangeResidual, fit_range_residual, no_residual
from calibration.evidence.evidence import evidence_of, write_evidence
from calibration.registration.backends import COARSE_TO_FINE, FINE, backend_named, register
from calibration.registration.gate import Refusal, Registration, check_registration
from calibration.registration.pairs import Pair, calibration_views, load_pair
from calibration.registration.pinned import pinned_worker
from tofcapture.errors import DataError, QualityError, TofError
from tofcapture.files.seal import write_text
from tofcapture.poses import Float64, invert
from tofcapture.rig import Rig, dumps_rig

MIN_PAIRS = 3  # below this no pair can be told from an outlier
REFINEMENTS = 2  # rounds of range residual and registration after the first; a third changes 0.1 mm

Progress = Callable[[str, int, int], None]


class RefusedPairsError(QualityError):
    """Too few pairs passed the gate; ``refusals`` says why which did not."""

    def __init__(self, message: str, hint: str, refusals: Sequence[Refusal | None]) -> None:
        super().__init__(message, hint)
        self.refusals = list(refusals)


@dataclass(frozen=True)
class Solution:
    """The state of an alignment after a round.

    Attributes
    ----------
    registrations, refusals
        One per pair; refusal None where the gate let the pair through.
    average
        Of the pairs that passed, ``T_stereo_tof``.
    passed
        Indices of the pairs that passed the gate, in the order of ``average``.
    working_point
        (3,) ToF frame, metres: mean of the centroids of the matched points.
    residual
        Range error that was taken off the ToF points of this round.
    """

    registrations: list[Registration]
    refusals: list[Refusal | None]
    average: Average
    passed: list[int]
    working_point: Float64
    residual: RangeResidual

    @property
    def used(self) -> list[int]:
        """Indices of the pairs in the average."""
        return [i for i, kept in zip(self.passed, self.average.kept, strict=True) if kept]


def align(
    recording: Path,
    backend: str = "open3d",
    initial: Rig | None = None,
    progress: Progress = lambda _stage, _done, _total: None,
    method: str = "averaged",
) -> tuple[Rig, dict[str, Any]]:
    """Align the cameras of a recording by averaged ICP; write ``evidence.json``, then ``rig.toml``.

    Every ToF cloud is registered into the stereo cloud of its view, gated, and the transforms are averaged; the range error
    common to all views is estimated from what remains and taken off, twice. Same input, same bytes.

    Parameters
    ----------
    recording
        Folder with ``views/calibration/view-*.h5``.
    backend
        ``open3d``, ``kiss-icp`` or ``small-gicp``.
    initial
        Rig to start from; by default the one the first view carries.
    progress
        Called with a stage, steps done and steps in all.
    method
        ``averaged`` as in the paper, ``weighted`` by each pair's information, or ``joint``: one robust problem over all
        accepted views that starts at the average and finds the range errors too.

    Returns
    -------
    rig
        The initial rig with the new ``T_tof_stereo``.
    evidence
        What ``evidence.json`` holds.

    Raises
    ------
    DataError
        No calibration views, unreadable ones, views of different cameras, in millimetres, mirrored or blind.
    ConfigError
        Unknown backend, or its library is missing; an initial guess in millimetres or swapped.
    QualityError
        Fewer than three pairs pass the gate, with the likely cause; nothing is written then.
    """
    backend_named(backend)
    method_named(method)
    recording = Path(recording)
    paths = calibration_views(recording)
    _demand(len(paths), [None] * len(paths))
    pairs = []
    for i, path in enumerate(paths):
        progress("reading", i, len(paths))
        pairs.append(load_pair(recording, path))
    start = _common_rig(pairs) if initial is None else initial
    check_start(start.T_tof_stereo)
    try:
        solution = solve(pairs, backend, start.T_tof_stereo, progress)
    except RefusedPairsError as err:
        raise _explained(err, recording, pairs, backend, invert(start.T_tof_stereo)) from None
    aligned = apply_method(method, recording, pairs, solution, start)
    rig = aligned.rig
    evidence = evidence_of(pairs, solution, backend, start.T_tof_stereo, rig.T_tof_stereo) | aligned.evidence
    write_evidence(recording / "evidence.json", evidence)
    write_text(recording / "rig.toml", dumps_rig(rig))
    return rig, evidence


def solve(
    pairs: Sequence[Pair],
    backend: str,
    T_tof_stereo: Float64,
    progress: Progress = lambda _stage, _done, _total: None,
) -> Solution:
    """Register, gate and average cloud pairs, and take off the range error they share.

    Parameters
    ----------
    pairs
        N >= 3 cloud pairs.
    backend
        Name of a registration backend.
    T_tof_stereo
        (4, 4) initial guess.
    progress
        As in :func:`align`.

    Raises
    ------
    QualityError
        Fewer than three pairs pass the gate or survive as inliers.
    """
    guess = invert(T_tof_stereo)
    residual = no_residual(pairs[0].rig.tof, pairs[0].modulation_hz)
    with pinned_worker() as worker:
        run = _Rounds(worker, backend, guess, progress, len(pairs))
        solution = run.round(pairs, guess, COARSE_TO_FINE, residual)
        for _ in range(REFINEMENTS):
            residual = _next_residual(pairs, solution)
            solution = run.round([p.corrected(residual) for p in pairs], solution.average.T, FINE, residual)
    return solution


def _explained(
    error: RefusedPairsError, recording: Path, pairs: Sequence[Pair], backend: str, guess: Float64
) -> TofError:
    with pinned_worker() as worker:

        def again(pair: Pair, T_start: Float64) -> Registration:
            return worker.submit(
                register, backend, pair.source, pair.target, T_start, COARSE_TO_FINE
            ).result()

        return explained(error, recording, pairs, error.refusals, guess, again)


def _next_residual(pairs: Sequence[Pair], solution: Solution) -> RangeResidual:
    chosen = [pairs[i].corrected(solution.residual) for i in solution.used]
    return fit_range_residual(
        [p.source for p in chosen],
        [p.target for p in chosen],
        [solution.registrations[i] for i in solution.used],
        solution.residual,
    )


@dataclass
class _Rounds:
    """Registration rounds in one worker, with one progress count over all of them."""

    worker: ProcessPoolExecutor
    backend: str
    guess: Float64
    progress: Progress
    views: int
    done: int = 0

    def round(
        self, pairs: Sequence[Pair], T_start: Float64, distances: Sequence[float], residual: RangeResidual
    ) -> Solution:
        jobs = [
            self.worker.submit(register, self.backend, p.source, p.target, T_start, distances) for p in pairs
        ]
        results = []
        for job in jobs:
            self.progress("registering", self.done, self.views * (1 + REFINEMENTS))
            results.append(job.result())
            self.done += 1
        refusals = [
            check_registration(r, p.source, p.target, self.guess) for r, p in zip(results, pairs, strict=True)
        ]
        return _averaged(results, refusals, residual)


def _averaged(
    results: list[Registration], refusals: list[Refusal | None], residual: RangeResidual
) -> Solution:
    passed = [i for i, refusal in enumerate(refusals) if refusal is None]
    _demand(len(passed), refusals)
    c = np.mean([_in_source(results[i]) for i in passed], axis=0)
    average = average_transforms([results[i].T_target_source for i in passed], c)
    _demand(int(average.kept.sum()), refusals)
    return Solution(results, refusals, average, passed, c, residual)


def _in_source(result: Registration) -> Float64:
    back = invert(result.T_target_source)
    centre: Float64 = back[:3, :3] @ result.centre + back[:3, 3]
    return centre


def _demand(good: int, refusals: Sequence[Refusal | None]) -> None:
    if good >= MIN_PAIRS:
        return
    reasons = Counter(str(r) for r in refusals if r is not None)
    listed = (
        ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        or "no other failed the gate"
    )
    raise RefusedPairsError(
        f"expected at least {MIN_PAIRS} good calibration pairs, got {good} of {len(refusals)}: {listed}",
        "record more board views, tilted 15 to 40 degrees in all directions, or pass a better --initial rig.toml",
        refusals,
    )


def _common_rig(pairs: Sequence[Pair]) -> Rig:
    first = pairs[0].rig
    for pair in pairs[1:]:
        if (pair.rig.tof, pair.rig.stereo) != (first.tof, first.stereo):
            raise DataError(
                f"{pair.name}: taken with other cameras than {pairs[0].name}",
                hint="use one recording per rig",
            )
    return first
