"""The stereo grid as a surface: bridging, cutting, and rays against its triangles, a row of the grid at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.compiled import compiled

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@compiled
def bridge(z: Float64, vertex: Bool, doubtful: Bool, steepest: float, filled_gap: int) -> None:
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
def cut(z: Float64, vertex: Bool, surface: Bool, steepest: float) -> None:
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
def place(
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
def cross(a: Float64, b: Float64) -> tuple[float, float, float]:
    """Cross product as three numbers: nothing is allocated."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def meet(
    n: tuple[float, float, float], m: tuple[float, float, float], k: tuple[float, float, float],
    det: float, x: float, y: float,
) -> tuple[float, float, float, float, bool]:  # fmt: skip
    """Ray (x, y, 1) against a triangle: depth (NaN: missed), three barycentric weights, whether it came from the front.

    The arguments are the three cross products of :func:`trace`.
    """
    w0, w1, w2 = n[0] * x + n[1] * y + n[2], m[0] * x + m[1] * y + m[2], k[0] * x + k[1] * y + k[2]
    total = w0 + w1 + w2
    inside = (w0 >= 0 and w1 >= 0 and w2 >= 0) or (w0 <= 0 and w1 <= 0 and w2 <= 0)
    if not inside or total == 0:
        return np.nan, 0.0, 0.0, 0.0, False
    depth = det / total
    return (depth if depth > 0 else np.nan), w0 / total, w1 / total, w2 / total, total > 0


@compiled
def record(
    depth: float, u: float, v: float, normal: tuple[float, float, float], pixel: int, out: Float64
) -> None:
    """Keep a hit where it is the nearest of its pixel: depth, place on the grid, normal. NaN compares false."""
    if depth < out[pixel, 0]:
        size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        out[pixel, 0], out[pixel, 1], out[pixel, 2] = depth, u, v
        out[pixel, 3], out[pixel, 4], out[pixel, 5] = -normal[0] / size, -normal[1] / size, -normal[2] / size


@compiled
def trace(
    corners: tuple[Float64, Float64, Float64, Float64], box: tuple[int, int, int, int], at: tuple[int, int],
    surface: bool, eye: Float64, width: int, out: Float64, skirt: Float64,
) -> None:  # fmt: skip
    """Intersect the rays of the pixels in a box with both triangles of a quad.

    For a triangle abc and a ray r the numbers ``r . (b x c)``, ``r . (c x a)``, ``r . (a x b)`` have one sign exactly when
    the ray goes through it, are its barycentric weights, and ``det(a, b, c)`` over their sum is the depth. Neighbouring
    triangles compute the same numbers for their common edge: no ray slips between them.
    """
    a, b, c, d = corners
    bc, ca, ab, dc, bd = cross(b, c), cross(c, a), cross(a, b), cross(d, c), cross(b, d)
    cb = (-bc[0], -bc[1], -bc[2])
    det_a = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2]
    det_d = d[0] * cb[0] + d[1] * cb[1] + d[2] * cb[2]
    upper = (ab[0] + bc[0] + ca[0], ab[1] + bc[1] + ca[1], ab[2] + bc[2] + ca[2])
    lower = (dc[0] + bd[0] + cb[0], dc[1] + bd[1] + cb[1], dc[2] + bd[2] + cb[2])
    for pv in range(box[2], box[3] + 1):
        for pu in range(box[0], box[1] + 1):
            x, y, pixel = (pu - eye[2]) / eye[0], (pv - eye[3]) / eye[1], pv * width + pu
            depth, _, wb, wc, front = meet(bc, ca, ab, det_a, x, y)
            if surface and front:
                record(depth, at[1] + wb, at[0] + wc, upper, pixel, out)
            elif depth < skirt[pixel]:
                skirt[pixel] = depth
            depth, wb, wc, wd, front = meet(dc, bd, cb, det_d, x, y)
            if surface and front:
                record(depth, at[1] + wb + wd, at[0] + wc + wd, lower, pixel, out)
            elif depth < skirt[pixel]:
                skirt[pixel] = depth


