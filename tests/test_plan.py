"""View plans: reachable, clear, spread, repeatable, and honest about what cannot be reached."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.devices.clearance import is_clear, obstacles, route, segment_gap, workcell_of
from tofcapture.devices.kinematics import HOME, MODELS, forward, link_frames
from tofcapture.devices.registry import StationContext
from tofcapture.devices.station import Station, open_station, read_station
from tofcapture.devices.ur_rtde.arm import UrArm
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.frames import ArmState
from tofcapture.poses import invert, look_at, rotation_exp, transform, transform_points
from tofcapture.record.plan import REMEDIES, board_sampling, object_sampling, plan_scene, plan_views, prove
from tofcapture.record.quality import board_pose, coverage
from tofcapture.record.sight import blocked, expected
from tofcapture.rig import Rig

UR10E = MODELS["ur10e"]
CAMERA = Camera(240, 180, 190.0, 200.0, 119.5, 89.5)
RIG = Rig(
    tof=CAMERA,
    stereo=CAMERA,
    T_tof_stereo=transform(rotation_exp([0.04, 0.01, 0.0]), [-0.05, 0.08, 0.0]),
    T_flange_tof=transform(rotation_exp([0.01, -0.02, 0.02]), [0.0, -0.035, 0.08]),
)
STAGE = workcell_of(read_station(None))


def _plan(views=25, seed=0, model=UR10E, workcell=STAGE, sampling=None, target=None):
    sampling = replace(sampling or object_sampling(), directions=160)
    target = workcell.target if target is None else target
    return plan_views(model, RIG, workcell, target, sampling, views, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def plan():
    return _plan()


def test_every_view_sees_the_target(plan):
    """The camera stands at the planned distance and direction; the target lies between both cameras' axes, not far from either."""
    for view in plan.views:
        T = view.T_base_flange @ RIG.T_flange_tof
        assert np.allclose(forward(UR10E, view.joints), view.T_base_flange, atol=1e-12)
        gap = STAGE.target - T[:3, 3]
        assert np.linalg.norm(gap) == pytest.approx(view.distance, abs=0.08)
        assert gap @ view.direction / np.linalg.norm(gap) < -0.98
        assert 0.34 < view.distance < 1.5
        for camera, pose in ((RIG.tof, T), (RIG.stereo, T @ RIG.T_tof_stereo)):
            pixel = camera.project(transform_points(invert(pose), STAGE.target))[0]
            assert (np.abs(pixel - [camera.cx, camera.cy]) < [60, 45]).all()


def test_views_show_enough_of_an_object(plan):
    """No view shows less than 85 % of what the best ones do; without regard to it some would."""
    shares = np.array([v.coverage for v in plan.views])
    assert shares.min() > 0.85 * shares.max()
    assert "% of an object" in plan.summary()
    blind = _plan(sampling=replace(object_sampling(), both=False)).views
    assert all(np.isnan(v.coverage) and v.spare is None for v in blind)
    poses = np.stack([v.T_base_flange for v in blind])
    assert expected(RIG, STAGE, poses).min() < 0.75 * shares.max()


def test_each_view_has_other_places(plan):
    """Nearly every view comes with two more, of its own number and turn, reachable, clear and no view of the plan."""
    first = [v.spare for v in plan.views if v.spare]
    second = [v.spare for v in first if v.spare]
    assert len(second) > 20
    assert all(v.spare is None for v in second)
    assert not {v.digest for v in first + second} & {v.digest for v in plan.views}
    for view in plan.views:
        spare = view.spare
        for digest in view.places[1:]:
            assert (spare.digest, spare.index, spare.turn) == (digest, view.index, view.turn)
            assert is_clear(UR10E, RIG, STAGE, HOME, spare.joints)
            spare = spare.spare
        if view.spare:
            assert view.as_json()["spare"]["joints"] == view.spare.joints.tolist()


def _looking(distance, tilt, rig=RIG, roll=0.0):
    """Flange poses from which the ToF camera looks at the target."""
    tilt = np.radians(tilt)
    eye = STAGE.target + distance * np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    return (look_at(eye, STAGE.target, roll=roll) @ invert(rig.T_flange_tof))[None]


def test_what_is_expected_of_a_pose():
    """Too near, too far, from straight above, with cameras that look apart: less of an object is covered, and none at the last."""
    at = {
        name: float(expected(rig, STAGE, _looking(distance, tilt, rig))[0])
        for name, distance, tilt, rig in (
            ("good", 0.6, 55, RIG),
            ("near", 0.25, 55, RIG),
            ("far", 1.4, 55, RIG),
            ("above", 0.6, 0, RIG),
            (
                "apart",
                0.6,
                55,
                replace(RIG, T_tof_stereo=transform(rotation_exp([1.5, 0, 0]), [-0.05, 0.08, 0.0])),
            ),
        )
    }
    assert 0.6 < at["good"] < 0.95
    assert all(at[name] < 0.9 * at["good"] for name in ("near", "far", "above"))
    assert at["apart"] == 0


