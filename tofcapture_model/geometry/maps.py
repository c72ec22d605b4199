"""Depth, rays and normals on the image grid, differentiable.

Depth is z in metres, normals are unit and face the camera, images are (B, C, H, W), intrinsics (B, 4 or 12).
All functions keep the dtype they are given.

Intrinsics are fx, fy, cx, cy in pixels, and with a lens OpenCV's k1, k2, p1, p2, k3, k4, k5, k6 behind them. Networks see images as
the sensor took them; nothing is rectified.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.errors import ConfigError
from tofcapture_model.frame import Frame

PINHOLE, LENS = 4, 12
_NEWTON_STEPS = 8  # four do for most lenses; one that nearly folds would take many more: refused
_INVERTED = 1e-4  # of a ray's x and y at z = 1


def intrinsics_of(camera: Camera) -> Tensor:
    """Return (4,) float32 of a pinhole, (12,) of a camera with a lens."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    found = torch.tensor(numbers, dtype=torch.float32)  # those of numpy would make all that follows double
    return with_lens(found) if camera.distortion else found


def expect_usable(camera: Camera) -> None:
    """Refuse a lens whose rays the networks would get wrong, at the sensor's resolution or at twice that, as it folds at the border."""
    if not camera.distortion:
        return
    for scale in (1, 2):
        fine = camera.scaled(scale)  # its outermost rays lie a quarter of a pixel further out
        found = rays(scale_intrinsics(intrinsics_of(camera)[None], scale), *fine.shape)[0].permute(1, 2, 0)
        off = float(np.nan_to_num(np.abs(found.numpy() - fine.rays), nan=np.inf).max())
        if off > _INVERTED:
            raise ConfigError(
                f"lens: the distortion {[float(f'{c:.4g}') for c in camera.distortion]} nearly folds at the image's border: rays come out {off:.2g} wrong",
                hint="no lens does that: calibrate again with targets in the corners of the image, or with fewer coefficients",
            )


def with_lens(intrinsics: Tensor) -> Tensor:
    """Add a lens that does nothing, so that cameras with and without one make a batch: (..., 12)."""
    return F.pad(intrinsics, (0, LENS - intrinsics.shape[-1]))


def scale_intrinsics(intrinsics: Tensor, s: int) -> Tensor:
    """Scale intrinsics (B, 4 or 12) to ``s`` times the resolution: ``f' = s f``, ``c' = s (c + 0.5) - 0.5``."""
    f, c, lens = intrinsics[:, :2], intrinsics[:, 2:PINHOLE], intrinsics[:, PINHOLE:]
    return torch.cat([f * s, (c + 0.5) * s - 0.5, lens], dim=1)


