"""Small analytic scenes, cast and exposed without the simulator: datasets for the tests of the networks."""

from __future__ import annotations

import numpy as np

from tofcapture.camera import Camera
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, ShardWriter, TofMaps
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.phase import taps
from tofcapture.ops.phase.reference import decode
from tofcapture.poses import look_at
from tofcapture.rig import SPEED_OF_LIGHT, Rig

HZ = (20e6, 100e6)


def hit_sphere(origin, rays, centre, radius):
    """Distance along rays and outward normals of a sphere; infinity where it is missed."""
    to = origin - centre
    b = (rays * to).sum(-1)
    disc = b**2 - (to @ to - radius**2)
    t = -b - np.sqrt(np.maximum(disc, 0))
    normal = (origin + t[..., None] * rays - centre) / radius
    return np.where((disc > 0) & (t > 0), t, np.inf), normal


def hit_box(origin, rays, centre, half):
    """Distance along rays and outward normals of an axis-aligned box; infinity where it is missed."""
    safe = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    near, far = np.sort(np.stack([(centre - half - origin) / safe, (centre + half - origin) / safe]), axis=0)
    axis = near.argmax(-1)
    t = near.max(-1)
    normal = np.eye(3)[axis] * -np.sign(np.take_along_axis(rays, axis[..., None], -1))
    return np.where((t < far.min(-1)) & (t > 0), t, np.inf), normal


def scene_shapes(seed):
    """A table and a few random spheres and boxes with albedos; the table comes first."""
    rng = np.random.default_rng(seed)
    shapes = [(hit_box, np.array([0, 0, -0.05]), np.array([0.6, 0.5, 0.05]), rng.uniform(0.3, 0.8))]
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform(0.03, 0.12)
        where = np.array([*rng.uniform(-0.15, 0.15, 2), size])
        box = rng.random() < 0.5
        extent = np.array([*rng.uniform(0.03, 0.12, 2), size]) if box else size
        shapes.append((hit_box if box else hit_sphere, where, extent, rng.uniform(0.2, 0.9)))
    return shapes


def cast(shapes, camera, T_world_camera):
    """Radial distance, depth, camera-frame normals, albedo and object index of every pixel."""
    rays = camera.rays / camera.ray_lengths[..., None]
    R, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
    world = rays @ R.T
    best, normals = np.full(camera.shape, np.inf), np.zeros((*camera.shape, 3))
    albedo, which = np.zeros(camera.shape), np.full(camera.shape, -1)
    for i, (hit, where, extent, rho) in enumerate(shapes):
        t, n = hit(origin, world, where, extent)
        closer = t < best
        best, albedo, which = (
            np.where(closer, t, best),
            np.where(closer, rho, albedo),
            np.where(closer, i, which),
        )
        normals = np.where(closer[..., None], n, normals)
    return best, best / camera.ray_lengths, normals @ R, albedo, which


def expose(radial, cosine, albedo, rng, frames):
    """Raw taps of a burst: sub-pixel mixing, wiggling, scattering, shot and read noise, 12 bits."""
    from scipy.ndimage import gaussian_filter

    radial = np.where(np.isfinite(radial), radial, 3.0)
    strength = 400 * albedo * np.clip(cosine, 0.05, 1) / radial**2
    phasor = []
    for hz in HZ:
        phase = 4 * np.pi * hz * radial / SPEED_OF_LIGHT
        wiggled = phase + 4 * np.pi * hz / SPEED_OF_LIGHT * 0.003 * np.sin(2 * phase + 0.5)
        z = strength * np.exp(1j * wiggled)
        z = z.reshape(z.shape[0] // 2, 2, z.shape[1] // 2, 2).mean((1, 3))
        phasor.append(z + 0.05 * (gaussian_filter(z.real, 15) + 1j * gaussian_filter(z.imag, 15)))
    z = np.stack(phasor)
    offset = np.abs(z) * 1.3 + 60
    info = TofInfo("", "", Camera(1, 1, 1, 1, 0, 0), np.zeros(3))
    clean = taps(z, offset, info.modulation_hz, info.phase_rad)
    electrons = rng.poisson(np.broadcast_to(clean * 12, (frames, *clean.shape))) / 12
    noisy = electrons + rng.normal(0, 4, electrons.shape)
    return np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)


