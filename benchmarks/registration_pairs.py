"""Pairs of clouds whose true registration is known: what ``registration.py`` runs on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.clouds import Cloud
from calibration.pairs import pair_of
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.devices.sim.meshes import read_mesh
from tofcapture.devices.sim.render import Caster, merge
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.scenes import (
    BOARD_CENTRE,
    BOARD_TILT,
    CALIBRATION,
    TABLE_CENTRE,
    scene_objects,
)
from tofcapture.devices.sim.shapes.made import board
from tofcapture.devices.sim.shapes.mesh import Mesh, cuboid, settle
from tofcapture.devices.sim.shapes.turned import ball
from tofcapture.devices.sim.world import SimWorld, read_constants
from tofcapture.frames import ArmState, View
from tofcapture.o3d import load_open3d
from tofcapture.poses import Float64

TOF = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
STEREO = Camera(1280, 1024, 1155.0, 1155.0, 639.5, 511.5)
T_STEREO_TOF = poses.invert(poses.transform(poses.rotation_exp([0.045, 0.012, 0.009]), [-0.05, 0.075, 0.004]))
TOF_NOISE, STEREO_NOISE = 0.004, 0.0003  # of the range
MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"


@dataclass(frozen=True)
class Problem:
    """One pair.

    Attributes
    ----------
    name
        Kind and seed.
    tof, sigma
        (H, W, 3) image, NaN where nothing was hit, and its noise (H, W); of a board view the points (N, 3) and (N,). Metres.
    stereo
        (H, W, 3) map, metres.
    cloud
        Of a board view what ``align`` makes of the map, else None.
    truth, guess
        (4, 4) ``T_stereo_tof``.
    target
        (M, 3) the true object's points, ToF frame.
    """

    name: str
    tof: Float64
    sigma: Float64
    stereo: np.ndarray
    cloud: Cloud | None
    truth: Float64
    guess: Float64
    target: Float64


def torus(radius: float, tube: float) -> Mesh:
    """Ring about z."""
    mesh = load_open3d().geometry.TriangleMesh.create_torus(radius, tube, 80, 48)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)


Scene = tuple[list[SceneObject], Float64]  # objects in the world, T_world_tof


def tabletop(rng: np.random.Generator) -> Scene:
    """Board with holes, torus, boxes and ball in front of it, wall behind; the world is the ToF frame."""
    tilt = poses.rotation_exp([np.pi + rng.normal(0, 0.25), rng.normal(0, 0.25), rng.normal(0, 0.3)])
    place = poses.transform(tilt, rng.uniform([-0.03, -0.03, 0.75], [0.03, 0.03, 0.95]))

    def on_board(name: str, mesh: Mesh, at: tuple[float, float, float]) -> SceneObject:
        turn = poses.transform(poses.rotation_exp(rng.normal(0, 0.3, 3)), at)
        return SceneObject(*mesh, albedo=0.6, T_world_object=place @ turn, name=name)

    wall = poses.transform(poses.rotation_exp(rng.normal(0, 0.15, 3)), [0, 0, 1.35])
    objects = [
        SceneObject(*board(), albedo=0.7, T_world_object=place, name="board"),
        on_board("torus", torus(0.06, 0.022), (-0.06, 0.02, 0.035)),
        on_board("box", cuboid(0.08, 0.06, 0.07), (0.12, 0.02, 0.012)),
        on_board("box", cuboid(0.05, 0.09, 0.05), (-0.18, 0.03, 0.012)),
        on_board("ball", ball(0.04), (0.0, -0.12, 0.012)),
        SceneObject(*cuboid(4, 4, 0.1), albedo=0.5, T_world_object=wall, target=False, name="wall"),
    ]
    return objects, np.eye(4)


def made(rng: np.random.Generator) -> Scene:
    """One to four procedural objects with clutter on the simulated station's table."""
    seed = int(rng.integers(1 << 30))
    return scene_objects(f"random-{seed}", seed), _above_the_table(rng)


def scanned(rng: np.random.Generator) -> Scene:
    """Three of the scanned or machined meshes with clutter on that table."""
    files = sorted(MESHES.glob("*.ply"))
    first, *more = rng.choice(len(files), 3, replace=False)
    name = files[first].stem
    objects = scene_objects(name, int(rng.integers(1 << 30)), {name: files[first]}, "mm")
    start = rng.uniform(0, 2 * np.pi)
    for k, which in enumerate(more):
        mesh = settle(read_mesh(files[which], "mm"))
        angle = start + np.pi * k + rng.uniform(-0.5, 0.5)
        spot = TABLE_CENTRE + 0.16 * np.array([np.cos(angle), np.sin(angle), 0])
        place = poses.transform(poses.rotation_exp([0, 0, rng.uniform(0, 2 * np.pi)]), spot)
        objects.append(SceneObject(*mesh, albedo=0.6, T_world_object=place, name=files[which].stem))
    return objects, _above_the_table(rng)


