"""Cameras: intrinsics and lens, project and unproject, depth and radial.

A lens is OpenCV's rational model. (X, Y, Z) has x = X/Z, y = Y/Z, r^2 = x^2 + y^2 and
``g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``. It is seen at ``x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2)``,
``y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y``, ``u = fx x' + cx``, ``v = fy y' + cy``.
Camera frames have x right, y down, z forward. Pixel centres are integers, so the image spans
``[-0.5, W - 0.5] x [-0.5, H - 0.5]``. ``depth`` is z, ``radial`` is the distance along the ray; both in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from tofcapture.errors import ConfigError

Float64 = NDArray[np.float64]
Coefficients = NDArray[np.floating] | Sequence[float]

LENS_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""The lens's coefficients in OpenCV's order; the last three belong to the rational model."""
_NEWTON_STEPS = 30
_INVERTED = 1e-9  # of an image coordinate at z = 1


def lens_coefficients(given: Sequence[float]) -> tuple[float, ...]:
    """Bring a lens's coefficients into OpenCV's order: none, 5 (k1, k2, p1, p2, k3), or 8 with k4, k5, k6.

    ``given`` has 0, 4, 5 or 8 of OpenCV's list, 12 or 14 whose further terms are zero, or the six k1 to k6 of a
    rational model without p1 and p2. Raises :class:`ConfigError` for any other.
    """
    c = tuple(float(k) for k in given)
    if len(c) not in {0, 4, 5, 6, 8, 12, 14} or not np.isfinite(c).all():
        raise ConfigError(
            f"camera: expected distortion k1, k2, p1, p2[, k3[, k4, k5, k6]], or k1 to k6, got {list(c)}",
            hint="OpenCV's order; leave it out for images without distortion",
        )
    if any(c[8:]):
        raise ConfigError(
            f"camera: expected a lens of at most 8 coefficients, got thin-prism or tilt terms {list(c[8:])}",
            hint="fit the lens with OpenCV's CALIB_RATIONAL_MODEL alone",
        )
    c = (*c[:2], 0.0, 0.0, *c[2:]) if len(c) == 6 else (*c, *(0.0,) * 8)[:8]
    return c if any(c[5:]) else c[:5] if any(c) else ()


