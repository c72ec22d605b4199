"""Registration of a ToF cloud into a stereo cloud: ours against Open3D, small_gicp and kiss-icp, on the same pairs in one process.

    python benchmarks/registration.py [--pairs 8] [--board 4] [--seed 0]

Pairs of the first kind are ray-cast: a board with holes, a torus, two boxes and a ball before a wall; a 1280 x 1024 stereo
camera with 0.03 % noise, a 240 x 180 ToF camera with 0.4 % noise along the ray, the guess off by up to 3 degrees (about the
ToF camera) and up to 5 cm along each axis. Every method gets the same points, ours also the standard deviation of the noise,
which a ToF camera's amplitude tells. The seconds run from the two point arrays to the transform, normals and down-sampling
included.

Pairs of the second kind are board views of the simulated station with all its errors, reduced to the board and its rims as
``align`` does, the guess as the bracket's drawing says; here every method gets clouds with normals, ours too.

Printed per method: rotation error, mean displacement of the true object's points ("error at the object"), median seconds over
pairs (of each pair the median of ``--repeat`` runs); then whether two fresh processes give ours the same bits.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.backends import BACKENDS, register
from calibration.clouds import Cloud
from calibration.pairs import pair_of
from calibration.projective.grid import surface_grid
from calibration.projective_icp import register_projective
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.devices.sim.render import Caster, merge
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.scenes import BOARD_CENTRE, BOARD_TILT, CALIBRATION, scene_objects
from tofcapture.devices.sim.shapes.made import board
from tofcapture.devices.sim.shapes.mesh import Mesh, cuboid
from tofcapture.devices.sim.shapes.turned import ball
from tofcapture.devices.sim.world import SimWorld, read_constants
from tofcapture.errors import TofError
from tofcapture.frames import ArmState, View
from tofcapture.o3d import load_open3d
from tofcapture.poses import Float64

TOF = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
STEREO = Camera(1280, 1024, 1155.0, 1155.0, 639.5, 511.5)
T_STEREO_TOF = poses.invert(poses.transform(poses.rotation_exp([0.045, 0.012, 0.009]), [-0.05, 0.075, 0.004]))
TOF_NOISE, STEREO_NOISE = 0.004, 0.0003  # of the range
STAGES = (0.080, 0.040, 0.020, 0.010)  # m, correspondence distances of the libraries
VOXEL = 0.003  # m
THREADS = 2


@dataclass(frozen=True)
class Problem:
    """One pair: ToF points (N, 3) with their noise (N,), a stereo map (H, W, 3) or cloud, truth, guess, the object's points."""

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


def tabletop(rng: np.random.Generator) -> list[SceneObject]:
    """Board with holes, torus, boxes and ball in front of it, wall behind; ToF frame."""
    tilt = poses.rotation_exp([np.pi + rng.normal(0, 0.25), rng.normal(0, 0.25), rng.normal(0, 0.3)])
    place = poses.transform(tilt, rng.uniform([-0.03, -0.03, 0.75], [0.03, 0.03, 0.95]))

    def on_board(name: str, mesh: Mesh, at: tuple[float, float, float]) -> SceneObject:
        turn = poses.transform(poses.rotation_exp(rng.normal(0, 0.3, 3)), at)
        return SceneObject(*mesh, albedo=0.6, T_world_object=place @ turn, name=name)

    wall = poses.transform(poses.rotation_exp(rng.normal(0, 0.15, 3)), [0, 0, 1.35])
    return [
        SceneObject(*board(), albedo=0.7, T_world_object=place, name="board"),
        on_board("torus", torus(0.06, 0.022), (-0.06, 0.02, 0.035)),
        on_board("box", cuboid(0.08, 0.06, 0.07), (0.12, 0.02, 0.012)),
        on_board("box", cuboid(0.05, 0.09, 0.05), (-0.18, 0.03, 0.012)),
        on_board("ball", ball(0.04), (0.0, -0.12, 0.012)),
        SceneObject(*cuboid(4, 4, 0.1), albedo=0.5, T_world_object=wall, target=False, name="wall"),
    ]


def radial_image(caster: Caster, camera: Camera, T_world_camera: Float64) -> tuple[Float64, np.ndarray]:
    """Range (H, W) that a noise-free camera sees, NaN where nothing, and what belongs to the object."""
    rays = poses.rotate_vectors(T_world_camera, camera.rays / camera.ray_lengths[..., None]).reshape(-1, 3)
    hits = caster.cast(T_world_camera[:3, 3].astype(np.float32), rays.astype(np.float32))
    radial = np.where(hits.found, hits.distance.astype(np.float64), np.nan).reshape(camera.shape)
    return radial, (caster.geometry.target[hits.triangle] & hits.found).reshape(camera.shape)


