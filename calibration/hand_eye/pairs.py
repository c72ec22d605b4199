"""Pairs of one moment from two streams of poses with clocks of their own, or from a calibration recording.

Streams: the rotation speed of a rigid body is the same number in every frame that is fixed to it, so the speeds of hand and camera
are one signal, seen twice. Cross-correlation finds the offset to a sample, the hand-eye likelihood refines it below one.

Recordings: the scene stands still while the arm moves, so registering the stereo cloud of a view into that of another is the motion
of the camera. One view's stereo frame serves as the target: what the scene is does not matter, only that it is rigid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.hand_eye.checks import Cause, HandEyeRefused, clean, thinned
from calibration.hand_eye.clocks import LEAST, read_clock
from calibration.hand_eye.readings import Meant, Readings, choose
from calibration.hand_eye.refine import refine, refined_from_consensus
from calibration.registration.clouds import Cloud, stereo_cloud
from calibration.registration.gate import FINE, Refusal, check_registration, register
from calibration.registration.pairs import calibration_views
from calibration.registration.rims import REPEAT, rim_cloud, stereo_rims
from tofcapture.errors import DataError, QualityError
from tofcapture.pool import Pool
from tofcapture.poses import Float64, invert, invert_all

STEP = 0.01  # s between samples of the speed
WINDOW = 0.1  # s over which a speed is taken: longer than a camera's frame, shorter than a swing of the arm
LEAST_OVERLAP = 0.3  # of the shorter stream
LEAST_CORRELATION = 0.5
RIVAL = 0.9  # a second peak this high makes the offset ambiguous
NEIGHBOURHOOD = 1.0  # s around the peak in which no rival is sought
GAP = 0.25  # s; poses farther apart are not interpolated
PAIRS = 200  # pairs kept of a stream: neighbours share their errors and add nothing
FINEST = 2e-5  # s to which the offset is searched
SEARCH = 0.15  # s on either side of the correlation's offset in which the likelihood is searched
SURFACE_POINTS = 40_000  # of the moving cloud; the fixed one stays dense
STAGES = (0.040, *FINE)  # m; arm poses and the rig's last calibration start it within centimetres


@dataclass(frozen=True)
class Stream:
    """Time-stamped poses."""

    seconds: Float64  #: (N,) ascending
    poses: Float64  #: (N, 4, 4)
    said: tuple[str, ...] = ()  #: How the stamps were read, and what was left out


def make_stream(stamps: ArrayLike, poses: ArrayLike, name: str) -> Stream:
    """Check a stream and bring its clock in order; :class:`DataError` for bad times, poses that are not rigid, fewer than ten poses."""
    t, T = np.asarray(stamps, dtype=np.float64), clean(poses, name)
    if t.shape != (len(T),):
        raise DataError(f"{name}: expected one time per pose, got {t.shape} for {len(T)} poses")
    clock = read_clock(t, T[:, :3, :3], name)
    return Stream(clock.seconds, T[clock.kept], clock.said)


def decided(
    hand: Readings, target: Readings, offset: float | None = None
) -> tuple[Float64, Float64, dict[str, Any]]:
    """Take the readings under which two streams move together, and pair them as :func:`stream_pairs` does.

    Rotation speed hardly depends on how rotations are written, so the clocks are brought together before the readings are ranked.
    """
    assert hand.seconds is not None
    assert target.seconds is not None
    one, two = _alike(hand, target) if offset is None else (hand.names[0], target.names[0])
    clocks = [
        read_clock(side.seconds, side.rotations(name), f"{who} poses")  # type: ignore[arg-type]
        for who, side, name in (("hand", hand, one), ("target", target, two))
    ]
    moving, seen = (
        Stream(c.seconds, side.take(c.kept).poses(name, "m"), c.said)
        for c, side, name in zip(clocks, (hand, target), (one, two), strict=True)
    )
    start = _coarse_offset(moving, seen)[0] if offset is None else offset
    after = np.clip(np.searchsorted(moving.seconds, seen.seconds + start), 1, len(moving.seconds) - 1)
    later = moving.seconds[after] - (seen.seconds + start)
    nearest = np.where(later < np.diff(moving.seconds)[after - 1] / 2, after, after - 1)
    close = np.flatnonzero(np.abs(moving.seconds[nearest] - seen.seconds - start) < GAP)
    few = close[thinned(len(close), PAIRS)] if len(close) else close
    meant = (
        choose(hand.take(clocks[0].kept[nearest[few]]), target.take(clocks[1].kept[few]))
        if len(few) >= LEAST
        else Meant(one, two, ("m", "m"), {}, ())
    )
    moving = replace(moving, poses=hand.take(clocks[0].kept).poses(meant.hand, meant.units[0]))
    seen = replace(seen, poses=target.take(clocks[1].kept).poses(meant.target, meant.units[1]))
    A, B, found = stream_pairs(moving, seen, offset)
    return A, B, {**found, **meant.report()}


def _alike(hand: Readings, target: Readings) -> tuple[str, str]:
    """Readings under which the rotation speeds correlate best; quaternions turn equally fast in either order."""
    best = hand.names[0], target.names[0]
    if max(len(hand.names), len(target.names)) <= 2:
        return best
    scores = {}
    for names in dict.fromkeys(
        [best, *((n, best[1]) for n in hand.names[:6]), *((best[0], n) for n in target.names[:6])]
    ):
        moving, seen = (
            make_stream(side.seconds, side.poses(n, "m"), "poses")  # type: ignore[arg-type]
            for side, n in zip((hand, target), names, strict=True)
        )
        correlation = _correlation(_rotation_speed(moving)[1], _rotation_speed(seen)[1])[1]
        scores[names] = float(np.nanmax(correlation, initial=-1.0))
    return max(scores, key=lambda n: scores[n])


def stream_pairs(
    hand: Stream, target: Stream, offset: float | None = None
) -> tuple[Float64, Float64, dict[str, Any]]:
    """Pair two streams, and find the offset of their clocks where it is not given.

    The hand pose at ``t + offset``, seconds, belongs to the target pose at ``t``.

    Returns target poses evenly chosen and hand poses interpolated, (M, 4, 4) each, hand first. Then, as JSON types, ``time_offset_s``;
    where it was found also ``time_offset_sigma_s`` (None where the likelihood has no curvature) and ``correlation``.

    :class:`HandEyeRefused` for no correlation, two offsets that fit alike (periodic motion), or streams that do not overlap.
    """
    clocks = {"clocks": {"hand": list(hand.said), "target": list(target.said)}}
    if offset is not None:
        return *_pairs_at(hand, target, offset), {"time_offset_s": offset, **clocks}
    start, correlation = _coarse_offset(hand, target)
    A, B = _pairs_at(hand, target, start)
    # The mount and the sense of the target may be wrong here; the gate says so once the clocks are right.
    as_given, turned = (refined_from_consensus(P, B).log_likelihood for P in (A, invert_all(A)))
    offset, sigma = _refined_offset(hand, target, start, inverted=turned > as_given)
    found = {"time_offset_s": offset, "time_offset_sigma_s": sigma, "correlation": correlation, **clocks}
    return *_pairs_at(hand, target, offset), found


def _at_times(stream: Stream, seconds: Float64) -> tuple[Float64, NDArray[np.bool_]]:
    """Poses (M, 4, 4), slerp and linear, and which (M,) are usable: neither outside the stream nor in a gap."""
    from scipy.spatial.transform import Rotation, Slerp

    t = stream.seconds
    inside = np.clip(seconds, t[0], t[-1])
    out = np.zeros((len(seconds), 4, 4))
    out[:, :3, :3] = Slerp(t, Rotation.from_matrix(stream.poses[:, :3, :3]))(inside).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(inside, t, stream.poses[:, axis, 3])
    out[:, 3, 3] = 1
    after = np.clip(np.searchsorted(t, inside), 1, len(t) - 1)
    return out, np.asarray((seconds == inside) & (t[after] - t[after - 1] <= GAP))


def _rotation_speed(stream: Stream) -> tuple[Float64, Float64]:
    """Rotation speed on a grid of ``STEP``: times (M,) and rad/s (M,), NaN where unknown."""
    from scipy.spatial.transform import Rotation

    grid = np.arange(stream.seconds[0], stream.seconds[-1], STEP)
    (before, known), (after, also) = (_at_times(stream, grid + s * WINDOW / 2) for s in (-1, 1))
    turned = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]).magnitude()
    return grid, np.where(known & also, turned / WINDOW, np.nan)


def _coarse_offset(hand: Stream, target: Stream) -> tuple[float, float]:
    """Offset in seconds by cross-correlation of the rotation speeds, and Pearson's correlation at the peak."""
    (t_hand, a), (t_target, b) = _rotation_speed(hand), _rotation_speed(target)
    lags, correlation = _correlation(a, b)
    best = float(np.nanmax(correlation)) if np.isfinite(correlation).any() else float("nan")
    if not best >= LEAST_CORRELATION:
        raise HandEyeRefused(
            Cause.TIME_OFFSET,
            f"expected rotation speeds that correlate by {LEAST_CORRELATION} or more, got {best:.2f}",
            "the streams may be of different recordings; rotate the hand briskly and irregularly while recording",
        )
    peak = int(np.nanargmax(correlation))
    away = np.abs(lags - lags[peak]) * STEP > NEIGHBOURHOOD
    rival = float(np.nanmax(correlation[away], initial=-1.0))
    if rival > RIVAL * best:
        raise HandEyeRefused(
            Cause.TIME_OFFSET,
            f"two offsets fit alike (correlations {best:.3f} and {rival:.3f})",
            "the motion repeats itself: move irregularly",
        )
    return float(t_hand[0] - t_target[0] + lags[peak] * STEP), best


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


