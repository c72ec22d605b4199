"""Decode in float64, step by step and by brute force: the oracle that the fast decoder is held against.

It asks no neighbours and raises no flags. Everything else that :class:`tofcapture.ops.phase.Decoder` does can be read here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import Reach, ambiguity, frequencies, unambiguous, wrap_table
from tofcapture.frames import TofInfo
from tofcapture.ops.phase.phasors import Complex128, Float64, information, phasors, wrapped_range
from tofcapture.rig import RangeError, image_places, radius_px

UNKNOWN_CELSIUS = 45.0
_STEPS, _SETTLED = 40, 1e-9  # of the fixed point, m


@dataclass(frozen=True)
class Decoded:
    """Hold what decoding yields, float64; ranges are half the path from the illuminator over the surface to the camera."""

    radial: Float64  #: (H, W) distance along the ray, metres; NaN where it cannot be decoded.
    ranges: Float64  #: (F, H, W) of each frequency alone, unwrapped, metres.
    amplitude: Float64  #: (F, H, W), raw units.
    misfit: (
        Float64  #: (J, H, W) of each wrap vector: chi squared times the variance of a tap, raw units squared.
    )


def decode(raw: NDArray[Any], info: TofInfo, celsius: float = float("nan")) -> Decoded:
    """Decode one frame (K, H, W), or the mean of some, pixel by pixel."""
    phasor = phasors(raw, info.modulation_hz, info.phase_rad, offset=info.offset)
    found = decode_phasors(phasor, info, celsius)
    saturated = info.saturated(np.asarray(raw)).any(axis=0)
    return replace(found, radial=np.where(saturated, np.nan, found.radial))


def decode_phasors(phasor: Complex128, info: TofInfo, celsius: float = float("nan")) -> Decoded:
    """Decode the phasors (F, H, W) of a frame."""
    hz, errors = frequencies(info.modulation_hz), {e.modulation_hz: e for e in info.range_errors}
    celsius = celsius if np.isfinite(celsius) else UNKNOWN_CELSIUS
    amplitude, known = np.abs(phasor), information(info)
    wrapped = np.stack(
        [
            correct_range(wrapped_range(z, f), errors.get(f, RangeError(f)), info.camera, celsius, A)
            for z, f, A in zip(phasor, hz, amplitude, strict=True)
        ]
    )
    table = wrap_table(hz, known, info.reach)
    # Maximum likelihood: sum_k (r_k + n_k U_k - r)^2 / v_k over all vectors n, with r the mean of what is summed.
    turn = 2 * np.pi / table.U
    weight = (turn**2 * known)[:, None, None] * np.square(amplitude)
    best, ranges = np.full(amplitude.shape[1:], np.inf), wrapped
    for n in wrap_vectors(table.U, info.reach or (0.0, unambiguous(hz))):
        candidate = wrapped + (n * table.U)[:, None, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (weight * candidate).sum(axis=0) / weight.sum(axis=0)
        misfit = (weight * np.square(candidate - mean)).sum(axis=0)
        better = (misfit < best) & (candidate[-1] >= table.bounds[0]) & (candidate[-1] <= table.bounds[1])
        best, ranges = np.where(better, misfit, best), np.where(better, candidate, ranges)
    # Fused by inverse variance at equal phase noise, within one period.
    fused = np.tensordot(table.lean, ranges, axes=1)
    rounds = table.period * np.floor((fused - table.start) / table.period)
    radial = range_to_radial(fused - rounds, info.camera, info.illuminator)
    return Decoded(np.where(amplitude.min(axis=0) > 0, radial, np.nan), ranges - rounds, amplitude, best)


def wrap_vectors(U: Float64, reach: Reach) -> NDArray[np.int64]:
    """List every vector of wraps (J, F) whose ranges, with half a wrap of noise, have one in common within the reach, metres."""
    low, high = reach
    every = [range(int(np.floor(low / u)) - 1, int(np.ceil(high / u)) + 1) for u in U]
    n = np.array([v for v in product(*every) if np.ptp(np.array(v) * U) < 2 * U.max()], dtype=np.int64)
    first, last = ((n - 0.5) * U).max(axis=1), ((n + 1.5) * U).min(axis=1)
    out: NDArray[np.int64] = n[np.minimum(last, high) > np.maximum(first, low)]
    return out


def correct_range(
    range_: Float64, error: RangeError, camera: Camera, celsius: float, amplitude: Float64 | None = None
) -> Float64:
    """Take the systematic error of one frequency off its wrapped range and wrap again, metres.

    The error is a function of the true phase: a fixed point, iterated until it moves less than a nanometre.
    """
    R = ambiguity(error.modulation_hz)
    radius, place = radius_px(camera), image_places(camera)
    fixed = range_ - error.pixels(camera)
    true = fixed
    for _ in range(_STEPS):
        varying = error.at(true * 2 * np.pi / R, radius, celsius, place, amplitude) - error.pixels(camera)
        before, true = true, fixed - varying
        if not (np.abs(true - before) > _SETTLED).any():
            break
    return np.mod(true, R)


def range_to_radial(
    range_: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Turn half the path illuminator - surface - camera (..., H, W) into distance along the ray, metres.

    The surface point lies on the ellipsoid with foci camera and illuminator:
    ``radial = (4 D^2 - |s|^2) / (2 (2 D - u . s))``, exact for any illuminator position s and unit ray u.
    """
    s = np.asarray(illuminator, dtype=np.float64)
    u = camera.rays / camera.ray_lengths[..., None]
    path = 2 * np.asarray(range_, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = (path**2 - s @ s) / (2 * (path - u @ s))
    out: Float64 = np.where(path > np.linalg.norm(s), radial, np.nan)
    return out