def ray_cast_problem(seed: int) -> Problem:
    """Make one pair of the first kind."""
    rng = np.random.default_rng([seed, 1])
    caster = Caster(merge(tabletop(rng)))
    radial, on_target = radial_image(caster, TOF, np.eye(4))
    far, _ = radial_image(caster, STEREO, poses.invert(T_STEREO_TOF))

    def noisy(radial: Float64, camera: Camera, relative: float) -> Float64:
        return camera.unproject(
            camera.radial_to_depth(radial * (1 + relative * rng.standard_normal(radial.shape)))
        )

    seen = np.isfinite(radial)
    axis = rng.normal(size=3)
    turn = np.radians(rng.uniform(0, 3)) * axis / np.linalg.norm(axis)
    offset = poses.transform(poses.rotation_exp(turn), rng.uniform(-0.05, 0.05, 3))
    return Problem(
        name=f"ray-cast {seed}",
        tof=noisy(radial, TOF, TOF_NOISE)[seen],
        sigma=TOF_NOISE * radial[seen],
        stereo=noisy(far, STEREO, STEREO_NOISE).astype(np.float32),
        cloud=None,
        truth=T_STEREO_TOF,
        guess=T_STEREO_TOF @ offset,
        target=TOF.unproject(TOF.radial_to_depth(radial))[on_target],
    )


def board_problem(seed: int) -> Problem:
    """Make one pair of the second kind."""
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


def ours(p: Problem) -> Float64:
    return register_projective(p.tof, surface_grid(p.stereo, STEREO), p.guess, p.sigma).T_target_source


def finite_points(points: np.ndarray) -> Float64:
    flat = points.reshape(-1, 3)
    return flat[np.isfinite(flat[:, 2])].astype(np.float64)


def open3d_plane(p: Problem, voxel: float | None, search: float) -> Float64:
    """Legacy point-to-plane with Tukey's kernel, coarse to fine; the coarse stages on every fourth ToF point."""
    o3d = load_open3d()
    icp = o3d.pipelines.registration
    dense = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(finite_points(p.stereo)))
    if voxel is not None:
        dense = dense.voxel_down_sample(voxel)
    dense.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(search, 15))
    stop = icp.ICPConvergenceCriteria(1e-5, 1e-5, 20)
    T = p.guess
    for distance in STAGES:
        thin = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p.tof[:: 4 if distance > 0.02 else 1]))
        to_plane = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(k=distance))
        T = icp.registration_icp(thin, dense, distance, T, to_plane, stop).transformation
    return T


def small_gicp_kind(p: Problem, kind: str) -> Float64:
    import small_gicp

    target, tree = small_gicp.preprocess_points(finite_points(p.stereo), VOXEL, 10, THREADS)
    source, _ = small_gicp.preprocess_points(p.tof, VOXEL, 10, THREADS)
    T = p.guess
    for distance in STAGES:
        stop = (1e-5, 1e-5) if distance == STAGES[-1] else (1e-3, 1e-3)  # rad, m
        T = small_gicp.align(target, source, tree, T, kind, distance, THREADS, 30, *stop).T_target_source
    return T


def kiss(p: Problem) -> Float64:
    """Point-to-point; its map searches neighbouring voxels only, so each stage fills its own."""
    from kiss_icp import mapping, registration, voxelization

    dense = voxelization.voxel_down_sample(finite_points(p.stereo), VOXEL)
    T = p.guess
    for distance in STAGES:
        solver = registration.Registration(50, 1e-5 if distance == STAGES[-1] else 1e-3, THREADS)
        voxels = mapping.VoxelHashMap(distance, 100.0, 20)
        voxels.add_points(dense)
        T = solver.align_points_to_map(p.tof[::4], voxels, T, distance, distance / 3)
    return T


METHODS: dict[str, Callable[[Problem], Float64]] = {
    "ours": ours,
    "Open3D plane, 5 mm": lambda p: open3d_plane(p, 0.005, 0.015),
    "Open3D plane, 3 mm": lambda p: open3d_plane(p, VOXEL, 0.009),
    "Open3D plane, full": lambda p: open3d_plane(p, None, 0.005),
    "small_gicp GICP": lambda p: small_gicp_kind(p, "GICP"),
    "small_gicp PLANE_ICP": lambda p: small_gicp_kind(p, "PLANE_ICP"),
    "kiss-icp": kiss,
}


