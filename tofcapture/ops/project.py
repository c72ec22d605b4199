"""Project the stereo surface onto the ToF image plane.

The organised stereo points are a triangulated sheet. It is cut where two neighbours are further apart in depth than a
surface can be; the cut quads become a *skirt*. A row's hole is bridged by a straight line. From a foreground edge to the first
background point that both eyes see, that line is the right eye's line of sight. So the skirt bounds the space that the stereo
camera does not know. A ToF ray that crosses the skirt before it hits the sheet went through unknown space, and so did one
that was outside the eyes' common view at a depth at which there are things.

Rays through pixel centres are intersected exactly with every triangle they can meet. Nothing is splatted: background never
leaks through a foreground that is sparser than the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.libraries import compiled
from tofcapture.poses import invert

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

STEEPEST = 5.67  # tan 80 deg: neighbours further apart in depth are not one surface
FILLED_GAP = 4  # pixels; a hole that is not wider, in a smooth surface, is interpolated
NEARER = 0.95  # things are at most this much nearer than the nearest that is measured
STEPS = 6  # places along a ray that must lie in the common view
LENS_FINER = 2  # times as fine a pinhole image is what a lens is looked up in, and
NEAREST_FINER = 3  # where the nearest of its pixels is the answer
HIDES = 0.002  # m, and relative; a skirt hides the sheet when it is nearer by both


@dataclass(frozen=True)
class Sheet:
    """A triangulated stereo depth image."""

    depth: Float64  #: (SH, SW) metres; bridged along rows, NaN outside the outermost points of a row.
    vertex: Bool  #: (SH, SW) measured, or interpolated across a small hole of a smooth surface.
    surface: Bool  #: (SH-1, SW-1) the quad of four neighbours is surface; others with four depths are skirt.
    doubtful: Bool  #: (SH, SW) interpolated across a small hole in which a step may hide.


@dataclass(frozen=True)
class Projection:
    """Hold what the ToF camera's rays meet."""

    depth: Float64  #: (H, W) metres; NaN: no surface, as for pixels and normals.
    pixels: Float64  #: (H, W, 2) (u, v) on the stereo grid of the point that is met.
    normals: Float64  #: (H, W, 3) of the triangles (noisy), ToF frame, unit, facing the camera.
    occluded: Bool  #: (H, W) a reason to mistrust the pixel.
    edge: Bool  #: (H, W) another one.


def triangulate(depth: NDArray[np.floating], camera: Camera) -> Sheet:
    """Turn a stereo depth image (SH, SW), z in metres, NaN: none, into a sheet with cuts.

    ``camera`` holds the intrinsics of that grid; :class:`DataError` when depth is not of its shape.
    """
    if depth.shape != camera.shape:
        raise DataError(f"triangulate: expected depth of shape {camera.shape}, got {depth.shape}")
    steepest = STEEPEST / min(camera.fx, camera.fy)
    z = np.array(depth, dtype=np.float64, order="C")
    vertex, doubtful = np.empty(z.shape, dtype=bool), np.zeros(z.shape, dtype=bool)
    _bridge(z, vertex, doubtful, steepest, FILLED_GAP)
    surface = np.empty((z.shape[0] - 1, z.shape[1] - 1), dtype=bool)
    _cut(z, vertex, surface, steepest)
    return Sheet(z, vertex, surface, doubtful)


def _dilate(mask: Bool, radius: int) -> Bool:
    from scipy.ndimage import maximum_filter

    out: Bool = maximum_filter(mask.view(np.uint8), 2 * radius + 1, mode="constant").view(bool)
    return out


