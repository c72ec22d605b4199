"""Balls before a wall, seen exactly by a ToF camera and a stereo camera: what registration is held against."""

from __future__ import annotations

import numpy as np

from calibration.projective.grid import surface_grid
from tofcapture import poses
from tofcapture.camera import Camera

TOF = Camera(160, 120, 127.0, 134.0, 78.0, 67.0)
STEREO = Camera(640, 512, 577.5, 577.5, 319.5, 255.5)
TRUE = poses.invert(poses.transform(poses.rotation_exp([0.045, 0.012, 0.009]), [-0.05, 0.075, 0.004]))
BALLS = [
    (-0.14, -0.08, 0.78, 0.09),
    (0.12, -0.10, 0.82, 0.07),
    (0.10, 0.12, 0.80, 0.08),
    (-0.10, 0.13, 0.84, 0.05),
]
WALL = np.array([0.12, -0.08, 1.0])  # 1 / z = n . (x, y, 1) / 1.05 m


def ranges(camera, T_scene_camera, balls=BALLS):
    """Range of every pixel to the nearest of the balls and the wall, in closed form."""
    rays = camera.rays / camera.ray_lengths[..., None]
    d, o = poses.rotate_vectors(T_scene_camera, rays), T_scene_camera[:3, 3]
    best = (1.05 - WALL @ o) / (d @ WALL)
    for *centre, radius in balls:
        along = d @ (np.array(centre) - o)
        miss = np.square(np.array(centre) - o).sum() - along**2
        hit = along - np.sqrt(np.maximum(radius**2 - miss, 0))
        best = np.where((miss < radius**2) & (hit < best), hit, best)
    return best


def tof_points(rng=None, sigma=0.0, balls=BALLS):
    """ToF points with range noise of ``sigma`` (a number or an image), ToF frame."""
    r = ranges(TOF, np.eye(4), balls)
    if rng is not None:
        r = r + sigma * rng.standard_normal(r.shape)
    return TOF.unproject(TOF.radial_to_depth(r)).reshape(-1, 3)


def stereo_points(noise=0.0, balls=BALLS, seed=9):
    r = ranges(STEREO, poses.invert(TRUE), balls)
    r = r * (1 + noise * np.random.default_rng(seed).standard_normal(r.shape))
    return STEREO.unproject(STEREO.radial_to_depth(r)).astype(np.float32)


GRID = surface_grid(stereo_points(3e-4), STEREO)


def errors(T):
    """Rotation error in degrees and displacement of a point 0.85 m ahead in millimetres."""
    c = np.array([0, 0, 0.85])
    away = poses.transform_points(T, c) - poses.transform_points(TRUE, c)
    return np.degrees(poses.rotation_angle(poses.invert(TRUE) @ T)), 1e3 * np.linalg.norm(away)


def guess(seed, degrees=3.0, metres=0.03):
    """Truth turned by exactly ``degrees`` about a random axis and shifted by exactly ``metres``."""
    rng = np.random.default_rng(seed)
    axis, way = rng.normal(size=(2, 3))
    turn = poses.rotation_exp(np.radians(degrees) * axis / np.linalg.norm(axis))
    return TRUE @ poses.transform(turn, metres * way / np.linalg.norm(way))
