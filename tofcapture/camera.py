"""Pinhole cameras: intrinsics, project and unproject, depth and radial.

Camera frames have x right, y down, z forward. Pixel centres are integers, so the image spans
``[-0.5, W - 0.5] x [-0.5, H - 0.5]``. ``depth`` is z, ``radial`` is the distance along the ray; both in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a pinhole camera.

    Attributes
    ----------
    width, height
        Image size in pixels.
    fx, fy
        Focal lengths in pixels.
    cx, cy
        Principal point in pixels, pixel centres at integers.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ConfigError(f"camera: expected a positive image size, got {self.width} x {self.height}")
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()):
            raise ConfigError(f"camera: expected positive focal lengths, got fx {self.fx}, fy {self.fy}")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image."""
        return self.height, self.width

    def scaled(self, s: int) -> Camera:
        """Intrinsics of the same view at ``s`` times the resolution: ``f' = s f``, ``c' = s (c + 0.5) - 0.5``."""
        return Camera(
            width=self.width * s,
            height=self.height * s,
            fx=self.fx * s,
            fy=self.fy * s,
            cx=s * (self.cx + 0.5) - 0.5,
            cy=s * (self.cy + 0.5) - 0.5,
        )

    @cached_property
    def rays(self) -> Float64:
        """(H, W, 3) rays through the pixel centres with z = 1; multiplied by depth they are points."""
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
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
        """Points (..., H, W, 3) of depth (..., H, W), metres; NaN stays NaN."""
        if depth.shape[-2:] != self.shape:
            raise ConfigError(f"unproject: expected depth of {self.shape}, got {depth.shape}")
        return np.asarray(depth, dtype=np.float64)[..., None] * self.rays

    def project(self, points: NDArray[np.floating]) -> tuple[Float64, Float64]:
        """Pixel coordinates of points.

        Parameters
        ----------
        points
            (..., 3), camera frame, metres.

        Returns
        -------
        pixels
            (..., 2) as (u, v); NaN at or behind the camera plane.
        depth
            (...,), metres.
        """
        z: Float64 = np.asarray(points, dtype=np.float64)[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            safe = np.where(z > 0, z, np.nan)
            u = self.fx * points[..., 0] / safe + self.cx
            v = self.fy * points[..., 1] / safe + self.cy
        return np.stack([u, v], axis=-1), z

    def depth_to_radial(self, depth: NDArray[np.floating]) -> Float64:
        """Distance along the ray of a depth image (..., H, W)."""
        return np.asarray(depth, dtype=np.float64) * self.ray_lengths

    def radial_to_depth(self, radial: NDArray[np.floating]) -> Float64:
        """Depth of a radial image (..., H, W)."""
        return np.asarray(radial, dtype=np.float64) / self.ray_lengths