@compiled
def render(
    z: Float64, surface: Bool, x: Float64, y: Float64, pose: Float64, far: float,
    eye: Float64, size: tuple[int, int], out: Float64, skirt: Float64,
) -> None:  # fmt: skip
    """Nearest hits of all pixels' rays with a sheet and with its skirt.

    Parameters
    ----------
    z, surface
        (SH, SW), (SH-1, SW-1) the sheet.
    x, y
        (SW,), (SH,) rays of the stereo grid.
    pose, far
        (4, 4) stereo to eye; depth limit in the eye's frame.
    eye, size
        fx, fy, cx, cy; height and width of the eye's image.
    out
        (H W, 6) depth (start with infinity), place on the grid (u, v), normal.
    skirt
        (H W,) depth, start with infinity.
    """
    height, width = size
    p, q = np.empty((len(x), 3)), np.empty((len(x), 3))
    s, t = np.empty((len(x), 2)), np.empty((len(x), 2))
    place(z[0], x, y[0], pose, far, eye, p, s)
    for v in range(len(y) - 1):
        place(z[v + 1], x, y[v + 1], pose, far, eye, q, t)
        for u in range(len(x) - 1):
            u0 = np.ceil(max(min(s[u, 0], s[u + 1, 0], t[u, 0], t[u + 1, 0]), 0.0))
            u1 = np.floor(min(max(s[u, 0], s[u + 1, 0], t[u, 0], t[u + 1, 0]), width - 1.0))
            v0 = np.ceil(max(min(s[u, 1], s[u + 1, 1], t[u, 1], t[u + 1, 1]), 0.0))
            v1 = np.floor(min(max(s[u, 1], s[u + 1, 1], t[u, 1], t[u + 1, 1]), height - 1.0))
            whole = np.isfinite(s[u, 0] + s[u + 1, 0] + t[u, 0] + t[u + 1, 0])
            if whole and u0 <= u1 and v0 <= v1:
                box = (int(u0), int(u1), int(v0), int(v1))
                corners = (p[u], p[u + 1], q[u], q[u + 1])
                trace(corners, box, (v, u), surface[v, u], eye, width, out, skirt)
        p, q, s, t = q, p, t, s


@compiled
def borders(
    z: Float64, vertex: Bool, surface: Bool, x: Float64, y: Float64, pose: Float64, far: float,
    eye: Float64, depth: Float64, mark: Bool,
) -> None:  # fmt: skip
    """Mark the pixels (H, W) where the sheet visibly ends or is cut."""
    height, width = mark.shape
    rows, columns = surface.shape
    p, s = np.empty((1, 3)), np.empty((1, 2))
    for v in range(rows + 1):
        for u in range(columns + 1):
            inner = 0 < v < rows and 0 < u < columns
            inner = (
                inner and surface[v, u] and surface[v, u - 1] and surface[v - 1, u] and surface[v - 1, u - 1]
            )
            if inner or not vertex[v, u]:
                continue
            place(z[v, u : u + 1], x[u : u + 1], y[v], pose, far, eye, p, s)
            if not (-1 < s[0, 0] < width and -1 < s[0, 1] < height):
                continue
            pu, pv = int(np.rint(s[0, 0])), int(np.rint(s[0, 1]))
            if 0 <= pu < width and 0 <= pv < height and not (p[0, 2] > depth[pv, pu] * 1.01 + 0.005):
                mark[pv, pu] = True


@compiled
def invented(doubtful: Bool, pixels: Float64, mark: Bool) -> None:
    """Mark the pixels (H, W) whose hit ``pixels`` (H, W, 2) lies on a quad with a doubtful corner."""
    rows, columns = doubtful.shape
    for pv in range(mark.shape[0]):
        for pu in range(mark.shape[1]):
            if not mark[pv, pu] and np.isfinite(pixels[pv, pu, 0]):
                u, v = min(int(pixels[pv, pu, 0]), columns - 2), min(int(pixels[pv, pu, 1]), rows - 2)
                above = doubtful[v, u] or doubtful[v, u + 1]
                mark[pv, pu] = above or doubtful[v + 1, u] or doubtful[v + 1, u + 1]


@compiled
def unseen(
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