def _above_the_table(rng: np.random.Generator) -> Float64:
    tilt, turn = np.radians(rng.uniform(10, 50)), rng.uniform(0, 2 * np.pi)
    way = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    aim = TABLE_CENTRE + [*rng.uniform(-0.05, 0.05, 2), 0.05]  # noqa: RUF005  an addition of numbers
    return poses.look_at(aim + rng.uniform(0.65, 1.0) * way, aim, roll=rng.uniform(0, 2 * np.pi))


KINDS: dict[str, tuple[int, Callable[[np.random.Generator], Scene]]] = {
    "tabletop": (1, tabletop),
    "made": (3, made),
    "scanned": (4, scanned),
}


def radial_image(caster: Caster, camera: Camera, T_world_camera: Float64) -> tuple[Float64, np.ndarray]:
    """Range (H, W) that a noise-free camera sees, NaN where nothing, and what belongs to the object."""
    rays = poses.rotate_vectors(T_world_camera, camera.rays / camera.ray_lengths[..., None]).reshape(-1, 3)
    hits = caster.cast(T_world_camera[:3, 3].astype(np.float32), rays.astype(np.float32))
    radial = np.where(hits.found, hits.distance.astype(np.float64), np.nan).reshape(camera.shape)
    return radial, (caster.geometry.target[hits.triangle] & hits.found).reshape(camera.shape)


def ray_cast_problem(kind: str, seed: int) -> Problem:
    """Make one pair of a kind of scene."""
    stream, scene = KINDS[kind]
    rng = np.random.default_rng([seed, stream])
    objects, T_world_tof = scene(rng)
    caster = Caster(merge(objects))
    radial, on_target = radial_image(caster, TOF, T_world_tof)
    far, _ = radial_image(caster, STEREO, T_world_tof @ poses.invert(T_STEREO_TOF))

    def noisy(radial: Float64, camera: Camera, relative: float) -> Float64:
        return camera.unproject(
            camera.radial_to_depth(radial * (1 + relative * rng.standard_normal(radial.shape)))
        )

    axis = rng.normal(size=3)
    turn = np.radians(rng.uniform(0, 3)) * axis / np.linalg.norm(axis)
    offset = poses.transform(poses.rotation_exp(turn), rng.uniform(-0.05, 0.05, 3))
    return Problem(
        name=f"{kind} {seed}",
        tof=noisy(radial, TOF, TOF_NOISE),
        sigma=TOF_NOISE * radial,
        stereo=noisy(far, STEREO, STEREO_NOISE).astype(np.float32),
        cloud=None,
        truth=T_STEREO_TOF,
        guess=T_STEREO_TOF @ offset,
        target=TOF.unproject(TOF.radial_to_depth(radial))[on_target],
    )


def board_problem(seed: int) -> Problem:
    """Make one pair of a board view of the simulated station, all errors on, reduced as ``align`` does."""
    rng = np.random.default_rng([seed, 2])
    world = SimWorld(read_constants({}, "benchmark"), seed, scene_objects)
    world.place(CALIBRATION)
    tilt, turn = np.radians(rng.uniform(15, 35)), rng.uniform(0, 2 * np.pi)
    leaning = poses.rotation_exp([0, BOARD_TILT, 0])
    way = leaning @ [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
    T_base_tof = poses.look_at(BOARD_CENTRE + rng.uniform(0.55, 0.95) * way, BOARD_CENTRE, roll=rng.normal())
    T_base_flange = T_base_tof @ poses.invert(world.true_rig.T_flange_tof)
    world.set_pose(T_base_flange, str(seed).encode())
    arm, rig = ArmState(np.zeros(6), T_base_flange, 0), world.nominal_rig()
    truth = world.truth()
    view = View(
        CALIBRATION, seed, world.tof(10, lambda: 0), world.stereo(lambda: 0), arm, arm, rig, {}, truth
    )
    pair = pair_of(view, str(seed), "")
    exact = world.constants.tof.scaled(2).unproject(truth.depth)
    return Problem(
        name=f"board view {seed}",
        tof=pair.source,
        sigma=np.full(len(pair.source), 0.001),
        stereo=view.stereo.points,
        cloud=pair.target,
        truth=world.true_rig.T_stereo_tof,
        guess=rig.T_stereo_tof,
        target=exact[truth.target & np.isfinite(truth.depth)],
    )
