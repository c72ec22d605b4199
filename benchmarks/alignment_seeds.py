"""Errors of the alignment methods over seeds of the simulated station, all imperfections on.

``python benchmarks/alignment_seeds.py --seeds 20`` makes, for every seed, a station of its own and twelve board views tilted 20 to
40 degrees, aligns them by every method, and prints the errors against the true rig and how often the stated 1-sigma covers them. A
seed draws everything that may differ from one station to another: the rig itself, sensor noise, fixed pattern, factory calibration,
the drawing's error, the surroundings that throw light back, and the poses. Seeds share nothing but the board, the lenses and the
lamp. Light and noise-free depth are rendered once into the cache, about half a minute of CPU a seed.

``--method targetless`` aligns by two scenes of the table, six views each, instead, from the drawing.

``--pool`` names an independent set of stations. Pool 1 was looked at while the method was made; figures come from others.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.alignment.averages import about, average_transforms, fuse, twist_about
from calibration.alignment.joint import joint_icp
from calibration.alignment.methods import alignment_error
from calibration.alignment.targetless import align_scenes
from calibration.alignment.views import joint_view_of
from calibration.registration.clouds import WORKING_DEPTH, Cloud, tof_depth
from calibration.registration.gate import register
from calibration.registration.pairs import sighting_of
from tofcapture.devices.sim import stereo as stereos
from tofcapture.devices.sim.config import Constants, read_constants
from tofcapture.devices.sim.light import Light
from tofcapture.devices.sim.scenes import BOARD_CENTRE, BOARD_TILT, TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.sensor import expose
from tofcapture.devices.sim.stereo import point_map
from tofcapture.devices.sim.world import SimWorld
from tofcapture.files.view import write_view
from tofcapture.frames import ArmState, StereoFrame, TofBurst, Truth, View
from tofcapture.poses import Float64, exp, invert, look_at, rotation_exp, transform_points

VIEWS = 12
SCENES, OBJECTS = 2, 3  # without a board; objects at least
ARM = np.repeat([0.02e-3, np.radians(0.001)], 3)  # m, rad: how well an arm repeats
RIG_SPREAD = (0.006, 0.012)  # m, rad: how far the seeds' rigs differ in each component
FRAMES = 10
LAMP = {"lamp": {"half_angle": 0.70, "edge": 0.17}}  # of the embedded station


def constants_of(overrides: dict[str, Any] | None = None) -> Constants:
    """Read the embedded station's constants."""
    return read_constants({**LAMP, **(overrides or {})}, "benchmark")


def world_of(pool: int, seed: int) -> SimWorld:
    """Make a station of its own: rig, sensors, surroundings."""
    rng = np.random.default_rng([pool, seed, 7])
    rig = constants_of().rig
    moved = {
        "stereo_position": (np.array(rig["stereo_position"]) + rng.normal(0, RIG_SPREAD[0], 3)).tolist(),
        "stereo_rotation": (np.array(rig["stereo_rotation"]) + rng.normal(0, RIG_SPREAD[1], 3)).tolist(),
    }
    own = 1000 * pool + seed
    world = SimWorld(constants_of({"rig": moved}), own, lambda name, _: scene_objects(name, own))
    world.place("calibration")
    return world