def test_the_base_is_in_the_way_of_sight():
    """From home the target in front is seen, one behind the base is not."""
    behind = replace(STAGE, target=np.array([-0.9, 0.0, -0.44]))
    assert not blocked(UR10E, RIG, STAGE, HOME[None])[0]
    assert blocked(UR10E, RIG, behind, HOME[None])[0]


def test_views_are_clear(plan):
    """No planned pose, and no way to it from home, meets table, object, base or the arm itself."""
    for view in plan.views:
        assert not obstacles(UR10E, RIG, STAGE, view.joints).any()
        assert is_clear(UR10E, RIG, STAGE, HOME, view.joints)
        assert (view.joints >= UR10E.low).all()
        assert (view.joints <= UR10E.high).all()


def test_views_are_spread(plan):
    """25 views cover near and far, steep and flat, and no two are alike."""
    assert len(plan.views) == 25
    assert sorted(v.index for v in plan.views) == list(range(25))
    distances = np.array([v.distance for v in plan.views])
    tilt = np.degrees(np.arccos([v.direction[2] for v in plan.views]))
    assert distances.min() < 0.6
    assert distances.max() > 0.8
    assert np.sum((distances > 0.45) & (distances < 1.1)) >= 8
    assert tilt.min() < 30
    assert tilt.max() > 50
    features = np.array([[*v.direction, 0.6 * np.log(v.distance)] for v in plan.views])
    gaps = np.linalg.norm(features[:, None] - features, axis=-1) + 10 * np.eye(25)
    assert gaps.min() > 0.15


def test_same_generator_same_plan(plan):
    """A plan repeats exactly; another generator gives another plan."""
    again = _plan()
    assert again.digest == plan.digest
    assert [v.index for v in again.views] == [v.index for v in plan.views]
    assert _plan(seed=1).digest != plan.digest


def test_a_plan_is_the_same_on_every_machine(plan):
    """The digests of a seed's plan, of one of its views, and of given joints, as written into recordings."""
    assert plan.digest == "5afcf2e1f7fcbb0a"
    assert plan.views[0].digest == "3b6ae58db056a0a4"
    view = replace(plan.views[0], joints=np.array([0.1, -1.2, 1.3, 0.0, 0.5, -0.0]), turn=0.0)
    assert view.digest == replace(view, joints=view.joints + 4e-7, distance=9.0).digest == "6ad404dbd3a45b3a"
    assert replace(view, turn=np.pi / 2).digest == "62e31b2e5c57eda3"


def test_shorter_plan_is_a_prefix(plan):
    """The first seven of 25 views are those of a plan for seven, so that a recording can be extended."""
    known = {v.index: v.digest for v in plan.views}
    short = _plan(views=7)
    assert {v.index: v.digest for v in short.views} == {i: known[i] for i in range(7)}


def test_travel_starts_near_home_and_is_short(plan):
    """The order of travel is shorter than the order of sampling."""

    def length(views):
        joints = np.array([HOME, *(v.joints for v in views)])
        return np.abs(np.diff(joints, axis=0)).max(axis=1).sum()

    assert length(plan.views) < 0.75 * length(sorted(plan.views, key=lambda v: v.index))


@pytest.mark.parametrize("seed", [0, 1])
def test_board_views_tilt_in_all_directions(seed):
    """Calibration views look at the board from 15 to 40 deg off its normal, 0.5 to 1.1 m away, from all sides; in the image it leans
    in at least six of the eight directions, and in none more than four times."""
    plan = _plan(12, seed, sampling=board_sampling(STAGE), target=STAGE.board)
    assert len(plan.views) == 12
    normal = STAGE.board_normal / np.linalg.norm(STAGE.board_normal)
    tilt = np.degrees(np.arccos([v.direction @ normal for v in plan.views]))
    assert tilt.min() > 14.9
    assert tilt.max() < 40.1
    side = np.array([v.direction - (v.direction @ normal) * normal for v in plan.views])
    assert np.linalg.eigvalsh(side.T @ side)[1] > 0.5
    assert all(0.5 <= v.distance <= 1.1 for v in plan.views)
    T_base_board = board_pose(STAGE.board, STAGE.board_normal)
    poses = [invert(v.T_base_flange @ RIG.T_flange_tof) @ T_base_board for v in plan.views]
    counts = np.array(list(coverage(poses, CAMERA)["sectors"].values()))
    assert (counts > 0).sum() >= 6
    assert counts.max() <= 4


