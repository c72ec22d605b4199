"""The UR driver with the real ``ur_rtde`` library against the emulator: it moves, refuses, records."""

import json
import time

import numpy as np
import pytest

from tests.emulated import THERE, at_home, station_file
from tests.ur_emulator.process import Emulator
from tofcapture.devices import faults
from tofcapture.devices.kinematics import HOME, MODELS, forward
from tofcapture.devices.registry import StationContext, make_device
from tofcapture.devices.station import open_station
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.files.view import open_view, view_path
from tofcapture.record import recorder
from tofcapture.record.plan import plan_scene, prove
from tofcapture.record.recorder import record
from tofcapture.testing import check_arm

pytest.importorskip("rtde_control", reason="the ur_rtde library is not installed")


def _turned(joint, angle):
    goal = THERE.copy()
    goal[joint - 1] += angle
    return goal


def test_moves_measures_and_refuses(emulator, tmp_path):
    """It goes where it is told, reports the controller's pose, and refuses bad goals without moving."""
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        at_home(station.arm)
        emulator.order("slow", speed=0.35)  # the way takes longer than an arm may take to settle
        state = station.arm.move_to(THERE)
        np.testing.assert_allclose(state.joints, THERE, atol=4e-4)
        np.testing.assert_allclose(state.T_base_flange, forward(MODELS["ur10e"], state.joints), atol=1e-9)
        np.testing.assert_allclose(emulator.order("status")["joints"], THERE, atol=4e-4)
        for bad in (np.full(6, np.nan), _turned(6, 3.0), _turned(2, 1.5)):
            with pytest.raises(MotionRefused):
                station.arm.move_to(bad)
        station.arm.stop()
        # Idle for longer than the watchdog's patience: it is fed.
        time.sleep(1.5)
        assert station.arm.state().time_ns > state.time_ns
    assert emulator.order("status")["runtime"] == 1


def test_nothing_moves_without_consent(emulator, tmp_path):
    """A station opened without allow_motion reads the arm and refuses to move it; so does the driver itself."""
    file = station_file(tmp_path, emulator)
    with open_station(file) as station:
        before = station.arm.state().joints
        with pytest.raises(MotionRefused, match="not allowed"):
            station.arm.move_to(THERE)
        np.testing.assert_array_equal(station.arm.state().joints, before)
        assert not station.simulated
        rig = station.rig
        config = station.config
    with make_device("arm", StationContext(config, tmp_path)) as arm:
        arm.equip(rig)
        with pytest.raises(MotionRefused, match="not allowed"):
            arm.move_to(THERE)


def test_another_model_is_refused(emulator, tmp_path):
    """A station file that names another arm than the controller drives is refused at opening."""
    file = station_file(tmp_path, emulator, 'model = "ur5e"')
    with pytest.raises(ConfigError, match="ur5e"), open_station(file):
        pass
    assert emulator.order("status")["runtime"] == 1


def _planned_once():
    """Planning is most of a short recording's time: the second run takes the first one's plan."""
    plans = []

    def plan(*args, **kwargs):
        plans.extend([] if plans else [plan_scene(*args, **kwargs)])
        return plans[0]

    return plan


def test_recording_completes_after_a_protective_stop(emulator, tmp_path, monkeypatch):
    """A protective stop in mid-move ends the run by its name; nothing unlocks it; after a person did, the run completes."""
    monkeypatch.setattr(recorder, "plan_scene", _planned_once())
    file, recording = station_file(tmp_path, emulator), tmp_path / "recording"
    emulator.order("protective_stop", share=0.5)
    with (
        pytest.raises(faults.ProtectiveStop, match="protective stop"),
        open_station(file, allow_motion=True) as station,
    ):
        record(station, "mug", recording, views=1, frames=1)
    with pytest.raises(faults.ProtectiveStop, match="protective"), open_station(file, allow_motion=True):
        pass
    assert emulator.order("status")["safety"] == "PROTECTIVE_STOP"
    emulator.calm()
    with open_station(file, allow_motion=True) as station:
        result = record(station, "mug", recording, views=1, frames=1)
    assert result.failed == ()
    view = open_view(view_path(recording, "mug", 0))
    places, place = [], result.plan.views[0]
    while place is not None:
        places.append(place.joints)
        place = place.spare
    assert min(np.abs(view.arm_before.joints - joints).max() for joints in places) < 4e-4
    assert view.truth.target.any()


