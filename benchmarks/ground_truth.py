"""Ground truth against the simulator's exact depth, per mask class, over scenes that are hard in different ways.

    python -m benchmarks.ground_truth [--seed 0] [--scenes rods,dark,...] [--distances 0.45,0.8,1.4]
    python -m benchmarks.ground_truth --fused 25 [--seed 0] [--scenes mug,...] [--poses off] [--recordings FOLDER]

Every scene is seen by cameras of full size with all of the stereo camera's errors, from three directions, with the true rig,
so that the figures are those of denoising, projection, normals and crop alone. Printed per scene and for all: median and 99th
percentile of the depth error of each class at 2x (object: no mask bit; table: bit OUTSIDE alone; edge, grazing, occluded:
pixels with depth that carry that bit), the share of wrong pixels (more than 2 mm off), background seen through foreground
(5 mm behind the truth), the median error of normals, the share of the object and of everything else that the crop keeps.

Then what denoising removes, of points of the stereo camera that are wrong (2 mm and 0.4 % off) and of those that are right:
ours, and Open3D's statistical and radius outlier removal.

``--fused N`` compares the truth of single views with that of all together: N views of each scene as the default station plans
them, built twice, with exact poses and with an arm that repeats to 0.1 mm (and 0.1 mrad) beside a hand-eye transform that is
0.5 mm and 0.1 degrees off. Asked for are the object's pixels that any stereo view measured, real depth edges apart; by class: rim
(within 4 ToF pixels of an edge), shadow (not hit or occluded for the own stereo camera), hollow (0.5 mm deeper than 8 pixels
about it), flat (the rest). ``ause`` is the area between two sparsification curves, of errors in the order of sigma, or of depth,
and in their own order, in mean errors: 0 is perfect. ``--recordings`` keeps what is simulated for the next time, or is a
simulated recording itself, as ``demo-out/recording``: then with ``--poses exact`` its scenes are compared, with the true rig.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tofcapture.dataset.build import build_dataset, scene_tasks
from tofcapture.dataset.sample import SampleConfig, decoder_for, make_sample
from tofcapture.devices.clearance import workcell_of
from tofcapture.devices.kinematics import arm_model
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.scenes import TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.shapes import board
from tofcapture.devices.sim.stereo import ideal
from tofcapture.devices.sim.world import SimWorld
from tofcapture.devices.station import read_station
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import GroundTruth, ShardReader
from tofcapture.files.view import open_view, view_path, write_view
from tofcapture.frames import ArmState, Truth, View
from tofcapture.libraries import load_open3d
from tofcapture.meshes import Mesh, cuboid, move
from tofcapture.ops.denoise import denoise
from tofcapture.ops.project import edges
from tofcapture.poses import Float64, exp, invert, look_at, transform, transform_points
from tofcapture.record.plan import PlannedView, object_sampling, plan_views
from tofcapture.record.quality import ELSEWHERE, broken_limits, measure
from tofcapture.rig import dumps_rig, load_rig

FAST = {"render": {"multipath": False, "subpixels": 1}}  # the ToF camera's light is no matter here
DISTANCES = (0.45, 0.8, 1.4)
DIRECTIONS = ((0.0, 0.3), (0.7, 0.2), (-0.5, -0.6))  # x and y per unit of height


WRONG = 0.002  # m; a pixel whose depth is off by more is wrong
ARM = np.repeat([1e-4, 1e-4], 3)  # m, rad; standard deviations of a pose of a bad arm
HAND_EYE = exp([3e-4, -3e-4, 2.6e-4, 1e-3, -1e-3, 1e-3])  # half a millimetre and a tenth of a degree
THROUGH = 0.005  # m; a pixel whose depth lies this far behind the truth shows what is behind it


@dataclass(frozen=True)
class ClassError:
    """Errors of the pixels of one mask class.

    Attributes
    ----------
    errors
        (n,) float32 absolute depth errors, metres; infinite where the truth has no surface.
    through
        Pixels whose depth lies behind the true surface: background seen through it.
    """

    errors: np.ndarray
    through: int

    @property
    def wrong(self) -> float:
        """Share of pixels that are off by more than :data:`WRONG`."""
        return float((self.errors > WRONG).mean()) if len(self.errors) else 0.0


@dataclass(frozen=True)
class CropShares:
    """Of the pixels with sound depth, no edge among them: those of the object, those the crop keeps; the same of the rest."""

    target: int
    target_kept: int
    other: int
    other_kept: int


def mask_classes(mask: np.ndarray) -> dict[str, np.ndarray]:
    """Pixels (H, W) of each class.

    ``object`` carries no bit and ``table`` only OUTSIDE; the others are the pixels with depth that carry a bit, whatever else
    they carry, edge pixels only under ``edge``.
    """
    edge = (mask & MaskBit.EDGE) > 0
    hit = (mask & MaskBit.NOT_HIT) == 0
    return {
        "object": mask == 0,
        "table": mask == MaskBit.OUTSIDE,
        "edge": hit & edge,
        "grazing": hit & ~edge & ((mask & MaskBit.GRAZING) > 0),
        "occluded": hit & ~edge & ((mask & MaskBit.OCCLUDED) > 0),
    }


def class_errors(gt: GroundTruth, truth: Truth) -> dict[str, ClassError]:
    """Errors of ground truth at 2x, by mask class."""
    error = gt.depth - truth.depth
    absolute = np.where(np.isfinite(error), np.abs(error), np.float32(np.inf))
    return {
        name: ClassError(absolute[where], int((error[where] > THROUGH).sum()))
        for name, where in mask_classes(gt.mask).items()
    }


def crop_shares(gt: GroundTruth, truth: Truth) -> CropShares:
    """What the crop keeps of the object and of everything else, at 2x."""
    sound = (gt.mask & ~np.uint8(MaskBit.OUTSIDE)) == 0
    target, other, kept = sound & truth.target, sound & ~truth.target, gt.mask == 0
    return CropShares(*(int(m.sum()) for m in (target, target & kept, other, other & kept)))


def target(mesh: Mesh, albedo: float, x: float = 0.0, y: float = 0.0) -> SceneObject:
    """Object that stands on the table."""
    return SceneObject(
        *mesh, albedo, transform(np.eye(3), TABLE_CENTRE + np.array([x, y, 0.0])), target=True, name="object"
    )


def rods(albedo: float = 0.5) -> list[SceneObject]:
    """Upright rods, 2 to 12 mm thick: thinner than pixels are wide, and thicker."""
    widths = (0.002, 0.003, 0.004, 0.006, 0.008, 0.012)
    return [
        target(cuboid(w, w, 0.12), albedo, 0.04 * (i % 3) - 0.04, 0.06 * (i // 3))
        for i, w in enumerate(widths)
    ]


def holes() -> list[SceneObject]:
    """The board with its cut-outs, tilted, above the table."""
    return [target(move(board(), exp([0, 0, 0.12, 0.3, 0.2, 0])), 0.6)]


def cliffs() -> list[SceneObject]:
    """Walls seen under ever more grazing angles."""
    return [
        target(move(cuboid(0.004, 0.12, 0.10), exp([0.05 * i - 0.1, 0, 0, 0, 0, 0.25 * i])), 0.5)
        for i in range(5)
    ]


OWN = {
    "rods": rods,
    "holes": holes,
    "cliffs": cliffs,
    "dark": lambda: [replace(o, albedo=0.03) for o in rods()[3:]],
}
SCENES = (*OWN, "mug", "steps", "gear", "sphere", "tool", "random-1", "random-2")


def objects(name: str, seed: int) -> list[SceneObject]:
    """Scene of this benchmark or of the simulator; dark ones have an albedo of 0.03."""
    surroundings = scene_objects(name, seed)
    if name not in OWN:
        return surroundings
    return [*OWN[name](), *(o for o in surroundings if not o.target)]


def views(name: str, seed: int, distances: tuple[float, ...]) -> Iterator[tuple[View, np.ndarray]]:
    """Views with the true rig, and the stereo depth without errors."""
    world = SimWorld(read_constants(FAST, "benchmark"), seed, objects)
    exact = SimWorld(
        replace(world.constants, stereo_model=ideal(world.constants.stereo_model)), seed, objects
    )
    for index, (distance, (x, y)) in enumerate((d, xy) for d in distances for xy in DIRECTIONS):
        aim = TABLE_CENTRE + np.array([0, 0, 0.03])
        T_base_tof = look_at(aim + distance * np.array([x, y, 1]) / np.linalg.norm([x, y, 1]), aim)
        for w in (world, exact):
            w.place(name)
            w.set_pose(T_base_tof @ invert(w.true_rig.T_flange_tof), bytes([index]))
        times = iter(range(1, 10**12, 10**6))
        state = ArmState(np.zeros(6), T_base_tof @ invert(world.true_rig.T_flange_tof), 1)
        burst, stereo = world.tof(1, times.__next__), world.stereo(times.__next__)
        yield (
            View(name, index, burst, stereo, state, state, world.true_rig, {}, world.truth()),
            exact.stereo(times.__next__).points[..., 2],
        )


def report(title: str, parts: dict[str, list], crops: list[CropShares], angles: list[np.ndarray]) -> None:
    """Print one block of figures."""
    print(f"\n{title}")
    for name, found in parts.items():
        errors = np.concatenate([f.errors for f in found])
        if len(errors):
            median, p99 = np.percentile(errors, [50, 99], method="nearest") * 1e3
            print(
                f"  {name:<9} {len(errors):>9} px  median {median:7.3f} mm  p99 {p99:8.3f} mm  "
                f"wrong {np.mean(errors > 0.002):9.4%}  seen through {sum(f.through for f in found)}"
            )
    t, tk, o, ok = (
        sum(getattr(c, k) for c in crops) for k in ("target", "target_kept", "other", "other_kept")
    )
    print(f"  crop keeps {tk / max(1, t):.3%} of the object, {ok / max(1, o):.4%} of all else; "
          f"normals: median {np.median(np.concatenate(angles)):.2f} deg")  # fmt: skip


def angle(sample, view: View) -> np.ndarray:
    """Angles (n,) between normals and the exact ones where the mask is 0, degrees."""
    gt = sample.ground_truth[2]
    cosine = np.einsum("nc,nc->n", gt.normals[gt.mask == 0], view.truth.normals[gt.mask == 0])
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def removals(view: View, exact: np.ndarray) -> dict[str, np.ndarray]:
    """Wrong points and those removed of them, right points and those removed of them, by rule."""
    depth = view.stereo.points[..., 2]
    there = np.isfinite(depth)
    wrong = ~(np.abs(depth - exact) < 0.002 + 0.004 * depth)[there]
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(view.stereo.points[there].astype(float)))

    def kept(indices: list[int]) -> np.ndarray:
        out = np.zeros(there.sum(), dtype=bool)
        out[np.asarray(indices)] = True
        return out

    rules = {
        "ours": denoise(depth, view.rig.stereo)[there],
        "statistical 20, 2": kept(cloud.remove_statistical_outlier(20, 2.0)[1]),
        "radius 16, 4 px": kept(
            cloud.remove_radius_outlier(16, 4 * float(np.median(depth[there])) / view.rig.stereo.fx)[1]
        ),
    }
    return {
        n: np.array([wrong.sum(), (wrong & ~k).sum(), (~wrong).sum(), (~wrong & ~k).sum()])
        for n, k in rules.items()
    }


def planned(name: str, seed: int, views: int, folder: Path) -> None:
    """Record a scene as the default station would, with exact poses and the true rig."""
    world = SimWorld(read_constants(FAST, "benchmark"), seed, objects)
    workcell, model, rig = workcell_of(read_station(None)), arm_model("ur10e"), world.nominal_rig()
    rng = np.random.default_rng(seed)
    plan = plan_views(model, rig, workcell, workcell.target, object_sampling(), views, rng)
    world.place(name)

    def shot(place: PlannedView) -> tuple[View, dict[str, float]]:
        world.set_pose(place.T_base_flange, bytes([place.index]))
        now = iter(range(1, 10**12, 10**6)).__next__
        state = ArmState(place.joints, place.T_base_flange, 1)
        burst, stereo = world.tof(1, now), world.stereo(now)
        numbers = measure(burst, stereo, state, state, rig, 1, table=True)
        view = View(name, place.index, burst, stereo, state, state, world.true_rig, {}, world.truth())
        return view, numbers

    for view in plan.views:
        best, numbers, spare = *shot(view), view.spare
        while spare is not None and any(limit.action == ELSEWHERE for limit in broken_limits(numbers)):
            other, others = shot(spare)
            if others.get("object_coverage", 0.0) > numbers["object_coverage"]:
                best, numbers = other, others
            spare = spare.spare
        write_view(view_path(folder, name, view.index), best)
    (folder / "rig.toml").write_text(dumps_rig(world.true_rig))


def disturbed(exact: Path, name: str, seed: int, folder: Path) -> None:
    """Copy a recording; its arm and its hand-eye transform are off."""
    rng = np.random.default_rng(seed)
    for path in sorted((exact / "views" / name).glob("view-*.h5")):
        view = open_view(path)
        said = view.arm_before.T_base_flange @ exp(ARM * rng.standard_normal(6))
        state = replace(view.arm_before, T_base_flange=said)
        write_view(view_path(folder, name, view.index), replace(view, arm_before=state, arm_after=state))
    rig = view.rig
    (folder / "rig.toml").write_text(dumps_rig(replace(rig, T_flange_tof=rig.T_flange_tof @ HAND_EYE)))


def taken(recording: Path, name: str, folder: Path) -> None:
    """Lay down one scene of a recording as :func:`planned` does, with the true rig."""
    task = next(t for t in scene_tasks([recording], folder, true_rig=True) if t.scene == name)
    (folder / "views").mkdir(parents=True)
    (folder / "views" / name).symlink_to(task.views[0].parent, target_is_directory=True)
    (folder / "rig.toml").write_text(dumps_rig(task.rig))


def asked(views: list[View], index: int) -> dict[str, np.ndarray]:
    """Pixels (2H, 2W) of a view by class; ``all`` of them are the object's, measured by a view, and at no real edge."""
    view, rig = views[index], views[index].rig
    camera, depth = rig.tof.scaled(2), view.truth.depth.astype(float)
    edge = edges(depth, camera, 2)
    at = np.flatnonzero(view.truth.target & ~edge)
    base = transform_points(
        view.arm_before.T_base_flange @ rig.T_flange_tof, camera.unproject(depth).reshape(-1, 3)[at]
    )
    seen = np.zeros(len(at), dtype=bool)
    for other in views:
        p = transform_points(invert(other.arm_before.T_base_flange @ rig.T_flange_stereo), base)
        at_other = np.nan_to_num(rig.stereo.project(p)[0], nan=-1.0)
        inside = (
            (p[:, 2] > 0)
            & (at_other > 0).all(axis=1)
            & (at_other < np.array(rig.stereo.shape[::-1]) - 1).all(axis=1)
        )
        u, v = np.rint(np.where(inside[:, None], at_other, 0)).astype(int).T
        seen |= inside & (np.abs(other.stereo.points[v, u, 2] - p[:, 2]) < 0.002 + 0.004 * p[:, 2])
    everything = np.zeros(depth.shape, dtype=bool)
    everything.ravel()[at[seen]] = True
    near = edges(depth, camera, 8)
    about = np.stack([np.roll(depth, (8 * a, 8 * b), (0, 1)) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))])
    hollow = depth - about.mean(axis=0) > 0.0005
    return {"all": everything, "rim": everything & near, "hollow": everything & ~near & hollow,
            "flat": everything & ~near & ~hollow}  # fmt: skip