@pytest.mark.parametrize(
    ("reason", "change", "least"),
    [("reach", {"target": np.array([4.0, 0.0, -0.4])}, 1.0), ("table", {"table": 0.9}, 0.001)],
)
def test_nothing_reachable_is_reported(reason, change, least):
    """A target beyond the arm, and a table as high as the camera, leave no view, and the plan says which stands against them."""
    plan = _plan(workcell=replace(STAGE, **change))
    assert plan.views == ()
    assert plan.refused[reason] >= least * plan.candidates
    assert "0 of 25 views" in plan.summary()
    assert reason in plan.summary()
    words, remedy = REMEDIES[reason]
    assert f"  {plan.refused[reason]} are {words}: {remedy}" in plan.shortfall()


def test_obstacles_are_named():
    """Joints that put the flange under the table are blocked by the table; home is clear."""
    assert not obstacles(UR10E, RIG, STAGE, HOME).any()
    low = HOME + np.array([0, 1.9, -0.9, 0, 0, 0])
    assert obstacles(UR10E, RIG, STAGE, low)[0]


def test_route_goes_straight_or_home():
    """A clear way is taken straight; a blocked one by way of home; none at all is refused."""
    a, b = HOME + 0.1, HOME - 0.1
    assert [w.tolist() for w in route(UR10E, RIG, STAGE, a, b)] == [b.tolist()]
    low = HOME + np.array([0, 1.9, -0.9, 0, 0, 0])
    with pytest.raises(MotionRefused, match="no clear way"):
        route(UR10E, RIG, STAGE, HOME, low)


def test_route_by_way_of_home():
    """When the straight way between two clear views is blocked, the route passes through home."""
    plan = _plan(30)
    views = plan.views
    pairs = [(a, b) for a in views for b in views if not is_clear(UR10E, RIG, STAGE, a.joints, b.joints)]
    assert pairs
    for a, b in pairs[:5]:
        ways = route(UR10E, RIG, STAGE, a.joints, b.joints)
        assert [w.tolist() for w in ways] == [HOME.tolist(), b.joints.tolist()]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": [1, 2]}, "3 finite numbers"),
        ({"colour": 1}, "colour"),
        ({"table": "low"}, "plan"),
        ({"table": [1.0]}, "a finite number"),
    ],
)
def test_wrong_stage_is_refused(change, message):
    """Wrong shapes, unknown keys and words in [plan] are refused by name."""
    config = read_station(None)
    with pytest.raises(ConfigError, match=message):
        workcell_of({"plan": {**config["plan"], **change}})


def test_missing_stage_is_refused():
    """A station without [plan] cannot be planned for."""
    with pytest.raises(ConfigError, match="plan"):
        workcell_of({})


def _beside(model, joints):
    """Where the metal of a UR is, by the published offsets alone: (4, 2, 3) shoulder, upper arm, forearm, wrist 1."""
    offsets = {
        "ur3e": (0.120, 0.027),
        "ur5e": (0.138, 0.007),
        "ur10e": (0.1762, 0.0393),
        "ur20": (0.260, 0.043),
    }
    T = link_frames(model, joints)
    aside = T[0, :3, 2]  # the shoulder's axis; those of elbow and wrist 1 are parallel to it
    shoulder, elbow = (aside * offset for offset in offsets[model.name])
    first, second, third, fourth = (T[i, :3, 3] for i in range(4))
    return np.array(
        [
            [first, first + shoulder],
            [first + shoulder, second + shoulder],
            [second + elbow, third + elbow],
            [third + elbow, fourth],
        ]
    )


def _gap(first, second):
    """Distance of two segments (2, 3), by sampling one and projecting on the other."""
    points = first[0] + np.linspace(0, 1, 400)[:, None] * (first[1] - first[0])
    way = second[1] - second[0]
    t = np.clip((points - second[0]) @ way / max(way @ way, 1e-12), 0, 1)
    return np.linalg.norm(points - second[0] - t[:, None] * way, axis=1).min()


@pytest.mark.parametrize("name", ["ur3e", "ur5e", "ur10e", "ur20"])
def test_clear_ways_pass_the_metal(name):
    """On ways that are called clear, cameras and wrist keep off the arm where its metal is, beside the frames' line; no elbow folds."""
    model, rng = MODELS[name], np.random.default_rng(5)
    joints = rng.uniform(-np.pi, np.pi, (3000, 6))
    clear = joints[
        ~obstacles(model, RIG, replace(STAGE, table=-3.0, keep_out_radius=0.0), joints).any(axis=1)
    ]
    assert len(clear) > 100
    for q in clear[np.abs(clear[:, 2]) < np.radians(160)][:200]:
        metal, T = _beside(model, q), link_frames(model, q)
        flange = T[5]
        eyes = [(flange @ mount)[:3, 3] for mount in (RIG.T_flange_tof, RIG.T_flange_stereo)]
        assert min(_gap(np.stack([eye, eye]), part) for eye in eyes for part in metal[:3]) > 0.10
        assert min(_gap(np.stack([T[4, :3, 3], flange[:3, 3]]), part) for part in metal[:2]) > 0.10
        assert min(_gap(metal[3], part) for part in metal[:1]) > 0.10
    folded = HOME.copy()
    folded[2] = np.radians(178)
    assert not is_clear(model, RIG, STAGE, HOME, folded)
    with pytest.raises(MotionRefused, match="joint 3 at 178 deg"):
        route(model, RIG, STAGE, HOME, folded)


