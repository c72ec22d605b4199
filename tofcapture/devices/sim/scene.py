"""Define what stands in a scene, and what rays meet there.

Embree (through open3d) finds the hits; normals are geometric, so a scene means the same to every renderer that reads the
same triangles.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.libraries import load_open3d
from tofcapture.poses import Float64, check_transform, transform_points

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

# Rays leave a surface this far along its normal: far above float32 rounding of a few metres, far below a millimetre.
_LIFT = 2e-5


@dataclass(frozen=True)
class SceneObject:
    """One Lambertian triangle mesh."""

    vertices: Float64  #: (N, 3) float64, object frame, metres.
    triangles: Int64  #: (M, 3) indices into the vertices.
    albedo: (
        float | Float64
    )  #: Diffuse reflectance at the illuminator's wavelength, in [0, 1]; (M,) of each triangle.
    T_world_object: Float64  #: (4, 4).
    target: bool = True  #: True for the scene's object, False for table, walls and clutter.
    name: str = "object"  #: For messages.

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.isfinite(self.vertices).all():
            raise ConfigError(
                f"{self.name}: expected finite vertices (N, 3), got shape {self.vertices.shape}"
            )
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or len(self.triangles) == 0:
            raise ConfigError(f"{self.name}: expected triangles (M, 3), got shape {self.triangles.shape}")
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices):
            raise ConfigError(f"{self.name}: a triangle names a vertex that does not exist")
        if np.shape(self.albedo) not in {(), (len(self.triangles),)}:
            raise ConfigError(f"{self.name}: expected one albedo, or one of each triangle")
        if not 0.0 <= np.min(self.albedo) <= np.max(self.albedo) <= 1.0:
            raise ConfigError(f"{self.name}: expected an albedo in [0, 1], got {self.albedo}")
        check_transform(self.T_world_object, f"{self.name}: T_world_object")

    def corners(self) -> Float64:
        """Place the triangles: (M, 3, 3) corners in the world frame, metres."""
        return transform_points(self.T_world_object, self.vertices)[self.triangles]


@dataclass(frozen=True)
class Geometry:
    """All triangles of a scene, merged, world frame."""

    corners: Float64  #: (M, 3, 3), metres.
    normals: Float32  #: (M, 3) unit geometric normals by the winding.
    albedo: Float32  #: (M,)
    owner: Int64  #: (M,) index of the scene object.
    target: NDArray[np.bool_]  #: (M,) the triangle belongs to the scene's object.


def merge(objects: Sequence[SceneObject]) -> Geometry:
    """Merge the objects of a scene without triangles of no area; :class:`ConfigError` when nothing is left."""
    if not objects:
        raise ConfigError("the scene is empty", hint="add at least one [[object]] to the world file")
    corners = np.concatenate([o.corners() for o in objects])
    counts = [len(o.triangles) for o in objects]
    owner = np.repeat(np.arange(len(objects)), counts)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    keep = length > 1e-14
    if not keep.any():
        raise ConfigError("the scene has no triangle with an area", hint="is the mesh unit right?")
    albedo = np.concatenate([np.broadcast_to(np.float32(o.albedo), len(o.triangles)) for o in objects])
    target = np.array([o.target for o in objects])[owner]
    return Geometry(
        corners=corners[keep],
        normals=(normals[keep] / length[keep, None]).astype(np.float32),
        albedo=albedo[keep],
        owner=owner[keep],
        target=target[keep],
    )


@dataclass(frozen=True)
class Hits:
    """Tell where rays meet the scene, flat arrays of the same length."""

    distance: Float32  #: float32, metres along the unit ray; infinite where nothing was met.
    triangle: Int64  #: int64, -1 where nothing was met.
    uv: Float32  #: (N, 2) float32 barycentric coordinates of corners 1 and 2.

    @property
    def found(self) -> NDArray[np.bool_]:
        """Tell which rays met something."""
        out: NDArray[np.bool_] = self.triangle >= 0
        return out


@lru_cache(maxsize=8)
def _unit_rays(camera: Camera) -> Float32:
    """Cast unit rays (3, H * W), one plane per coordinate."""
    rays = (camera.rays / camera.ray_lengths[..., None]).reshape(-1, 3)
    out: Float32 = np.ascontiguousarray(rays.T, dtype=np.float32)
    out.flags.writeable = False
    return out


def unit_rays(camera: Camera, T_world_camera: Float64, part: slice = slice(None)) -> Float32:
    """Cast unit rays (N, 3) float32 through the pixel centres, world frame; ``part`` of the flat image only.

    Not a matrix product: BLAS may round differently with another number of threads.
    """
    x, y, z = _unit_rays(camera)[:, part]
    out = np.empty((len(x), 3), dtype=np.float32)
    for i, (a, b, c) in enumerate(T_world_camera[:3, :3].astype(np.float32)):
        np.multiply(x, a, out=out[:, i])
        out[:, i] += b * y
        out[:, i] += c * z
    return out


class Caster:
    """A scene ready for rays; uses as many threads as ``OMP_NUM_THREADS`` says, or all."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        wanted = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
        self._threads = int(wanted) if wanted.isdigit() else 0
        o3d = load_open3d()
        self._tensor: Any = o3d.core.Tensor
        self._scene: Any = o3d.t.geometry.RaycastingScene(nthreads=self._threads)
        vertices = geometry.corners.reshape(-1, 3).astype(np.float32)
        triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))

    def cast(self, origins: NDArray[Any], directions: NDArray[Any]) -> Hits:
        """Find the first hits of rays from ``origins`` (3,) or (N, 3) in unit ``directions`` (N, 3), world frame, metres."""
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origins
        rays[:, 3:] = directions
        answer = self._scene.cast_rays(self._tensor(rays), nthreads=self._threads)
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        distance = answer["t_hit"].numpy()
        triangle[~np.isfinite(distance)] = -1
        return Hits(distance=distance, triangle=triangle, uv=answer["primitive_uvs"].numpy())

    def blocked(self, origins: Float32, target: NDArray[Any]) -> NDArray[np.bool_]:
        """Tell where the segment from an origin (N, 3) to ``target`` (3,) or (N, 3) meets a surface.

        Origins must already be lifted off their surface, see :func:`lift`.
        """
        rays = np.empty((len(origins), 6), dtype=np.float32)
        rays[:, :3] = origins
        rays[:, 3:] = np.asarray(target, dtype=np.float32) - origins
        out: NDArray[np.bool_] = self._scene.test_occlusions(
            self._tensor(rays), tnear=0.0, tfar=1.0 - 1e-5, nthreads=self._threads
        ).numpy()
        return out

    def facing(self, triangle: Int64, directions: NDArray[Any]) -> Float32:
        """Turn the triangles' normals (N, 3) against rays of the given directions."""
        normals = self.geometry.normals[triangle]
        away = np.einsum("ij,ij->i", normals, np.asarray(directions, dtype=np.float32)) > 0
        normals[away] *= -1
        return normals


def lift(points: NDArray[Any], normals: Float32) -> Float32:
    """Move points (N, 3) a hair along their normals, so that new rays do not meet the surface they leave."""
    out: Float32 = (points + _LIFT * normals).astype(np.float32)
    return out