def poses_of(pool: int, seed: int, near: float = 0.5, far: float = 1.1) -> list[Float64]:
    """``T_base_tof`` of a seed's board views: 20 to 40 degrees off the board's normal, all round, in random order of distance."""
    rng = np.random.default_rng([pool, seed])
    upright = rotation_exp([0.0, BOARD_TILT, 0.0])
    order, start = rng.permutation(VIEWS), rng.uniform(0, 2 * np.pi)
    out = []
    for i in range(VIEWS):
        tilt, turn = np.radians(rng.uniform(20, 40)), start + 2.399963 * i
        direction = upright @ [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        away = near + (far - near) * (order[i] + rng.uniform()) / VIEWS
        target = BOARD_CENTRE + rng.uniform(-0.03, 0.03, 3)
        out.append(
            look_at(target + away * direction, target, up=[1.0, 0.0, 0.0], roll=rng.uniform(-0.5, 0.5))
        )
    return out


def render(world: SimWorld, T_base_tof: Float64, path: Path) -> tuple[Light, NDArray[np.float32]]:
    """Light of a pose and its noise-free stereo depth, from the cache where it is there."""
    if not path.exists():
        world.set_pose(T_base_tof @ invert(world.true_rig.T_flange_tof), path.stem.encode())
        light = world.light()
        points = point_map(
            world.caster()[0],
            world.constants.stereo,
            T_base_tof @ world.true_rig.T_tof_stereo,
            stereos.ideal(world.constants.stereo_model),
            np.random.default_rng(0),
        )
        partial = path.with_suffix(".partial.npz")
        np.savez(partial, phasor=light.phasor, steady=light.steady, depth=points[..., 2])
        partial.replace(path)
    with np.load(path) as held:
        return Light(held["phasor"], held["steady"]), held["depth"].astype(np.float32)


def view_of(world: SimWorld, light: Light, depth: NDArray[np.float32], index: int) -> View:
    """Take one view of a pose with the noise of the world's seed."""
    rng = np.random.default_rng([world.seed, index])
    raw, celsius = expose(light, world.constants.sensor, world.tof_info, FRAMES, rng, world.seed)
    times = np.arange(FRAMES, dtype=np.int64)
    measured = stereos._disturb(  # noqa: SLF001  the noise alone, geometry is cached
        depth, world.constants.stereo, world.constants.stereo_model, rng
    )
    points = (measured[..., None] * world.constants.stereo.rays).astype(np.float32)
    state = ArmState(np.zeros(6), np.eye(4), 0)
    fine = world.constants.tof.scaled(2).shape
    truth = Truth(
        np.full(fine, np.nan, np.float32),
        np.full((*fine, 3), np.nan, np.float32),
        np.zeros(fine, bool),
        world.true_rig.T_tof_stereo,
        world.true_rig.T_flange_tof,
    )
    return View(
        "calibration",
        index,
        TofBurst(raw, times, celsius, world.tof_info),
        StereoFrame(points, 0, world.stereo_info),
        state,
        state,
        world.nominal_rig(),
        {},
        truth,
    )


def plain(views: list[View], dense: list[Cloud], T_tof_stereo: Float64) -> tuple[Float64, Float64]:
    """Point-to-plane ICP of the whole clouds of every view, averaged and weighted by information.

    No rims, no range residual, no choice of surface: what the libraries give without what this package adds.
    """
    results = [
        register("open3d", whole_cloud(view), cloud, invert(T_tof_stereo))
        for view, cloud in zip(views, dense, strict=True)
    ]
    centre = np.mean([transform_points(invert(r.T_target_source), r.centre) for r in results], axis=0)
    average = average_transforms([r.T_target_source for r in results], centre)
    # A registration's information is of a motion in target axes, on the left of the transform; that of its inverse is on the right.
    informations = [about(r.information, r.centre) for r in results]
    return invert(average.T), fuse([invert(r.T_target_source) for r in results], informations)


def whole_cloud(view: View) -> Float64:
    """Every sixth decoded pixel with light, ToF frame, as a library's user would pass it."""
    _, depth = tof_depth(view.tof)
    near = (depth > WORKING_DEPTH[0]) & (depth < WORKING_DEPTH[1])
    points: Float64 = view.tof.info.camera.unproject(depth)[near][::6]
    return points


def run_seed(pool: int, seed: int, cache: Path) -> list[dict[str, Any]]:
    """Align one seed by every method; one row per method."""
    world, folder = world_of(pool, seed), cache / f"{pool}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    views = [
        view_of(world, *render(world, pose, folder / f"pose-{i:03d}.npz"), i)
        for i, pose in enumerate(poses_of(pool, seed))
    ]
    start, true = world.nominal_rig().T_tof_stereo, world.true_rig.T_tof_stereo
    reduced = [joint_view_of(view, sighting_of(view)) for view in views]
    averaged, weighted = plain(views, [view.surface for view in reduced], start)
    rows = [_row("plain averaged", averaged, true), _row("plain weighted", weighted, true)]
    joint = joint_icp(reduced, start)
    row = _row("joint", joint.T_tof_stereo, true)
    return [*rows, row | _judged(joint.T_tof_stereo, true, joint.centre, joint.covariance)]


def scenes_of(pool: int, seed: int) -> list[str]:
    """Name two scenes of at least three objects."""
    own, first = 1000 * pool + seed, int(np.random.default_rng([pool, seed, 11]).integers(0, 1000))
    names = (f"random-{n}" for n in count(first + 1))
    return list(islice((n for n in names if sum(o.target for o in scene_objects(n, own)) >= OBJECTS), SCENES))


def scene_poses(pool: int, seed: int, scene: int) -> list[Float64]:
    """``T_base_tof`` of a scene's views: 15 to 55 degrees off the vertical, all round, 0.45 to 0.95 m away."""
    rng = np.random.default_rng([pool, seed, 13, scene])
    each = VIEWS // SCENES
    order, start = rng.permutation(each), rng.uniform(0, 2 * np.pi)
    out = []
    for i in range(each):
        tilt, turn = np.radians(rng.uniform(15, 55)), start + 2.399963 * i
        direction = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        away = 0.45 + 0.5 * (order[i] + rng.uniform()) / each
        target = TABLE_CENTRE + [0, 0, 0.05] + rng.uniform(-0.08, 0.08, 3)  # noqa: RUF005  a sum
        up, roll = [1.0, 0.0, 0.0], rng.uniform(-0.5, 0.5)
        out.append(look_at(target + away * direction, target, up=up, roll=roll))
    return out


