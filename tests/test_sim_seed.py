"""What a seed stands for: shapes, scenes, point maps and taps are those that older recordings hold.

Numbers, not digests: the last bits of sines differ between machines. A change here changes every simulated dataset, so raise
``tofcapture.devices.sim.VERSION`` with it.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.test_sim_world import SMALL
from tofcapture.devices.kinematics import HOME, MODELS
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.drivers import SimArm, SimOperator, SimStereo, SimTof
from tofcapture.devices.sim.scenes import scene_objects
from tofcapture.devices.sim.shapes import FAMILIES
from tofcapture.devices.sim.world import SimWorld
from tofcapture.poses import look_at

# Vertices, triangles and a checksum of the corners of every family's objects of seeds 0 to 11: every letter and every variant is there.
SHAPES = {
    "blob": (72600, 145152, -0.0205197171),
    "board": (4680, 9648, -0.7852325094),
    "bottle": (26520, 52992, 0.1084483053),
    "bowl": (59352, 118656, 1.1036674377),
    "box": (96, 144, 1.0777927370),
    "bracket": (2568, 5136, -4.3039507259),
    "cone": (2328, 4608, 2.5589224484),
    "cup": (54552, 109056, -0.6049453125),
    "dumbbell": (82488, 164832, 0.0011219204),
    "gear": (5312, 10756, 1.4080087865),
    "lathe": (69144, 138240, 0.3388618658),
    "mug": (64176, 128256, 0.1966404924),
    "plate": (3936, 8176, -5.1268993339),
    "sphere": (40632, 81216, 0.0002240336),
    "stack": (2056, 3968, -3.0931799743),
    "steps": (288, 528, -0.9476969695),
    "text": (690, 1264, 0.4085445183),
    "tool": (2952, 5904, 0.5133493258),
    "wedge": (96, 144, 0.7188949942),
}
# Names of a scene's objects and a checksum of corners and albedos, seed 0.
SCENES = {
    "calibration": (
        "board leg leg leg ball block pyramid ridge peg table pedestal floor back wall side wall side wall",
        -3.682290958,
    ),
    "mug-2": ("mug table pedestal floor back wall clutter clutter clutter clutter clutter", 13.270684318),
    "random-3": ("text dumbbell table pedestal floor back wall", 16.014854189),
    "whatever": ("cup bowl text table pedestal floor back wall clutter clutter clutter", -8.898281665),
}


def checksum(*arrays):
    """A sum that every number and its place in line have a part in."""
    flat = np.concatenate([np.asarray(a, dtype=np.float64).ravel() for a in arrays])
    return float(flat @ np.cos(np.arange(len(flat))))


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_shapes_of_a_seed(family):
    """Every vertex and every triangle is in its place."""
    meshes = [FAMILIES[family](np.random.default_rng(seed)) for seed in range(12)]
    assert tuple(sum(map(len, part)) for part in zip(*meshes, strict=True)) == SHAPES[family][:2]
    assert checksum(*(v[t] for v, t in meshes)) == pytest.approx(SHAPES[family][2], abs=1e-8)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_scenes_of_a_seed(name):
    """Objects, surroundings, places and albedos."""
    objects = scene_objects(name, 0)
    assert " ".join(o.name for o in objects) == SCENES[name][0]
    found = checksum(*(o.corners() for o in objects), [o.albedo for o in objects])
    assert found == pytest.approx(SCENES[name][1], abs=1e-7)


def test_measurements_of_a_seed():
    """Point map, taps and truth of one pose: noise, holes and light between surfaces included."""
    world = SimWorld(read_constants(SMALL, "test"), 5, scene_objects)
    world.place("mug")
    world.set_pose(look_at([0.3, 0.2, 0.3], [0.7, 0.0, -0.4]), b"pose")
    light = world.light()
    sums = [checksum(part) for part in (light.phasor.real, light.phasor.imag, light.steady)]
    # rays are cast by what vector units the processor has: at a rim one more or less meets the mug
    assert sums == pytest.approx([-0.13307733, 0.07112404, -0.03828060], abs=3e-3)
    assert light.steady.mean() == pytest.approx(0.37338298, rel=1e-4)
    assert np.abs(light.phasor).mean(axis=(1, 2)) == pytest.approx([0.34554366, 0.34548458], rel=1e-4)
    points = world.stereo(lambda: 0).points
    there = np.isfinite(points[..., 2])
    assert there.sum() == pytest.approx(2956, abs=3)
    assert np.nanmean(points, axis=(0, 1)) == pytest.approx([0.039329, -0.062161, 0.936058], abs=2e-5)
    assert np.nanstd(points[..., 2]) == pytest.approx(0.272217, abs=2e-5)
    burst = world.tof(2, lambda: 0)
    assert burst.celsius == pytest.approx([44.8092626579, 45.0923845869], abs=1e-9)
    assert burst.raw.mean(axis=(0, 2, 3)) == pytest.approx(
        [179.473, 65.773, 70.101, 183.753, 164.910, 95.416, 84.887, 154.277], abs=0.02
    )
    assert checksum(burst.raw) == pytest.approx(-430.9, abs=60)
    truth = world.truth()
    assert np.nanmean(truth.depth) == pytest.approx(0.9834157, abs=1e-6)
    assert truth.target.sum() == 74
    offsets = [e.offset for e in world.tof_info.range_errors]
    assert offsets == pytest.approx([-0.01454788640715, -0.74238374723536], abs=1e-12)
    assert world.nominal_rig().T_tof_stereo[:3, 3] == pytest.approx(
        [-0.04912699168806, 0.07500575175137, 0.00480362891128], abs=1e-12
    )


def test_a_simulated_station_keeps_time():
    """A move takes what the farthest joint takes at the arm's speed, and half a second; frames come 30 a second, readings later."""
    station = {**SMALL, "seed": 5, "render": {**SMALL["render"], "multipath": False}}
    context = StationContext({"sim": station}, Path())
    goal = HOME + np.array([0.3, 0.0, -0.5, 0.0, 0.1, 0.0])
    with SimArm({"model": "ur5e"}, context) as arm, SimOperator({}, context) as operator:
        operator.place("mug")
        arrived = [arm.move_to(goal), arm.move_to(goal)]
        burst = SimTof({}, context).capture(4)
        points = SimStereo({}, context).capture()
    assert arrived[0].time_ns == pytest.approx(1e9 * (0.5 / MODELS["ur5e"].speed + 0.5 + 0.5), abs=1)
    assert arrived[0].time_ns == arrived[1].time_ns
    assert np.diff(burst.time_ns) == pytest.approx([1e9 / 30] * 3, abs=1.5)
    assert arrived[0].time_ns < burst.time_ns[0]
    assert burst.time_ns[-1] < points.time_ns