@example([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.2e-7, 0.0])
@example([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.2e-7, 1.0, 0.0, -1.2e-7, 0.0, 0.0])
@given(st.lists(st.floats(-1, 1), min_size=12, max_size=12))
def test_gaps_of_segments(numbers):
    """The closed form is the least distance to micrometres: not above that of any two points, and reached by sampling."""
    first, second = np.array(numbers).reshape(2, 2, 3)
    found = segment_gap(first, second)
    sampled = _gap(first, second)
    assert found <= sampled + 5e-6
    assert sampled <= found + 0.01
    assert segment_gap(second, first) == pytest.approx(found, abs=5e-6)


def test_a_camera_is_as_large_as_the_station_says():
    """A larger housing of either camera refuses views that a small one takes, and a box whose corners are swapped is named."""
    joints = np.stack([v.joints for v in _plan(12).views])
    for key in ("tof_box", "stereo_box"):
        large = replace(STAGE, **{key: np.array([[-0.3, -0.3, -0.1], [0.5, 0.3, 0.35]])})
        assert obstacles(UR10E, RIG, large, joints).any()
    plan = read_station(None)["plan"]
    with pytest.raises(ConfigError, match="lower corner first"):
        workcell_of({"plan": {**plan, "tof_box": [[0, 0, 0.1], [0.1, 0.1, 0.0]]}})
    with pytest.raises(ConfigError, match="2 x 3 finite numbers"):
        workcell_of({"plan": {**plan, "stereo_box": [1.0, 2.0]}})


def _real(model, seed, tmp_path, **more):
    """The simulated station with a UR's driver, closed, in place of its arm: what it would refuse it says."""
    config = read_station(None, seed)
    table = {"host": "127.0.0.1", "model": model, "controller_limits": "ignore", **more}
    arm = UrArm(table, StationContext(config, tmp_path, allow_motion=True))
    with open_station() as station:
        rig = station.rig
    arm.equip(rig)
    arm.state = lambda: ArmState(HOME, forward(MODELS[model], HOME), 1)
    return Station(arm, None, None, None, rig, config)


def _completes(station, scene, views):
    """A plan has all of its views, and each motion between them is one that the driver takes."""
    plan = plan_scene(station, scene, views)
    assert len(plan.views) == views
    ways = prove(station, plan)
    assert [tuple(way[-1]) for way in ways] == [tuple(v.joints) for v in plan.views] + [tuple(HOME)]
    here = HOME
    for goal in [q for way in ways for q in way]:
        station.arm.check_move(here + 3e-4, goal)  # an arm arrives within 0.02 deg, not exactly
        assert np.degrees(np.abs(goal - here).max()) < 150
        here = goal


@pytest.mark.parametrize(
    ("model", "seed", "scene", "views"),
    [("ur10e", 0, "calibration", 12), ("ur5e", 1, "calibration", 25), ("ur5e", 0, "mug", 25)],
)
def test_default_plans_are_completed_by_the_real_driver(tmp_path, model, seed, scene, views):
    """The driver of the real arm refuses no motion of a default plan."""
    _completes(_real(model, seed, tmp_path), scene, views)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["ur10e", "ur5e"])
def test_twenty_seeds_are_completed_by_the_real_driver(tmp_path, model):
    """Whatever the seed: 12 and 25 board views, 25 of a scene."""
    for seed in range(20):
        station = _real(model, seed, tmp_path)
        for scene, views in (("calibration", 12), ("calibration", 25), ("mug", 25)):
            _completes(station, scene, views)


def test_a_plan_keeps_to_what_the_driver_allows(tmp_path):
    """Steps of 100 deg at most, a workspace and a keep-out of the driver's own change the plan, and none of its motions is refused."""
    tight = {"max_step_deg": 100.0, "workspace": [[-0.4, -1.0, -0.5], [1.4, 0.45, 1.4]]}
    tight["keep_out"] = [[[0.2, -0.9, 0.3], [0.5, -0.5, 0.9]]]
    station, free = _real("ur10e", 0, tmp_path, **tight), _real("ur10e", 0, tmp_path)
    plan, other = (plan_scene(one, "calibration", 8) for one in (station, free))
    assert plan.digest != other.digest
    prove(station, plan)
    with pytest.raises(MotionRefused, match=r"view \d+: no clear way .*: move:"):
        prove(station, other)
