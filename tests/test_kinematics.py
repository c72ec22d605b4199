"""Arm kinematics: forward and inverse agree everywhere, singularities and the workspace's border included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.devices.kinematics import (
    HOME,
    MODELS,
    arm_model,
    forward,
    inverse,
    inverse_all,
    link_frames,
    wrap,
)
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim.drivers import SimArm
from tofcapture.devices.sim.world import FaultPlan, Faults
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.poses import check_transform, rotation_angle, transform

ARMS = sorted(MODELS)
JOINTS = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6).map(np.array)


@pytest.mark.parametrize("name", ARMS)
def test_inverse_undoes_forward(name):
    """Every branch of the inverse leads back to the pose, to a nanometre, over 2000 random joint angles."""
    model = MODELS[name]
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (2000, 6))
    T = forward(model, q)
    branches = inverse_all(model, T)
    found = np.isfinite(branches).all(axis=-1)
    assert np.abs(forward(model, np.nan_to_num(branches)) - T[:, None])[found].max() < 1e-9
    near = np.abs(wrap(np.nan_to_num(branches, nan=99.0) - q[:, None])).max(axis=-1)
    assert np.where(found, near, np.inf).min(axis=1).max() < 1e-6
    assert found.sum(axis=1).max() == 8


@settings(max_examples=40)
@given(joints=JOINTS)
def test_inverse_of_any_joints(joints):
    """Whatever the joints, zeros and singular ones included, all solutions that are offered are right."""
    model = MODELS["ur10e"]
    T = forward(model, joints)
    check_transform(T)
    solutions = inverse(model, T)
    assert ((solutions >= -np.pi) & (solutions <= np.pi)).all()
    if len(solutions):
        assert np.abs(forward(model, solutions) - T).max() < 1e-9


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("joint", [2, 4])
@pytest.mark.parametrize("offset", [1e-12, 1e-9, 1e-6, 1e-3])
def test_next_to_singularities(name, joint, offset):
    """Close to the stretched elbow and to the wrist singularity the solutions stay exact."""
    q = np.array([0.3, -1.2, 1.4, -1.0, -1.5, 0.2])
    q[joint] = offset
    model = MODELS[name]
    T = forward(model, q)
    solutions = inverse(model, T)
    assert len(solutions)
    assert np.abs(forward(model, solutions) - T).max() < 1e-9


@pytest.mark.parametrize("name", ARMS)
def test_out_of_reach_is_empty(name):
    """A pose beyond the reach, and one inside the shoulder's cylinder, have no solution."""
    model = MODELS[name]
    down = np.diag([1.0, -1.0, -1.0])
    assert inverse(model, transform(down, [2.0, 0.0, 0.0])).shape == (0, 6)
    assert inverse(model, transform(down, [0.01, 0.0, 0.5])).shape == (0, 6)


def test_known_poses():
    """At zero joints the UR10e lies stretched along -x: x = a2 + a3, y = -(d4 + d6), z = d1 - d5, the maker's own example."""
    T = forward(MODELS["ur10e"], np.zeros(6))
    assert T[:3, 3] == pytest.approx([-0.6127 - 0.57155, -0.17415 - 0.11655, 0.1807 - 0.11985], abs=1e-12)
    assert T[:3, 2] == pytest.approx([0, -1, 0], abs=1e-12)


def test_link_lengths():
    """Consecutive link origins are as far apart as the constants say, at any joint angles."""
    q = np.random.default_rng(1).uniform(-3, 3, (50, 6))
    origins = link_frames(MODELS["ur5e"], q)[..., :3, 3]
    lengths = np.linalg.norm(np.diff(origins, axis=1), axis=-1)
    assert np.allclose(lengths, [0.425, 0.3922, 0.1333, 0.0997, 0.0996], atol=1e-12)


def test_unknown_model_and_wrong_shape():
    """A wrong name or shape is refused with what is expected."""
    with pytest.raises(ConfigError, match="ur10e"):
        arm_model("kuka")
    with pytest.raises(ConfigError, match="6"):
        forward(MODELS["ur5e"], np.zeros(5))


class _World:
    seed = 7

    def __init__(self):
        self.poses = []
        self.faults = Faults(FaultPlan())

    def set_pose(self, T_base_flange, key):
        self.poses.append((T_base_flange, key))


def _arm(tmp_path, **table):
    world = _World()
    context = StationContext(config={}, folder=tmp_path, shared={"sim": world})
    return SimArm(table, context), world


def test_simulated_arm_repeats_within_its_error(tmp_path):
    """The world hears a flange within 0.2 mm and 0.01 deg of the goal, the same each time the goal is the same."""
    arm, world = _arm(tmp_path)
    with arm:
        goal = HOME + 0.1
        first = arm.move_to(goal)
        arm.move_to(HOME)
        again = arm.move_to(goal)
    assert (first.joints == goal).all()
    assert first.time_ns == again.time_ns
    assert (world.poses[1][0] == world.poses[3][0]).all()
    assert world.poses[1][1] == np.round(goal, 9).tobytes()
    true, told = world.poses[1][0], first.T_base_flange
    assert 0 < np.linalg.norm(true[:3, 3] - told[:3, 3]) < 0.2e-3
    assert 0 < rotation_angle(true[:3, :3].T @ told[:3, :3]) < np.radians(0.01)


def test_simulated_arm_refuses(tmp_path):
    """Non-finite goals, goals outside the limits and unknown settings are refused by name."""
    arm, _ = _arm(tmp_path)
    with pytest.raises(MotionRefused, match="finite"):
        arm.move_to(np.array([0, 0, np.nan, 0, 0, 0]))
    with pytest.raises(MotionRefused, match="joint 2"):
        arm.move_to(np.array([0, 7.0, 0, 0, 0, 0]))
    with pytest.raises(ConfigError, match="colour"):
        _arm(tmp_path, colour="red")
