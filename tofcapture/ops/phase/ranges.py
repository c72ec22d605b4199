"""From half the path illuminator - surface - camera to the distance along the ray and back; systematic range errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.ops.phase.phasor import Float64, ambiguity
from tofcapture.rig import RangeError, image_places

_STEPS = 20  # of the fixed point
_SETTLED = 1e-8  # m


def range_to_radial(
    range_: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Distance along the ray from half the path illuminator - surface - camera.

    The surface point lies on the ellipsoid with foci camera and illuminator:
    ``radial = (4 D^2 - |s|^2) / (2 (2 D - u . s))``, exact for any illuminator position s and unit ray u.

    Parameters
    ----------
    range_
        (..., H, W), metres.
    camera
        Intrinsics.
    illuminator
        (3,) in the ToF frame, metres.
    """
    s = np.asarray(illuminator, dtype=np.float64)
    u = camera.rays / camera.ray_lengths[..., None]
    path = 2 * np.asarray(range_, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = (path**2 - s @ s) / (2 * (path - u @ s))
    out: Float64 = np.where(path > np.linalg.norm(s), radial, np.nan)
    return out


def radial_to_range(
    radial: NDArray[np.floating], camera: Camera, illuminator: NDArray[np.floating]
) -> Float64:
    """Half the path illuminator - surface - camera, of a distance along the ray; inverse of :func:`range_to_radial`."""
    u = camera.rays / camera.ray_lengths[..., None]
    points = np.asarray(radial, dtype=np.float64)[..., None] * u
    out: Float64 = (
        np.asarray(radial, dtype=np.float64) + np.linalg.norm(points - np.asarray(illuminator), axis=-1)
    ) / 2
    return out


def radius_px(camera: Camera) -> Float64:
    """(H, W) distance of each pixel to the principal point, pixels."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    out: Float64 = np.hypot(u - camera.cx, v - camera.cy)
    return out


def correct_range(
    range_: Float64, error: RangeError, camera: Camera, celsius: float, amplitude: Float64 | None = None
) -> Float64:
    """Take the systematic error of one frequency off its wrapped range and wrap again.

    The error is a function of the true phase: a fixed point, iterated until it moves less than 0.01 micrometres (slopes
    below 1; those of real sensors stay below 0.1). ``amplitude`` (..., H, W) is needed where the error depends on it.
    """
    R = ambiguity(error.modulation_hz)
    radius, place = radius_px(camera), image_places(camera)
    true = range_
    for _ in range(_STEPS):
        before, true = true, range_ - error.at(true * 2 * np.pi / R, radius, celsius, place, amplitude)
        if not (np.abs(true - before) > _SETTLED).any():
            break
    return np.mod(true, R)
