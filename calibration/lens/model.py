"""The lens of the ToF camera: what a fit is fed with and what it answers.

The model is OpenCV's, as :class:`tofcapture.camera.Camera` has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofcapture.camera import Camera, distorted
from tofcapture.errors import QualityError
from tofcapture.poses import Float64


class LensRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Views that do not determine a lens."""


@dataclass(frozen=True)
class LensView:
    """Points of a target and where one image shows them.

    Attributes
    ----------
    points
        (N, 3) target frame, metres; z = 0 on a plane target.
    pixels
        (N, 2) as (u, v), pixel centres at integers; NaN where a point was not found.
    radius
        Radius of round holes whose ellipses were centred, metres; 0 for points. The centre of an ellipse is not the image of
        the circle's centre: at 40 degrees and 0.5 m a 60 mm hole is off by some tenths of a pixel.
    """

    points: Float64
    pixels: Float64
    radius: float = 0.0


@dataclass(frozen=True)
class LensFit:
    """A fitted lens.

    Attributes
    ----------
    camera
        The answer.
    sigma
        (9,) standard deviations of fx, fy, cx, cy, k1, k2, p1, p2, k3; 0 for what was held.
    rms
        Root mean square distance, pixels.
    residuals
        (M, 2) pixels, predicted minus seen, all views.
    T_camera_target
        One (4, 4) per view; empty when fitted to rays.
    coverage
        Share of the image's width and height that the points span, the smaller one.
    """

    camera: Camera
    sigma: Float64
    rms: float
    residuals: Float64
    T_camera_target: tuple[Float64, ...]
    coverage: float


def coefficients(camera: Camera) -> Float64:
    """(5,) k1, k2, p1, p2, k3; zeros of a pinhole."""
    return np.array(camera.distortion or (0.0,) * 5)


def pixels_of(camera: Camera, xy: Float64) -> Float64:
    """Pixels (..., 2) of undistorted image coordinates (..., 2) at z = 1, beyond the image too."""
    out: Float64 = distorted(xy, coefficients(camera)) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return out


def circle_centres(T: Float64, centres: Float64, radius: float) -> Float64:
    """Centres (N, 2), at z = 1, of the ellipses that circles (N, 3) in planes z = const of the target appear as.

    From the dual conic: ``C* = H diag(r^2, r^2, -1) H^T`` with H = [R_x, R_y, T c]; its last column is the centre.
    """
    at = centres @ T[:3, :3].T + T[:3, 3]
    plane = T[:3, :2] @ T[:3, :2].T * radius**2
    last = plane[2] - at * at[:, 2:]
    return np.asarray(last[:, :2] / last[:, 2:])