def _jumps(depth: Float64, camera: Camera) -> Bool:
    """Mark pixels beside a step in depth that no surface at less than 80 degrees makes."""
    limit = STEEPEST / min(camera.fx, camera.fy) * depth
    out = np.zeros(camera.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        across = np.abs(np.diff(depth, axis=1)) > np.fmin(limit[:, 1:], limit[:, :-1])
        down = np.abs(np.diff(depth, axis=0)) > np.fmin(limit[1:], limit[:-1])
    for part, step in ((out[:, 1:], across), (out[:, :-1], across), (out[1:], down), (out[:-1], down)):
        np.logical_or(part, step, out=part)
    return out


def edges(depth: Float64, camera: Camera, edge_pixels: int) -> Bool:
    """Mark the pixels (H, W) that are so near to a step in depth, or to a pixel without depth."""
    return _dilate(np.isnan(depth) | _jumps(depth, camera), edge_pixels)


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
    sheet, stereo, T_tof_stereo
        From :func:`triangulate`, with the intrinsics of its grid, and (4, 4) its frame to the ToF frame.
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
    eye, grid = (np.array([c.fx, c.fy, c.cx, c.cy]) for c in (camera, stereo.pinhole("stereo depth")))
    x, y = stereo.rays[0, :, 0].copy(), stereo.rays[:, 0, 1].copy()
    found = np.full((camera.height * camera.width, 6), np.inf)
    skirt = np.full(camera.height * camera.width, np.inf)
    _render(sheet.depth, sheet.surface, x, y, T_tof_stereo, far, eye, camera.shape, found, skirt)
    found[~np.isfinite(found[:, 0])] = np.nan
    image = found.reshape(*camera.shape, 6)
    depth, hidden = np.ascontiguousarray(image[..., 0]), skirt.reshape(camera.shape)
    border = _borders(sheet, x, y, T_tof_stereo, far, camera, depth)
    edge = _dilate(np.isnan(depth) | border | _jumps(depth, camera), edge_pixels)
    # Those beside it hit measured surface: marking them too would cost small far objects half of their pixels.
    _interpolated(sheet.doubtful, image[..., 1:3], edge)
    aside = np.zeros(camera.shape, dtype=bool)
    if np.isfinite(depth).any():
        near = NEARER * float(np.nanmin(depth))
        _unseen(sheet.depth, grid, invert(T_tof_stereo), eye, near, depth, STEPS, aside)
    return Projection(
        depth=depth,
        pixels=image[..., 1:3],
        normals=image[..., 3:6],
        occluded=aside | (np.isfinite(hidden) & ~(hidden > depth * (1 - HIDES) - HIDES)),
        edge=edge,
    )


class RayCast:
    """Cast the rays (H, W, 3) of a window of a camera's image at sheets; a lens's are those of the nearest finer pixels."""

    def __init__(self, camera: Camera, rays: Float64) -> None:
        finer = NEAREST_FINER if camera.distortion else 1
        low, high = (f(rays[..., :2].reshape(-1, 2).T.copy(), axis=1) for f in (np.min, np.max))
        focal = finer * np.array([camera.fx, camera.fy])
        width, height = (np.rint((high - low) * focal).astype(int) + 1).tolist()
        self._eye = Camera(width, height, *focal.tolist(), *(-low * focal).tolist())
        self._at = None if finer == 1 else np.rint(self._eye.project(rays)[0]).astype(np.intp)
        self._found = np.empty((height, width, 3))
        self.shape: tuple[int, int] = rays.shape[:2]

    def met(
        self, depth: NDArray[np.floating], surface: Bool, x: Float64, y: Float64, T: Float64, far: float
    ) -> Float64:
        """Find where the rays first meet a sheet's surface from its front; nothing else is asked.

        ``depth`` (h, w) is NaN at what is no corner of ``surface`` (h-1, w-1), ``x`` (w,) and ``y`` (h,) are the rays of its grid,
        ``T`` (4, 4) maps its frame to the camera's. Points deeper than ``far`` there are no surface.

        Returns (H, W, 3) depth, infinite: no surface, and the place (u, v) on the grid; the next call may overwrite it.
        """
        self._found.fill(np.inf)
        eye = np.array([self._eye.fx, self._eye.fy, self._eye.cx, self._eye.cy])
        z, cut, nowhere = depth.astype(np.float64), np.ascontiguousarray(surface), np.empty(0)
        _render(z, cut, x, y, T, far, eye, self._eye.shape, self._found.reshape(-1, 3), nowhere)
        return self._found if self._at is None else self._found[self._at[..., 1], self._at[..., 0]]


def _borders(
    sheet: Sheet, x: Float64, y: Float64, T: Float64, far: float, camera: Camera, depth: Float64
) -> Bool:
    """Mark the pixels where the sheet visibly ends or is cut: a vertex there has a quad about it that is no surface."""
    inner = np.zeros_like(sheet.vertex)
    s = sheet.surface
    inner[1:-1, 1:-1] = s[:-1, :-1] & s[:-1, 1:] & s[1:, :-1] & s[1:, 1:]
    v, u = np.nonzero(sheet.vertex & ~inner)
    p, q, r = (sheet.depth[v, u] * (T[k, 0] * x[u] + T[k, 1] * y[v] + T[k, 2]) + T[k, 3] for k in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where((r > 0) & (r < far), r, np.nan)
        at = np.rint([camera.fy * q / z + camera.cy, camera.fx * p / z + camera.cx])
        inside = ((at >= 0) & (at < np.array(camera.shape)[:, None])).all(axis=0)
    row, column = at[:, inside].astype(np.intp)
    seen = ~(r[inside] > depth[row, column] * 1.01 + 0.005)
    mark = np.zeros(camera.shape, dtype=bool)
    mark[row[seen], column[seen]] = True
    return mark


@compiled
def _interpolated(doubtful: Bool, pixels: Float64, mark: Bool) -> None:
    """Mark the pixels (H, W) whose hit ``pixels`` (H, W, 2) lies on a quad with a doubtful corner."""
    rows, columns = doubtful.shape
    for pv in range(mark.shape[0]):
        for pu in range(mark.shape[1]):
            if np.isfinite(pixels[pv, pu, 0]):
                u, v = min(int(pixels[pv, pu, 0]), columns - 2), min(int(pixels[pv, pu, 1]), rows - 2)
                mark[pv, pu] |= doubtful[v : v + 2, u : u + 2].any()


@compiled
def _bridge(z: Float64, vertex: Bool, doubtful: Bool, steepest: float, filled_gap: int) -> None:
    """Fill holes of rows linearly in inverse depth, in place; small fills of a smooth surface become vertices.

    Those are ``doubtful`` (start with False) where a step may hide that would have been cut between neighbours.
    """
    height, width = z.shape
    for v in range(height):
        last = -1
        for b in range(width):
            zb = z[v, b]
            vertex[v, b] = np.isfinite(zb)
            if not vertex[v, b]:
                continue
            if last >= 0 and b - last > 1:
                za, span = z[v, last], b - last
                step, limit = abs(za - zb), steepest * min(za, zb)
                smooth = span - 1 <= filled_gap and step <= limit * span
                for u in range(last + 1, b):
                    t = (u - last) / span
                    z[v, u] = 1 / ((1 - t) / za + t / zb)
                    vertex[v, u] = smooth
                    doubtful[v, u] = smooth and step > limit
            last = b


@compiled
def _cut(z: Float64, vertex: Bool, surface: Bool, steepest: float) -> None:
    """Say which quads are surface: four vertices, neighbours no further apart in depth than a surface can be."""
    height, width = z.shape
    for v in range(height - 1):
        for u in range(width - 1):
            a, b, c, d = z[v, u], z[v, u + 1], z[v + 1, u], z[v + 1, u + 1]
            whole = vertex[v, u] & vertex[v, u + 1] & vertex[v + 1, u] & vertex[v + 1, u + 1]
            across = (abs(b - a) <= steepest * b) & (abs(d - c) <= steepest * d)
            down = (abs(c - a) <= steepest * c) & (abs(d - b) <= steepest * d)
            surface[v, u] = whole & across & down


@compiled
def _points_of_row(
    z: Float64, x: Float64, y: float, pose: Float64, far: float, eye: Float64, p: Float64, uv: Float64
) -> None:
    """Points (W, 3) of one row in the frame of the eye, and their pixels (W, 2); NaN beyond ``far`` and behind it.

    ``x`` (W,) and ``y`` are the rays of the row, ``pose`` (4, 4) maps it to the eye, ``eye`` is fx, fy, cx, cy.
    """
    for u in range(len(z)):
        for k in range(3):
            p[u, k] = z[u] * (pose[k, 0] * x[u] + pose[k, 1] * y + pose[k, 2]) + pose[k, 3]
        depth = p[u, 2] if 0 < p[u, 2] < far else np.nan
        uv[u, 0] = eye[0] * p[u, 0] / depth + eye[2]
        uv[u, 1] = eye[1] * p[u, 1] / depth + eye[3]


@compiled
def _cross(a: Float64, b: Float64) -> tuple[float, float, float]:
    """Cross product as three numbers: nothing is allocated."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _meet(
    n: tuple[float, float, float], m: tuple[float, float, float], k: tuple[float, float, float],
    det: float, x: float, y: float,
) -> tuple[float, float, float, float, bool]:  # fmt: skip
    """Ray (x, y, 1) against a triangle: depth (NaN: missed), three barycentric weights, whether it came from the front.

    The arguments are the three cross products of :func:`_trace`.
    """
    w0, w1, w2 = n[0] * x + n[1] * y + n[2], m[0] * x + m[1] * y + m[2], k[0] * x + k[1] * y + k[2]
    total = w0 + w1 + w2
    inside = (w0 >= 0 and w1 >= 0 and w2 >= 0) or (w0 <= 0 and w1 <= 0 and w2 <= 0)
    if not inside or total == 0:
        return np.nan, 0.0, 0.0, 0.0, False
    depth = det / total
    return (depth if depth > 0 else np.nan), w0 / total, w1 / total, w2 / total, total > 0


@compiled
def _keep_nearest(
    depth: float, u: float, v: float, normal: tuple[float, float, float], pixel: int, out: Float64
) -> None:
    """Keep a hit where it is the nearest of its pixel: depth, place on the grid, normal. NaN compares false."""
    if depth < out[pixel, 0]:
        out[pixel, 0], out[pixel, 1], out[pixel, 2] = depth, u, v
        if out.shape[1] == 3:  # nobody asks for normals
            return
        size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        out[pixel, 3], out[pixel, 4], out[pixel, 5] = -normal[0] / size, -normal[1] / size, -normal[2] / size


@compiled
def _trace(
    corners: tuple[Float64, Float64, Float64, Float64], box: tuple[int, int, int, int], at: tuple[int, int],
    surface: bool, eye: Float64, width: int, out: Float64, skirt: Float64,
) -> None:  # fmt: skip
    """Intersect the rays of the pixels in a box with both triangles of a quad.

    For a triangle abc and a ray r the numbers ``r . (b x c)``, ``r . (c x a)``, ``r . (a x b)`` have one sign exactly when
    the ray goes through it. They are its barycentric weights, and ``det(a, b, c)`` over their sum is the depth. Neighbouring
    triangles compute the same numbers for their common edge: no ray slips between them.
    """
    a, b, c, d = corners
    bc, ca, ab, dc, bd = _cross(b, c), _cross(c, a), _cross(a, b), _cross(d, c), _cross(b, d)
    cb = (-bc[0], -bc[1], -bc[2])
    det_a = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2]
    det_d = d[0] * cb[0] + d[1] * cb[1] + d[2] * cb[2]
    upper = (ab[0] + bc[0] + ca[0], ab[1] + bc[1] + ca[1], ab[2] + bc[2] + ca[2])
    lower = (dc[0] + bd[0] + cb[0], dc[1] + bd[1] + cb[1], dc[2] + bd[2] + cb[2])
    for pv in range(box[2], box[3] + 1):
        for pu in range(box[0], box[1] + 1):
            x, y, pixel = (pu - eye[2]) / eye[0], (pv - eye[3]) / eye[1], pv * width + pu
            depth, _, wb, wc, front = _meet(bc, ca, ab, det_a, x, y)
            if surface and front:
                _keep_nearest(depth, at[1] + wb, at[0] + wc, upper, pixel, out)
            elif len(skirt) and depth < skirt[pixel]:
                skirt[pixel] = depth
            depth, wb, wc, wd, front = _meet(dc, bd, cb, det_d, x, y)
            if surface and front:
                _keep_nearest(depth, at[1] + wb + wd, at[0] + wc + wd, lower, pixel, out)
            elif len(skirt) and depth < skirt[pixel]:
                skirt[pixel] = depth


@compiled
def _render(
    z: Float64, surface: Bool, x: Float64, y: Float64, pose: Float64, far: float,
    eye: Float64, size: tuple[int, int], out: Float64, skirt: Float64,
) -> None:  # fmt: skip
    """Find the nearest hits of all pixels' rays with a sheet ``z``, ``surface`` and with its skirt.

    ``x`` and ``y`` are rays of the grid, ``pose`` maps its frame to that of the ``eye`` (fx, fy, cx, cy), whose image has
    ``size`` (H, W). ``out`` (H W, 6) receives depth, place on the grid (u, v), normal, ``skirt`` (H W,) depth; both start with
    infinity. ``out`` may be (H W, 3), without normals, ``skirt`` empty.
    """
    height, width = size
    p, q = np.empty((len(x), 3)), np.empty((len(x), 3))
    s, t = np.empty((len(x), 2)), np.empty((len(x), 2))
    _points_of_row(z[0], x, y[0], pose, far, eye, p, s)
    for v in range(len(y) - 1):
        _points_of_row(z[v + 1], x, y[v + 1], pose, far, eye, q, t)
        for u in range(len(x) - 1):
            if not (surface[v, u] or len(skirt)):
                continue
            u0 = np.ceil(max(min(s[u, 0], s[u + 1, 0], t[u, 0], t[u + 1, 0]), 0.0))
            u1 = np.floor(min(max(s[u, 0], s[u + 1, 0], t[u, 0], t[u + 1, 0]), width - 1.0))
            v0 = np.ceil(max(min(s[u, 1], s[u + 1, 1], t[u, 1], t[u + 1, 1]), 0.0))
            v1 = np.floor(min(max(s[u, 1], s[u + 1, 1], t[u, 1], t[u + 1, 1]), height - 1.0))
            whole = np.isfinite(s[u, 0] + s[u + 1, 0] + t[u, 0] + t[u + 1, 0])
            if whole and u0 <= u1 and v0 <= v1:
                box = (int(u0), int(u1), int(v0), int(v1))
                corners = (p[u], p[u + 1], q[u], q[u + 1])
                _trace(corners, box, (v, u), surface[v, u], eye, width, out, skirt)
        p, q, s, t = q, p, t, s


@compiled
def _unseen(
    z: Float64,
    stereo: Float64,
    back: Float64,
    eye: Float64,
    near: float,
    depth: Float64,
    steps: int,
    mark: Bool,
) -> None:
    """Mark the pixels (H, W) whose ray, between depth ``near`` and its hit, leaves what the sheet's rows span.

    ``stereo`` and ``eye`` are fx, fy, cx, cy of the sheet's grid and of the image, ``back`` (4, 4) maps the eye's frame to the
    stereo frame.
    """
    rows, columns = z.shape
    first, last = np.full(rows, columns), np.full(rows, -1)
    for v in range(rows):
        for u in range(columns):
            if np.isfinite(z[v, u]):
                first[v], last[v] = min(first[v], u), u
    p = np.empty(3)
    for pv in range(mark.shape[0]):
        for pu in range(mark.shape[1]):
            x, y = (pu - eye[2]) / eye[0], (pv - eye[3]) / eye[1]
            for step in range(steps):
                depth_here = near + (depth[pv, pu] - near) * step / steps
                if not near < depth[pv, pu]:  # nothing measured is nearer; NaN compares false
                    break
                for k in range(3):
                    p[k] = depth_here * (back[k, 0] * x + back[k, 1] * y + back[k, 2]) + back[k, 3]
                u, v = stereo[0] * p[0] / p[2] + stereo[2], stereo[1] * p[1] / p[2] + stereo[3]
                seen = p[2] > 0 and 0 <= v < rows - 0.5
                if not seen or not (first[int(np.rint(v))] <= u <= last[int(np.rint(v))]):
                    mark[pv, pu] = True
                    break
