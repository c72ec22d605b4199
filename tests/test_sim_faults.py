"""Faults on demand: each strikes once, when it was ordered, under its own error."""

import numpy as np
import pytest

from tests.test_sim_world import SMALL
from tofcapture.devices.kinematics import HOME
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim.drivers import SimArm, SimStereo, SimTof
from tofcapture.devices.sim.world import FaultPlan, Faults, read_faults, shared_world
from tofcapture.errors import ConfigError, DeviceError, MotionRefused

GOAL = HOME + 0.01


def devices(tmp_path, **faults):
    """Arm and cameras of a small station with faults, a scene before them."""
    context = StationContext({"sim": {**SMALL, "faults": faults}}, tmp_path)
    world = shared_world(context)
    world.place("box")
    arm = SimArm({}, context)
    with arm:
        pass
    arm.move_to(HOME)
    return arm, SimTof({}, context), SimStereo({}, context), world


def test_without_faults_nothing_goes_wrong(tmp_path):
    """A station without the table behaves as before."""
    arm, tof, stereo, _ = devices(tmp_path)
    before = arm.move_to(GOAL)
    tof.capture(1)
    assert np.isfinite(stereo.capture().points).any()
    np.testing.assert_array_equal(arm.state().T_base_flange, before.T_base_flange)


def test_the_arm_refuses_once_before_the_listed_burst(tmp_path):
    """The move before burst 1 is refused, the next try goes through."""
    arm, tof, _, _ = devices(tmp_path, arm_refuses=[1])
    arm.move_to(GOAL)
    tof.capture(1)
    with pytest.raises(MotionRefused, match="burst 1"):
        arm.move_to(GOAL)
    arm.move_to(GOAL)


def test_a_lost_burst_and_the_same_view_again(tmp_path):
    """Burst 0 is lost; the second try gives the arrays that the first would have given."""
    _, tof, _, _ = devices(tmp_path, tof_drops=[0])
    with pytest.raises(DeviceError, match="lost burst 0"):
        tof.capture(2)
    _, whole, _, _ = devices(tmp_path)
    np.testing.assert_array_equal(tof.capture(2).raw, whole.capture(2).raw)


def test_empty_and_failing_stereo(tmp_path):
    """After burst 0 the point map is empty, after burst 1 the camera does not answer, after burst 2 all is well."""
    _, tof, stereo, _ = devices(tmp_path, stereo_empty=[0], stereo_fails=[1])
    tof.capture(1)
    assert np.isnan(stereo.capture().points).all()
    tof.capture(1)
    with pytest.raises(DeviceError, match="does not answer after burst 1"):
        stereo.capture()
    tof.capture(1)
    assert np.isfinite(stereo.capture().points).any()


def test_the_arm_moves_between_the_exposures(tmp_path):
    """A move between burst and point map shows in the arm's state and in the points, until the next goal."""
    arm, tof, stereo, world = devices(tmp_path, moves=[0], shift=0.02)
    before = arm.move_to(GOAL)
    tof.capture(1)
    moved = stereo.capture().points
    gone = arm.state().T_base_flange[:3, 3] - before.T_base_flange[:3, 3]
    assert np.linalg.norm(gone) == pytest.approx(0.02)
    assert not np.array_equal(world.faults.offset, np.eye(4))
    arm.move_to(GOAL)
    tof.capture(1)
    still = stereo.capture().points
    np.testing.assert_array_equal(arm.state().T_base_flange, before.T_base_flange)
    both = np.isfinite(moved) & np.isfinite(still)
    assert both.any()
    assert not np.array_equal(moved[both], still[both])


def test_slow_devices_wait_until_the_last_fault():
    """Bursts and point maps take longer, up to ``until``."""
    waits = []
    faults = Faults(FaultPlan(slow=0.3, until=1, tof_drops=(1,)), waits.append)
    for _ in range(2):
        faults.before_burst()
        faults.before_points()
    assert waits == [0.3, 0.3]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"arm_refusse": [1]}, "arm_refusse"),
        ({"tof_drops": 3}, "list"),
        ({"moves": [-1]}, "list"),
        ({"moves": [True]}, "list"),
        ({"slow": "yes"}, "number"),
        ({"shift": -0.1}, "number"),
    ],
)
def test_wrong_tables_are_explained(table, message):
    """Misspelt keys and wrong values are errors that name them."""
    with pytest.raises(ConfigError, match=message):
        read_faults(table)


def test_a_recording_goes_on_once_its_faults_are_lifted(tmp_path):
    """Stereo never answers and the run gives up; the same command without the faults finishes the recording."""
    from tests.test_recorder import _small_station
    from tofcapture.cli import main

    station = _small_station(tmp_path)
    sound = station.read_text()
    command = ["record", "--scene", "box", "--views", "2", "--frames", "1", "--foreground"]
    command += ["--station", str(station), "--out", str(tmp_path / "rec")]
    station.write_text(f"{sound}\n[sim.faults]\nstereo_fails = {list(range(99))}\n")
    assert main(command) == DeviceError.exit_code
    station.write_text(sound)
    assert main(command) == 0
