"""Rims without the two biases that a joint solution would otherwise stand on.

Averaged over a dozen views, rims are good to a hundredth of a millimetre of noise, and two biases of :mod:`calibration.rims` that a
single view hides come out, half a millimetre at 0.8 m together:

* The illuminator stands beside the lens, so the front throws a shadow beside itself on what is behind. A pixel there mixes
  three things, front, back and dark. Two shares are estimated, of front and of back, and what is missing to one is dark.
* Beside a rim a stereo matcher answers anything between front and back, which eats the front on the side where the right eye
  sees the background. A stereo rim counts only where the front's last pixel borders on the background's own depth or on nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.rims import JUMP, REACH, Rims, facing_edge, joined, on_surface, outward, stereo_rims
from tofcapture.camera import Camera
from tofcapture.poses import Float64

ACROSS = 3  # px that a rim's mixture may reach over
MIN_ANGLE = (
    0.15  # sine of the angle between front and back phasors below which their shares cannot be told apart
)
VEIL = 0.006  # m, unevenness of a background over a few stereo pixels
DARK = 0.1  # px that the dark beside a rim may differ from the shadow


def lit_rims(phasor: NDArray[np.complex128], depth: Float64, camera: Camera, illuminator: Float64) -> Rims:
    """Rims in a ToF image, free of the front's shadow.

    What is dark beside a front must be as wide as the shadow that the illuminator can throw there; where it is not, the front's
    side face is seen, of another brightness, and the rim is not used.

    Parameters
    ----------
    phasor, depth, camera
        As for :func:`calibration.rims.tof_rims`.
    illuminator
        (3,) ToF frame, metres.
    """
    found = []
    for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):
        z, d = facing_edge(phasor, axis, sign), facing_edge(depth, axis, sign)
        image, focal = (0, camera.fx) if axis == 1 else (1, camera.fy)
        row, front, inverse, share = _lit_steps(z, d, -sign * focal * float(illuminator[image]))
        at = front + 0.5 + share
        along = at if sign > 0 else d.shape[-1] - 1 - at
        u, v = (along, row) if axis == 1 else (row, along)
        ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(row))], -1)
        slope = (inverse[:, -1] - inverse[:, 0]) / (REACH - 1)
        reach = at - front + (REACH - 1) / 2
        found.append((ray / (inverse.mean(axis=1) + slope * reach)[:, None], outward(axis, sign, len(row))))
    return joined(found)


def unveiled_rims(points: NDArray[np.floating], camera: Camera) -> Rims:
    """Rims in a stereo point map (H, W, 3), stereo frame, that no wrong match beside them can have moved."""
    rims = stereo_rims(points)
    step = np.rint(rims.outward[:, :2]).astype(np.intp)
    u = camera.fx * rims.points[:, 0] / rims.points[:, 2] + camera.cx - step[:, 0] / 2
    v = camera.fy * rims.points[:, 1] / rims.points[:, 2] + camera.cy - step[:, 1] / 2
    column, row = np.rint(u).astype(np.intp), np.rint(v).astype(np.intp)
    depth = points[..., 2]

    def beyond(pixels: int) -> Float64:
        at_row = np.clip(row + pixels * step[:, 1], 0, depth.shape[0] - 1)
        at_column = np.clip(column + pixels * step[:, 0], 0, depth.shape[1] - 1)
        return np.asarray(depth[at_row, at_column], dtype=np.float64)

    next_one = beyond(1)
    good = np.isnan(next_one) | (np.abs(next_one - beyond(REACH)) < VEIL)
    return Rims(rims.points[good], rims.outward[good])


def _lit_steps(
    z: NDArray[np.complex128], d: Float64, parallax: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64, Float64]:
    """Rows, last front pixels, inverse depths (N, REACH) up to them and the front's width beyond, in pixels."""
    width = d.shape[1] - REACH - ACROSS - 1
    window = {k: slice(k, k + width) for k in range(REACH + ACROSS + 2)}
    inverse = np.stack([1 / d[:, window[k]] for k in range(REACH)], axis=-1)
    front, back = d[:, window[REACH - 1]], d[:, window[REACH + ACROSS]]
    behind = np.abs(d[:, window[REACH + ACROSS + 1]] - back) < JUMP / 2
    good = (back - front > JUMP) & behind & on_surface(inverse, front)
    row, column = np.nonzero(good)
    last = column + REACH - 1
    across = np.stack([z[:, row, last + 1 + k] for k in range(ACROSS)], axis=-1)
    share, lit, apart = _shares(across, z[:, row, last], z[:, row, last + 1 + ACROSS])
    clean = (share[:, 0] > 0.85) & (share[:, -1] < 0.15) & (share > -0.2).all(axis=1)
    clean &= (share < 1.2).all(axis=1) & (lit < 1.2).all(axis=1) & (apart > MIN_ANGLE)
    shadow = np.maximum(parallax * (inverse[good][:, -1] - 1 / back[good]), 0)
    clean &= np.abs((1 - lit).sum(axis=1) - shadow) < DARK
    return row[clean], last[clean], inverse[good][clean], share[clean].sum(axis=1)


def _shares(
    across: NDArray[np.complex128], z_front: NDArray[np.complex128], z_back: NDArray[np.complex128]
) -> tuple[Float64, Float64, Float64]:
    """Share of the front (N, ACROSS) in phasors (F, N, ACROSS), sum of both shares, and the sine between front and back (N,)."""
    ff, bb = (np.square(np.abs(z)).sum(axis=0) for z in (z_front, z_back))
    fb = (z_front.conj() * z_back).real.sum(axis=0)
    determinant = ff * bb - fb**2
    apart = np.sqrt(np.maximum(determinant, 0) / np.maximum(ff * bb, 1e-12))
    f = (across * z_front.conj()[..., None]).real.sum(axis=0)
    b = (across * z_back.conj()[..., None]).real.sum(axis=0)
    safe = np.maximum(determinant, 1e-12)[:, None]
    front = (f * bb[:, None] - b * fb[:, None]) / safe
    back = (b * ff[:, None] - f * fb[:, None]) / safe
    return front, front + back, apart
