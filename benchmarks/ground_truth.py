"""Ground truth against the simulator's exact depth, per mask class, over scenes that are hard in different ways.

    python benchmarks/ground_truth.py [--seed 0] [--scenes rods,dark,...] [--distances 0.45,0.8,1.4]

Every scene is seen by cameras of full size with all of the stereo camera's errors, from three directions, with the true rig,
so that the figures are those of denoising, projection, normals and crop alone. Printed per scene and for all: median and 99th
percentile of the depth error of each class at 2x (object: no mask bit; table: bit OUTSIDE alone; edge, grazing, occluded:
pixels with depth that carry that bit), the share of wrong pixels (more than 2 mm off), background seen through foreground
(5 mm behind the truth), the median error of normals, the share of the object and of everything else that the crop keeps.

Then what denoising removes, of points of the stereo camera that are wrong (2 mm and 0.4 % off) and of those that are right:
ours, and Open3D's statistical and radius outlier removal.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tofcapture.dataset.sample import SampleConfig, decoder_for, make_sample
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.scenes import TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.shapes import board
from tofcapture.devices.sim.stereo import ideal
from tofcapture.devices.sim.world import SimWorld
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import GroundTruth
from tofcapture.frames import ArmState, Truth, View
from tofcapture.libraries import load_open3d
from tofcapture.meshes import Mesh, cuboid, move
from tofcapture.ops.denoise import denoise
from tofcapture.poses import exp, invert, look_at, transform

FAST = {"render": {"multipath": False, "subpixels": 1}}  # the ToF camera's light is no matter here
DISTANCES = (0.45, 0.8, 1.4)
DIRECTIONS = ((0.0, 0.3), (0.7, 0.2), (-0.5, -0.6))  # x and y per unit of height


WRONG = 0.002  # m; a pixel whose depth is off by more is wrong
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--distances", default=",".join(map(str, DISTANCES)))
    args = parser.parse_args()
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
