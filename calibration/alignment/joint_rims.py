"""Rims without the biases that a joint solution would otherwise stand on.

Averaged over a dozen views, rims are good to a hundredth of a millimetre of noise, and biases of :mod:`calibration.board.rims` that a
single view hides come out, half a millimetre at 0.8 m together. Each was found by ray-casting the true rim beside every measured one:

* The illuminator stands beside the lens, so the front throws a shadow beside itself on what is behind. A pixel there mixes
  three things, front, back and dark. Two shares are estimated, of front and of back, and what is missing to one is dark.
* A board that recedes grows darker by about half a percent a pixel, and rims whose cut is hidden are those where it recedes. The
  front's phasor is therefore continued beyond its last pixels; held constant, it made every rim short by 0.04 to 0.16 mrad.
* A board is thick, and where its cut is in sight, each camera ends it elsewhere. Such rims are not used (0.4 to 1.7 mrad).
* Beside a rim a stereo matcher answers anything between front and back. A stereo rim counts only where the front's last pixel
  borders on the background's own depth or on nothing, and does not lie a whole pixel off its neighbours.

What is left, up to 0.03 mrad, is light that other surfaces throw into the shadow: it is not dark there, only darker.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.board.rims import (
    JUMP,
    REACH,
    Rims,
    facing_edge,
    joined,
    on_surface,
    outward,
    rim_tangents,
    stereo_rims,
)
from calibration.registration.clouds import Cloud
from tofcapture.camera import Camera
from tofcapture.poses import Float64

ACROSS = 3  # px that a rim's mixture may reach over
MIN_ANGLE = (
    0.15  # sine of the angle between front and back phasors below which their shares cannot be told apart
)
VEIL = 0.006  # m, unevenness of a background over a few stereo pixels
ON_FRONT = 0.003  # m that a rim may lie off the plane of the front beside it
STEP = 2.5  # medians that a rim may lie off its neighbours' line; those of whole pixels lie within two
HIDDEN = 0.03  # sine of the angle by which both cameras must look past a cut that is square to the front
DARK = 0.1  # px that the dark beside a rim may differ from the shadow


def lit_rims(phasor: NDArray[np.complex128], depth: Float64, camera: Camera, illuminator: Float64) -> Rims:
    """Rims in a ToF image, free of the front's shadow.

    What is dark beside a front must be as wide as the shadow that the illuminator can throw there; where it is not, the front's
    side face is seen, of another brightness, and the rim is not used.

    Parameters
    ----------
    phasor, depth, camera
        As for :func:`calibration.board.rims.tof_rims`.
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
        ray = camera.rays_at(np.stack([u, v], axis=-1))
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

    next_one, back = beyond(1), beyond(REACH)
    with np.errstate(divide="ignore"):
        continued = 1 / (back**-1 + (REACH - 1) / 2 * (1 / back - 1 / beyond(REACH + 2)))
    good = np.isnan(next_one) | (np.abs(next_one - continued) < VEIL)
    return Rims(rims.points[good], rims.outward[good])


def square_rims(rims: Rims, surface: Cloud, seen_from: Float64) -> Cloud:
    """Give stereo rims normals across the ToF ray, and drop those whose cut neither camera may see.

    A board is millimetres thick. Where a camera looks at the cut, the front ends at the board's rear edge for it, or somewhere on
    the way; where both see past the front's edge, both see the same line in space. The cut is taken to be square to the front.

    Parameters
    ----------
    rims
        Stereo rims, stereo frame.
    surface
        Stereo points with normals, among them the fronts.
    seen_from
        (3,) ToF camera in the stereo frame, metres; centimetres suffice.
    """
    from scipy.spatial import cKDTree

    tangents, straight, off = rim_tangents(rims)
    _, nearest = cKDTree(surface.points).query(rims.points)
    normal = surface.normals[nearest]
    offset = ((rims.points - surface.points[nearest]) * normal).sum(axis=-1)
    out = np.cross(normal, tangents)
    out *= np.sign((out * rims.outward).sum(axis=-1, keepdims=True))
    good = straight & (np.abs(offset) < ON_FRONT)
    for eye in (np.zeros(3), seen_from):
        ray = rims.points - eye
        good &= (out * ray).sum(axis=-1) > HIDDEN * np.linalg.norm(ray, axis=-1)
    # A whole pixel's step off the neighbours' line is a front's pixel matched to the back, or the reverse.
    step = np.abs((out * off).sum(axis=-1)) / rims.points[:, 2]
    good &= step < STEP * np.median(step[good]) if good.any() else good
    across = np.cross(tangents[good], (rims.points - seen_from)[good])
    return Cloud(rims.points[good], across / np.linalg.norm(across, axis=-1, keepdims=True))


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
    share, lit, apart = _shares(across, _continued(z, row, last), z[:, row, last + 1 + ACROSS])
    clean = (share[:, 0] > 0.85) & (share[:, -1] < 0.15) & (share > -0.2).all(axis=1)
    clean &= (share < 1.2).all(axis=1) & (lit < 1.2).all(axis=1) & (apart > MIN_ANGLE)
    shadow = np.maximum(parallax * (inverse[good][:, -1] - 1 / back[good]), 0)
    clean &= np.abs((1 - lit).sum(axis=1) - shadow) < DARK
    return row[clean], last[clean], inverse[good][clean], share[clean].sum(axis=1)


def _continued(
    z: NDArray[np.complex128], row: NDArray[np.intp], last: NDArray[np.intp]
) -> NDArray[np.complex128]:
    """Phasors (F, N, ACROSS) that the front would have beyond its last pixels, by a line through the logarithms of its own."""
    own = np.stack([z[:, row, last - k] for k in range(REACH - 1, -1, -1)], axis=-1)
    log = np.log(own / own[..., -1:] + 1e-300)
    t = np.arange(REACH) - (REACH - 1) / 2
    slope, mean = (log @ t / (t @ t))[..., None], log.mean(axis=-1)[..., None]
    return np.asarray(own[..., -1:] * np.exp(mean + slope * (t[-1] + 1 + np.arange(ACROSS))))


def _shares(
    across: NDArray[np.complex128], z_front: NDArray[np.complex128], z_back: NDArray[np.complex128]
) -> tuple[Float64, Float64, Float64]:
    """Share of the front (N, ACROSS) in phasors, sum of both shares, and the least sine (N,) between front and back.

    ``across`` and ``z_front`` are (F, N, ACROSS), ``z_back`` is (F, N).
    """
    back_there = z_back[..., None]
    ff, bb = (np.square(np.abs(z)).sum(axis=0) for z in (z_front, back_there))
    fb = (z_front.conj() * back_there).real.sum(axis=0)
    determinant = ff * bb - fb**2
    apart = np.sqrt(np.maximum(determinant, 0) / np.maximum(ff * bb, 1e-12)).min(axis=-1)
    f = (across * z_front.conj()).real.sum(axis=0)
    b = (across * back_there.conj()).real.sum(axis=0)
    safe = np.maximum(determinant, 1e-12)
    front = (f * bb - b * fb) / safe
    back = (b * ff - f * fb) / safe
    return front, front + back, apart
