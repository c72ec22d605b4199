"""Project the stereo surface onto the ToF image plane.

The organised stereo points are a triangulated sheet. Where two neighbours are further apart in depth than a surface can be,
the sheet is cut; the cut quads become a *skirt*. A row's hole is bridged by a straight line: from a foreground edge to
the first background point that both eyes see, that line is the right eye's line of sight, so the skirt bounds the space that
the stereo camera does not know. A ToF ray that crosses the skirt before it hits the sheet went through unknown space, and so
did one that was outside the eyes' common view at a depth at which there are things.

Rays through pixel centres are intersected exactly with every triangle they can meet; nothing is splatted, so background
never leaks through a foreground that is sparser than the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.poses import invert

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

STEEPEST = 5.67  # tan 80 deg: neighbours further apart in depth are not one surface
FILLED_GAP = 4  # pixels; a hole that is not wider, in a smooth surface, is interpolated
NEARER = 0.95  # things are at most this much nearer than the nearest that is measured
STEPS = 6  # places along a ray that must lie in the common view
LENS_FINER = 2  # times as fine a pinhole image is what a lens is looked up in
HIDES = 0.002  # m, and relative; a skirt hides the sheet when it is nearer by both


@dataclass(frozen=True)
class Sheet:
    """A triangulated stereo depth image.

    Attributes
    ----------
    depth
        (SH, SW) float64, stereo frame, metres; holes are bridged along rows, NaN outside the outermost points of a row.
    vertex
        (SH, SW) bool, measured, or interpolated across a small hole of a smooth surface.
    surface
        (SH-1, SW-1) bool, the quad between four neighbours is surface; other quads with four depths are skirt.
    doubtful
        (SH, SW) bool, interpolated across a small hole whose ends differ by more than neighbours on one surface can: a step
        may hide in it.
    """

    depth: Float64
    vertex: Bool
    surface: Bool
    doubtful: Bool


@dataclass(frozen=True)
class Projection:
    """What the ToF camera's rays meet.

    Attributes
    ----------
    depth
        (H, W) float64, metres; NaN: no surface.
    pixels
        (H, W, 2) float64, (u, v) on the stereo grid of the point that is met; NaN where depth is.
    normals
        (H, W, 3) float64, of the triangles (noisy), ToF frame, unit, facing the camera; NaN where depth is.
    occluded, edge
        (H, W) bool, reasons to mistrust the pixel.
    """

    depth: Float64
    pixels: Float64
    normals: Float64
    occluded: Bool
    edge: Bool


def _axes(camera: Camera) -> tuple[Float64, Float64]:
    """Rays of a camera's columns and rows."""
    rays = camera.pinhole("stereo depth").rays
    return rays[0, :, 0].copy(), rays[:, 0, 1].copy()


def triangulate(depth: NDArray[np.floating], camera: Camera) -> Sheet:
    """Turn a stereo depth image into a sheet with cuts.

    ``depth`` is (SH, SW) z in the stereo frame in metres, NaN: none; ``camera`` holds the intrinsics of that grid.

    Raises
    ------
    DataError
        When depth is not of the camera's shape.
    """
    from tofcapture.ops.kernels.sheet import bridge, cut

    if depth.shape != camera.shape:
        raise DataError(f"triangulate: expected depth of shape {camera.shape}, got {depth.shape}")
    steepest = STEEPEST / min(camera.fx, camera.fy)
    z = np.array(depth, dtype=np.float64, order="C")
    vertex, doubtful = np.empty(z.shape, dtype=bool), np.zeros(z.shape, dtype=bool)
    bridge(z, vertex, doubtful, steepest, FILLED_GAP)
    surface = np.empty((z.shape[0] - 1, z.shape[1] - 1), dtype=bool)
    cut(z, vertex, surface, steepest)
    return Sheet(z, vertex, surface, doubtful)


def _dilate(mask: Bool, radius: int) -> Bool:
    padded = np.pad(mask, radius)
    height, width = mask.shape
    out = np.zeros_like(mask)
    for dv in range(2 * radius + 1):
        for du in range(2 * radius + 1):
            out |= padded[dv : dv + height, du : du + width]
    return out


