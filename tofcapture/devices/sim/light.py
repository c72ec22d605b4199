"""The light that reaches each pixel of the ToF camera: phasors, direct and indirect, before any electronics.

A pixel is an area: sub-pixel samples are added as phasors, so that a pixel on an edge mixes foreground and background
(a flying pixel) as a real one does. Pixels on one smooth, evenly lit surface need fewer samples than those on an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.devices.sim.scene import Caster, Float32, Int64, unit_rays
from tofcapture.devices.sim.transport import Complex64, Lamp, Transport, direct, turn, wavenumbers
from tofcapture.poses import Float64, invert, rotate_vectors

_STRAIGHT = 0.98  # cosine of the largest bend between neighbouring samples of one smooth surface
_FLAT = 1e-3  # how far a sample may lie off its neighbour's tangent plane, as a share of the distance
_TILE = 4  # interleaved sampling: 4 x 4 neighbouring pixels use 16 different sets of directions


@dataclass(frozen=True)
class Light:
    """Light at the pixels, per unit of radiant intensity of the illuminator."""

    #: (F, H, W) complex128, albedo x irradiance phasor averaged over the pixel, with the phase of the whole
    #: path; 1/m^2.
    phasor: NDArray[np.complex128]
    steady: Float64  #: (H, W) float64, the same for unmodulated light.


@dataclass(frozen=True)
class _Samples:
    points: Float32  # (N, 3) world
    normals: Float32  # (N, 3) facing the camera
    albedo: Float32
    distance: Float32
    found: NDArray[np.bool_]


def _look(caster: Caster, camera: Camera, T_world_camera: Float64, pixels: Int64 | None = None) -> _Samples:
    """Find what the rays of all pixels meet, or of those with the given flat indices."""
    directions = unit_rays(camera, T_world_camera)
    directions = directions if pixels is None else directions[pixels]
    eye = T_world_camera[:3, 3].astype(np.float32)
    hits = caster.cast(eye, directions)
    found = hits.found
    tri = np.where(found, hits.triangle, 0)
    normals = caster.facing(tri, directions)
    distance: Float32 = np.where(found, hits.distance, np.float32(0))
    albedo: Float32 = np.where(found, caster.geometry.albedo[tri], np.float32(0))
    points: Float32 = eye + distance[:, None] * directions
    return _Samples(points, normals, albedo, distance, found)


def exact_view(
    caster: Caster, camera: Camera, T_world_camera: Float64
) -> tuple[Float32, Float32, NDArray[np.bool_]]:
    """Measure as an ideal camera of these intrinsics would, at its pixel centres.

    Returns depth (H, W) float32, metres, geometric normals (H, W, 3) float32, camera frame, facing the camera, both NaN where
    nothing is met; and (H, W) bool, the scene's object is met.
    """
    rays = camera.rays.reshape(-1, 3) / camera.ray_lengths.reshape(-1, 1)
    directions = rotate_vectors(T_world_camera, rays)
    hits = caster.cast(T_world_camera[:3, 3], directions)
    tri = np.where(hits.found, hits.triangle, 0)
    normals = rotate_vectors(invert(T_world_camera), caster.facing(tri, directions))
    normals[~hits.found] = np.nan
    # The float32 distance of Embree is good to 1e-7; the plane of the triangle gives the rest in float64.
    corners = caster.geometry.corners[tri]
    plane = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    offset = np.einsum("ij,ij->i", plane, corners[:, 0] - T_world_camera[:3, 3])
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = offset / np.einsum("ij,ij->i", plane, directions)
    radial = np.where(np.abs(radial - hits.distance) < 1e-4, radial, hits.distance)
    depth = np.where(hits.found, radial, np.nan).reshape(camera.shape) / camera.ray_lengths
    target = (hits.found & caster.geometry.target[tri]).reshape(camera.shape)
    return depth.astype(np.float32), normals.reshape(*camera.shape, 3).astype(np.float32), target


def light_at_pixels(
    caster: Caster, camera: Camera, T_world_tof: Float64, lamp: Lamp, hz: Sequence[float],
    transport: Transport | None, subpixels: int = 4, rays: int = 64,
) -> Light:  # fmt: skip
    """Render the phasors of one pose.

    ``hz`` are modulation frequencies, ascending, and ``transport`` is light between surfaces; ``None`` leaves direct light only.
    A pixel has ``subpixels`` points along each axis, and ``rays`` rays of the last indirect bounce.
    """
    k = wavenumbers(hz)

    def look(subpixels: int, pixels: Int64) -> tuple[_Samples, Complex64]:
        """Sample the given pixels, pixel by pixel; with the direct irradiance (len(k), N) there."""
        own = None if subpixels == 1 else _within(camera, subpixels, pixels)
        samples = _look(caster, camera.scaled(subpixels), T_world_tof, own)
        seen = np.flatnonzero(samples.found)
        out = np.zeros((len(k), len(samples.points)), dtype=np.complex64)
        out[:, seen] = direct(caster, samples.points[seen], samples.normals[seen], lamp, k)
        return samples, out

    coarse = _look(caster, camera, T_world_tof)
    indirect = None if transport is None else _indirect(coarse, camera, lamp, transport, rays)
    # A pixel on one smooth surface is sampled half as finely: what it averages over changes linearly across it.
    first = subpixels // 2 if subpixels % 2 == 0 else subpixels
    samples, direct_light = look(first, np.arange(coarse.found.size))
    total = _means(samples, direct_light, indirect, coarse, camera, np.arange(coarse.found.size), k)
    if first < subpixels:
        odd = np.flatnonzero(_broken(samples, direct_light[0].real > 0, camera, first))
        samples, direct_light = look(subpixels, odd)
        total[:, odd] = _means(samples, direct_light, indirect, coarse, camera, odd, k)
    total = total.reshape(len(k), *camera.shape)
    return Light(phasor=total[1:], steady=total[0].real)


def _within(camera: Camera, subpixels: int, pixels: Int64) -> Int64:
    """List flat indices, in the image ``subpixels`` times as fine, of the samples of each pixel, one pixel after the other."""
    v, u = pixels // camera.width, pixels % camera.width
    step = np.arange(subpixels)
    rows = (v[:, None] * subpixels + step)[:, :, None] * (camera.width * subpixels)
    out: Int64 = rows + (u[:, None] * subpixels + step)[:, None, :]
    return out.reshape(-1)


def _means(
    samples: _Samples, irradiance: Complex64, indirect: Complex64 | None, coarse: _Samples, camera: Camera,
    pixels: Int64, k: Sequence[float],
) -> NDArray[np.complex128]:  # fmt: skip
    """Average albedo times irradiance, turned by the way back to the camera, over each pixel's samples: (len(k), P)."""
    if not len(pixels):
        return np.zeros((len(k), 0), dtype=np.complex128)
    own = np.repeat(pixels, len(samples.points) // len(pixels))
    if indirect is not None:
        irradiance = irradiance + indirect[:, _nearest(coarse, samples, own, camera)]
    out = np.empty((len(k), len(pixels)), dtype=np.complex128)
    for c, kk in enumerate(k):
        phase = (kk * samples.distance.astype(np.float64)) % (2 * np.pi)
        arriving = irradiance[c] * samples.albedo * turn(phase.astype(np.float32))
        out[c] = arriving.reshape(len(pixels), -1).mean(axis=1, dtype=np.complex128)
    return out


def _broken(samples: _Samples, lit: NDArray[np.bool_], camera: Camera, subpixels: int) -> NDArray[np.bool_]:
    """Mark pixels (H * W,) with a sample beside another surface, another albedo or the edge of a shadow."""
    (H, W), s = camera.shape, subpixels

    def image(values: NDArray[Any]) -> NDArray[Any]:
        tail = values.shape[1:]
        return values.reshape(H, W, s, s, *tail).swapaxes(1, 2).reshape(H * s, W * s, *tail)

    points, normals, albedo = image(samples.points), image(samples.normals), image(samples.albedo)
    state = image(samples.found + 2 * lit.astype(np.int8))
    distance = image(samples.distance)
    odd = np.zeros((H * s, W * s), dtype=bool)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        gap = np.abs(np.einsum("ijk,ijk->ij", points[a] - points[b], normals[b]))
        bend = np.einsum("ijk,ijk->ij", normals[a], normals[b])
        differs = (state[a] != state[b]) | (albedo[a] != albedo[b])
        differs |= (state[a] > 0) & ((bend < _STRAIGHT) | (gap > _FLAT * distance[b]))
        odd[a] |= differs
        odd[b] |= differs
    return odd.reshape(H, s, W, s).any(axis=(1, 3)).reshape(-1)


def _indirect(coarse: _Samples, camera: Camera, lamp: Lamp, transport: Transport, rays: int) -> Complex64:
    """Compute indirect irradiance (K, H * W) at the pixel centres, denoised over the interleaving tile."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    pattern = ((v % _TILE) * _TILE + u % _TILE).reshape(-1)
    seen = np.flatnonzero(coarse.found)
    solution = transport.solve(lamp)
    h = np.zeros((len(transport.k), len(coarse.points)), dtype=np.complex64)
    h[:, seen] = transport.gather(
        coarse.points[seen], coarse.normals[seen], lamp, solution, rays, pattern[seen]
    )
    return _filter(h, coarse, camera)


def _filter(h: Complex64, samples: _Samples, camera: Camera) -> Complex64:
    """Average over the 5 x 5 neighbours that lie on the same smooth surface (ends weigh half: a full 4 x 4 tile)."""
    H, W = camera.shape
    points, normals = samples.points.reshape(H, W, 3), samples.normals.reshape(H, W, 3)
    found = samples.found.reshape(H, W)
    image = h.reshape(len(h), H, W)
    total, weights = np.zeros_like(image), np.zeros((H, W), dtype=np.float32)
    reach = _TILE // 2
    tap = np.array([0.5, 1, 1, 1, 0.5], dtype=np.float32)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            a = (slice(max(0, -dy), H - max(0, dy)), slice(max(0, -dx), W - max(0, dx)))
            b = (slice(max(0, dy), H + min(0, dy)), slice(max(0, dx), W + min(0, dx)))
            if min(H - abs(dy), W - abs(dx)) <= 0:
                continue
            offset = points[b] - points[a]
            gap = np.abs(np.einsum("ijk,ijk->ij", offset, normals[a]))
            alike = np.einsum("ijk,ijk->ij", normals[a], normals[b]) > 0.9
            near = gap < 0.05 * np.linalg.norm(offset, axis=-1) + 1e-4
            w = (found[a] & found[b] & alike & near) * (tap[dy + reach] * tap[dx + reach])
            total[:, *a] += w * image[:, *b]
            weights[a] += w
    mean = total / np.maximum(weights, np.float32(1e-9))
    return mean.astype(np.complex64).reshape(h.shape)


def _nearest(coarse: _Samples, fine: _Samples, own: Int64, camera: Camera) -> Int64:
    """Find the nearest pixel centre on the surface of each sample, as flat index; ``own`` is the sample's pixel."""
    H, W = camera.shape
    choice = own.copy()
    cost = _unlike(fine, np.arange(len(own)), coarse, own)
    odd = np.flatnonzero(fine.found & (cost > 0.02))
    best = cost[odd]
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y = np.clip(own[odd] // W + dy, 0, H - 1)
            x = np.clip(own[odd] % W + dx, 0, W - 1)
            other = y * W + x
            cost = _unlike(fine, odd, coarse, other)
            better = cost < best
            choice[odd[better]], best[better] = other[better], cost[better]
    return choice


def _unlike(fine: _Samples, i: Int64, coarse: _Samples, j: Int64) -> Float32:
    """Measure how little sample i and pixel centre j belong to one surface: normals apart plus distance off the plane."""
    offset = fine.points[i] - coarse.points[j]
    gap = np.abs(np.einsum("ij,ij->i", offset, coarse.normals[j])) / np.maximum(fine.distance[i], 1e-6)
    turn = 1 - np.einsum("ij,ij->i", fine.normals[i], coarse.normals[j])
    out: Float32 = np.where(coarse.found[j], turn + 4 * gap, np.float32(9)).astype(np.float32)
    return out