def sparsified(error: np.ndarray, by: np.ndarray) -> float:
    """Area between the sparsification curve by a key and the best there is, in mean errors; NaN with infinite errors."""
    shares = np.maximum(np.arange(1, 21) * len(error) // 20, 1)
    curves = []
    for key in (by, error):
        best = np.cumsum(error[np.argsort(key, kind="stable")], dtype=float)
        curves.append(best[shares - 1] / shares)
    with np.errstate(invalid="ignore"):
        return float((curves[0] - curves[1]).mean() / error.mean())


def compare(name: str, seed: int, count: int, kept: Path, poses_of: tuple[str, ...], folder: Path) -> None:
    """Print single and fused truth of one scene, with exact poses and with bad ones; ``kept`` holds its recordings."""
    if (kept.parent / "views").is_dir():
        kept, recording = folder / "kept", kept.parent
        taken(recording, name, kept / "exact")
    elif not (kept / "off/rig.toml").exists():
        planned(name, seed, count, kept / "exact")
        disturbed(kept / "exact", name, seed, kept / "off")
    rig = load_rig(kept / "exact/rig.toml")
    paths = sorted((kept / "exact/views" / name).glob("view-*.h5"))
    views = [replace(open_view(p), rig=rig) for p in paths]
    classes = [asked(views, k) for k in range(len(views))]
    single = build_dataset([kept / "exact"], folder / "single", config=SampleConfig(truth="single"), jobs=1)
    for poses in poses_of:
        start = time.process_time()
        built = build_dataset(
            [kept / poses], folder / f"fused-{poses}", config=SampleConfig(truth="fused"), jobs=1
        )
        seconds = (time.process_time() - start) / len(views)
        print(f"{name}, {len(views)} views, poses {poses}: {seconds:.2f} s of CPU a view, "
              f"{built.peak_memory / 2**30:.2f} GiB, alone: {dict(built.alone.get(name, {}))}")  # fmt: skip
        _print(single.dataset / f"shards/{name}.h5", built.dataset / f"shards/{name}.h5", views, classes)


def _print(single: Path, fused: Path, views: list[View], classes: list[dict[str, np.ndarray]]) -> None:
    found: dict[str, list[Float64]] = {}
    covers: list[tuple[float, float, float]] = []
    through = 0
    with ShardReader(single) as a, ShardReader(fused) as b:
        for k, view in enumerate(views):
            one, all_of_them = a.ground_truth(k, 2), b.ground_truth(k, 2)
            good, was = all_of_them.mask == 0, one.mask == 0
            error = np.nan_to_num(np.abs(all_of_them.depth - view.truth.depth), nan=np.inf)
            through += int((good & (all_of_them.depth - view.truth.depth > THROUGH)).sum())
            dark = (one.mask & (MaskBit.NOT_HIT | MaskBit.OCCLUDED)) > 0
            asked_for = classes[k]["all"]
            wanted, target = max(1, asked_for.sum()), view.truth.target
            of_object = (was & target).sum() / max(1, target.sum())
            covers.append(((asked_for & was).sum() / wanted, (asked_for & good).sum() / wanted, of_object))
            parts = {
                **classes[k],
                "shadow": asked_for & dark,
                "covered": was,
                "added": ~was & view.truth.target,
            }
            for title, where in parts.items():
                some = where & good
                sigma = all_of_them.sigma[some]
                row = np.stack([error[some], error[some] / sigma, sigma, all_of_them.depth[some]])
                found.setdefault(title, []).append(row)
                counts = found.setdefault(f"{title}#", [])
                counts.append(np.array([where.sum(), (where & was).sum(), some.sum()], dtype=float))
            alone = np.abs(one.depth - view.truth.depth)[was]
            found.setdefault("single", []).append(np.stack([alone] * 4))
    cover = np.array(covers)
    print(f"  of what was asked for: single {cover[:, 0].mean():.1%} (worst {cover[:, 0].min():.1%}), fused {cover[:, 1].mean():.1%} "
          f"(worst {cover[:, 1].min():.1%}); single, of the whole object {cover[:, 2].mean():.1%} (worst {cover[:, 2].min():.1%}); seen through {through}")  # fmt: skip
    for title in (t for t in found if not t.endswith("#")):
        error, ratio, sigma, depth = np.concatenate(found[title], axis=1)
        if not len(error):
            continue
        counts = np.sum(found.get(f"{title}#", [np.array([np.nan] * 3)]), axis=0)
        median, p99 = np.percentile(error, [50, 99], method="nearest") * 1e3
        by_sigma, by_depth = (sparsified(error, key) for key in (sigma, depth))
        print(f"  {title:<8} {len(error):>8} px  single {counts[1] / counts[0]:6.1%} fused {counts[2] / counts[0]:6.1%}  median {median:6.4f} mm  "
              f"p99 {p99:6.3f} mm  worst {1e3 * error.max():6.2f}  within one sigma {np.mean(ratio < 1):6.1%}  "
              f"ause {by_sigma:.3f}, by depth {by_depth:.3f}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--distances", default=",".join(map(str, DISTANCES)))
    parser.add_argument("--fused", type=int, metavar="N", help="views of each scene, built single and fused")
    parser.add_argument("--poses", default="exact,off", help="which of them are built")
    parser.add_argument(
        "--recordings", type=Path, metavar="FOLDER", help="of simulated views, to be used again"
    )
    args = parser.parse_args()
    if args.fused:
        for name in args.scenes.split(","):
            with tempfile.TemporaryDirectory() as folder:
                kept = Path(folder) if args.recordings is None else args.recordings / name
                compare(name, args.seed, args.fused, kept, tuple(args.poses.split(",")), Path(folder))
        return
    distances = tuple(float(d) for d in args.distances.split(","))
    everything, crops, angles, removed = {}, [], [], {}
    for name in args.scenes.split(","):
        mine, my_crops, my_angles = {}, [], []
        for view, exact in views(name, args.seed, distances):
            sample = make_sample(
                view, view.rig, SampleConfig(), np.random.default_rng(view.index), decoder_for(view, view.rig)
            )
            for key, error in class_errors(sample.ground_truth[2], view.truth).items():
                mine.setdefault(key, []).append(error)
                everything.setdefault(key, []).append(error)
            my_crops.append(crop_shares(sample.ground_truth[2], view.truth))
            my_angles.append(angle(sample, view))
            if view.index == len(DIRECTIONS):  # one view of each scene; Open3D takes seconds
                for rule, counts in removals(view, exact).items():
                    removed[rule] = removed.get(rule, 0) + counts
        report(name, mine, my_crops, my_angles)
        crops += my_crops
        angles += my_angles
    report("ALL", everything, crops, angles)
    for rule, (wrong, gone, right, lost) in removed.items():
        print(
            f"denoise, {rule:<18} removes {gone / wrong:7.2%} of {wrong} wrong points and {lost / right:7.3%} of {right} right ones"
        )


if __name__ == "__main__":
    main()
