"""Rims: where a surface ends before a deeper one, found to a fraction of a pixel.

Point-to-plane registration slides along a board, and the rims of its outline and of its holes hold it. A ToF rim is an angle,
free of any range error: the pixels across it are mixtures of the front's and the back's phasors, and the sum of the front's
shares says where it ends.

:func:`tof_rims`, :func:`stereo_rims` and :func:`rim_cloud` serve registration. The joint alignment averages rims over a dozen
views to a hundredth of a millimetre, where half a millimetre of bias comes out that a single view hides. Each cause was found by
ray-casting the true rim beside every measured one, and :func:`lit_rims`, :func:`unveiled_rims` and :func:`square_rims` take it off:

* The illuminator stands beside the lens, so the front throws a shadow on what is behind. A pixel there mixes front, back and
  dark. The shares of front and of back are both estimated, and what is missing to one is dark.
* A board that recedes grows darker by half a percent a pixel. The front's phasor is therefore continued beyond its last pixels;
  held constant, it made every rim short by 0.04 to 0.16 mrad.
* A board is thick, and where its cut is in sight, each camera ends it elsewhere. Such rims are not used (0.4 to 1.7 mrad).
* Beside a rim a stereo matcher answers anything between front and back. A stereo rim counts only where the front's last pixel
  borders on the background's own depth or on nothing, and does not lie a whole pixel off its neighbours.

What is left, up to 0.03 mrad, is light that other surfaces throw into the shadow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Cloud, Mask
from tofcapture.camera import Camera
from tofcapture.poses import Float64

Index = NDArray[np.intp]
Complex128 = NDArray[np.complex128]

JUMP = 0.04  # m of depth behind a rim: far more than noise, bias and a board's own thickness
FLAT = 0.004  # m, most departure of the front's pixels from a straight line in inverse depth
REACH = 4  # px of flat front that a rim needs
ACROSS = 3  # px that a rim's mixture may reach over
TANGENT_NEIGHBOURS = 12
STRAIGHT = 0.2  # largest ratio of the second to the first principal axis of a rim's neighbours
REPEAT = 40  # surface points that one rim point weighs as much as: rims are few, and free of range bias
DIRECTIONS = ((1, 1), (1, -1), (0, 1), (0, -1))  # image axis along which a front may end, and which way

MIN_ANGLE = 0.15  # sine of the angle between front and back phasors below which shares cannot be told apart
VEIL = 0.006  # m, unevenness of a background over a few stereo pixels
ON_FRONT = 0.003  # m that a rim may lie off the plane of the front beside it
STEP = 2.5  # medians that a rim may lie off its neighbours' line; those of whole pixels lie within two
HIDDEN = 0.03  # sine of the angle by which both cameras must look past a cut that is square to the front
DARK = 0.1  # px that the dark beside a rim may differ from the shadow


@dataclass(frozen=True)
class Rims:
    """Points on rims."""

    points: Float64  #: (N, 3) float64, camera frame, metres; on the front surface's edge
    outward: Float64  #: (N, 3) float64, unit, image axis along which the front ends


def tof_rims(phasor: Complex128, depth: Float64, camera: Camera) -> Rims:
    """Find rims in a ToF image, ToF frame.

    The phasor (F, H, W) is burst-averaged; the depth (H, W), metres, is NaN where it cannot be decoded.
    """
    return _rims_in(phasor, depth, camera, lambda z, d, _axis, _sign: _mixed_steps(z, d))


def lit_rims(phasor: Complex128, depth: Float64, camera: Camera, illuminator: Float64) -> Rims:
    """Find rims in a ToF image, free of the front's shadow.

    What is dark beside a front must be as wide as the shadow that the illuminator (3,), ToF frame, metres, can throw there. Where
    it is not, the front's side face is seen, of another brightness, and the rim is not used. Otherwise as :func:`tof_rims`.
    """

    def steps(z: Complex128, d: Float64, axis: int, sign: int) -> tuple[Index, Index, Float64, Float64]:
        focal = camera.fx if axis == 1 else camera.fy
        return _lit_steps(z, d, -sign * focal * float(illuminator[1 - axis]))

    return _rims_in(phasor, depth, camera, steps)


def stereo_rims(points: NDArray[np.floating]) -> Rims:
    """Find rims in an organised point map (H, W, 3), stereo frame, at the outer border of the front's last pixel."""
    found = []
    for axis, sign in DIRECTIONS:
        P = points if axis == 1 else points.swapaxes(0, 1)
        P = P[:, ::sign]
        row, last = _stereo_steps(P[..., 2].astype(np.float64))
        edge, inner = P[row, last].astype(np.float64), P[row, last - REACH + 1].astype(np.float64)
        found.append((edge + (edge - inner) / (2 * (REACH - 1)), _outward(axis, sign, len(row))))
    return _joined(found)