def backend(name: str) -> Callable[[Problem], Float64]:
    return lambda p: register(name, p.tof, p.cloud, p.guess).T_target_source


CLOUD_METHODS = {"ours (projective)": backend("projective")} | {
    name: backend(name) for name in BACKENDS if name != "projective"
}


def errors(p: Problem, T: Float64) -> tuple[float, float]:
    """Rotation error in degrees and mean displacement of the object's points in millimetres."""
    moved = poses.transform_points(T, p.target) - poses.transform_points(p.truth, p.target)
    turned = poses.rotation_angle(poses.invert(p.truth) @ T)
    return float(np.degrees(turned)), float(1e3 * np.linalg.norm(moved, axis=1).mean())


def run(
    problems: list[Problem], methods: dict[str, Callable[[Problem], Float64]], repeat: int
) -> dict[str, list[tuple[float, float, float]]]:
    """Run every method on every pair; (rotation, error, seconds) per pair, methods interleaved."""
    results: dict[str, list[tuple[float, float, float]]] = {name: [] for name in methods}
    for p in problems:
        for name, method in methods.items():
            seconds = []
            for _ in range(1 if name.endswith("full") else repeat):
                start = time.perf_counter()
                T = method(p)
                seconds.append(time.perf_counter() - start)
            results[name].append((*errors(p, T), float(np.median(seconds))))
        degrees, mm = errors(p, p.guess)
        size = p.stereo.size // 3 if p.cloud is None else len(p.cloud)
        print(
            f"  {p.name}: {len(p.tof)} ToF, {size} stereo points, guess off by {degrees:.2f} deg, {mm:.0f} mm",
            file=sys.stderr,
        )
    return results


def table(title: str, results: dict[str, list[tuple[float, float, float]]]) -> str:
    """Lay results out; the first method is ours."""
    lines = [title, f"{'method':22}{'rotation deg':>18}{'error at object mm':>22}{'seconds':>10}{'ratio':>8}"]
    lines.append(f"{'':22}{'mean':>9}{'max':>9}{'mean':>12}{'max':>10}{'median':>10}{'to ours':>8}")
    own = np.median([r[2] for r in next(iter(results.values()))])
    for name, rows in results.items():
        degrees, mm, seconds = np.array(rows).T
        middle = np.median(seconds)
        lines.append(
            f"{name:22}{degrees.mean():9.3f}{degrees.max():9.3f}{mm.mean():12.3f}{mm.max():10.3f}"
            f"{middle:10.3f}{middle / own:8.1f}"
        )
    return "\n".join(lines)


def digest_of(path: Path) -> str:
    """Digest of everything that ours returns for a pair on file."""
    with np.load(path) as f:
        grid = surface_grid(f["stereo"], STEREO)
        r = register_projective(f["tof"], grid, f["guess"], f["sigma"])
    bits = [r.T_target_source, r.information, r.centre, r.step, np.array([r.rmse, r.condition, r.fitness])]
    return hashlib.sha256(b"".join(a.tobytes() for a in bits)).hexdigest()


def same_bits(p: Problem) -> bool:
    """Run ours in two fresh processes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pair.npz"
        np.savez(path, tof=p.tof, sigma=p.sigma, stereo=p.stereo, guess=p.guess)
        command = [sys.executable, __file__, "--digest", str(path)]
        digests = {
            subprocess.run(command, check=True, capture_output=True, text=True).stdout for _ in range(2)
        }
    return len(digests) == 1


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=8, help="ray-cast pairs")
    parser.add_argument("--board", type=int, default=4, help="board views of the simulated station")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--digest", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.digest is not None:
        print(digest_of(args.digest))
        return 0
    cast = [ray_cast_problem(args.seed + k) for k in range(args.pairs)]
    print(table(f"{len(cast)} ray-cast pairs", run(cast, METHODS, args.repeat)), flush=True)
    if args.board:
        views = [board_problem(args.seed + k) for k in range(args.board)]
        title = f"{len(views)} simulated board views, all errors on, as align reduces them"
        print("\n" + table(title, run(views, CLOUD_METHODS, args.repeat)))
    same = same_bits(cast[0])
    print(f"\nours, two fresh processes: {'the same bits' if same else 'DIFFERENT bits'}")
    return 0 if same else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except TofError as err:
        sys.exit(str(err))
