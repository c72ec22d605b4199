"""Scenes: names decide what stands on the table, always the same, always on the table, never in each other."""

from pathlib import Path

import numpy as np
import pytest

from tofcapture.devices.sim.scenes import BOARD_CENTRE, BOARD_TILT, TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.shapes import FAMILIES
from tofcapture.errors import ConfigError
from tofcapture.poses import rotation_exp

MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"
RANDOM = [f"random-{i}" for i in range(12)]


def _targets(name, seed=0):
    return [o for o in scene_objects(name, seed) if o.target]


@pytest.mark.parametrize("name", ["calibration", "mug", "mug-2", "random-3", "whatever"])
def test_same_name_same_scene(name):
    """Name and seed decide everything; another seed gives another scene."""
    first, again = scene_objects(name, 0), scene_objects(name, 0)
    assert [o.name for o in first] == [o.name for o in again]
    for a, b in zip(first, again, strict=True):
        assert a.corners().tobytes() == b.corners().tobytes()
        assert a.albedo == b.albedo
    other = scene_objects(name, 1)
    assert [o.albedo for o in other] != [o.albedo for o in first]


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_family_scene_holds_one_of_the_family(family):
    """A scene named after a family holds one object of it, and ``-<n>`` another one."""
    (first,), (second,) = _targets(family), _targets(f"{family}-2")
    assert first.name == second.name == family
    assert family == "board" or not np.array_equal(first.corners()[:1], second.corners()[:1])


@pytest.mark.parametrize("name", RANDOM)
def test_objects_stand_apart_on_the_table(name):
    """Targets touch the table top, stay near its centre and keep their bounding discs apart."""
    discs = []
    for o in _targets(name):
        points = o.corners().reshape(-1, 3)
        assert points[:, 2].min() == pytest.approx(TABLE_CENTRE[2], abs=1e-9)
        centre = o.T_world_object[:2, 3]
        radius = np.linalg.norm(points[:, :2] - centre, axis=1).max()
        assert np.linalg.norm(centre - TABLE_CENTRE[:2]) + radius < 0.34
        assert all(np.linalg.norm(centre - c) > radius + r for c, r in discs)
        discs.append((centre, radius))
        assert 0.15 <= o.albedo <= 0.9


def test_random_scenes_vary():
    """Random scenes hold one to four objects, of many families, before differing backgrounds."""
    counts = {len(_targets(f"random-{i}")) for i in range(30)}
    assert counts <= {1, 2, 3, 4}
    assert len(counts) > 1
    assert len({o.name for i in range(30) for o in _targets(f"random-{i}")}) > 10
    assert len({sum(not o.target for o in scene_objects(f"random-{i}", 0)) for i in range(30)}) > 3


def test_calibration_board_faces_its_normal():
    """The board's centre and front are where the default station says, and no other object pierces it."""
    board = next(o for o in scene_objects("calibration", 0) if o.name == "board")
    normal = rotation_exp([0, BOARD_TILT, 0])[:, 2]
    height = (board.corners().reshape(-1, 3) - BOARD_CENTRE) @ normal
    assert [height.min(), height.max()] == pytest.approx([-0.005, 0.005], abs=1e-9)
    for other in scene_objects("calibration", 0):
        if other.name == "board":
            continue
        points = other.corners().reshape(-1, 3) - BOARD_CENTRE
        along = points @ rotation_exp([0, BOARD_TILT, 0])
        inside = (np.abs(along[:, 0]) < 0.25) & (np.abs(along[:, 1]) < 0.2) & (np.abs(along[:, 2]) < 0.0055)
        assert not inside.any(), other.name


def test_default_station_agrees_with_the_scenes():
    """The embedded station.toml and the simulated scenes put table, target and board at the same places."""
    from tofcapture.devices.station import read_station

    plan = read_station(None)["plan"]
    assert plan["table"] == TABLE_CENTRE[2]
    assert plan["target"][:2] == TABLE_CENTRE[:2].tolist()
    assert plan["board"] == pytest.approx(BOARD_CENTRE)
    assert plan["board_normal"] == pytest.approx(rotation_exp([0, BOARD_TILT, 0])[:, 2], abs=1e-6)


def test_scene_from_a_mesh():
    """A mesh in the folder is a scene of its name, in metres, on the table."""
    path = MESHES / "ycb_055_baseball.ply"
    if not path.is_file():
        pytest.skip("../shared/meshes is not here")
    objects = [o for o in scene_objects("ball", 0, {"ball": path}, "mm") if o.target]
    assert [o.name for o in objects] == ["ball"]
    points = objects[0].corners().reshape(-1, 3)
    assert np.ptp(points, axis=0).max() == pytest.approx(0.075, abs=0.01)
    assert points[:, 2].min() == pytest.approx(TABLE_CENTRE[2], abs=1e-9)
    with pytest.raises(ConfigError, match="no size"):
        scene_objects("ball", 0, {"ball": path}, "m")
