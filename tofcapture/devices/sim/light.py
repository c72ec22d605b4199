"""What light reaches each pixel of the ToF camera: phasors of direct and indirect light, before any electronics.

A pixel is an area: sub-pixel samples are added as phasors, so that a pixel on an edge mixes foreground and background
(a flying pixel) as a real one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.devices.sim.render import Caster, Float32
from tofcapture.devices.sim.transport import Complex64, Lamp, Transport, direct, wavenumbers
from tofcapture.poses import Float64, invert, rotate_vectors

_TILE = 4  # interleaved sampling: 4 x 4 neighbouring pixels use 16 different sets of directions


@dataclass(frozen=True)
class Light:
    """Light at the pixels, per unit of radiant intensity of the illuminator.

    Attributes
    ----------
    phasor
        (F, H, W) complex128, albedo x irradiance phasor averaged over the pixel, with the phase of the whole path; 1/m^2.
    steady
        (H, W) float64, the same for unmodulated light.
    """

    phasor: NDArray[np.complex128]
    steady: Float64


@dataclass(frozen=True)
class _Samples:
    points: Float32  # (N, 3) world
    normals: Float32  # (N, 3) facing the camera
    albedo: Float32
    distance: Float32
    found: NDArray[np.bool_]


def _look(caster: Caster, camera: Camera, T_world_camera: Float64) -> _Samples:
    rays = camera.rays.reshape(-1, 3) / camera.ray_lengths.reshape(-1, 1)
    directions = rotate_vectors(T_world_camera, rays).astype(np.float32)
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
    """What an ideal camera of these intrinsics would measure at its pixel centres.

    Returns
    -------
    depth
        (H, W) float32, metres, NaN where nothing is met.
    normals
        (H, W, 3) float32, geometric, camera frame, facing the camera; NaN where nothing is met.
    target
        (H, W) bool, the scene's object is met.
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
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = np.einsum("ij,ij->i", plane, corners[:, 0] - T_world_camera[:3, 3]) / np.einsum(
            "ij,ij->i", plane, directions
        )
    radial = np.where(np.abs(radial - hits.distance) < 1e-4, radial, hits.distance)
    depth = np.where(hits.found, radial, np.nan).reshape(camera.shape) / camera.ray_lengths
    return (
        depth.astype(np.float32),
        normals.reshape(*camera.shape, 3).astype(np.float32),
        (hits.found & caster.geometry.target[tri]).reshape(camera.shape),
    )


def light_at_pixels(
    caster: Caster,
    camera: Camera,
    T_world_tof: Float64,
    lamp: Lamp,
    hz: Sequence[float],
    transport: Transport | None,
    subpixels: int = 4,
    rays: int = 64,
) -> Light:
    """Render the phasors of one pose.

    Parameters
    ----------
    caster
        The scene.
    camera, T_world_tof
        Intrinsics and pose of the ToF camera.
    lamp
        The illuminator, world frame.
    hz
        Modulation frequencies, ascending.
    transport
        Light between surfaces; ``None`` leaves direct light only.
    subpixels
        Each pixel is sampled on ``subpixels x subpixels`` points.
    rays
        Rays of the last indirect bounce, per pixel.
    """
    k = wavenumbers(hz)
    fine = _look(caster, camera.scaled(subpixels), T_world_tof)
    seen = np.flatnonzero(fine.found)
    irradiance = np.zeros((len(k), len(fine.points)), dtype=np.complex64)
    irradiance[:, seen] = direct(caster, fine.points[seen], fine.normals[seen], lamp, k)
    if transport is not None:
        coarse = _look(caster, camera, T_world_tof)
        indirect = _indirect(coarse, camera, lamp, transport, rays)
        irradiance += _spread(indirect, coarse, fine, camera, subpixels)
    total = np.empty((len(k), *camera.shape), dtype=np.complex128)
    for c, kk in enumerate(k):
        arriving = irradiance[c] * fine.albedo * np.exp(1j * kk * fine.distance.astype(np.float64))
        blocks = arriving.reshape(camera.height, subpixels, camera.width, subpixels)
        total[c] = blocks.mean(axis=(1, 3))
    return Light(phasor=total[1:], steady=total[0].real)


def _indirect(coarse: _Samples, camera: Camera, lamp: Lamp, transport: Transport, rays: int) -> Complex64:
    """Indirect irradiance (K, H * W) at the pixel centres, denoised over the interleaving tile."""
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


def _spread(
    indirect: Complex64, coarse: _Samples, fine: _Samples, camera: Camera, subpixels: int
) -> Complex64:
    """Give every sub-pixel sample the indirect light of the nearest pixel centre on its own surface."""
    H, W = camera.shape
    row = np.repeat(np.arange(H), subpixels)[:, None]
    column = np.repeat(np.arange(W), subpixels)[None, :]
    own = (row * W + column).reshape(-1)
    choice = own.copy()
    odd = np.flatnonzero(fine.found & (_unlike(fine, np.arange(len(own)), coarse, own) > 0.02))
    best = _unlike(fine, odd, coarse, own[odd])
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y = np.clip(own[odd] // W + dy, 0, H - 1)
            x = np.clip(own[odd] % W + dx, 0, W - 1)
            other = y * W + x
            cost = _unlike(fine, odd, coarse, other)
            better = cost < best
            choice[odd[better]], best[better] = other[better], cost[better]
    return indirect[:, choice]


def _unlike(fine: _Samples, i: NDArray[np.int64], coarse: _Samples, j: NDArray[np.int64]) -> Float32:
    """How little sample i and pixel centre j belong to one surface: normals apart plus distance off the plane."""
    offset = fine.points[i] - coarse.points[j]
    gap = np.abs(np.einsum("ij,ij->i", offset, coarse.normals[j])) / np.maximum(fine.distance[i], 1e-6)
    turn = 1 - np.einsum("ij,ij->i", fine.normals[i], coarse.normals[j])
    out: Float32 = np.where(coarse.found[j], turn + 4 * gap, np.float32(9)).astype(np.float32)
    return out
