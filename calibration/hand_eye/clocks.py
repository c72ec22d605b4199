"""Stamps of poses as seconds of one clock: their unit from the step, stray stamps left out, a clock that steps back cut there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError
from tofcapture.poses import Float64

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
WALL = (9e8, 4.1e9)  # s since 1970 in the years 1998 to 2099
WALL_TELLS = 4.0  # how much a stamp of that size counts, in e-foldings of the step
USUAL_STEP = 0.03  # s between poses of arms and cameras
SPEEDS = (0.002, 6.0)  # rad/s: slower than that nothing moves, faster no arm turns
STRAY = 50.0  # spreads of the middle stamps away from the median
PAUSE = 3600.0  # s without a pose: another recording
SWAPPED = 5.0  # steps by which neighbours may be out of order
LONGEST = 2e5  # s; more than two days of poses is no calibration
LEAST = 10  # poses


@dataclass(frozen=True)
class Clock:
    """What became of N stamps."""

    kept: NDArray[np.intp]  #: (M,) poses whose stamps are good, in order of time
    seconds: Float64  #: (M,) ascending
    unit: str  #: s, ms, us or ns
    said: tuple[str, ...]  #: What was left out, and how the stamps were read


def read_clock(stamps: Float64, R: Float64, name: str) -> Clock:
    """Bring the stamps (N,) of rotations (N, 3, 3) in order; :class:`DataError` where fewer than ten poses are left."""
    kept = np.flatnonzero(np.isfinite(stamps))
    said = [f"{len(stamps) - len(kept)} stamps are NaN"] if len(kept) < len(stamps) else []
    kept = _without_strays(stamps, kept, said)
    unit = _unit(stamps[kept], R[kept]) if len(kept) > 1 else "s"
    t = stamps * SECONDS[unit]
    kept = _one_run(t, R, kept, said)
    kept = kept[np.r_[True, np.diff(t[kept]) > 0]] if len(kept) else kept
    if len(kept) < LEAST:
        raise DataError(
            f"{name}: expected at least {LEAST} poses of distinct times in one run of the clock, got {len(kept)} of {len(stamps)}",
            "; ".join(said),
        )
    if t[kept[-1]] - t[kept[0]] > LONGEST:
        raise DataError(
            f"{name}: expected times of one recording, got {(t[kept[-1]] - t[kept[0]]) / 3600:.0f} hours read as {unit}",
            "write the times in seconds",
        )
    step = float(np.median(np.diff(t[kept])))
    return Clock(kept, t[kept], unit, (f"stamps in {unit}, {1e3 * step:.3g} ms apart", *said))


def _without_strays(stamps: Float64, kept: NDArray[np.intp], said: list[str]) -> NDArray[np.intp]:
    """Leave out stamps that are of no clock: a zero among wall-clock times, single ones that jump and come back."""
    t = stamps[kept]
    low, middle, high = np.quantile(t, [0.1, 0.5, 0.9]) if len(t) else (0.0, 0.0, 0.0)
    good = np.abs(t - middle) <= STRAY * max(high - low, 1e-12)
    before, after = np.r_[-np.inf, t[:-1]], np.r_[t[1:], np.inf]
    usual = float(np.median(np.abs(np.diff(t)))) if len(t) > 1 else 0.0
    beyond = np.maximum(before - t, t - after) > SWAPPED * usual
    good &= ~(beyond & (before <= after) & np.isfinite(before) & np.isfinite(after))
    if not good.all():
        bad = kept[~good]
        said.append(f"{len(bad)} stray stamps left out, such as {stamps[bad[0]]:.9g} at pose {bad[0]}")
    return kept[good]


def _unit(stamps: Float64, R: Float64) -> str:
    """Unit of stamps: by the size of a wall clock's, else by the step and by how fast an arm may turn."""
    size, moved = float(np.median(np.abs(stamps))), np.abs(np.diff(stamps))
    step = float(np.median(moved[moved > 0], axis=None)) if (moved > 0).any() else 1.0
    turned = 2 * np.arcsin(np.minimum(np.linalg.norm(np.diff(R, axis=0), axis=(1, 2)) / np.sqrt(8), 1))
    turn = float(np.quantile(turned, 0.75))

    def cost(unit: str) -> float:
        seconds = step * SECONDS[unit]
        speed = turn / seconds
        outside = max(np.log(SPEEDS[0] / max(speed, 1e-12)), np.log(max(speed, 1e-12) / SPEEDS[1]), 0.0)
        wall = WALL[0] < size * SECONDS[unit] < WALL[1]
        return float(abs(np.log(seconds / USUAL_STEP)) + 2 * outside - WALL_TELLS * wall)

    return min(SECONDS, key=cost)


def _one_run(t: Float64, R: Float64, kept: NDArray[np.intp], said: list[str]) -> NDArray[np.intp]:
    """Sort rows that are merely out of order; where the clock itself stepped, keep its longest run."""
    step = np.diff(t[kept])
    back = step < 0
    if not back.any() and not (step > PAUSE).any():
        return kept
    order = kept[np.argsort(t[kept], kind="stable")]
    usual = float(np.median(np.abs(step)))
    if back.any() and ((-step[back] <= SWAPPED * usual).all() or _way(R[order]) < 0.8 * _way(R[kept])):
        said.append(f"{int(back.sum())} poses out of order of time: sorted")
        kept, back, step = order, np.zeros(len(step), bool), np.diff(t[order])
    cuts = np.flatnonzero(back | (step > PAUSE))
    runs = np.split(kept, cuts + 1)
    longest = max(runs, key=len)
    for cut in cuts[:3]:
        what = "steps back" if step[cut] < 0 else "jumps"
        said.append(f"the clock {what} by {abs(step[cut]):.6g} s at pose {kept[cut + 1]}")
    if len(cuts):
        said.append(
            f"only its longest run is used, {len(longest)} of {len(kept)} poses from pose {longest[0]}"
        )
    return longest


def _way(R: Float64) -> float:
    return float(np.linalg.norm(np.diff(R, axis=0), axis=(1, 2)).sum())
