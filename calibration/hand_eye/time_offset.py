"""Time offset between two streams of poses, and pairs of one moment from them.

The rotation speed of a rigid body is the same number in every frame that is fixed to it, so the speeds of hand and camera
are one signal, seen twice: cross-correlation finds the offset to a sample, the hand-eye likelihood refines it below one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.hand_eye.checks import clean
from calibration.hand_eye.refusal import Cause, HandEyeRefused
from tofcapture.errors import DataError
from tofcapture.poses import Float64

STEP = 0.01  # s between samples of the speed
WINDOW = 0.1  # s over which a speed is taken: longer than a camera's frame, shorter than a swing of the arm
LEAST_OVERLAP = 0.3  # of the shorter stream
LEAST_CORRELATION = 0.5
RIVAL = 0.9  # a second peak this high makes the offset ambiguous
NEIGHBOURHOOD = 1.0  # s around the peak in which no rival is sought
GAP = 0.25  # s; poses farther apart are not interpolated
PAIRS = 200  # pairs kept of a stream: neighbours share their errors and add nothing


@dataclass(frozen=True)
class Stream:
    """Time-stamped poses.

    Attributes
    ----------
    seconds
        (N,) ascending.
    poses
        (N, 4, 4).
    """

    seconds: Float64
    poses: Float64


def make_stream(seconds: ArrayLike, poses: ArrayLike, name: str) -> Stream:
    """Check and sort a stream.

    Raises
    ------
    DataError
        Times that are not finite or not distinct, poses that are not rigid, fewer than ten.
    """
    t, T = np.asarray(seconds, dtype=np.float64), clean(poses, name)
    if t.shape != (len(T),) or not np.isfinite(t).all():
        raise DataError(f"{name}: expected one finite time per pose, got {t.shape} for {len(T)} poses")
    order = np.argsort(t, kind="stable")
    t, T = t[order], T[order]
    once = np.concatenate([[True], np.diff(t) > 0])
    if once.sum() < 10:
        raise DataError(f"{name}: expected at least 10 poses of distinct times, got {int(once.sum())}")
    return Stream(t[once], T[once])


def at_times(stream: Stream, seconds: Float64) -> tuple[Float64, NDArray[np.bool_]]:
    """Interpolate poses: slerp and linear.

    Returns
    -------
    poses
        (M, 4, 4).
    usable
        (M,) bool; False outside the stream and inside gaps.
    """
    from scipy.spatial.transform import Rotation, Slerp

    t = stream.seconds
    inside = np.clip(seconds, t[0], t[-1])
    out = np.zeros((len(seconds), 4, 4))
    out[:, :3, :3] = Slerp(t, Rotation.from_matrix(stream.poses[:, :3, :3]))(inside).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(inside, t, stream.poses[:, axis, 3])
    out[:, 3, 3] = 1
    after = np.clip(np.searchsorted(t, inside), 1, len(t) - 1)
    usable = (seconds == inside) & (t[after] - t[after - 1] <= GAP)
    return out, np.asarray(usable)


def rotation_speed(stream: Stream) -> tuple[Float64, Float64]:
    """Rotation speed on a grid of ``STEP``: times (M,) and rad/s (M,), NaN where unknown."""
    from scipy.spatial.transform import Rotation

    grid = np.arange(stream.seconds[0], stream.seconds[-1], STEP)
    (before, known), (after, also) = (at_times(stream, grid + s * WINDOW / 2) for s in (-1, 1))
    turned = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]).magnitude()
    return grid, np.where(known & also, turned / WINDOW, np.nan)


def coarse_offset(hand: Stream, target: Stream) -> tuple[float, float]:
    """Offset by cross-correlation of the rotation speeds.

    Returns
    -------
    offset
        Seconds; the hand pose at ``t + offset`` belongs to the target pose at ``t``.
    correlation
        Pearson's, at the peak.

    Raises
    ------
    HandEyeRefused
        No correlation, or two offsets that fit alike (periodic motion).
    """
    (t_hand, a), (t_target, b) = rotation_speed(hand), rotation_speed(target)
    lags, correlation = _correlation(a, b)
    if not np.isfinite(correlation).any() or np.nanmax(correlation) < LEAST_CORRELATION:
        best = float(np.nanmax(correlation)) if np.isfinite(correlation).any() else float("nan")
        raise HandEyeRefused(
            Cause.TIME_OFFSET,
            f"expected rotation speeds that correlate by {LEAST_CORRELATION} or more, got {best:.2f}",
            "the streams may be of different recordings; rotate the hand briskly and irregularly while recording",
        )
    peak = int(np.nanargmax(correlation))
    away = np.abs(lags - lags[peak]) * STEP > NEIGHBOURHOOD
    rival = float(np.nanmax(correlation[away], initial=-1.0))
    if rival > RIVAL * correlation[peak]:
        raise HandEyeRefused(
            Cause.TIME_OFFSET,
            f"two offsets fit alike (correlations {correlation[peak]:.3f} and {rival:.3f})",
            "the motion repeats itself: move irregularly",
        )
    return float(t_hand[0] - t_target[0] + lags[peak] * STEP), float(correlation[peak])


def _correlation(a: Float64, b: Float64) -> tuple[Float64, Float64]:
    """Pearson correlation of ``a[n + lag]`` with ``b[n]`` over the known samples of each overlap."""
    from scipy.signal import fftconvolve

    def cross(x: Float64, y: Float64) -> Float64:
        return np.asarray(fftconvolve(x, y[::-1]))

    m_a, m_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    x, y = np.nan_to_num(a - np.nanmean(a)), np.nan_to_num(b - np.nanmean(b))
    n = cross(m_a, m_b)
    enough = n > max(LEAST_OVERLAP * min(m_a.sum(), m_b.sum()), 50)
    n = np.where(enough, n, np.nan)
    s_x, s_y = cross(x, m_b), cross(m_a, y)
    variance = (cross(x * x, m_b) - s_x**2 / n) * (cross(m_a, y * y) - s_y**2 / n)
    with np.errstate(invalid="ignore", divide="ignore"):
        out = (cross(x, y) - s_x * s_y / n) / np.sqrt(np.where(variance > 1e-12, variance, np.nan))
    return np.arange(len(out), dtype=np.float64) - (len(b) - 1), out


def pairs_at(hand: Stream, target: Stream, offset: float, count: int = PAIRS) -> tuple[Float64, Float64]:
    """Pairs (M, 4, 4) of one moment: target poses evenly chosen, hand poses interpolated at ``t + offset``."""
    A, usable = at_times(hand, target.seconds + offset)
    chosen = np.flatnonzero(usable)
    if len(chosen) < 10:
        raise HandEyeRefused(
            Cause.TIME_OFFSET, f"the streams share {len(chosen)} poses", "record both at once"
        )
    thin = chosen[np.unique(np.linspace(0, len(chosen) - 1, count).round().astype(int))]
    return A[thin], target.poses[thin]


def refine_offset(
    hand: Stream, target: Stream, start: float, cost: Callable[[Float64, Float64], float], reach: float = 0.15
) -> tuple[float, float]:
    """Refine the offset by the likelihood of the whole calibration.

    Parameters
    ----------
    hand, target
        The streams.
    start
        Offset to start from, seconds.
    cost
        Negative log-likelihood of pairs (A, B) after hand-eye is solved on them.
    reach
        Seconds to search on either side.

    Returns
    -------
    offset
        Seconds.
    sigma
        Standard deviation from the curvature of the likelihood, seconds; NaN when it has none.
    """
    from scipy.optimize import minimize_scalar

    # The same target poses at every trial offset: otherwise the likelihood would jump with the selection.
    t = target.seconds
    inside = (t + start - reach >= hand.seconds[0]) & (t + start + reach <= hand.seconds[-1])
    inside &= at_times(hand, t + start)[1]
    chosen = np.flatnonzero(inside)
    thin = chosen[np.unique(np.linspace(0, len(chosen) - 1, PAIRS // 2).round().astype(int))]
    few = Stream(t[thin], target.poses[thin])

    def at(offset: float) -> float:
        return cost(at_times(hand, few.seconds + offset)[0], few.poses)

    found = minimize_scalar(
        at, bounds=(start - reach, start + reach), method="bounded", options={"xatol": 3e-4}
    )
    h = 0.01
    curvature = (at(found.x - h) - 2 * found.fun + at(found.x + h)) / h**2
    return float(found.x), float(1 / np.sqrt(curvature)) if curvature > 0 else float("nan")
