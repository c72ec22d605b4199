"""The driver franka: seven joints in plans and files, and the real library against franky-sim, which speaks the robot's protocol."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests import PATIENCE
from tests.franka_sim import HOME, THERE, FrankaSim, station_file
from tests.test_files_view import make_view
from tofcapture.cli import main
from tofcapture.devices import faults, registry
from tofcapture.devices.arm.franka import FrankaArm, FrankaLink, fr3
from tofcapture.devices.kinematics import forward, inverse_all
from tofcapture.devices.registry import StationContext
from tofcapture.devices.station import open_station, read_station
from tofcapture.errors import ConfigError, DeviceError, MotionRefused, MotionStopped
from tofcapture.files.check import check
from tofcapture.files.view import find_views, open_view, view_path, write_view
from tofcapture.frames import ArmState
from tofcapture.testing import check_arm

SOON = 15.0 + PATIENCE


def driver(folder, address, *, allow=True, **more):
    config = read_station(station_file(folder, address))
    table = {k: v for k, v in config["arm"].items() if k != "driver"} | more
    return FrankaArm(table, StationContext(config, folder, allow_motion=allow))


def rig():
    with open_station() as station:
        return station.rig


def test_seven_joints_reach_what_they_reach():
    """Poses of random joints are found again, by other joints or the same; six angles are refused."""
    model, rng = fr3(), np.random.default_rng(0)
    T = forward(model, rng.uniform(model.low, model.high, (20, 7)))
    found = inverse_all(model, T, HOME)
    good = np.isfinite(found).all(axis=-1)
    assert good.any(axis=1).mean() > 0.9
    np.testing.assert_allclose(
        forward(model, found[good]), np.repeat(T[:, None], found.shape[1], 1)[good], atol=1e-8
    )
    with pytest.raises(ConfigError, match="7"):
        forward(model, HOME[:6])


def test_a_view_file_holds_seven_joints(tmp_path):
    """A file says how many joints its arm had; both states must have as many."""
    view = make_view()
    state = ArmState(HOME, forward(fr3(), HOME), 1)
    path = view_path(tmp_path, "mug", 7)
    write_view(path, replace(view, arm_before=state, arm_after=replace(state, time_ns=9)))
    assert list(check(path)) == []
    np.testing.assert_array_equal(open_view(path).arm_after.joints, HOME)
    with pytest.raises(Exception, match="arm/after/joints"):
        write_view(view_path(tmp_path, "mug", 8), replace(view, index=8, arm_before=state))


@pytest.mark.parametrize("table", [{"realtime": "maybe"}, {"speed": 9.0}, {"model": "panda"}, {"host": ""}])
def test_wrong_settings_are_refused(table, tmp_path):
    """What the arm has not is refused before anything opens."""
    with pytest.raises(ConfigError):
        driver(tmp_path, "127.0.0.1", **table)
    assert registry.load_driver("franka").keys() == {"arm"}


def test_absent(tmp_path):
    """Nobody at the address is named at once."""
    begun = time.monotonic()
    with pytest.raises(faults.ControllerSilent, match="port 1337"), driver(tmp_path, "127.0.0.199"):
        pass
    assert time.monotonic() - begun < SOON


class _Told(FrankaLink):
    """The connection over states that are told, one a look: shares of speeds and accelerations that are still commanded."""

    def __init__(self, *commanded):
        self._host, self._newest, self._commanded = "told", 0.0, iter(commanded)
        most = SimpleNamespace(get=lambda: np.full(7, 5.0))
        self.robot = SimpleNamespace(state=None, joint_acceleration_limit=most)

    def _state(self):
        dq, ddq = next(self._commanded)
        self._newest += 0.5
        self.robot.state = SimpleNamespace(q_d=HOME, dq_d=dq * AHEAD, ddq_d=ddq * AHEAD)
        return self.robot.state

    def sample(self):
        return SimpleNamespace(timestamp=self._newest)


AHEAD = np.array([0.5, 0.0, 0.0, -1.0, 0.0, 0.0, 0.1])


def test_a_move_begins_at_rest():
    """It waits until neither speed nor acceleration is commanded; what stays is named."""
    link = _Told((0.3, 0.0), (0.0, 0.5), (0.0, 0.0), (0.3, 0.0))
    link.rest()
    assert link._newest == 1.5
    with pytest.raises(faults.NotSettled, match="still commanded"):
        _Told(*[(0.3, 0.0)] * 9).rest()


@pytest.mark.parametrize("speed", [0.0, 0.2, 1.0])
def test_a_stop_is_ahead_on_the_way(speed):
    """The arm is told to rest where braking takes it, no joint beside its way; one at rest stays."""
    link = _Told((speed, 0.0))
    link._state()
    way = link.brake() - HOME
    assert way == pytest.approx(-way[3] * AHEAD)
    assert -way[3] == pytest.approx(speed**2 / 10 + 0.02 * speed, rel=0.2)


@pytest.fixture(scope="module")
def sim():
    """One simulator for the tests that leave it well."""
    for library in ("franky", "franky_sim"):
        pytest.importorskip(library, reason=f"{library} is not installed: pip install --group device-tests")
    with FrankaSim() as process:
        yield process


def at_home(arm):
    arm.equip(rig())
    if np.abs(arm.state().joints - HOME).max() > 1e-3:
        arm.move_to(HOME)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_moves_straight_and_refuses(sim, tmp_path):
    """It goes where it is told on the straight way that was checked; without consent, to NaN or too far it does not move."""
    with driver(tmp_path, sim.host, allow=False) as arm:
        arm.equip(rig())
        with pytest.raises(MotionRefused, match="not allowed"):
            arm.move_to(THERE)
    with driver(tmp_path, sim.host) as arm:
        at_home(arm)
        sim.order("clear")
        state = arm.move_to(THERE)
        seen = np.array(sim.order("report"))[:, 1:]
        np.testing.assert_allclose(state.joints, THERE, atol=np.radians(0.1))
        np.testing.assert_allclose(state.T_base_flange, forward(fr3(), state.joints), atol=2e-3)
        along = (seen - HOME) @ (THERE - HOME) / np.square(THERE - HOME).sum()
        assert np.abs(seen - HOME - along[:, None] * (THERE - HOME)).max() < np.radians(1.0)
        too_far, table = THERE.copy(), HOME.copy()
        too_far[6] += 3.0
        table[[1, 3]] = 1.5, -0.9
        for bad in (THERE * np.nan, THERE[:6], too_far, table):
            with pytest.raises(MotionRefused):
                arm.move_to(bad)
        assert np.abs(arm.state().joints - THERE).max() < np.radians(0.1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_contract_holds(sim, tmp_path):
    """The conformance suite passes with the real library."""
    check_arm(lambda: driver(tmp_path, sim.host), at_home)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_stop_holds(sim, tmp_path):
    """A stop in mid-move ends it within 0.3 s of the arm's clock, ahead on its way, until somebody resumes."""
    with driver(tmp_path, sim.host) as arm:
        at_home(arm)
        sim.order("clear")

        def press():
            while np.abs(arm._link.sample().joints - HOME).max() < 0.1:
                time.sleep(0.005)
            sim.order("clear")
            arm.interrupt()

        thread = threading.Thread(target=press)
        thread.start()
        with pytest.raises(MotionStopped):
            arm.move_to(THERE)
        thread.join()
        ticks = np.array(sim.order("report"))[:, 1:]
        moving = np.abs(np.diff(ticks, axis=0)).max(axis=1) > 2e-5  # rad in a tick of 1 ms
        assert np.flatnonzero(moving).max(initial=0) < 300
        assert np.ptp(ticks, axis=0).max() < 0.25
        along = (ticks - HOME) @ (THERE - HOME) / np.linalg.norm(THERE - HOME)
        assert along.max() - along[-1] < 0.01  # it does not go back
        with pytest.raises(MotionStopped):
            arm.move_to(HOME)
        arm.resume()
        arm.move_to(HOME)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("mode", "kind"),
    [("kReflex", faults.ProtectiveStop), ("kUserStopped", faults.SafetyStop), ("kOther", faults.NotReady)],
)
def test_modes_have_names(sim, tmp_path, mode, kind):
    """A reflex, the user stop and closed brakes are named at opening."""
    begun = time.monotonic()
    sim.order(f"mode {mode}")
    try:
        with pytest.raises(kind, match="the controller reports"), driver(tmp_path, sim.host):
            pass
    finally:
        sim.order("mode own")
    assert time.monotonic() - begun < SOON


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("fault", "after"), [("die", True), ("hang", True), ("hang", False)])
def test_a_lost_controller_has_a_name(sim, tmp_path, fault, after):
    """Unplugged in mid-move, silent in mid-move, silent before it is opened: each a named error within 15 s, also through the host."""
    with FrankaSim(2) as own:
        config = read_station(station_file(tmp_path, own.host))
        arm = registry.make_device("arm", StationContext(config, tmp_path, allow_motion=True))
        if not after:
            own.hang()
            begun = time.monotonic()
            with pytest.raises(DeviceError), arm:
                pass
            assert time.monotonic() - begun < SOON
            return
        with arm:
            arm.equip(rig())
            begun, lost = [], (faults.LinkLost, faults.StaleData, faults.ControllerSilent, faults.HostLost)

            def break_it():
                time.sleep(1.0)
                begun.append(time.monotonic())
                getattr(own, fault)()

            threading.Thread(target=break_it).start()
            with pytest.raises(lost):
                arm.move_to(THERE)
            assert time.monotonic() - begun[0] < SOON


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_twenty_five_views_are_recorded(sim, tmp_path):
    """From a plan of 25 views, each leg checked, to a recording that ``check`` passes, in the arm's own process."""
    file, out = station_file(tmp_path, sim.host), tmp_path / "rec"
    command = ["record", "--scene", "mug", "--frames", "1", "--station", str(file), "--out", str(out)]
    assert main([*command, "--allow-motion"]) == 0
    assert main(["check", str(out)]) == 0
    views = find_views(out)["mug"]
    assert len(views) == 25
    assert {len(open_view(v).arm_before.joints) for v in views} == {7}