def thin_intrinsics(intrinsics: Tensor, step: int) -> Tensor:
    """Take every ``step``-th pixel, from pixel ``step // 2`` on; intrinsics (B, 4 or 12)."""
    f, c, lens = intrinsics[:, :2], intrinsics[:, 2:PINHOLE], intrinsics[:, PINHOLE:]
    return torch.cat([f / step, (c - step // 2) / step, lens], dim=1)


def cut_intrinsics(intrinsics: Tensor, top: int, left: int) -> Tensor:
    """Cut a window at (top, left) out of the image; intrinsics (..., 4 or 12)."""
    moved = intrinsics.clone()
    moved[..., 2] -= left
    moved[..., 3] -= top
    return moved


def mirror_intrinsics(intrinsics: Tensor, axis: int, size: int) -> Tensor:
    """Mirror images of ``size`` pixels along ``axis``: -1 left and right, -2 up and down; intrinsics (..., 4 or 12)."""
    flipped, component = intrinsics.clone(), -1 - axis
    flipped[..., 2 + component] = size - 1 - flipped[..., 2 + component]
    if intrinsics.shape[-1] == LENS:
        flipped[..., 7 - component] *= -1  # of the tangential distortion p2 changes sign with x, p1 with y
    return flipped


def rays(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Return rays (B, 3, H, W) through the pixel centres, z = 1; a lens is inverted by Newton's method, inside the image only."""
    fx, fy, cx, cy = (intrinsics[:, i, None, None] for i in range(PINHOLE))
    v, u = torch.meshgrid(
        torch.arange(height, dtype=intrinsics.dtype, device=intrinsics.device),
        torch.arange(width, dtype=intrinsics.dtype, device=intrinsics.device),
        indexing="ij",
    )
    x, y = (u - cx) / fx, (v - cy) / fy
    if intrinsics.shape[1] == LENS:
        x, y = _undistorted(intrinsics, x, y)
    return torch.stack([x, y, torch.ones_like(x)], dim=1)


def pixel_slopes(intrinsics: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return du/dx, du/dy, dv/dx, dv/dy in pixels at rays (x, y, 1): each (B, H, W), or (B, 1, 1) of a pinhole."""
    fx, fy = intrinsics[:, 0, None, None], intrinsics[:, 1, None, None]
    if intrinsics.shape[1] == PINHOLE:
        return fx, torch.zeros_like(fx), torch.zeros_like(fy), fy
    _, _, xx, both, yy = _distorted(intrinsics, x, y)
    return fx * xx, fx * both, fy * both, fy * yy


def _distorted(intrinsics: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Distort x and y; with the derivative, which is symmetric: of x along x, of either along the other, of y along y."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (intrinsics[:, i, None, None] for i in range(PINHOLE, LENS))
    r2 = x * x + y * y
    under = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / under
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / under
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        radial + x * x * slope + 2 * p1 * y + 6 * p2 * x,
        x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


def _undistorted(intrinsics: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Invert :func:`_distorted`."""
    goal_x, goal_y = x, y
    for _ in range(_NEWTON_STEPS):
        found_x, found_y, xx, both, yy = _distorted(intrinsics, x, y)
        off_x, off_y, det = found_x - goal_x, found_y - goal_y, xx * yy - both * both
        x, y = x - (yy * off_x - both * off_y) / det, y - (xx * off_y - both * off_x) / det
    return x, y


_TINY = 1e-12
_FAINT = 1e-10  # keeps atan2 differentiable where a pixel is dark


def unproject(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Return points (B, 3, H, W) of depth (B, 1, H, W), metres."""
    return depth * rays(intrinsics, *depth.shape[-2:])


def unit(vectors: Tensor) -> Tensor:
    """Normalise (B, 3, H, W) along the channels; the gradient at zero length is finite."""
    return vectors / vectors.square().sum(1, keepdim=True).clamp_min(_TINY).sqrt()


def shifted(image: Tensor, dy: int, dx: int) -> Tensor:
    """Return ``out[v, u] = image[v + dy, u + dx]``; beyond the border the border is repeated."""
    h, w = image.shape[-2:]
    padded = F.pad(image, (max(-dx, 0), max(dx, 0), max(-dy, 0), max(dy, 0)), mode="replicate")
    return padded[..., max(dy, 0) : max(dy, 0) + h, max(dx, 0) : max(dx, 0) + w]


def doubled_parts(image: Tensor) -> Tensor:
    """Double bilinearly, the four sub-pixels side by side (B, C, 4, H, W): ``pixel_shuffle`` of (B, 4C, H, W) interleaves them."""
    across = [torch.lerp(image, shifted(image, 0, dx), 0.25) for dx in (-1, 1)]
    return torch.stack([torch.lerp(a, shifted(a, dy, 0), 0.25) for dy in (-1, 1) for a in across], dim=2)


def offsets(radius: int, step: int = 1) -> Iterator[tuple[int, int]]:
    """Yield the (dy, dx) of a square window without its centre."""
    reach = range(-radius * step, radius * step + 1, step)
    return ((dy, dx) for dy in reach for dx in reach if (dy, dx) != (0, 0))


def _moment_filters(radius: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Filters (6, 3, 1, k) along rows and (10, 6, k, 1) along columns: powers of u of each image, then of v of those.

    Made on the device: a copy from the host would keep a GPU waiting and cannot be part of a CUDA graph.
    """
    r = torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device)
    powers = torch.stack([torch.ones_like(r), r, r * r])
    rows, columns = (
        torch.block_diag(*(powers[:n] for n in counts))  # type: ignore[no-untyped-call]
        for counts in ((3, 2, 1), (3, 2, 1, 2, 1, 1))
    )
    return rows.reshape(6, 3, 1, -1), columns.reshape(10, 6, -1, 1)


@contextmanager
def _whole_float32(device: torch.device) -> Iterator[None]:
    """Convolve in float32 all through: moments need more mantissa than bfloat16 and TF32 have."""
    now = torch.backends.cudnn
    with (
        torch.autocast(device.type, enabled=False),
        now.flags(now.enabled, now.benchmark, now.benchmark_limit, now.deterministic, allow_tf32=False),
    ):
        yield


def _moments(images: Tensor, radius: int) -> Tensor:
    """Sum images a, b, c over every window: (B, 10, H, W) ``a (1, v, vv, u, uv, uu), b (1, v, u), c``, all at once for speed."""
    rows, columns = _moment_filters(radius, images)
    with _whole_float32(images.device):
        return F.conv2d(F.conv2d(images, rows, padding=(0, radius)), columns, padding=(radius, 0))


def local_planes(depth: Tensor, valid: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Fit inverse depth linearly in every window: a plane is linear in inverse depth, ``n . r = 1 / z``.

    ``depth`` (B, 1, H, W), metres, is positive and finite everywhere; ``valid`` (B, 1, H, W) weighs pixels, 0 for holes. A window
    has ``2 radius + 1`` pixels.

    Returns
    -------
    coefficients
        (B, 3, H, W): inverse depth at the window's centre, its slope per pixel in u and in v; 1/m.
    variance
        (B, 1, H, W) weighted mean square residual of the fit, 1/m^2.
    """
    inverse = 1 / depth
    origin = inverse.mean(dim=(2, 3), keepdim=True)  # float32 moments cancel badly far from zero
    i = (inverse - origin) * valid
    images = torch.cat([valid, i, i * (inverse - origin)], dim=1)
    s1, sv, svv, su, suv, suu, t1, tv, tu, tt = _moments(images, radius).unbind(1)
    # a window with one row or column of pixels has a slope of zero across it
    ridge = 10 * torch.finfo(depth.dtype).eps * suu + _TINY
    n = s1.clamp_min(_TINY)
    mu, mv, mi = su / n, sv / n, t1 / n
    cuu, cvv, cuv = suu - su * mu + ridge, svv - sv * mv + ridge, suv - su * mv
    cui, cvi = tu - t1 * mu, tv - t1 * mv
    det = (cuu * cvv - cuv * cuv).clamp_min(_TINY)
    a, b = (cvv * cui - cuv * cvi) / det, (cuu * cvi - cuv * cui) / det
    variance = ((tt - t1 * mi - a * cui - b * cvi) / n).clamp_min(0)
    centre = mi - a * mu - b * mv + origin[:, 0]
    return torch.stack([centre, a, b], dim=1), variance[:, None]


def plane_normals(coefficients: Tensor, intrinsics: Tensor, directions: Tensor | None = None) -> Tensor:
    """Turn :func:`local_planes` into unit camera-facing normals (B, 3, H, W); ``directions`` are the grid's rays, if at hand."""
    centre, a, b = coefficients.unbind(1)
    x, y, _ = (rays(intrinsics, *centre.shape[-2:]) if directions is None else directions).unbind(1)
    ux, uy, vx, vy = pixel_slopes(intrinsics, x, y)
    # a window is small beside the bend of a lens: inverse depth is linear in pixels about each one
    along_x, along_y = (
        (a * ux, b * vy) if intrinsics.shape[1] == PINHOLE else (a * ux + b * vx, a * uy + b * vy)
    )
    outward = torch.stack([along_x, along_y, centre - along_x * x - along_y * y], dim=1)  # n . r = 1/z > 0
    return -unit(outward)


def depth_to_normals(depth: Tensor, valid: Tensor, intrinsics: Tensor, radius: int = 4) -> Tensor:
    """Fit unit camera-facing normals (B, 3, H, W) to a depth map by :func:`local_planes`; radius 4 is GeoNet's 9 x 9 window."""
    coefficients, _ = local_planes(depth, valid, radius)
    return plane_normals(coefficients, intrinsics)


def side_window_planes(
    depth: Tensor, valid: Tensor, radius: int, floor: float = 2e-3
) -> tuple[Tensor, Tensor]:
    """Fit planes that do not reach across edges: side-window filtering with planes instead of means.

    Nine windows explain a pixel: the one centred on it and the eight that touch it with a side or a corner. Those that fit badly,
    as they hold an edge, count little; below a standard deviation of ``floor``, 1/m, residuals are equal.

    Returns
    -------
    coefficients
        (B, 3, H, W) as of :func:`local_planes`, at the pixel itself.
    variance
        (B, 1, H, W) of the best window.
    """
    planes, variance = local_planes(depth, valid, radius)
    precise = 1 / (variance + floor**2)
    weight = precise * precise * precise  # a power takes ten times as long
    weight = weight / weight.amax(dim=(2, 3), keepdim=True)
    # a window says c + a dx + b dy of the pixel (dx, dy) from its centre; the sum over nine goes along rows, then along columns
    packed, best = torch.cat([planes * weight, weight], dim=1), variance
    for slope, step in ((1, (0, radius)), (2, (radius, 0))):
        before, after = (shifted(packed, way * step[0], way * step[1]) for way in (-1, 1))
        moved = radius * (before[:, slope] - after[:, slope])[:, None]
        packed = before + packed + after
        packed = torch.cat([packed[:, :1] + moved, packed[:, 1:]], dim=1)
        sides = [shifted(best, way * step[0], way * step[1]) for way in (-1, 1)]
        best = torch.minimum(best, torch.minimum(*sides))
    return packed[:, :3] / packed[:, 3:].clamp_min(1e-30), best


def propagate_depth(
    depth: Tensor,
    normals: Tensor,
    intrinsics: Tensor,
    confidence: Tensor,
    radius: int = 2,
    step: int = 1,
    alpha: float = 0.95,
    max_jump: float = 0.02,
) -> Tensor:
    """Move every depth towards the tangent planes of its neighbours (GeoNet's normal-to-depth kernel regression).

    Neighbour j votes ``z_ji = z_j (n_j . r_j) / (n_j . r_i)`` for pixel i with weight ``n_j . n_i`` where that is above
    ``alpha``. Votes further than ``max_jump``, metres, from the present depth are dropped. Neighbours are ``radius`` taps to each
    side, ``step`` pixels apart, and count by their ``confidence`` (B, 1, H, W). Returns (B, 1, H, W) metres.
    """
    r = rays(intrinsics, *depth.shape[-2:])
    plane = (normals * r).sum(1, keepdim=True) * depth  # n . p, the plane's distance
    packed = torch.cat([normals, plane, confidence], dim=1)
    total, norm = depth * confidence, confidence
    for dy, dx in offsets(radius, step):
        other = shifted(packed, dy, dx)
        n, distance, trust = other[:, :3], other[:, 3:4], other[:, 4:]
        cosine = (n * normals).sum(1, keepdim=True)
        slope = (n * r).sum(1, keepdim=True)
        steep = slope.abs() < 1e-2
        vote = distance / torch.where(steep, torch.ones_like(slope), slope)
        keep = (cosine > alpha) & ~steep & ((vote - depth).abs() < max_jump)
        weight = torch.where(keep, cosine * trust, torch.zeros_like(trust))
        total = total + weight * torch.where(keep, vote, torch.zeros_like(vote))
        norm = norm + weight
    return total / norm


def turn(new: Tensor, old: Tensor) -> Tensor:
    """Return the angle (B, 1, H, W) in [-pi, pi] from phasor ``old`` to ``new``, each (B, 2, H, W) I and Q."""
    real = (new * old).sum(1, keepdim=True)
    imaginary = (new[:, 1] * old[:, 0] - new[:, 0] * old[:, 1])[:, None]
    return torch.atan2(imaginary, real + torch.where(real < 0, -_FAINT, _FAINT))


def metres_per_radian(frame: Frame, which: int) -> Tensor:
    """Return (B, 1, 1, 1) range per phase of the lowest (0), the highest (1) or another frequency."""
    return (SPEED_OF_LIGHT / (4 * math.pi)) / frame.modulation[:, which].reshape(-1, 1, 1, 1)
