"""Scenes that hardly hold the pose one way: tried from places along that way.

A low object on a table leaves a turn about its normal, or a slide along it, to a few rays. Noise gives such a valley hollows of
its own, and Newton steps rest in the first. So the valley is walked at some millimetres a stride, each place is refined, and
what explains most rays at the scale of the noise is kept.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calibration.projective.newton import Match, moved, tukey
from calibration.registration import MIN_POINTS
from tofcapture.poses import Float64

WEAK = (
    350.0  # a motion is weak where the strongest holds so many times better, by unweighted normal equations
)
STRIDES = 0.005 * np.array([-3, -2, -1, 1, 2, 3])  # m of motion at the mean radius along a weak motion
MOST = 2  # motions tried

Refine = Callable[[Float64], tuple[Float64, Match]]


def along_weak_motions(
    T: Float64, ways: list[Float64], centre: Float64, refine: Refine, kernel: float
) -> Float64:
    """Walk along motions and return the place (4, 4) that explains most rays.

    Parameters
    ----------
    T
        (4, 4) where the pose rests.
    ways, centre
        From :func:`weak_motions`.
    refine
        Some steps from a transform: where they end, and the rays there.
    kernel
        Tukey's scale in standard deviations of the noise model.
    """
    best = refine(T)
    for way in ways:
        found = [best, *(refine(moved(best[0], stride * way, centre)) for stride in STRIDES)]
        best = min(found, key=lambda one: unexplained(one[1], kernel))
    return best[0]


def weak_motions(H: Float64, radius: float) -> list[Float64]:
    """Weak motions (6,) of one metre at the mean radius, weakest first, by unweighted normal equations (6, 6)."""
    even = np.repeat([1, 1 / radius], 3)
    values, vectors = np.linalg.eigh(H * even * even[:, None])
    return [even * vectors[:, i] for i in range(MOST) if values[i] * WEAK < values[-1]]


def unexplained(match: Match, kernel: float) -> float:
    """Share of the rays in the stereo camera's view that no surface explains at the scale of the noise."""
    u = match.distance / (kernel * np.sqrt(match.variance))
    return 1 - float(np.sum(tukey(u))) / max(match.seen, MIN_POINTS)