@pytest.mark.slow
def test_slow_controller_is_waited_for(emulator, tmp_path):
    """A speed slider at 30 % and late answers are no faults."""
    emulator.order("slow", speed=0.3, delay=0.05)
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        at_home(station.arm)
        state = station.arm.move_to(HOME + 0.1)
        assert np.isfinite(state.joints).all()


@pytest.mark.slow
def test_older_controllers_do(emulator, tmp_path):
    """A controller without the outputs that came later is asked in other ways, and moves."""
    emulator.order("lack", names=["tcp_offset", "payload", "speed_scaling"])
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        at_home(station.arm)
        goal = HOME + 0.05
        np.testing.assert_allclose(station.arm.move_to(goal).joints, goal, atol=4e-4)


@pytest.mark.slow
def test_a_whole_scene(emulator, tmp_path):
    """A plan of 25 views completes, each at its planned joints."""
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        result = record(station, "mug", tmp_path / "recording", views=25, frames=1)
    assert len(result.recorded) == len(result.plan.views) == 25
    assert json.dumps(result.plan.as_json())


@pytest.mark.slow
def test_keeps_the_contract(emulator, tmp_path):
    """The driver passes the suite that any driver can be put through."""
    with open_station(station_file(tmp_path, emulator)) as station:
        rig, config = station.rig, station.config
    context = StationContext(config, tmp_path, allow_motion=True)
    check_arm(lambda: make_device("arm", context), prepare=lambda arm: arm.equip(rig))


def test_a_controller_that_denies_every_pose_is_no_check(emulator, tmp_path, capfd):
    """It is refused by name; a setting does without it, and says so in every run; limits that change later refuse the goal."""
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        at_home(station.arm)
    emulator.order("deny")
    with pytest.raises(faults.NotReady, match="safety limits do not allow") as caught:
        open_station(station_file(tmp_path, emulator), allow_motion=True).__enter__()
    assert "controller_limits" in caught.value.hint
    assert emulator.order("status")["runtime"] == 1
    capfd.readouterr()
    file = station_file(tmp_path, emulator, 'controller_limits = "ignore"')
    for _ in range(2):
        with open_station(file, allow_motion=True) as station:
            assert 'caution: [arm] controller_limits = "ignore"' in capfd.readouterr().err
            goal = station.arm.state().joints + 0.02
            assert np.abs(station.arm.move_to(goal).joints - goal).max() < 4e-4
    emulator.order("lift")
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        emulator.order("deny")
        with pytest.raises(MotionRefused, match="controller's safety limits"):
            station.arm.check_move(HOME, HOME + 0.02)
        with pytest.raises(MotionRefused, match="controller's safety limits"):
            station.arm.move_to(station.arm.state().joints - 0.02)  # back, where nothing is in the way


@pytest.mark.parametrize(("model", "seed"), [("ur10e", 0), pytest.param("ur5e", 1, marks=pytest.mark.slow)])
def test_a_default_plan_is_driven_to_its_end(tmp_path, model, seed):
    """A planned calibration, its dry run's motions, home and back, on the emulated controller of either arm."""
    with Emulator(model=model) as emulator:
        file = station_file(tmp_path, emulator, f'model = "{model}"')
        emulator.order("haste", factor=10.0)
        with open_station(file, seed, allow_motion=True) as station:
            plan = plan_scene(station, "calibration", 5)
            for goal in [q for way in prove(station, plan) for q in way]:
                assert np.abs(station.arm.move_to(goal).joints - goal).max() < 4e-4
    assert len(plan.views) == 5
