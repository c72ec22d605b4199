"""Suites: recipes give the same scenes every time, and each suite holds what its file promises."""

import itertools

import numpy as np
import pytest

from tests.test_sim_seed import checksum
from tofcapture.devices.sim.scene import Caster, merge, unit_rays
from tofcapture.devices.sim.scenes import TABLE_CENTRE, generator
from tofcapture.errors import ConfigError
from tofcapture.files.manifest import object_of
from tofcapture.files.view import check_scene_name
from tofcapture.suites.make import DatasetSpec, make_scene
from tofcapture.suites.rooms import _PROBE
from tofcapture.suites.scene import SUITES, load_recipe
from tofcapture.suites.tabletop import table_meshes

PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
0 0 0
{size} 0 0
0 {size} 0
0 0 {size}
3 0 2 1
3 0 1 3
3 0 3 2
3 1 2 3
"""


# Objects in the first eight scenes of seed 0, and a checksum of their corners and albedos: a change makes other datasets.
SCENES = {
    "tof100": (78, 28.3089461),
    "indoor": (172, -58.1913253),
    "multipath": (27, 2.9166969),
    "noise": (74, -29.0780345),
}


def scenes(suite, count, seed=0, meshes=()):
    recipe = load_recipe(suite)
    return [make_scene(recipe, i, seed, meshes) for i in range(count)]


@pytest.mark.parametrize("suite", SUITES)
def test_same_seed_same_scenes(suite):
    """Scene i is a function of suite, seed and i; another seed gives other scenes."""
    first, again, other = scenes(suite, 6), scenes(suite, 6), scenes(suite, 6, seed=1)
    for a, b in zip(first, again, strict=True):
        assert (a.name, a.facts, a.sim, a.identities) == (b.name, b.facts, b.sim, b.identities)
        assert merge(a.objects).corners.tobytes() == merge(b.objects).corners.tobytes()
    assert any(
        merge(a.objects).corners.tobytes() != merge(b.objects).corners.tobytes()
        for a, b in zip(first, other, strict=True)
    )


@pytest.mark.parametrize("suite", SUITES)
def test_scenes_of_a_seed(suite):
    """Every wall, shelf and instrument is in its place."""
    objects = [o for scene in scenes(suite, 8) for o in scene.objects]
    assert len(objects) == SCENES[suite][0]
    found = checksum(*(o.corners() for o in objects), [o.albedo for o in objects])
    assert found == pytest.approx(SCENES[suite][1], abs=1e-6)


@pytest.mark.parametrize("suite", SUITES)
def test_names_are_file_names_and_objects_stay_in_one_split(suite):
    """Every scene has a safe name of its own, and scenes that share an object share the name that decides their split."""
    made = scenes(suite, 40)
    assert len({s.name for s in made}) == 40
    groups = {}
    for scene in made:
        check_scene_name(scene.name)
        assert scene.identities
        for identity in scene.identities:
            groups.setdefault(identity, set()).add(object_of(scene.name))
    assert all(len(names) == 1 for names in groups.values())


def test_unknown_suite():
    """A suite that does not exist is refused with the list of those that do."""
    with pytest.raises(ConfigError, match="tof100"):
        load_recipe("tof1000")


def test_tof100_has_every_kind_within_four_scenes_of_ten():
    """Dark and bright albedos, combinations, concave objects and corners, in fixed shares."""
    made = scenes("tof100", 20)
    kinds = [s.facts["kind"] for s in made]
    assert kinds[:10] == kinds[10:]
    assert {"object", "combination", "concave", "corner", "bright", "dark"} == set(kinds)
    for scene in made:
        targets = [o for o in scene.objects if o.target]
        albedo = [o.albedo for o in targets if o.name != "panel"]
        assert scene.facts["kind"] != "dark" or max(albedo) <= 0.25
        assert scene.facts["kind"] != "bright" or min(albedo) >= 0.6
        assert (scene.facts["kind"] == "corner") == any(o.name == "panel" for o in targets)
        assert any(not o.target for o in scene.objects)


def test_everything_stands_where_the_arm_keeps_out():
    """Targets, panels included, lie within the cylinder that nothing of the rig may enter."""
    for scene in scenes("tof100", 10):
        points = np.concatenate([o.corners().reshape(-1, 3) for o in scene.objects if o.target])
        assert np.linalg.norm(points[:, :2] - TABLE_CENTRE[:2], axis=1).max() < 0.345
        assert points[:, 2].max() - TABLE_CENTRE[2] < 0.31


def test_meshes_take_their_turn(tmp_path):
    """Meshes that fit are used one after the other in their tenth of the scenes; used again they are the same object."""
    for name, size in (("big", 900), ("one", 80), ("two", 100), ("dust", 1)):
        (tmp_path / f"{name}.ply").write_text(PLY.format(size=size))
    meshes, others = table_meshes(tmp_path, "mm", 0)
    assert {p.stem for p in meshes} == {"one", "two"}
    assert {p.stem for p in others} == {"big", "dust"}
    names = [s.name for s in scenes("tof100", 26, meshes=meshes) if s.facts["kind"] == "mesh"]
    assert sorted(names) == sorted([f"{meshes[0].stem}-1", f"{meshes[1].stem}-1", f"{meshes[0].stem}-2"])
    with pytest.raises(ConfigError, match="none of 4 meshes"):
        table_meshes(tmp_path, "m", 0)
    with pytest.raises(ConfigError, match="folder"):
        table_meshes(tmp_path / "gone", "mm", 0)


def test_kinds_replace_the_pattern_and_every_mesh_has_its_turn(tmp_path):
    """With three meshes in five scenes, no two scenes share a name; unknown kinds and other suites are refused."""
    for name in ("one", "two", "three"):
        (tmp_path / f"{name}.ply").write_text(PLY.format(size=80))
    meshes, _ = table_meshes(tmp_path, "mm", 0)
    spec = DatasetSpec("tof100", 0, 10, meshes=meshes, kinds=("mesh", "object", "mesh", "dark", "mesh"))
    made = [make_scene(spec.recipe(), i, 0, meshes) for i in range(10)]
    assert [m.facts["kind"] for m in made] == list(spec.kinds) * 2
    assert len({m.name for m in made}) == 10
    for wrong in (
        DatasetSpec("tof100", 0, 1, kinds=("sphere",)),
        DatasetSpec("indoor", 0, 1, kinds=("mesh",)),
    ):
        with pytest.raises(ConfigError, match="--kinds"):
            wrong.recipe()


@pytest.mark.parametrize(("kind", "low", "high"), [("black", 0.03, 0.12), ("white", 0.75, 0.92)])
def test_a_room_may_be_black_or_white(kind, low, high):
    """Table, floor and walls have one albedo then, another in every scene; objects and sheets keep theirs."""
    spec = DatasetSpec("tof100", 0, 6, kinds=(kind,))
    seen = []
    for i in range(6):
        scene = make_scene(spec.recipe(), i, 0)
        around = {float(o.albedo) for o in scene.objects if not o.target and o.name != "sheet"}
        assert len(around) == 1
        assert low <= min(around) <= high
        seen += around
        assert not around & {float(o.albedo) for o in scene.objects if o.target}
    assert len(set(seen)) == 6


def test_noise_levels_change_the_sensor_alone():
    """The levels of a base scene share objects, poses and split, and differ in exposure or ambient light."""
    levels = len(load_recipe("noise").table["level"])
    made = scenes("noise", 2 * levels)
    for group in (made[:levels], made[levels:]):
        assert len({object_of(s.name) for s in group}) == 1
        assert len({s.plan_name for s in group}) == 1
        assert len({merge(s.objects).corners.tobytes() for s in group}) == 1
        assert len({tuple(s.sim["sensor"].items()) for s in group}) == levels
    assert made[0].plan_name != made[levels].plan_name


def test_multipath_corners_have_the_stated_angle_and_albedo():
    """Rays from inside a wedge meet two planes whose normals are 180 degrees less the angle apart, of the stated albedo."""
    seen = set()
    for scene in scenes("multipath", 40):
        facts = scene.facts
        seen.add((facts["kind"], facts["angle_deg"], facts["albedo"]))
        caster = Caster(merge(scene.objects))
        eye = np.array([0.6 * facts["size"], 0.0, 0.3 * facts["size"]])
        half = np.radians(facts["angle_deg"]) / 2
        sides = np.array([[-np.sin(half), s * np.cos(half), 0] for s in (-1, 1)])
        hits = caster.cast(eye, sides)
        normals = caster.facing(hits.triangle, sides)
        opening = np.degrees(np.pi - np.arccos(np.clip(normals[0] @ normals[1], -1, 1)))
        assert opening == pytest.approx(facts["angle_deg"], abs=0.01)
        np.testing.assert_allclose(caster.geometry.albedo[hits.triangle], facts["albedo"], rtol=1e-6)
        np.testing.assert_allclose(hits.distance, eye[0] * np.sin(half), rtol=1e-4)
    table = load_recipe("multipath").table
    assert len(seen) == 40
    assert seen <= {
        (s, a, r)
        for s, a, r in itertools.product(table["shapes"], table["angles"], table["albedos"])
        if s != "box" or a == 90
    }


@pytest.mark.parametrize("suite", ["multipath", "indoor"])
def test_free_poses_see_the_scene(suite):
    """Every pose of a room keeps its distances, every pose before a corner sees it in the middle of the image."""
    table = load_recipe(suite).table
    for scene in scenes(suite, 3):
        caster = Caster(merge(scene.objects))
        poses = scene.poses(caster, generator(scene.name, 0, "test"), 8)
        assert len(poses) == 8
        for T in poses:
            distance = caster.cast(T[:3, 3], unit_rays(_PROBE, T)).distance
            if suite == "indoor":
                assert table["median"][0] < np.median(distance) < table["median"][1]
                assert np.percentile(distance, 98) < table["distances"][1]
            else:
                hits = caster.cast(T[:3, 3], T[None, :3, 2])
                assert caster.geometry.target[hits.triangle[0]]
                assert hits.distance[0] < table["distances"][1] + 0.5
