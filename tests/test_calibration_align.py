"""Alignment end to end: ray-cast board views with mixed pixels, noise and wiggle go in, the rig's transform comes out."""

from __future__ import annotations

import numpy as np
import pytest

from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth, View
from tofcapture.o3d import load_open3d
from tofcapture.ops import phase
from tofcapture.rig import Rig

TOF = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
STEREO = Camera(640, 512, 575.0, 575.0, 319.5, 255.5)
TRUE = poses.transform(poses.rotation_exp([0.01, -0.06, 0.02]), [0.095, 0.012, -0.02])
GUESS = poses.exp([0.006, -0.007, 0.005, 0.015, -0.012, 0.02]) @ TRUE
SUB = 3  # sub-samples per ToF pixel and axis: mixed pixels come out right


def box_mesh(size, T):
    """Triangles of a box centred on its frame."""
    o3d = load_open3d()
    mesh = o3d.geometry.TriangleMesh.create_box(*size)
    mesh.translate(-np.asarray(size) / 2)
    return mesh.transform(T)


def board_meshes():
    """0.5 x 0.4 m board as strips around two windows of different size, a box, a ball, table and wall; world z up."""
    o3d = load_open3d()
    tilt = poses.transform(poses.rotation_exp([0.0, -0.35, 0.0]), [0.0, 0.0, 0.27])
    strips = [
        ((0.01, 0.5, 0.06), (0, 0, 0.17)), ((0.01, 0.5, 0.05), (0, 0, -0.175)), ((0.01, 0.5, 0.05), (0, 0, 0.03)),
        ((0.01, 0.06, 0.4), (0, 0.22, 0)), ((0.01, 0.05, 0.4), (0, -0.225, 0)), ((0.01, 0.07, 0.2), (0, 0.02, 0.1)),
        ((0.01, 0.12, 0.2), (0, -0.06, -0.1)), ((0.01, 0.1, 0.1), (0, 0.15, 0.1)),
    ]
    meshes = [box_mesh(size, tilt @ poses.transform(np.eye(3), at)) for size, at in strips]
    turned = poses.rotation_exp([0.0, 0.0, 0.6])
    meshes.append(box_mesh((0.12, 0.1, 0.2), poses.transform(turned, [-0.12, 0.33, 0.1])))
    meshes.append(o3d.geometry.TriangleMesh.create_sphere(0.07, 40).translate([-0.08, -0.33, 0.07]))
    meshes.append(box_mesh((1.4, 1.2, 0.02), poses.transform(np.eye(3), [0, 0, -0.01])))
    meshes.append(box_mesh((0.02, 2.4, 2.0), poses.transform(np.eye(3), [0.55, 0, 0.6])))
    return meshes


def scene_of(meshes):
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene


def cast(scene, T_world_camera, rays):
    """Depth factor along unnormalised rays (..., 3) and normals in the camera frame."""
    o3d = load_open3d()
    world = poses.rotate_vectors(T_world_camera, rays)
    origin = np.broadcast_to(T_world_camera[:3, 3], world.shape)
    hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([origin, world], -1).astype(np.float32)))
    t = hit["t_hit"].numpy().astype(np.float64)
    normals = poses.rotate_vectors(poses.invert(T_world_camera), hit["primitive_normals"].numpy())
    return np.where(np.isfinite(t), t, np.nan), normals


def tof_burst(scene, T_world_tof, rng, frames, wiggle, scatter):
    """Burst of a coaxial ToF camera: I/Q averaged over sub-samples, wiggle in metres, scattered light, read noise."""
    fine = TOF.scaled(SUB)
    depth, normals = cast(scene, T_world_tof, fine.rays)
    radial = depth * fine.ray_lengths
    cosine = np.abs((normals * fine.rays).sum(-1)) / fine.ray_lengths
    amplitude = np.nan_to_num(250 * cosine / radial**2)
    planes = []
    for hz in (20e6, 100e6):
        k = 4 * np.pi * hz / 299_792_458.0
        longer = np.nan_to_num(radial) + wiggle * np.sin(2 * k * np.nan_to_num(radial))
        z = amplitude * np.exp(1j * k * longer)
        z = z.reshape(TOF.height, SUB, TOF.width, SUB).mean(axis=(1, 3))
        planes.append(z * (1 - scatter) + scatter * z.mean())
    phasor = np.stack(planes)
    offset = np.full(phasor.shape, 900.0) + np.abs(phasor)
    info = TofInfo("test", "0", TOF, np.zeros(3))
    clean = phase.taps(phasor, offset, info.modulation_hz, info.phase_rad)
    noisy = rng.normal(clean, 7.0, (frames, *clean.shape))
    raw = np.clip(np.round(noisy), 0, 4095).astype(np.uint16)
    return TofBurst(raw, np.arange(frames, dtype=np.int64), np.full(frames, 45.0), info), depth


def stereo_frame(scene, T_world_stereo, rng):
    """Point map with 0.03 % noise and holes where the surface is grazing or the right eye is blocked."""
    depth, normals = cast(scene, T_world_stereo, STEREO.rays)
    points = depth[..., None] * STEREO.rays
    cosine = np.abs((normals * STEREO.rays).sum(-1)) / STEREO.ray_lengths
    eye = poses.transform(np.eye(3), [0.1, 0, 0])
    seen, _ = cast(scene, T_world_stereo @ eye, np.nan_to_num(points - eye[:3, 3], nan=1.0))
    good = (cosine > np.cos(np.radians(70))) & (np.abs(seen - 1) < 0.003) & (depth < 3)
    noisy = points * (1 + rng.normal(0, 3e-4, depth.shape))[..., None]
    return StereoFrame(np.where(good[..., None], noisy, np.nan).astype(np.float32), 0, StereoInfo("test", "0", STEREO))


def simulated_view(index, seed=0, frames=4, wiggle=0.001, scatter=0.003, meshes=None, T_world_tof=None):
    """One view of the board from a direction tilted 15 to 40 degrees, 0.55 to 0.95 m away."""
    rng = np.random.default_rng([seed, index])
    if T_world_tof is None:
        yaw, pitch = np.radians(38) * np.sin(2.4 * index + 0.5), np.radians(20 + 16 * np.cos(2.4 * index + 0.5))
        away = 0.55 + 0.4 * ((index * 0.618) % 1)
        eye = np.array([0, 0, 0.25]) + away * np.array([-np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        T_world_tof = poses.look_at(eye, [0, 0, 0.23], roll=rng.uniform(-0.3, 0.3))
    scene = scene_of(board_meshes() if meshes is None else meshes)
    burst, _ = tof_burst(scene, T_world_tof, rng, frames, wiggle, scatter)
    state = ArmState(np.zeros(6), np.eye(4), 0)
    fine = TOF.scaled(2).shape
    truth = Truth(
        np.full(fine, np.nan, np.float32), np.full((*fine, 3), np.nan, np.float32), np.zeros(fine, bool), TRUE, np.eye(4)
    )
    rig = Rig(TOF, STEREO, GUESS, np.eye(4))
    return View("calibration", index, burst, stereo_frame(scene, T_world_tof @ TRUE, rng), state, state, rig, {}, truth)