def _radial(r2: Float64, coefficients: Coefficients) -> tuple[Float64, Float64, Float64]:
    """Compute the radial factor, twice its derivative by r^2, and its denominator."""
    k1, k2, _, _, k3, *below = coefficients
    above, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * r2 * k3)
    if not below:
        return above, 2 * slope, np.ones_like(r2)
    k4, k5, k6 = below
    under = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factor = above / under
        return factor, 2 * (slope - factor * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / under, under


def distorted(xy: Float64, coefficients: Coefficients) -> Float64:
    """Distort coordinates (..., 2) at z = 1 by 5 or 8 coefficients of :data:`LENS_NAMES`."""
    p1, p2 = coefficients[2:4]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = _radial(r2, coefficients)[0]
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def distortion_jacobian(xy: Float64, coefficients: Coefficients) -> Float64:
    """Compute the derivative (..., 2, 2) of :func:`distorted`."""
    p1, p2 = coefficients[2:4]
    x, y = xy[..., 0], xy[..., 1]
    radial, slope, _ = _radial(x * x + y * y, coefficients)
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    both = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return np.stack([np.stack([xx, both], axis=-1), np.stack([both, yy], axis=-1)], axis=-2)


def undistorted(goal: Float64, coefficients: Coefficients) -> Float64:
    """Invert :func:`distorted` by Newton's method, to 1e-9; NaN stays NaN.

    Raises :class:`ConfigError` when the lens folds before it reaches a coordinate: it was fitted on a smaller part of
    the image.
    """
    xy = np.array(goal, dtype=np.float64)
    for _ in range(_NEWTON_STEPS):
        off = distorted(xy, coefficients) - goal
        if np.nanmax(np.abs(off), initial=0.0) < 1e-14:
            break
        J = distortion_jacobian(xy, coefficients)
        det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        du, dv = off[..., 0], off[..., 1]
        step = np.stack(
            [J[..., 1, 1] * du - J[..., 0, 1] * dv, J[..., 0, 0] * dv - J[..., 1, 0] * du], axis=-1
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            step = step / det[..., None]
        xy = xy - np.clip(np.nan_to_num(step, nan=0.0), -1, 1)
    xy = np.where(np.isnan(goal), np.nan, xy)
    missed = np.nanmax(np.abs(distorted(xy, coefficients) - goal), initial=0.0) > _INVERTED
    if missed or _folds(xy, coefficients):
        raise ConfigError(
            f"lens: the distortion {[float(f'{c:.4g}') for c in coefficients]} folds inside the image and cannot be inverted",
            hint="targets must have covered the corners of the image; fit with fewer coefficients, or set distortion to none",
        )
    return xy


def _folds(xy: Float64, coefficients: Coefficients) -> bool:
    """Tell whether the image turns over anywhere on the straight way from the axis to the coordinates."""
    for share in (0.25, 0.5, 0.75, 1.0):
        J = distortion_jacobian(share * xy, coefficients)
        under = _radial(np.square(share * xy).sum(axis=-1), coefficients)[2]
        if (under <= 0).any() or (J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0] <= 0).any():
            return True
    return False


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera."""

    width: int  #: Image size in pixels.
    height: int
    fx: float  #: Focal lengths in pixels.
    fy: float
    cx: float  #: Principal point in pixels, pixel centres at integers.
    cy: float
    #: As :func:`lens_coefficients` returns them; empty for a pinhole or a rectified image.
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ConfigError(f"camera: expected a positive image size, got {self.width} x {self.height}")
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()):
            raise ConfigError(f"camera: expected positive focal lengths, got fx {self.fx}, fy {self.fy}")
        object.__setattr__(self, "distortion", lens_coefficients(self.distortion))

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image."""
        return self.height, self.width

    def scaled(self, s: int) -> Camera:
        """Scale the same view to ``s`` times the resolution: ``f' = s f``, ``c' = s (c + 0.5) - 0.5``."""
        cx, cy = s * (self.cx + 0.5) - 0.5, s * (self.cy + 0.5) - 0.5
        return Camera(self.width * s, self.height * s, self.fx * s, self.fy * s, cx, cy, self.distortion)

    def pinhole(self, where: str) -> Camera:
        """Return the camera itself; what assumes straight projection asks for it.

        Raises :class:`ConfigError` when the camera has distortion.
        """
        if self.distortion:
            raise ConfigError(
                f"{where}: expected an image without distortion, got k1 {self.distortion[0]:.4g} and more",
                hint="give the intrinsics of the rectified grid, as the stereo camera's own software does",
            )
        return self

    def rays_at(self, pixels: NDArray[np.floating]) -> Float64:
        """Cast rays (..., 3) with z = 1 through pixel coordinates (..., 2); NaN stays NaN."""
        xy = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        xy = undistorted(xy, self.distortion) if self.distortion else xy
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    @cached_property
    def _reach(self) -> float:
        """Square of the radius at z = 1 at which the lens folds: nothing beyond is in the image."""
        if not self.distortion:
            return np.inf
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, 0.0, 0.0, 0.0)[:8]
        above, under = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])  # of r^2
        slope = above.deriv() * under - above * under.deriv()
        # In 1 / r^2 a polynomial keeps its degree however small the coefficients are.
        turns = [np.roots(p.coef) for p in (above * under + Polynomial([0, 2]) * slope, under)]
        roots = np.concatenate(turns)
        real = roots[np.isreal(roots) & (roots.real > 1e-9)].real
        return float(1 / real.max()) if len(real) else np.inf

    @cached_property
    def rays(self) -> Float64:
        """(H, W, 3) rays through the pixel centres with z = 1; multiplied by depth they are points."""
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
        if self.distortion:
            out = self.rays_at(np.stack([u, v], axis=-1))
        else:
            out = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], axis=-1)
        out.flags.writeable = False
        return out

    @cached_property
    def ray_lengths(self) -> Float64:
        """(H, W) length of :attr:`rays`: ``radial = depth * ray_lengths``."""
        out: Float64 = np.linalg.norm(self.rays, axis=-1)
        out.flags.writeable = False
        return out

    def unproject(self, depth: NDArray[np.floating]) -> Float64:
        """Turn depth (..., H, W) into points (..., H, W, 3), metres; NaN stays NaN."""
        if depth.shape[-2:] != self.shape:
            raise ConfigError(f"unproject: expected depth of {self.shape}, got {depth.shape}")
        return np.asarray(depth, dtype=np.float64)[..., None] * self.rays

    def project(self, points: NDArray[np.floating]) -> tuple[Float64, Float64]:
        """Project points (..., 3), camera frame, metres.

        Returns pixels (..., 2) as (u, v), NaN at or behind the camera plane and beyond the angle at which a distorted image
        folds, and depth (...,), metres.
        """
        z: Float64 = np.asarray(points, dtype=np.float64)[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            safe = np.where(z > 0, z, np.nan)
            if self.distortion:
                return self._through_lens(points[..., :2] / safe[..., None]), z
            u = self.fx * points[..., 0] / safe + self.cx
            v = self.fy * points[..., 1] / safe + self.cy
        return np.stack([u, v], axis=-1), z

    def nearest(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Project points (N, 3), camera frame, metres, to the depth (H, W) of the nearest in each pixel; NaN where there is none."""
        points = points[np.isfinite(points).all(axis=-1) & (points[:, 2] > 1e-3)]
        out = np.full(self.shape, np.inf)
        u, v = np.moveaxis(self.project(points)[0], -1, 0)
        inside = (u > -0.5) & (u < self.width - 0.5) & (v > -0.5) & (v < self.height - 0.5)
        np.minimum.at(
            out, (np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)), points[inside, 2]
        )
        return np.where(np.isfinite(out), out, np.nan).astype(np.float32)

    def _through_lens(self, xy: Float64) -> Float64:
        near = np.square(xy).sum(axis=-1) < self._reach
        xy = np.where(near[..., None], xy, np.nan)
        out: Float64 = distorted(xy, self.distortion) * [self.fx, self.fy] + [self.cx, self.cy]
        return out

    def depth_to_radial(self, depth: NDArray[np.floating]) -> Float64:
        """Turn depth (..., H, W) into distance along the ray."""
        return np.asarray(depth, dtype=np.float64) * self.ray_lengths

    def radial_to_depth(self, radial: NDArray[np.floating]) -> Float64:
        """Turn distance along the ray (..., H, W) into depth."""
        return np.asarray(radial, dtype=np.float64) / self.ray_lengths
