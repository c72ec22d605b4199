"""What a seed stands for: shapes, scenes, point maps and taps are those that older recordings hold.

Numbers, not digests: the last bits of sines differ between machines. A change here changes every simulated dataset, so raise
``tofcapture.devices.sim.VERSION`` with it.
"""

import numpy as np
import pytest

from tests.test_sim_world import SMALL
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scenes import scene_objects
from tofcapture.devices.sim.shapes import FAMILIES
from tofcapture.devices.sim.world import SimWorld
from tofcapture.poses import look_at

# Vertices, triangles and a checksum of the corners of every family's object of seed 3.
SHAPES = {
    "blob": (6050, 12096, 0.0604167279),
    "board": (390, 804, -1.0066005817),
    "bottle": (2210, 4416, 0.1604439705),
    "bowl": (4898, 9792, 0.1085293456),
    "box": (8, 12, 0.3311614086),
    "bracket": (214, 428, 1.1393562465),
    "cone": (194, 384, 0.2854304382),
    "cup": (4514, 9024, 0.1991031045),
    "dumbbell": (6874, 13736, 0.0024153740),
    "gear": (264, 528, -0.5255227886),
    "lathe": (5762, 11520, 0.0295322288),
    "mug": (5316, 10624, 0.1673319448),
    "plate": (320, 664, 0.1297654493),
    "sphere": (3386, 6768, -0.0061170405),
    "stack": (152, 296, 0.0524849580),
    "steps": (28, 52, 0.1302248661),
    "text": (32, 56, -0.0353070719),
    "tool": (214, 428, 0.0079282358),
    "wedge": (8, 12, 0.4927550381),
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
    vertices, triangles = FAMILIES[family](np.random.default_rng(3))
    assert (len(vertices), len(triangles)) == SHAPES[family][:2]
    assert checksum(vertices[triangles]) == pytest.approx(SHAPES[family][2], abs=1e-8)


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