def _pairs_at(hand: Stream, target: Stream, offset: float) -> tuple[Float64, Float64]:
    A, usable = _at_times(hand, target.seconds + offset)
    chosen = np.flatnonzero(usable)
    if len(chosen) < 10:
        raise HandEyeRefused(
            Cause.TIME_OFFSET, f"the streams share {len(chosen)} poses", "record both at once"
        )
    few = chosen[thinned(len(chosen), PAIRS)]
    return A[few], target.poses[few]


def _refined_offset(
    hand: Stream, target: Stream, start: float, *, inverted: bool
) -> tuple[float, float | None]:
    """Offset of the highest likelihood of the whole calibration, and its standard deviation from the curvature, seconds."""
    from scipy.optimize import minimize_scalar

    # The same target poses at every trial offset: otherwise the likelihood would jump with the selection.
    t = target.seconds
    inside = (t + start - SEARCH >= hand.seconds[0]) & (t + start + SEARCH <= hand.seconds[-1])
    inside &= _at_times(hand, t + start)[1]
    chosen = np.flatnonzero(inside)
    few = chosen[thinned(len(chosen), PAIRS // 2)]

    def turned(late: float) -> Float64:
        A = _at_times(hand, t[few] + (start + late))[0]
        return invert_all(A) if inverted else A

    # One start for all trials: a new consensus each time would make the likelihood jump.
    seen = target.poses[few]
    first = refined_from_consensus(turned(0.0), seen)

    def cost(late: float) -> float:
        return -refine(turned(late), seen, first.X, first.Z, first.noise).log_likelihood

    # Searched about zero: the minimiser's tolerance is relative, and clocks may be an epoch apart.
    trials = np.linspace(-SEARCH, SEARCH, 11)
    near = trials[int(np.argmin([cost(late) for late in trials]))]
    width = trials[1] - trials[0]
    found = minimize_scalar(
        cost, bounds=(near - width, near + width), method="bounded", options={"xatol": FINEST}
    )
    h = 0.01
    curvature = (cost(found.x - h) - 2 * found.fun + cost(found.x + h)) / h**2
    return start + float(found.x), float(1 / np.sqrt(curvature)) if curvature > 0 else None


@dataclass(frozen=True)
class _Seen:
    hand: Float64
    camera: Float64  # believed T_base_stereo
    cloud: Cloud
    rims: Float64


def recording_pairs(
    recording: Path, progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None
) -> tuple[Float64, Float64]:
    """Take T_base_flange and T_stereo_target (N, 4, 4) from the views that register; the target is the first view's stereo frame.

    ``progress`` is called with a stage, steps done and steps in all. :class:`DataError` for no or unreadable views,
    :class:`QualityError` where fewer than three register.
    """
    paths = calibration_views(recording)
    fixed, hand, target, refused = _seen(paths[0]), [], [], []
    with Pool(1, pinned=True) as pool:
        for i, path in enumerate(paths):
            progress("registering", i, len(paths))
            view = fixed if i == 0 else _seen(path)
            guess = invert(fixed.camera) @ view.camera
            source = _source(view)
            result = pool.call(register, "open3d", source, fixed.cloud, guess, STAGES)
            refusal = check_registration(result, source, fixed.cloud, guess)
            if refusal in (None, Refusal.POOR_FIT):  # what one view sees and the other does not is no misfit
                hand.append(view.hand)
                target.append(invert(result.T_target_source))
            else:
                refused.append(f"{path.stem} {refusal}")
    if len(hand) < 3:
        raise QualityError(
            f"{recording}: expected at least 3 views that register, got {len(hand)}: {', '.join(refused)}",
            hint="record board views that overlap, or correct the rig the recording started from",
        )
    return np.stack(hand), np.stack(target)


def _seen(path: Path) -> _Seen:
    from tofcapture.files.view import open_view

    view = open_view(path)
    held = rim_cloud(stereo_rims(view.stereo.points), np.zeros(3))
    hand = view.arm_before.T_base_flange
    return _Seen(hand, hand @ view.rig.T_flange_stereo, held + stereo_cloud(view.stereo), held.points)


def _source(view: _Seen) -> Float64:
    surface = view.cloud.points[len(view.rims) :]
    few = surface[:: max(1, len(surface) // SURFACE_POINTS)]
    return np.concatenate([np.repeat(view.rims[:: max(1, len(view.rims) // 2000)], REPEAT, axis=0), few])
