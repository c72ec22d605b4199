"""An industrial stereo camera: dense points, holes where it cannot see, sub-millimetre noise, outliers at edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices.sim.scene import Caster, Float32, lift, unit_rays
from tofcapture.poses import Float64, transform_points

_CHUNK = 65_536  # pixels at a time: what they need stays in the cache


@dataclass(frozen=True)
class StereoModel:
    """Constants of the stereo camera; docs/simulator.md explains where they come from."""

    baseline: float = 0.10  #: Distance of the right eye along x, metres.
    disparity_noise: float = 0.025  #: Pixels after matching; depth noise is ``z^2 / (f b)`` times it.
    correlation: float = 1.5  #: Pixels of the Gaussian that correlates noise, the matching window's doing.
    grazing: float = np.radians(78.0)  #: Surfaces at more than this from their normal are lost, radians.
    darkest: float = 0.02  #: Surfaces with a lower albedo are lost.
    edge_outliers: float = 0.3  #: Share of points beside a depth edge that are matched wrongly.
    dropout: float = 0.001  #: Share of points lost anywhere.
    far: float = 3.0  #: Points beyond this depth are lost, metres.


def ideal(model: StereoModel) -> StereoModel:
    """Return the same camera without noise, outliers and dropouts; occlusion and range stay."""
    return replace(model, disparity_noise=0.0, edge_outliers=0.0, dropout=0.0)


def point_map(
    caster: Caster, camera: Camera, T_world_stereo: Float64, model: StereoModel, rng: np.random.Generator
) -> Float32:
    """Measure one point map, on the grid of the left eye that ``camera`` and ``T_world_stereo`` describe.

    Returns
    -------
    (H, W, 3) float32, stereo frame, metres; NaN where nothing was measured.
    """
    depth = np.full(camera.width * camera.height, np.nan, dtype=np.float32)
    for begin in range(0, len(depth), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        _see(caster, camera, T_world_stereo, model, part, depth[part])
    measured = _disturb(depth.reshape(camera.shape), camera, model, rng)
    shift = np.float32(camera.fx * model.baseline) / measured
    u = np.arange(camera.width, dtype=np.float32)
    measured[u - shift < -0.5] = np.nan  # the right eye's image ends
    out = np.empty((*camera.shape, 3), dtype=np.float32)
    out[..., 2] = measured
    for axis in (0, 1):
        np.multiply(measured, camera.rays[..., axis], out=out[..., axis], casting="same_kind")
    return out


def _see(
    caster: Caster, camera: Camera, T_world_stereo: Float64, model: StereoModel, part: slice, depth: Float32
) -> None:
    """Fill in the exact depth of those of a part of the pixels that both eyes see well."""
    lengths = camera.ray_lengths.reshape(-1)[part].astype(np.float32)
    directions = unit_rays(camera, T_world_stereo, part)
    eye = T_world_stereo[:3, 3].astype(np.float32)
    hits = caster.cast(eye, directions)
    good = np.flatnonzero(hits.found & (hits.distance < np.float32(model.far) * lengths))
    tri, towards, distance = hits.triangle[good], directions[good], hits.distance[good]
    normals = caster.facing(tri, towards)
    cosine = -np.einsum("ij,ij->i", normals, towards)
    keep = (cosine > np.cos(model.grazing)) & (caster.geometry.albedo[tri] >= model.darkest)
    points = eye + distance[:, None] * towards
    right_eye = transform_points(T_world_stereo, np.array([model.baseline, 0.0, 0.0]))
    keep[keep] = ~caster.blocked(lift(points[keep], normals[keep]), right_eye)
    depth[good[keep]] = distance[keep] / lengths[good[keep]]


def _disturb(depth: Float32, camera: Camera, model: StereoModel, rng: np.random.Generator) -> Float32:
    from scipy.ndimage import gaussian_filter

    out = depth.copy()
    if model.edge_outliers:
        _mismatch(out, depth, model.edge_outliers, rng)
    if model.disparity_noise:
        noise = gaussian_filter(rng.standard_normal(depth.shape, dtype=np.float32), model.correlation)
        # The filter leaves 1 / (2 sqrt(pi) s) of the noise.
        noise *= np.float32(model.disparity_noise * 2 * np.sqrt(np.pi) * model.correlation)
        out += out**2 / np.float32(camera.fx * model.baseline) * noise
    if model.dropout:
        lost = rng.integers(0, out.size, rng.binomial(out.size, model.dropout))
        out.reshape(-1)[lost] = np.nan
    return out


def _mismatch(out: Float32, depth: Float32, share: float, rng: np.random.Generator) -> None:
    """Match a share of the points beside depth edges wrongly: a window across an edge answers anything in between."""
    from scipy.ndimage import grey_dilation, grey_erosion

    missing = np.isnan(depth)
    far = grey_dilation(np.where(missing, np.float32(0), depth), size=(5, 5))
    near = grey_erosion(np.where(missing, np.float32(99), depth), size=(5, 5))
    beside = np.flatnonzero(~missing & (far - near > 0.02 * depth))
    wrong = beside[rng.random(len(beside)) < share]
    low, high = near.reshape(-1)[wrong], far.reshape(-1)[wrong]
    out.reshape(-1)[wrong] = low + rng.random(len(wrong), dtype=np.float32) * (high - low)