def edges(depth):
    """Pixels within two of a depth step."""
    from scipy.ndimage import maximum_filter, minimum_filter

    filled = np.where(np.isfinite(depth), depth, 9)
    return maximum_filter(filled, 5) - minimum_filter(filled, 5) > 0.03


def shoot(shapes, camera, index, seed, frames):
    """One view as a shard sample."""
    rng = np.random.default_rng([seed, index])
    direction = np.array([rng.normal(), rng.normal(), 1.2])
    eye = direction / np.linalg.norm(direction) * rng.uniform(0.4, 1.2)
    T = look_at(eye, np.array([0, 0, 0.04]), roll=rng.uniform(-3, 3))
    fine = camera.scaled(2)
    radial, depth, normals, albedo, which = cast(shapes, fine, T)
    cosine = -(normals * fine.rays).sum(-1) / fine.ray_lengths
    raw = expose(radial, cosine, albedo, rng, frames)
    hit = np.isfinite(depth)
    mask = np.where(hit, 0, 1).astype(np.uint8)
    mask |= np.where(hit & (cosine < np.cos(np.radians(75))), 4, 0).astype(np.uint8)
    mask |= np.where(edges(depth), 8, 0).astype(np.uint8) | np.where(which < 1, 16, 0).astype(np.uint8)
    depth = np.where(hit, depth, np.nan).astype(np.float32)
    normals = np.where(hit[..., None], normals, np.nan).astype(np.float32)
    info = TofInfo("", "", camera, np.zeros(3))
    found = decode(raw.mean(axis=0), info)
    gt = {
        s: GroundTruth(depth[:: 3 - s, :: 3 - s], normals[:: 3 - s, :: 3 - s], mask[:: 3 - s, :: 3 - s])
        for s in (1, 2)
    }
    return Sample(
        index=index,
        raw=raw,
        celsius=np.full(frames, 45.0),
        time_ns=np.arange(frames),
        tof=TofMaps(
            camera.radial_to_depth(found.radial).astype(np.float32),
            found.amplitude[-1].astype(np.float32),
            np.zeros(camera.shape, bool),
        ),
        native_depth=np.full((8, 10), np.nan, np.float32),
        ground_truth=gt,
        T_base_tof=T,
        truth=ExactMaps(depth, normals),
    )


def make_dataset(
    folder,
    *,
    views=3,
    frames=2,
    scale=1,
    splits=("train", "train", "test"),
    seed=0,
    objects=(),
    distortion=(),
):
    """Write a dataset of analytic scenes; ``scale`` divides the sensor's resolution, ``objects`` are the scenes' as shards tell them."""
    f, c = (190.6 / scale, 200.8 / scale), (116.8 / scale, 101.5 / scale)
    camera = Camera(240 // scale, 180 // scale, *f, *c, distortion)
    info = TofInfo("analytic", "0", camera, np.zeros(3))
    stereo = StereoInfo("none", "0", Camera(10, 8, 10, 10, 4.5, 3.5))
    rig = Rig(camera, stereo.camera, np.eye(4), np.eye(4))
    (folder / "shards").mkdir(parents=True)
    scenes = {}
    for i, split in enumerate(splits):
        name = f"scene-{i}"
        path = f"shards/{name}.h5"
        with ShardWriter(folder / path, name, rig, info, stereo, views) as shard:
            shapes = scene_shapes(seed + i)
            for view in range(views):
                shard.add(shoot(shapes, camera, view, seed + i, frames))
            told = {"objects": list(objects[i])} if objects else {}
            scenes[name] = SceneEntry(path, shard.seal(told), views, split)
    write_manifest(folder, Manifest(scenes))
    return folder
