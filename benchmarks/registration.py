"""Registration of a ToF cloud into a stereo cloud: ours against Open3D, small_gicp and kiss-icp, on the same pairs in one process.

    python benchmarks/registration.py [--pairs 2] [--board 2] [--seed 0]

Ray-cast pairs are of three kinds of scenes: ``tabletop`` (a board with holes, a torus, two boxes and a ball before a wall), ``made``
(one to four procedural objects and clutter on the simulated station's table), ``scanned`` (a mesh of ../shared/meshes there, where
it is present). A 1280 x 1024 stereo camera has 0.03 % noise, a 240 x 180 ToF camera 0.4 % along the ray; the guess is off by up to
3 degrees (about the ToF camera) and up to 5 cm along each axis. Every method gets the same points, ours as the images that they are
and with the standard deviation of the noise, which a ToF camera's amplitude tells. The seconds run from the two point arrays to the
transform, normals, edges and down-sampling included.

Board views are of the simulated station with all its errors, reduced to the board and its rims as ``align`` does, the guess as the
bracket's drawing says; the libraries get clouds with normals, ours the stereo image.

Printed per method: rotation error, mean displacement of the true object's points ("error at the object"), median seconds over
pairs (of each pair the median of ``--repeat`` runs); whether two fresh processes give ours the same bits; a verdict per kind.

Pairs whose condition number at the true transform, measured as ``align``'s gate measures it, is beyond the gate's limit count apart:
``align`` refuses them whatever the method. Errors are compared over the others; of these, how many end within 2 mm.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from registration_pairs import KINDS, MESHES, STEREO, Problem, board_problem, ray_cast_problem

from calibration.backends import BACKENDS, register
from calibration.projective.edges import stereo_edges
from calibration.projective.grid import surface_grid
from calibration.projective_icp import register_projective
from calibration.registration import MAX_CONDITION, Registration, measure_registration
from tofcapture import poses
from tofcapture.errors import TofError
from tofcapture.o3d import load_open3d
from tofcapture.poses import Float64

STAGES = (0.080, 0.040, 0.020, 0.010)  # m, correspondence distances of the libraries
VOXEL = 0.003  # m
THREADS = 2
SAME = 1.25  # an Open3D configuration is as accurate as the best of them when its mean error is within this factor
FASTER = 2.0  # what ours must be, against the fastest of those

CONVERGED = 2.0  # mm

Row = tuple[float, float, float, float]  # degrees, millimetres, seconds, condition number of the pair


def registered(p: Problem) -> Registration:
    grid = surface_grid(p.stereo, STEREO)
    return register_projective(p.tof, grid, p.guess, p.sigma, edges=stereo_edges(p.stereo, STEREO, grid))


def ours(p: Problem) -> Float64:
    return registered(p).T_target_source


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
    T, tof = p.guess, finite_points(p.tof)
    for distance in STAGES:
        thin = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(tof[:: 4 if distance > 0.02 else 1]))
        to_plane = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(k=distance))
        T = icp.registration_icp(thin, dense, distance, T, to_plane, stop).transformation
    return T


def small_gicp_kind(p: Problem, kind: str) -> Float64:
    import small_gicp

    target, tree = small_gicp.preprocess_points(finite_points(p.stereo), VOXEL, 10, THREADS)
    source, _ = small_gicp.preprocess_points(finite_points(p.tof), VOXEL, 10, THREADS)
    T = p.guess
    for distance in STAGES:
        stop = (1e-5, 1e-5) if distance == STAGES[-1] else (1e-3, 1e-3)  # rad, m
        T = small_gicp.align(target, source, tree, T, kind, distance, THREADS, 30, *stop).T_target_source
    return T


def kiss(p: Problem) -> Float64:
    """Point-to-point; its map searches neighbouring voxels only, so each stage fills its own."""
    from kiss_icp import mapping, registration, voxelization

    dense = voxelization.voxel_down_sample(finite_points(p.stereo), VOXEL)
    T, tof = p.guess, finite_points(p.tof)
    for distance in STAGES:
        solver = registration.Registration(50, 1e-5 if distance == STAGES[-1] else 1e-3, THREADS)
        voxels = mapping.VoxelHashMap(distance, 100.0, 20)
        voxels.add_points(dense)
        T = solver.align_points_to_map(tof[::4], voxels, T, distance, distance / 3)
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


def condition_of(p: Problem) -> float:
    """Condition number at the true transform, as the gate measures it."""
    cloud = surface_grid(p.stereo, STEREO).cloud() if p.cloud is None else p.cloud
    return measure_registration(p.truth, finite_points(p.tof), cloud).condition


def run(
    problems: list[Problem], methods: dict[str, Callable[[Problem], Float64]], repeat: int
) -> dict[str, list[Row]]:
    """Run every method on every pair; (rotation, error, seconds) per pair, methods interleaved."""
    results: dict[str, list[Row]] = {name: [] for name in methods}
    for p in problems:
        condition = condition_of(p)
        for name, method in methods.items():
            seconds = []
            for _ in range(1 if name.endswith("full") else repeat):
                start = time.perf_counter()
                T = method(p)
                seconds.append(time.perf_counter() - start)
            results[name].append((*errors(p, T), float(np.median(seconds)), condition))
        degrees, mm = errors(p, p.guess)
        size = p.stereo.size // 3 if p.cloud is None else len(p.cloud)
        print(
            f"  {p.name}: {p.tof.size // 3} ToF, {size} stereo points, condition {condition:.0f}, guess off by {degrees:.2f} deg, {mm:.0f} mm",
            file=sys.stderr,
        )
    return results


def table(title: str, results: dict[str, list[Row]]) -> str:
    """Lay results out; the first method is ours."""
    lines = [title, f"{'method':22}{'rotation deg':>18}{'error at object mm':>30}{'seconds':>10}{'ratio':>8}"]
    lines.append(
        f"{'':22}{'mean':>9}{'max':>9}{'mean':>12}{'median':>9}{'max':>9}{'median':>10}{'to ours':>8}"
    )
    own = np.median([r[2] for r in next(iter(results.values()))])
    for name, rows in results.items():
        degrees, mm, seconds, _ = np.array(rows).T
        middle = np.median(seconds)
        lines.append(
            f"{name:22}{degrees.mean():9.3f}{degrees.max():9.3f}{mm.mean():12.3f}{np.median(mm):9.3f}{mm.max():9.3f}"
            f"{middle:10.3f}{middle / own:8.1f}"
        )
    return "\n".join(lines)


def verdict(results: dict[str, list[Row]]) -> tuple[bool, str]:
    """Compare ours, the first, with the best of the others in mean, median and maximum, and with the fastest good Open3D."""
    rows = {name: np.array(found) for name, found in results.items()}
    own, *others = rows
    within = rows[own][:, 3] <= MAX_CONDITION
    seconds = {name: float(np.median(found[:, 2])) for name, found in rows.items()}
    apart = {name: int((found[~within, 1] < CONVERGED).sum()) for name, found in rows.items()}
    convergent = apart[own] >= max(apart[name] for name in others)
    text = f"; {(~within).sum()} beyond the gate, within {CONVERGED:g} mm: ours {apart[own]}, " + ", ".join(
        f"{name} {apart[name]}" for name in others if name.lower().startswith("open3d")
    )
    if not within.any():
        return convergent, f"no pair within the gate{text}"
    mm = {name: found[within, 1] for name, found in rows.items()}
    best = min(others, key=lambda name: mm[name].mean())
    stated = [(f(mm[own]), f(mm[best])) for f in (np.mean, np.median, np.max)]
    good = [name for name in others if name.lower().startswith("open3d")]
    least = min(mm[name].mean() for name in good)
    rival = min((n for n in good if mm[n].mean() <= SAME * least), key=lambda name: seconds[name])
    faster = seconds[rival] / seconds[own]
    accurate = convergent and all(a <= b for a, b in stated)
    numbers = ", ".join(
        f"{word} {a:.3f} to {b:.3f}" for word, (a, b) in zip(("mean", "median", "max"), stated, strict=True)
    )
    return accurate and faster >= FASTER, (
        f"{within.sum()} pairs: {'not less accurate' if accurate else 'LESS ACCURATE'} than {best} ({numbers} mm), "
        f"{faster:.1f}x as fast as {rival}{'' if faster >= FASTER else ': TOO SLOW'}{text if not within.all() else ''}"
    )


def digest_of(path: Path) -> str:
    """Digest of everything that ours returns for a pair on file."""
    with np.load(path) as f:
        p = Problem("", f["tof"], f["sigma"], f["stereo"], None, np.eye(4), f["guess"], np.zeros((0, 3)))
    r = registered(p)
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
    parser.add_argument("--pairs", type=int, default=2, help="ray-cast pairs of each kind")
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--board", type=int, default=2, help="board views of the simulated station")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument(
        "--skip", nargs="*", default=[], help="methods to leave out, by the start of their names"
    )
    parser.add_argument("--digest", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.digest is not None:
        print(digest_of(args.digest))
        return 0
    methods = {n: m for n, m in METHODS.items() if not n.startswith(tuple(args.skip))}
    kinds = [kind for kind in args.kinds if args.pairs and (kind != "scanned" or MESHES.is_dir())]
    found = {}
    for kind in kinds:
        problems = [ray_cast_problem(kind, args.seed + k) for k in range(args.pairs)]
        found[kind] = run(problems, methods, args.repeat)
        print(table(f"{len(problems)} ray-cast pairs, {kind}", found[kind]) + "\n", flush=True)
    if args.board:
        views = [board_problem(args.seed + k) for k in range(args.board)]
        found["board"] = run(views, CLOUD_METHODS, args.repeat)
        print(table(f"{len(views)} simulated board views, all errors on", found["board"]) + "\n", flush=True)
    verdicts = {kind: verdict(results) for kind, results in found.items()}
    if len(kinds) > 1:
        every = {name: [row for kind in kinds for row in found[kind][name]] for name in methods}
        verdicts["all ray-cast"] = verdict(every)
    for kind, (_, text) in verdicts.items():
        print(f"{kind:14}{text}")
    same = not kinds or same_bits(ray_cast_problem(kinds[0], args.seed))
    print(f"{'bits':14}two fresh processes: {'the same' if same else 'DIFFERENT'}")
    held = same and all(passed for passed, _ in verdicts.values())
    print(f"verdict       {'PASS' if held else 'FAIL'}")
    return 0 if held else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except TofError as err:
        sys.exit(str(err))