def unveiled_rims(rims: Rims, points: NDArray[np.floating], camera: Camera) -> Rims:
    """Keep rims of a stereo point map (H, W, 3), stereo frame, that no wrong match beside them can have moved."""
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


def rim_cloud(rims: Rims, seen_from: Float64) -> Cloud:
    """Give stereo rims that are locally straight the normals by which point-to-plane registration holds them.

    The normal is across the rim and across the ray from the ToF camera: a range error moves a ToF rim along that ray and costs
    nothing. ``seen_from`` (3,) is the ToF camera in the stereo frame, metres; centimetres suffice.
    """
    tangents, straight, _ = _tangents(rims)
    across = np.cross(tangents, rims.points - seen_from)
    length = np.linalg.norm(across, axis=-1)
    good = straight & (length > 0)
    return Cloud(rims.points[good], across[good] / length[good, None])


def square_rims(rims: Rims, surface: Cloud, seen_from: Float64) -> Cloud:
    """Give stereo rims normals as :func:`rim_cloud`, and drop those whose cut a camera may see.

    Where a camera looks at the cut of a thick board, the front ends at the board's rear edge for it, or on the way there. Where
    both see past the front's edge, both see the same line in space. The cut is taken to be square to the front.

    All is in the stereo frame; the fronts are among the surface. ``seen_from`` is that of :func:`rim_cloud`.
    """
    from scipy.spatial import cKDTree

    tangents, straight, off = _tangents(rims)
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


def _rims_in(
    phasor: Complex128,
    depth: Float64,
    camera: Camera,
    steps: Callable[[Complex128, Float64, int, int], tuple[Index, Index, Float64, Float64]],
) -> Rims:
    """Rims from ``steps``, which gives rows, last front pixels, inverse depths up to them, and the front's width beyond in pixels."""
    found = []
    for axis, sign in DIRECTIONS:
        z, d = _facing_edge(phasor, axis, sign), _facing_edge(depth, axis, sign)
        row, front, inverse, width = steps(z, d, axis, sign)
        at = front + 0.5 + width
        along = at if sign > 0 else d.shape[-1] - 1 - at
        ray = camera.rays_at(np.stack((along, row) if axis == 1 else (row, along), axis=-1))
        slope = (inverse[:, -1] - inverse[:, 0]) / (REACH - 1)
        reach = at - front + (REACH - 1) / 2
        found.append((ray / (inverse.mean(axis=1) + slope * reach)[:, None], _outward(axis, sign, len(row))))
    return _joined(found)


def _mixed_steps(z: Complex128, d: Float64) -> tuple[Index, Index, Float64, Float64]:
    """Front's width beyond its last pixel where the pixels across mix front and back alone."""
    row, last, inverse = _steps(d)
    z_front, z_back = z[:, row, last], z[:, row, last + 1 + ACROSS]
    contrast = z_front - z_back
    mixed = ((_across(z, row, last) - z_back[..., None]) * contrast.conj()[..., None]).real.sum(axis=0)
    share = mixed / np.square(np.abs(contrast)).sum(axis=0)[:, None]
    good = _plausible(share) & (np.abs(contrast).max(axis=0) > 0.2 * np.abs(z_front).max(axis=0))
    return row[good], last[good], inverse[good], np.clip(share[good], 0, 1).sum(axis=-1)


def _lit_steps(z: Complex128, d: Float64, parallax: float) -> tuple[Index, Index, Float64, Float64]:
    """Front's width where the pixels across mix front, back and the front's shadow."""
    row, last, inverse = _steps(d)
    z_back = z[:, row, last + 1 + ACROSS]
    share, lit, apart = _shares(_across(z, row, last), _continued(z, row, last), z_back)
    good = _plausible(share) & (lit < 1.2).all(axis=1) & (apart > MIN_ANGLE)
    shadow = np.maximum(parallax * (inverse[:, -1] - 1 / d[row, last + 1 + ACROSS]), 0)
    good &= np.abs((1 - lit).sum(axis=1) - shadow) < DARK
    return row[good], last[good], inverse[good], share[good].sum(axis=1)


def _steps(d: Float64) -> tuple[Index, Index, Float64]:
    """Rows, last front pixels and inverse depths (N, REACH) up to them, where a flat front ends rightwards before something deeper."""
    width = d.shape[1] - REACH - ACROSS - 1
    inverse = np.stack([1 / d[:, k : k + width] for k in range(REACH)], axis=-1)
    front, back, beyond = (d[:, k : k + width] for k in (REACH - 1, REACH + ACROSS, REACH + ACROSS + 1))
    good = (back - front > JUMP) & (np.abs(beyond - back) < JUMP / 2) & _on_surface(inverse, front)
    row, column = np.nonzero(good)
    return row, column + REACH - 1, inverse[good]


