"""An industrial stereo camera: dense points, holes where it cannot see, sub-millimetre noise, outliers at edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.devices.sim.render import Caster, lift
from tofcapture.poses import Float64, rotate_vectors, transform_points

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class StereoModel:
    """Constants of the stereo camera; docs/simulator.md explains where they come from.

    Attributes
    ----------
    baseline
        Distance of the right eye along x, metres.
    disparity_noise
        Standard deviation in pixels, after matching; depth noise is ``z^2 / (f b)`` times it.
    correlation
        Standard deviation in pixels of the Gaussian that correlates the noise, the matching window's doing.
    grazing
        Surfaces seen at more than this angle from their normal are lost, radians.
    darkest
        Surfaces with a lower albedo are lost.
    edge_outliers
        Share of points beside a depth edge that are matched wrongly.
    dropout
        Share of points lost anywhere.
    far
        Points beyond this depth are lost, metres.
    """

    baseline: float = 0.10
    disparity_noise: float = 0.025
    correlation: float = 1.5
    grazing: float = np.radians(78.0)
    darkest: float = 0.02
    edge_outliers: float = 0.3
    dropout: float = 0.001
    far: float = 3.0


def ideal(model: StereoModel) -> StereoModel:
    """Return the same camera without noise, outliers and dropouts; occlusion and range stay."""
    return replace(model, disparity_noise=0.0, edge_outliers=0.0, dropout=0.0)


def point_map(
    caster: Caster, camera: Camera, T_world_stereo: Float64, model: StereoModel, rng: np.random.Generator
) -> Float32:
    """Measure one point map.

    Parameters
    ----------
    caster
        The scene.
    camera, T_world_stereo
        Intrinsics and pose of the left eye, whose grid the map lies on.
    model
        Constants.
    rng
        Noise of this frame.

    Returns
    -------
    (H, W, 3) float32, stereo frame, metres; NaN where nothing was measured.
    """
    lengths = camera.ray_lengths.reshape(-1)
    directions = rotate_vectors(T_world_stereo, camera.rays.reshape(-1, 3) / lengths[:, None]).astype(
        np.float32
    )
    eye = T_world_stereo[:3, 3].astype(np.float32)
    hits = caster.cast(eye, directions)
    seen = np.flatnonzero(hits.found)
    tri = hits.triangle[seen]
    normals = caster.facing(tri, directions[seen])
    points = eye + hits.distance[seen, None] * directions[seen]
    cosine = -np.einsum("ij,ij->i", normals, directions[seen])
    good = (cosine > np.cos(model.grazing)) & (caster.geometry.albedo[tri] >= model.darkest)
    good &= hits.distance[seen] < model.far * lengths[seen]
    right_eye = transform_points(T_world_stereo, np.array([model.baseline, 0.0, 0.0]))
    good[good] = ~caster.blocked(lift(points[good], normals[good]), right_eye)
    depth = np.full(len(lengths), np.nan)
    depth[seen[good]] = hits.distance[seen[good]] / lengths[seen[good]]
    measured = _disturb(depth.reshape(camera.shape), camera, model, rng)
    shift = camera.fx * model.baseline / measured
    u = np.arange(camera.width)
    measured[(u - shift < -0.5)] = np.nan  # the right eye's image ends
    return (measured[..., None] * camera.rays).astype(np.float32)


def _disturb(depth: Float64, camera: Camera, model: StereoModel, rng: np.random.Generator) -> Float64:
    from scipy.ndimage import gaussian_filter, grey_dilation, grey_erosion

    out = depth.copy()
    if model.edge_outliers:
        far = grey_dilation(np.nan_to_num(depth, nan=0.0), size=(5, 5))
        near = grey_erosion(np.nan_to_num(depth, nan=99.0), size=(5, 5))
        beside = np.isfinite(depth) & (far - near > 0.02 * depth) & (near < 99)
        wrong = beside & (rng.random(depth.shape) < model.edge_outliers)
        # A matching window across an edge answers anything between the two surfaces.
        mix = rng.random(depth.shape)
        out[wrong] = (near + mix * (far - near))[wrong]
    if model.disparity_noise:
        noise = gaussian_filter(rng.standard_normal(depth.shape), model.correlation)
        noise *= (
            model.disparity_noise * 2 * np.sqrt(np.pi) * model.correlation
        )  # the filter leaves 1 / (2 sqrt(pi) s)
        out = out + out**2 / (camera.fx * model.baseline) * noise
    if model.dropout:
        out[rng.random(depth.shape) < model.dropout] = np.nan
    return out
