"""Rims: where a surface ends before a deeper one, found to a fraction of a pixel.

Point-to-plane registration slides along a board; the rims of its outline and of its holes hold it. A ToF rim is an angle, free
of any range error: the pixels across it are mixtures ``z = w z_front + (1 - w) z_back`` of phasors, and the sum of w says
where the front ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Cloud
from tofcapture.camera import Camera
from tofcapture.poses import Float64

JUMP = 0.04  # m of depth behind a rim: far more than noise, bias and a board's own thickness
FLAT = 0.004  # m, most departure of the front's pixels from a straight line in inverse depth
REACH = 4  # px of flat front that a rim needs
TANGENT_NEIGHBOURS = 12
STRAIGHT = 0.2  # largest ratio of the second to the first principal axis of a rim's neighbours
REPEAT = 40  # surface points that one rim point weighs as much as: rims are few, and free of range bias


@dataclass(frozen=True)
class Rims:
    """Points on rims.

    Attributes
    ----------
    points
        (N, 3) float64, camera frame, metres; on the front surface's edge.
    outward
        (N, 3) float64, unit, image axis along which the front ends.
    """

    points: Float64
    outward: Float64


def tof_rims(phasor: NDArray[np.complex128], depth: Float64, camera: Camera) -> Rims:
    """Rims in a ToF image.

    Parameters
    ----------
    phasor
        (F, H, W) complex, burst-averaged.
    depth
        (H, W) metres, NaN where it cannot be decoded.
    camera
        Intrinsics.

    Returns
    -------
    Rims
        ToF frame.
    """
    found = []
    for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):
        z, d = facing_edge(phasor, axis, sign), facing_edge(depth, axis, sign)
        row, front, inverse, w = _tof_steps(z, d)
        at = front + 0.5 + w
        along = at if sign > 0 else d.shape[-1] - 1 - at
        uv = (along, row) if axis == 1 else (row, along)
        ray = camera.rays_at(np.stack(uv, axis=-1))
        slope = (inverse[:, -1] - inverse[:, 0]) / (REACH - 1)
        reach = at - front + (REACH - 1) / 2
        found.append((ray / (inverse.mean(axis=1) + slope * reach)[:, None], outward(axis, sign, len(row))))
    return joined(found)


def rim_cloud(rims: Rims, seen_from: Float64) -> Cloud:
    """Give rim points the normals that make point-to-plane registration hold them.

    The normal is across the rim and across the ray from the ToF camera: a range error moves a ToF rim along that ray and so
    costs nothing.

    Parameters
    ----------
    rims
        Stereo rims.
    seen_from
        (3,) ToF camera in the stereo frame, metres; centimetres suffice.

    Returns
    -------
    Cloud
        The rims that are locally straight.
    """
    tangents, straight, _ = rim_tangents(rims)
    across = np.cross(tangents, rims.points - seen_from)
    length = np.linalg.norm(across, axis=-1)
    good = straight & (length > 0)
    return Cloud(rims.points[good], across[good] / length[good, None])


def rim_tangents(rims: Rims) -> tuple[Float64, NDArray[np.bool_], Float64]:
    """Directions (N, 3) along which rims run, of either sign, which (N,) are straight, and how far (N, 3) they lie off their neighbours."""
    from scipy.spatial import cKDTree

    if len(rims.points) <= TANGENT_NEIGHBOURS:
        return np.zeros_like(rims.points), np.zeros(len(rims.points), dtype=bool), np.zeros_like(rims.points)
    _, neighbours = cKDTree(rims.points).query(rims.points, TANGENT_NEIGHBOURS)
    near = rims.points[neighbours]
    centred = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    off: Float64 = rims.points - near.mean(axis=1)
    return vectors[:, :, 2], values[:, 1] < STRAIGHT**2 * values[:, 2], off


def _tof_steps(
    z: NDArray[np.complex128], d: Float64
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64, Float64]:
    """Rows, last front pixels, inverse depths (N, REACH) up to them and mixed widths, where the front ends rightwards."""
    width = d.shape[1] - REACH - 4
    window = {k: slice(k, k + width) for k in range(REACH + 5)}
    inverse = np.stack([1 / d[:, window[k]] for k in range(REACH)], axis=-1)
    front, back = d[:, window[REACH - 1]], d[:, window[REACH + 3]]
    z_front, z_back = z[..., window[REACH - 1]], z[..., window[REACH + 3]]
    across = np.stack([z[..., window[REACH + k]] for k in range(3)], axis=-1)
    contrast = z_front - z_back
    mixed = ((across - z_back[..., None]) * contrast.conj()[..., None]).real.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        w = mixed / np.square(np.abs(contrast)).sum(axis=0)[..., None]
    behind = np.abs(d[:, window[REACH + 4]] - back) < JUMP / 2
    clean = (w[..., 0] > 0.85) & (w[..., 2] < 0.15) & (w > -0.2).all(axis=-1) & (w < 1.2).all(axis=-1)
    strong = np.abs(contrast).max(axis=0) > 0.2 * np.abs(z_front).max(axis=0)
    good = (back - front > JUMP) & behind & clean & strong & on_surface(inverse, front)
    row, column = np.nonzero(good)
    return row, column + REACH - 1, inverse[good], np.clip(w[good], 0, 1).sum(axis=-1)


def stereo_rims(points: NDArray[np.floating]) -> Rims:
    """Rims in an organised point map (H, W, 3) of the stereo camera, at the outer border of the last pixel of the front."""
    found = []
    for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):
        P = points if axis == 1 else points.swapaxes(0, 1)
        P = P[:, ::sign]
        row, last = _stereo_steps(P[..., 2].astype(np.float64))
        edge, inner = P[row, last].astype(np.float64), P[row, last - REACH + 1].astype(np.float64)
        found.append((edge + (edge - inner) / (2 * (REACH - 1)), outward(axis, sign, len(row))))
    return joined(found)


def _stereo_steps(d: Float64) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and last front pixels, where the front ends rightwards before something deeper."""
    ends = np.isfinite(d[:, :-1]) & ~(d[:, 1:] - d[:, :-1] < JUMP)
    row, last = np.nonzero(ends)
    inside = (last >= REACH - 1) & (last < d.shape[1] - 3)
    row, last = row[inside], last[inside]
    front = d[row, last]
    inverse = 1 / np.stack([d[row, last - k] for k in range(REACH - 1, -1, -1)], axis=-1)
    gone = np.stack([~(d[row, last + k] - front < JUMP) for k in (2, 3)]).all(axis=0)
    good = gone & (_next_valid(d, row, last + 1) - front > JUMP) & on_surface(inverse, front)
    return row[good], last[good]