def run_scenes(pool: int, seed: int, cache: Path) -> list[dict[str, Any]]:
    """Align one seed by scenes without a board, from the drawing; the arm says its poses as it repeats them."""
    world, rng = world_of(pool, seed), np.random.default_rng([pool, seed, 23])
    true, rig = world.true_rig, world.nominal_rig()
    with tempfile.TemporaryDirectory() as files:
        scenes = []
        for k, name in enumerate(scenes_of(pool, seed)):
            world.place(name)
            folder = cache / f"{pool}-{seed}-{name}"
            folder.mkdir(parents=True, exist_ok=True)
            scenes.append([Path(files) / f"{name}-{i}.h5" for i in range(VIEWS // SCENES)])
            for i, (path, pose) in enumerate(zip(scenes[-1], scene_poses(pool, seed, k), strict=True)):
                view = view_of(world, *render(world, pose, folder / f"pose-{i:03d}.npz"), 100 * k + i)
                said = pose @ invert(true.T_flange_tof) @ exp(ARM * rng.standard_normal(6))
                arm = ArmState(np.zeros(6), said, 0)
                write_view(path, replace(view, scene=name, index=i, arm_before=arm, arm_after=arm))
        found = align_scenes(scenes, rig)
    row = _row("targetless", found.T_tof_stereo, true.T_tof_stereo)
    return [row | _judged(found.T_tof_stereo, true.T_tof_stereo, found.centre, found.covariance)]


def _judged(T: Float64, true: Float64, centre: Float64, covariance: Float64) -> dict[str, Any]:
    error, sigma = twist_about(T @ invert(true), centre), np.sqrt(np.diag(covariance))
    return {
        "covered": (np.abs(error) < sigma).tolist(),
        "standardised": (error / sigma).tolist(),
        "error": error.tolist(),
        "sigma": sigma.tolist(),
    }


def _row(method: str, T_tof_stereo: Float64, true: Float64) -> dict[str, Any]:
    rotation, translation = alignment_error(T_tof_stereo, true)
    return {
        "method": method,
        "rotation_deg": float(np.degrees(rotation)),
        "translation_mm": 1e3 * translation,
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """Lay the medians out, one line a method."""
    lines = [
        f"{'method':16}{'median deg':>11}{'median mm':>11}{'max deg':>9}{'max mm':>8}  better than plain"
    ]
    plain = [r for r in rows if r["method"] == "plain averaged"] or rows
    base = [float(np.median([r[k] for r in plain])) for k in ("rotation_deg", "translation_mm")]
    for method in dict.fromkeys(r["method"] for r in rows):
        own = [r for r in rows if r["method"] == method]
        a, b = (np.array([r[k] for r in own]) for k in ("rotation_deg", "translation_mm"))
        ratio = f"{base[0] / np.median(a):6.1f} x deg {base[1] / np.median(b):6.1f} x mm"
        lines.append(
            f"{method:16}{np.median(a):11.4f}{np.median(b):11.3f}{a.max():9.4f}{b.max():8.3f}  {ratio}"
        )
    covered = np.array([r["covered"] for r in rows if "covered" in r])
    share = 100 * covered.mean()
    lines.append(
        f"{rows[-1]['method']}: 1-sigma covers {covered.sum()} of {covered.size} seed-components, {share:.1f} %"
    )
    each = ", ".join(f"{c:.0f}" for c in 100 * covered.mean(axis=0))
    lines.append(f"  by component (x y z, rx ry rz), %: {each}")
    twice = np.abs([r["standardised"] for r in rows if "standardised" in r]) < 2
    lines.append(f"  2-sigma covers {100 * twice.mean():.1f} %")
    error = np.array([r["error"] for r in rows if "error" in r]) * np.repeat([1e3, np.degrees(1)], 3)
    for words, of in (("mean error", error.mean(axis=0)), ("its spread over seeds", error.std(axis=0))):
        lines.append(
            f"  {words}, mm: {np.array2string(of[:3], precision=3)}, deg: {np.array2string(of[3:], precision=4)}"
        )
    return "\n".join(lines)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--pool", type=int, default=5)
    parser.add_argument(
        "--cache", type=Path, default=Path(tempfile.gettempdir()) / "tofcapture-alignment-seeds"
    )
    parser.add_argument("--method", choices=("board", "targetless"), default="board")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    run = run_scenes if args.method == "targetless" else run_seed
    rows: list[dict[str, Any]] = []
    began = time.monotonic()
    for seed in range(args.first, args.first + args.seeds):
        rows += [{"seed": seed, **row} for row in run(args.pool, seed, args.cache)]
        told = "  ".join(
            f"{r['method']} {r['rotation_deg']:.3f} deg {r['translation_mm']:.2f} mm"
            for r in rows
            if r["seed"] == seed
        )
        print(f"seed {seed}: {told}  ({time.monotonic() - began:.0f} s)", flush=True)
        if args.out:
            args.out.write_text(json.dumps(rows))
    print(summary(rows))


if __name__ == "__main__":
    main()
