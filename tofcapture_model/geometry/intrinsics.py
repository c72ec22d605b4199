"""A camera as numbers on a device, and the rays of its pixels.

Intrinsics are (B, 4) fx, fy, cx, cy in pixels, or (B, 9) with OpenCV's k1, k2, p1, p2, k3 of a lens behind them.
Networks see images as the sensor took them; nothing is rectified.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError

PINHOLE, LENS = 4, 9
_NEWTON_STEPS = 8  # four do for most lenses; one that nearly folds would take many more: refused
_INVERTED = 1e-4  # of a ray's x and y at z = 1


def intrinsics_of(camera: Camera) -> Tensor:
    """Return (4,) float32 of a pinhole, (9,) of a camera with a lens."""
    return torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


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
    """Add a lens that does nothing, so that cameras with and without one make a batch: (..., 9)."""
    return F.pad(intrinsics, (0, LENS - intrinsics.shape[-1]))


def scale_intrinsics(intrinsics: Tensor, s: int) -> Tensor:
    """Scale intrinsics (B, 4 or 9) to ``s`` times the resolution: ``f' = s f``, ``c' = s (c + 0.5) - 0.5``."""
    f, c, lens = intrinsics[:, :2], intrinsics[:, 2:PINHOLE], intrinsics[:, PINHOLE:]
    return torch.cat([f * s, (c + 0.5) * s - 0.5, lens], dim=1)


def thin_intrinsics(intrinsics: Tensor, step: int) -> Tensor:
    """Take every ``step``-th pixel, from pixel ``step // 2`` on; intrinsics (B, 4 or 9)."""
    f, c, lens = intrinsics[:, :2], intrinsics[:, 2:PINHOLE], intrinsics[:, PINHOLE:]
    return torch.cat([f / step, (c - step // 2) / step, lens], dim=1)


def cut_intrinsics(intrinsics: Tensor, top: int, left: int) -> Tensor:
    """Cut a window at (top, left) out of the image; intrinsics (..., 4 or 9)."""
    moved = intrinsics.clone()
    moved[..., 2] -= left
    moved[..., 3] -= top
    return moved


def mirror_intrinsics(intrinsics: Tensor, axis: int, size: int) -> Tensor:
    """Mirror images of ``size`` pixels along ``axis``: -1 left and right, -2 up and down; intrinsics (..., 4 or 9)."""
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
    k1, k2, p1, p2, k3 = (intrinsics[:, i, None, None] for i in range(PINHOLE, LENS))
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
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
