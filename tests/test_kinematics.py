"""Arm kinematics: forward and inverse agree everywhere, singularities and the workspace's border included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.devices import Arm
from tofcapture.devices.kinematics import (
    HOME,
    MODELS,
    arm_model,
    dh_model,
    forward,
    inverse_all,
    link_frames,
    wrap,
)
from tofcapture.devices.registry import StationContext, arm_kinematics
from tofcapture.devices.sim.drivers import SimArm
from tofcapture.devices.sim.world import FaultPlan, Faults
from tofcapture.devices.urdf import urdf_model
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.frames import ArmInfo
from tofcapture.poses import check_transform, rotation_angle, rotation_exp, transform


def inverse(model, T_base_flange):
    """All different solutions (S, 6) of one pose."""
    q = inverse_all(model, T_base_flange)
    q = q[np.isfinite(q).all(axis=-1)]
    return q[np.sort(np.unique(np.round(q, 9), axis=0, return_index=True)[1])]


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


def _puma(tmp_path):
    """An arm with a spherical wrist and a theta offset, by its table and by an equal URDF."""
    rows = np.array(
        [
            [0.0, 0.3, 90, 0], [0.45, 0.0, 0, 90], [0.05, 0.0, 90, 0],
            [0.0, 0.4, -90, 0], [0.0, 0.0, 90, 0], [0.0, 0.1, 0, 0],
        ]
    )  # fmt: skip
    joints, T = [], np.eye(4)
    for n, (a, d, alpha, theta) in enumerate(rows):
        T = T @ transform(rotation_exp(np.array([0, 0, np.radians(theta)])), np.zeros(3))
        joints.append(_joint(f"j{n}", "revolute", T, f"l{n}", f"l{n + 1}"))
        T = transform(rotation_exp(np.array([np.radians(alpha), 0, 0])), [a, 0, d])
    joints.append(_joint("mount", "fixed", T, "l6", "flange"))
    links = "".join(f'<link name="{name}"/>' for name in (*(f"l{n}" for n in range(7)), "flange"))
    file = tmp_path / "arm.urdf"
    file.write_text(f'<robot name="puma">{links}{"".join(joints)}</robot>')
    return rows, file


def _joint(name, kind, T, parent, child, axis="0 0 1"):
    R = T[:3, :3]
    rpy = np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])
    place, turn = (" ".join(map(repr, map(float, v))) for v in (T[:3, 3], rpy))
    limit = '<limit lower="-3" upper="3.1"/>' if kind == "revolute" else ""
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{place}" rpy="{turn}"/><axis xyz="{axis}"/>{limit}'
        f'<parent link="{parent}"/><child link="{child}"/></joint>'
    )


def test_any_six_axis_arm_by_table_or_urdf(tmp_path):
    """A Denavit-Hartenberg table and an equal URDF are one arm; its poses are found again, from anywhere, to a nanometre."""
    rows, file = _puma(tmp_path)
    one = dh_model("puma", rows * [1, 1, np.pi / 180, np.pi / 180], low=np.full(6, -3), high=np.full(6, 3.1))
    other = urdf_model(file, "l0", "flange", 0.08)
    q = np.random.default_rng(0).uniform(-2.9, 2.9, (200, 6))
    np.testing.assert_allclose(forward(other, q), forward(one, q), atol=1e-9)
    np.testing.assert_allclose([other.low, other.high], [one.low, one.high])
    # By hand: all angles zero, the upper arm stands up (theta 90), the forearm lies along x.
    np.testing.assert_allclose(forward(one, np.zeros(6))[:3, 3], [0.5, 0.0, 0.8], atol=1e-12)
    found = inverse_all(one, forward(one, q))
    there = np.isfinite(found).all(axis=-1)
    assert there.any(axis=1).mean() > 0.98
    assert np.abs(forward(one, found[there]) - np.repeat(forward(one, q)[:, None], 4, 1)[there]).max() < 3e-9
    assert not np.isfinite(inverse_all(one, transform(np.eye(3), [3.0, 0, 0]))).any()


def test_a_sideways_axis_of_a_urdf_turns_the_same_way(tmp_path):
    """A joint about -y turns as -y does, wherever its frame's z points."""
    _, file = _puma(tmp_path)
    file.write_text(file.read_text().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 -1 0"/>', 1))
    model = urdf_model(file, "l0", "flange", 0.08)
    q = np.array([0.4, 0, 0, 0, 0, 0])
    turn = transform(rotation_exp(np.array([0, -0.4, 0])), np.zeros(3))
    np.testing.assert_allclose(forward(model, q), turn @ forward(model, np.zeros(6)), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (("revolute", "prismatic"), "six turning joints"),
        (('type="revolute"', 'type="fixed"'), "six turning joints"),
        (('upper="3.1"', 'upper="lots"'), "lots"),
        (("</robot>", ""), "cannot read"),
        (('link="l0"', 'link="l6"'), "six turning joints"),
    ],
)
def test_a_urdf_that_is_no_arm_is_refused(tmp_path, change, pattern):
    """Joints that slide, too few, words for numbers, a broken file and a circle are named, with the links that there are."""
    _, file = _puma(tmp_path)
    file.write_text(file.read_text().replace(*change, 1))
    with pytest.raises((ConfigError, ValueError), match=pattern):
        urdf_model(file, "l0", "flange", 0.08)


class _Own(Arm):
    def describe(self):
        return ArmInfo("acme 6", "1")


def test_kinematics_of_an_own_arm(tmp_path):
    """They come from the driver or from [arm.kinematics], never from both; nobody's are named before anything opens."""
    rows, _ = _puma(tmp_path)

    def found(arm, **table):
        config = {"arm": {"driver": "acme", **({"kinematics": table} if table else {})}}
        return arm_kinematics(arm, StationContext(config, tmp_path))

    assert found(_Own(), dh=rows.tolist(), low_deg=[-170] * 6).low[0] == pytest.approx(np.radians(-170))
    assert found(_Own(), urdf="arm.urdf", base="l0", tip="flange").high[5] == 3.1
    with pytest.raises(ConfigError, match="nobody knows its kinematics") as caught:
        found(_Own())
    assert "[arm.kinematics]" in caught.value.hint
    arm = _Own()
    arm.kinematics = lambda: MODELS["ur5e"]
    assert found(arm).name == "ur5e"
    with pytest.raises(ConfigError, match="brings its own, of the ur5e"):
        found(arm, dh=rows.tolist())
    for wrong in (
        {"dh": rows[:5].tolist()}, {"dh": "ur"}, {"urdf": "arm.urdf"}, {"colour": 1}, {"urdf": "none.urdf", "base": "a", "tip": "b"},
        {"dh": rows.tolist(), "low_deg": [200] * 6, "high_deg": [100] * 6}, {"dh": rows.tolist(), "radius": -1},
        {"dh": (rows * np.nan).tolist()},
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=r"kinematics|Denavit|limits|URDF"):
            found(_Own(), **wrong)