def _across(z: Complex128, row: Index, last: Index) -> Complex128:
    """Phasors (F, N, ACROSS) of the pixels beyond a front's last."""
    return np.stack([z[:, row, last + 1 + k] for k in range(ACROSS)], axis=-1)


def _plausible(share: Float64) -> Mask:
    """Tell shares (N, ACROSS) that fall from front to back."""
    ends = (share[:, 0] > 0.85) & (share[:, -1] < 0.15)
    return np.asarray(ends & (share > -0.2).all(axis=1) & (share < 1.2).all(axis=1))


def _continued(z: Complex128, row: Index, last: Index) -> Complex128:
    """Phasors (F, N, ACROSS) that the front would have beyond its last pixels, by a line through the logarithms of its own."""
    own = np.stack([z[:, row, last - k] for k in range(REACH - 1, -1, -1)], axis=-1)
    log = np.log(own / own[..., -1:] + 1e-300)
    t = np.arange(REACH) - (REACH - 1) / 2
    slope, mean = (log @ t / (t @ t))[..., None], log.mean(axis=-1)[..., None]
    return np.asarray(own[..., -1:] * np.exp(mean + slope * (t[-1] + 1 + np.arange(ACROSS))))


def _shares(across: Complex128, z_front: Complex128, z_back: Complex128) -> tuple[Float64, Float64, Float64]:
    """Share of the front (N, ACROSS) in phasors, sum of both shares, and the least sine (N,) between front and back."""
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


def _stereo_steps(d: Float64) -> tuple[Index, Index]:
    """Rows and last front pixels, where the front ends rightwards before something deeper or nothing."""
    ends = np.isfinite(d[:, :-1]) & ~(d[:, 1:] - d[:, :-1] < JUMP)
    row, last = np.nonzero(ends)
    inside = (last >= REACH - 1) & (last < d.shape[1] - 3)
    row, last = row[inside], last[inside]
    front = d[row, last]
    inverse = 1 / np.stack([d[row, last - k] for k in range(REACH - 1, -1, -1)], axis=-1)
    gone = np.stack([~(d[row, last + k] - front < JUMP) for k in (2, 3)]).all(axis=0)
    good = gone & (_next_valid(d, row, last + 1) - front > JUMP) & _on_surface(inverse, front)
    return row[good], last[good]


def _next_valid(d: Float64, row: Index, column: Index) -> Float64:
    """Value at or right of each pixel (row, column) that is not NaN; NaN where there is none."""
    width = d.shape[1]
    columns = np.where(np.isfinite(d), np.arange(width, dtype=np.int32), np.int32(width))
    nearest = np.minimum.accumulate(columns[:, ::-1], axis=1)[row, width - 1 - column]
    out: Float64 = np.where(nearest < width, d[row, np.minimum(nearest, width - 1)], np.nan)
    return out


def _on_surface(inverse: Float64, front: Float64) -> Mask:
    """Tell which runs of inverse depth (..., REACH) before an edge at depth ``front`` are one smooth, not too steep surface."""
    bend = np.abs(np.diff(inverse, n=2, axis=-1)).max(axis=-1) * np.square(front)
    steep = np.abs(inverse[..., -1] - inverse[..., 0]) * np.square(front)
    return np.asarray((bend < FLAT) & (steep < JUMP / 2))


def _tangents(rims: Rims) -> tuple[Float64, Mask, Float64]:
    """Directions (N, 3) of rims, which (N,) are straight, and how far (N, 3) they lie off their neighbours."""
    from scipy.spatial import cKDTree

    if len(rims.points) <= TANGENT_NEIGHBOURS:
        return np.zeros_like(rims.points), np.zeros(len(rims.points), dtype=bool), np.zeros_like(rims.points)
    _, neighbours = cKDTree(rims.points).query(rims.points, TANGENT_NEIGHBOURS)
    near = rims.points[neighbours]
    centred = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    off: Float64 = rims.points - near.mean(axis=1)
    return vectors[:, :, 2], values[:, 1] < STRAIGHT**2 * values[:, 2], off


def _facing_edge(image: NDArray[Any], axis: int, sign: int) -> NDArray[Any]:
    """View of an image (..., H, W) whose last axis runs along ``axis`` in the direction of ``sign``."""
    turned = image if axis == 1 else image.swapaxes(-1, -2)
    return turned[..., ::sign]


def _outward(axis: int, sign: int, count: int) -> Float64:
    """(count, 3) unit vectors along an image axis (0 down, 1 right), camera frame."""
    out = np.zeros((count, 3))
    out[:, 0 if axis == 1 else 1] = sign
    return out


def _joined(parts: list[tuple[Float64, Float64]]) -> Rims:
    return Rims(np.concatenate([p for p, _ in parts]), np.concatenate([o for _, o in parts]))
