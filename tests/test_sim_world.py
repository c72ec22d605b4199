"""The shared simulated world and world files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.test_sim_light import wall
from tofcapture.devices.sim.config import Render, load_world, read_constants
from tofcapture.devices.sim.sensor import Sensor
from tofcapture.devices.sim.stereo import StereoModel
from tofcapture.devices.sim.world import SimWorld, simulate
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.ops.phase.reference import decode
from tofcapture.poses import rotation_angle

SMALL = {
    "tof": {"width": 32, "height": 24, "fx": 26.0, "fy": 26.0, "cx": 15.5, "cy": 11.5},
    "stereo": {"width": 64, "height": 52, "fx": 58.0, "fy": 58.0, "cx": 31.5, "cy": 25.5},
    "render": {"patches": 100, "patch_rays": 32, "rays": 8, "subpixels": 2},
}
WORLD = """
units = "m"
[tof]
width = 32
height = 24
fx = 26.0
fy = 26.0
cx = 15.5
cy = 11.5
illuminator = [0.01, 0.0, 0.0]
[stereo]
width = 64
height = 52
fx = 58.0
fy = 58.0
cx = 31.5
cy = 25.5
[camera]
T_world_tof = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.2], [0, 0, 0, 1]]
[[object]]
mesh = "plate.stl"
mesh_unit = "mm"
albedo = 0.4
T_world_object = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]]
"""
PLATE = """solid plate
facet normal 0 0 -1
outer loop
vertex -2000 -2000 0
vertex 2000 2000 0
vertex 2000 -2000 0
endloop
endfacet
facet normal 0 0 -1
outer loop
vertex -2000 -2000 0
vertex -2000 2000 0
vertex 2000 2000 0
endloop
endfacet
endsolid
"""


def make_world(seed=0):
    world = SimWorld(read_constants(SMALL, "test"), seed, lambda _name, _seed: [wall(1.0)])
    world.place("wall")
    world.set_pose(np.eye(4), b"pose")
    return world


@pytest.fixture
def world_path(tmp_path):
    (tmp_path / "plate.stl").write_text(PLATE)
    path = tmp_path / "world.toml"
    path.write_text(WORLD)
    return path


def ticking():
    return 0


def test_same_seed_scene_and_pose_give_the_same_arrays():
    """A view is a function of seed, scene and commanded pose, whatever was captured before."""
    a, b = make_world(), make_world()
    b.set_pose(np.eye(4), b"other")
    b.tof(2, ticking)
    b.stereo(ticking)
    b.set_pose(np.eye(4), b"pose")
    np.testing.assert_array_equal(a.tof(2, ticking).raw, b.tof(2, ticking).raw)
    np.testing.assert_array_equal(a.stereo(ticking).points, b.stereo(ticking).points)


def test_another_pose_key_or_seed_draws_other_noise():
    """Noise differs between poses and between stations."""
    a, b, c = make_world(), make_world(), make_world(seed=1)
    b.set_pose(np.eye(4), b"other")
    raw = a.tof(1, ticking).raw
    assert (raw != b.tof(1, ticking).raw).any()
    assert (raw != c.tof(1, ticking).raw).any()


def test_factory_calibration_is_close_and_not_exact():
    """The maker knows the offset to a millimetre or so and the wiggling to a fraction."""
    world = make_world()
    for true, known in zip(world.true_rig.range_errors, world.tof_info.range_errors, strict=True):
        assert 0 < abs(known.offset - true.offset) < 2e-3
        for (m, a, _), (n, b, _) in zip(true.harmonics, known.harmonics, strict=True):
            assert m == n
            assert 0 < abs(a - b) < abs(a)


def test_drawing_is_wrong_by_millimetres_and_a_degree():
    """The nominal rig differs from the true one as a drawing does."""
    world = make_world()
    turn = rotation_angle(world.true_rig.T_tof_stereo[:3, :3].T @ world.nominal_rig().T_tof_stereo[:3, :3])
    shift = np.linalg.norm(world.true_rig.T_tof_stereo[:3, 3] - world.nominal_rig().T_tof_stereo[:3, 3])
    assert 0 < turn < 0.06
    assert 0 < shift < 0.02


def test_cameras_need_a_pose_and_a_scene():
    """Capturing before the arm is open or a scene stands says what to do."""
    world = SimWorld(read_constants(SMALL, "test"), 0, lambda _n, _s: [wall(1.0)])
    world.place("wall")
    with pytest.raises(DeviceError, match="arm"):
        world.stereo(ticking)
    world.place("")
    world.set_pose(np.eye(4), b"")
    with pytest.raises(DeviceError, match="scene"):
        world.stereo(ticking)


def test_constants_file_and_code_agree():
    """constants.toml states the defaults of the dataclasses, so that neither can drift."""
    constants = read_constants({}, "defaults")
    assert replace(constants.sensor, range_errors=()) == Sensor()
    assert constants.render == Render()
    assert constants.stereo_model == replace(StereoModel(), grazing=constants.stereo_model.grazing)
    assert constants.stereo_model.grazing == pytest.approx(StereoModel().grazing, abs=1e-4)


def test_unknown_constant_is_refused():
    """A misspelt key is an error that lists what is known."""
    with pytest.raises(ConfigError, match="sginal"):
        read_constants({"sensor": {"sginal": 3}}, "world")


def test_ideal_world_measures_the_truth(world_path):
    """An ideal view of a single convex surface decodes to the exact depth of the world file, millimetre meshes included."""
    view = simulate(world_path, ideal=True, frames=1)
    info = view.tof.info
    decoded = decode(view.tof.raw.mean(axis=0), info)
    assert view.tof.raw.dtype == np.float64
    assert info.range_errors == ()
    np.testing.assert_allclose(info.camera.radial_to_depth(decoded.radial), 1.0, atol=2e-4)
    assert view.truth is not None
    np.testing.assert_allclose(view.truth.depth, 1.0, atol=1e-6)


def test_real_view_is_quantised_and_near_the_truth(world_path):
    """With all imperfections on, raw is uint16 and the factory-corrected depth is right to a few centimetres everywhere."""
    view = simulate(world_path, ideal=False, frames=3)
    info = view.tof.info
    decoded = decode(view.tof.raw.mean(axis=0), info, 45.0)
    assert view.tof.raw.dtype == np.uint16
    error = info.camera.radial_to_depth(decoded.radial) - 1.0
    assert 0 < np.median(np.abs(error)) < 0.02
    assert np.abs(error).max() < 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('units = "m"', 'units = "inch"'), "unit"),
        (('mesh = "plate.stl"', 'mesh = "gone.ply"'), "no such mesh"),
        (('mesh = "plate.stl"', 'mesh = "plate.xyz"'), "mesh file"),
        (("albedo = 0.4", "albedo = 1.4"), "albedo"),
        (("albedo = 0.4", "albdo = 0.4"), "albdo"),
        (
            ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.2]", "[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.2]"),
            "right-handed",
        ),
        (('mesh = "plate.stl"', 'family = "unicorn"'), "unicorn"),
        (("[camera]", "[camra]"), "camra"),
        (("illuminator = [0.01, 0.0, 0.0]", "illuminator = [0.01, 0.0]"), "3 numbers"),
        (("width = 32", "width = -3"), "positive"),
    ],
)
def test_wrong_world_files_are_explained(world_path: Path, change, message):
    """Every mistake in a world file is a ConfigError that names it."""
    text = world_path.read_text().replace(*change)
    assert text != world_path.read_text()
    world_path.write_text(text.replace('mesh_unit = "mm"\n', "") if "family" in change[1] else text)
    with pytest.raises(ConfigError, match=message):
        load_world(world_path)