def _next_valid(d: Float64, row: NDArray[np.intp], column: NDArray[np.intp]) -> Float64:
    """Value at or right of each pixel (row, column) that is not NaN; NaN where there is none."""
    width = d.shape[1]
    columns = np.where(np.isfinite(d), np.arange(width, dtype=np.int32), np.int32(width))
    nearest = np.minimum.accumulate(columns[:, ::-1], axis=1)[row, width - 1 - column]
    out: Float64 = np.where(nearest < width, d[row, np.minimum(nearest, width - 1)], np.nan)
    return out


def on_surface(inverse: Float64, front: Float64) -> NDArray[np.bool_]:
    """Tell which runs of inverse depth (N, REACH) before an edge are one smooth, not too steep surface; ``front`` (N,) is their depth."""
    bend = np.abs(np.diff(inverse, n=2, axis=-1)).max(axis=-1) * np.square(front)
    steep = np.abs(inverse[..., -1] - inverse[..., 0]) * np.square(front)
    return np.asarray((bend < FLAT) & (steep < JUMP / 2))


def facing_edge(image: NDArray[Any], axis: int, sign: int) -> NDArray[Any]:
    """View of an image (..., H, W) whose last axis runs along ``axis`` in the direction of ``sign``."""
    turned = image if axis == 1 else image.swapaxes(-1, -2)
    return turned[..., ::sign]


def outward(axis: int, sign: int, count: int) -> Float64:
    """(count, 3) unit vectors along an image axis (0 down, 1 right), camera frame."""
    out = np.zeros((count, 3))
    out[:, 0 if axis == 1 else 1] = sign
    return out


def joined(parts: list[tuple[Float64, Float64]]) -> Rims:
    """One set of rims from parts (points, outward directions)."""
    return Rims(np.concatenate([p for p, _ in parts]), np.concatenate([o for _, o in parts]))