def _jumps(depth: Float64, camera: Camera) -> Bool:
    """Pixels beside a step in depth that no surface at less than 80 degrees makes."""
    limit = STEEPEST / min(camera.fx, camera.fy) * depth
    out = np.zeros(camera.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        across = np.abs(np.diff(depth, axis=1)) > np.fmin(limit[:, 1:], limit[:, :-1])
        down = np.abs(np.diff(depth, axis=0)) > np.fmin(limit[1:], limit[:-1])
    out[:, 1:] |= across
    out[:, :-1] |= across
    out[1:] |= down
    out[:-1] |= down
    return out


def _through_lens(
    sheet: Sheet, stereo: Camera, T_tof_stereo: Float64, camera: Camera, edge_pixels: int, far: float
) -> Projection:
    """Render into a finer pinhole camera; every ray of the lens meets the triangle that its nearest fine ray met."""
    rays = camera.rays
    low, high = rays[..., :2].min(axis=(0, 1)), rays[..., :2].max(axis=(0, 1))
    focal = LENS_FINER * np.array([camera.fx, camera.fy])
    size = np.ceil((high - low) * focal).astype(int) + 3
    centre = 1 - low * focal
    fine = Camera(int(size[0]), int(size[1]), *focal.tolist(), *centre.tolist())
    found = project(sheet, stereo, T_tof_stereo, fine, 0, far)
    u, v = np.rint(fine.project(rays)[0]).astype(np.intp).transpose(2, 0, 1)
    depth, normals, at = found.depth[v, u], found.normals[v, u], fine.rays[v, u]
    with np.errstate(divide="ignore", invalid="ignore"):
        slid = depth * (normals * at).sum(axis=-1) / (normals * rays).sum(axis=-1)
        # Where a triangle is seen from its side, half a fine pixel is far along it: its own depth is nearer to the truth.
        slid = np.where(np.abs(slid - depth) < STEEPEST / focal.min() * depth, slid, depth)
    back = invert(T_tof_stereo)
    points = (slid[..., None] * rays) @ back[:3, :3].T + back[:3, 3]
    near_edge = found.edge[v, u] | np.isnan(slid) | _jumps(slid, camera)
    return Projection(
        depth=slid,
        pixels=stereo.project(points)[0],
        normals=normals,
        occluded=found.occluded[v, u],
        edge=_dilate(near_edge, edge_pixels),
    )


def project(
    sheet: Sheet, stereo: Camera, T_tof_stereo: Float64, camera: Camera, edge_pixels: int, far: float = np.inf
) -> Projection:
    """Render the sheet into a camera on the ToF plane.

    Parameters
    ----------
    sheet
        From :func:`triangulate`.
    stereo
        Intrinsics of the sheet's grid.
    T_tof_stereo
        (4, 4) stereo frame to ToF frame.
    camera
        Intrinsics on the ToF plane, any size.
    edge_pixels
        Pixels this near to a depth edge or to a pixel without surface are marked, and so is a pixel whose surface is
        interpolated where a step may hide.
    far
        Points deeper than this in the ToF frame are no surface, metres.
    """
    if camera.distortion:
        return _through_lens(sheet, stereo, T_tof_stereo, camera, edge_pixels, far)
    from tofcapture.ops.kernels.sheet import borders, invented, render, unseen

    eye = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    x, y = _axes(stereo)
    found = np.full((camera.height * camera.width, 6), np.inf)
    skirt = np.full(camera.height * camera.width, np.inf)
    render(sheet.depth, sheet.surface, x, y, T_tof_stereo, far, eye, camera.shape, found, skirt)
    found[~np.isfinite(found[:, 0])] = np.nan
    image = found.reshape(*camera.shape, 6)
    depth = np.ascontiguousarray(image[..., 0])
    border = np.zeros(camera.shape, dtype=bool)
    borders(sheet.depth, sheet.vertex, sheet.surface, x, y, T_tof_stereo, far, eye, depth, border)
    edge = _dilate(np.isnan(depth) | border | _jumps(depth, camera), edge_pixels)
    # Those beside it hit measured surface: marking them too would cost small far objects half of their pixels.
    invented(sheet.doubtful, image[..., 1:3], edge)
    hidden = skirt.reshape(camera.shape)
    aside = np.zeros(camera.shape, dtype=bool)
    if np.isfinite(depth).any():
        near, grid = NEARER * float(np.nanmin(depth)), np.array([stereo.fx, stereo.fy, stereo.cx, stereo.cy])
        unseen(sheet.depth, grid, invert(T_tof_stereo), eye, near, depth, STEPS, aside)
    return Projection(
        depth=depth,
        pixels=image[..., 1:3],
        normals=image[..., 3:6],
        occluded=aside | (np.isfinite(hidden) & ~(hidden > depth * (1 - HIDES) - HIDES)),
        edge=edge,
    )
