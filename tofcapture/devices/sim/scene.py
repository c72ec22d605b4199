"""What stands in a simulated world: triangle meshes with an albedo and a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, check_transform, transform_points


@dataclass(frozen=True)
class SceneObject:
    """One Lambertian triangle mesh.

    Attributes
    ----------
    vertices
        (N, 3) float64, object frame, metres.
    triangles
        (M, 3) int, indices into ``vertices``.
    albedo
        Diffuse reflectance at the illuminator's wavelength, in [0, 1].
    T_world_object
        (4, 4).
    target
        True for the scene's object, False for table, walls and clutter.
    name
        For messages.
    """

    vertices: Float64
    triangles: NDArray[np.int64]
    albedo: float
    T_world_object: Float64
    target: bool = True
    name: str = "object"

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.isfinite(self.vertices).all():
            raise ConfigError(
                f"{self.name}: expected finite vertices (N, 3), got shape {self.vertices.shape}"
            )
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or len(self.triangles) == 0:
            raise ConfigError(f"{self.name}: expected triangles (M, 3), got shape {self.triangles.shape}")
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices):
            raise ConfigError(f"{self.name}: a triangle names a vertex that does not exist")
        if not 0.0 <= self.albedo <= 1.0:
            raise ConfigError(f"{self.name}: expected an albedo in [0, 1], got {self.albedo}")
        check_transform(self.T_world_object, f"{self.name}: T_world_object")

    def corners(self) -> Float64:
        """(M, 3, 3) triangle corners in the world frame, metres."""
        return transform_points(self.T_world_object, self.vertices)[self.triangles]
