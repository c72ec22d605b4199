"""The parts of the UR driver and of its emulator that need no library: wire, settings, codes, way, probe, motion."""

import socket
import struct
import threading
import tomllib
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import until
from tests.ur_emulator.faults import STAGES, Faults
from tests.ur_emulator.motion import Motion
from tests.ur_emulator.process import Emulator
from tests.ur_emulator.robot import PLAYING, Robot
from tests.ur_emulator.rtde_server import pack
from tests.ur_emulator.script import ControlScript
from tofcapture.devices import faults
from tofcapture.devices.arm.limits import Link, Sample, check_goal, check_way, follow, joint_speed, stopping
from tofcapture.devices.clearance import body_of, workcell_of
from tofcapture.devices.kinematics import HOME
from tofcapture.devices.station import DEFAULT, open_station
from tofcapture.devices.ur_rtde import link as wire
from tofcapture.devices.ur_rtde import probe as probing
from tofcapture.devices.ur_rtde.link import danger, halted
from tofcapture.devices.ur_rtde.settings import read_settings
from tofcapture.errors import ConfigError, DeviceError, MotionRefused

SETTINGS = read_settings({"host": "127.0.0.1"})


def _turned(joint, angle):
    """Home with one joint turned."""
    goal = HOME.copy()
    goal[joint - 1] += angle
    return goal


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=6),
    st.lists(st.integers(1, 20), min_size=1, max_size=5),
)
@settings(max_examples=60)
def test_packages_survive_any_cutting(packages, cuts):
    """However a stream is cut, the same packages come out."""
    stream = b"".join(wire.package(kind, payload) for kind, payload in packages)
    splitter, out, at = wire.Splitter(), [], 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        out += splitter.feed(stream[at : at + step])
        at += step
    assert out == packages


@given(st.tuples(*[finite] * 6), finite, st.integers(-(2**31), 2**31 - 1))
@settings(max_examples=40)
def test_values_survive_their_recipe(vector, number, integer):
    """Vectors, doubles and integers come back bit by bit, in big-endian order."""
    recipe = wire.Recipe(["q", "t", "i"], ["VECTOR6D", "DOUBLE", "INT32"])
    data = pack(recipe, [vector, number, integer])
    assert len(data) == 60
    assert struct.unpack(">d", data[48:56])[0] == number
    assert recipe.unpack(data) == {"q": vector, "t": number, "i": integer}


def test_nonsense_on_the_wire_is_refused():
    """A size below a header's, data of another length and unknown types are device errors."""
    with pytest.raises(DeviceError, match="size 1"):
        list(wire.Splitter().feed(b"\x00\x01V"))
    with pytest.raises(DeviceError, match="8 bytes"):
        wire.Recipe(["t"], ["DOUBLE"]).unpack(b"abc")
    with pytest.raises(DeviceError, match="known type"):
        wire.Recipe(["t"], ["NOT_FOUND"])
    assert wire.split_names(b"a,b,") == ["a", "b"]


@pytest.mark.parametrize(
    ("table", "pattern"),
    [
        ({}, "host"),
        ({"host": "h", "color": 1}, "color"),
        ({"host": "h", "speed": 9.0}, "speed"),
        ({"host": "h", "speed": "fast"}, "speed"),
        ({"host": "h", "model": "ur99"}, "ur99"),
        ({"host": "h", "pose": "guess"}, "pose"),
        ({"host": "h", "controller_limits": "off"}, "ask or ignore"),
        ({"host": "h", "camera_speed": 3.0}, "camera_speed"),
        ({"host": "h", "workspace": [[0, 0, 0], [1, 1, -1]]}, "workspace"),
        ({"host": "h", "workspace": [[0, 0, 0], [1, 1, 0]]}, "workspace"),
        ({"host": "h", "keep_out": [[0, 0, 0], [1, 1, 1]]}, "keep_out"),
    ],
)
def test_wrong_settings_are_refused(table, pattern):
    """Each wrong entry of [arm] is a configuration error that names it."""
    with pytest.raises(ConfigError, match=pattern):
        read_settings(table)


def test_codes_have_one_meaning():
    """Every bit and mode of the controller is a named state; normal and reduced are none; the gravest wins."""
    assert danger(1, 7) is None
    assert danger(2, 7) is None
    assert halted(2) is None
    kinds = {2: faults.ProtectiveStop, 3: faults.SafetyStop, 4: faults.SafetyStop, 5: faults.EmergencyStop}
    kinds |= {6: faults.EmergencyStop, 7: faults.EmergencyStop, 8: faults.SafetyStop, 9: faults.SafetyStop}
    for bit, kind in kinds.items():
        assert type(danger(1 << bit | 1 << 10, 7)) is kind
    assert type(danger(1 << 2 | 1 << 7, 7)) is faults.EmergencyStop
    for mode in (-1, 0, 1, 2, 3, 4, 5, 6, 8, 42):
        assert type(danger(1, mode)) is faults.NotReady
    for runtime in (0, 1, 3, 4, 5):
        fault = halted(runtime)
        assert type(fault) is faults.ProgramStopped
        assert fault.hint


@pytest.mark.parametrize(
    ("joints", "pattern"),
    [
        (np.full(6, np.nan), "finite"),
        (HOME[:5], "finite"),
        (_turned(6, 7.0), "outside"),
        (_turned(6, 3.0), "joint 6 would turn by 172"),
    ],
)
def test_goals_are_checked(joints, pattern):
    """No number, too few angles, beyond the limits, too large a step: each is refused with its reason."""
    with pytest.raises(MotionRefused, match=pattern):
        check_goal(SETTINGS, HOME, joints)


def test_ways_are_checked():
    """The free way passes; a workspace, a keep-out box and the table stop it, even when only the way is blocked."""
    config = tomllib.loads(DEFAULT.read_text())
    stage = workcell_of(config)
    with open_station() as station:
        rig = station.rig
    goal = _turned(1, 0.3)
    check_way(SETTINGS, rig, stage, HOME, goal)
    tight = replace(SETTINGS, workspace=np.array([[0.0, -1.0, 0.6], [1.0, 1.0, 1.0]]))
    with pytest.raises(MotionRefused, match="workspace"):
        check_way(tight, rig, stage, HOME, goal)
    # A post half-way: neither start nor goal touches it.
    middle = np.array([0.6, 0.0, 0.5])
    post = replace(SETTINGS, keep_out=np.array([[middle - 0.02, middle + 0.02]]))
    across = _turned(1, 0.7)
    start = _turned(1, -0.7)
    check_way(post, rig, stage, start, start + 1e-3)
    check_way(post, rig, stage, across, across + 1e-3)
    with pytest.raises(MotionRefused, match="keep_out 1"):
        check_way(post, rig, stage, start, across)
    # Links and cameras have a girth: a box beside the flange is too close.
    flange = body_of(SETTINGS.model, rig, stage, HOME).flange
    for gap, refusal in ((0.05, pytest.raises(MotionRefused, match="keep_out 1")), (0.5, nullcontext())):
        corner = flange + np.array([gap, 0.0, 0.0])
        beside = replace(SETTINGS, keep_out=np.array([[corner, corner + 0.002]]))
        with refusal:
            check_way(beside, rig, stage, HOME, HOME + 1e-3)
    with pytest.raises(MotionRefused, match="table"):
        check_way(SETTINGS, rig, stage, HOME, _turned(2, 1.5))


def test_motion_is_a_trapezoid():
    """A move takes length/speed + speed/acceleration, never exceeds its limits, and ends exactly at its goal."""
    goal = (1.0, -0.5, 0.0, 0.2, 0.0, 0.0)
    motion, seconds, top, last = Motion((0.0,) * 6, goal, 0.5, 1.0), 0.0, 0.0, 0.0
    while not motion.finished:
        motion.advance(0.002)
        seconds += 0.002
        rate = abs(motion.velocity[0])
        assert rate - last < 1.0 * 0.002 + 1e-9
        top, last = max(top, rate), rate
    assert motion.position == goal
    assert top == pytest.approx(0.5, rel=1e-6)
    assert seconds == pytest.approx(1.0 / 0.5 + 0.5 / 1.0, abs=0.05)


@pytest.mark.parametrize(("speed", "rate"), [(0.7, 0.0), (0.05, 1.4), (0.5, -1.4), (1.05, 1.4), (1e-3, 0.0)])
def test_the_way_of_a_stop_is_known(speed, rate):
    """A joint that brakes as hard as it may, at a jerk that it may, stops where it is said to."""
    step, most, jerk, place = 1e-5, 5.0, 250.0, 0.0
    told, speed_, rate_ = stopping(speed, rate, most, jerk), speed, rate
    while speed_ > 0:
        # It eases off when just enough is left to end without acceleration.
        easing = rate_ < 0 and speed_ <= rate_**2 / (2 * jerk)
        rate_ = min(rate_ + jerk * step, -1e-9) if easing else max(rate_ - jerk * step, -most)
        speed_ += rate_ * step
        place += speed_ * step
    assert told == pytest.approx(place, rel=0.01, abs=1e-5)


@pytest.mark.parametrize(("bend", "refused"), [(0.03, False), (0.08, True)])
def test_an_arm_that_leaves_its_way_is_stopped(bend, refused):
    """The way was checked as a straight one: 3 degrees beside it are too many."""
    goal = HOME + np.array([0.5, 0.1, 0, 0, 0, -0.3])

    class Bent(Link):
        clock = 0.0

        def sample(self):
            self.clock += 0.25
            share = min(self.clock - 0.25, 1.0)
            joints = HOME + share * (goal - HOME) + [0, 0, bend * np.sin(np.pi * share), 0, 0, 0]
            return Sample(self.clock, joints, np.zeros(6), np.zeros(3))

    with pytest.raises(faults.ProgramStopped, match="left the way") if refused else nullcontext():
        follow(Bent(), goal, 1.0, lambda: None)


def _robot():
    now = [0.0]
    robot = Robot("ur10e", Faults(), clock=lambda: now[0])

    def run(seconds):
        for _ in range(round(seconds / 0.004)):
            now[0] += 0.004
            robot.tick()

    robot.start_program(ControlScript())
    run(0.02)
    return robot, run


def test_script_keeps_the_handshake():
    """READY, command, DONE, zero, READY again; an asynchronous move is done at once and reports that it runs."""
    robot, run = _robot()
    assert robot.int_out[0] == 1
    robot.int_in |= {0: 1, 1: 1}
    robot.double_in |= dict(enumerate([*(HOME + 0.1), 0.5, 1.0]))
    run(0.01)
    assert robot.int_out[0] == 2
    assert robot.int_out[2] >> 15 & 1
    robot.int_in[0] = 0
    run(0.01)
    assert robot.int_out[0] == 1
    run(3)
    assert not robot.int_out[2] >> 15 & 1
    assert robot.joints == tuple(HOME + 0.1)


def test_watchdog_ends_the_script():
    """Without a write in time the program ends and the arm comes to rest on its way."""
    robot, run = _robot()
    robot.int_in[0], robot.double_in[0] = 35, 2.0
    run(0.01)
    robot.written_at = robot.now
    robot.move(HOME + 1.0, 0.5, 1.0)
    run(0.4)
    assert robot.runtime == PLAYING
    run(0.5)
    assert robot.runtime != PLAYING
    assert robot.motion is None
    assert robot.joints != tuple(HOME + 1.0)


def test_protective_stop_waits_to_be_unlocked():
    """It is not released for five seconds, and never by itself."""
    robot, run = _robot()
    robot.protective_stop()
    run(4)
    assert not robot.unlock()
    run(60)
    assert robot.safety_name == "PROTECTIVE_STOP"
    assert robot.unlock()
    assert robot.safety_name == "NORMAL"


def test_faults_come_when_they_are_due():
    """At a share of a move, at once, or after some answers; nonsense is refused; lifting takes all out."""
    faults_ = Faults()
    assert faults_.apply({"do": "drop", "share": 0.5}) == ""
    assert faults_.due(None) == faults_.due(0.4) == []
    assert faults_.due(0.5) == ["drop"]
    assert faults_.apply({"do": "mute", "stage": "V", "skip": 1}) == ""
    assert [faults_.silent("V") for _ in range(3)] == [False, True, True]
    assert faults_.apply({"do": "mute", "stage": "moon"})
    assert faults_.apply({"do": "lift"}) == ""
    assert not faults_.silent("V")


@pytest.fixture(scope="module")
def emulator():
    with Emulator() as running:
        yield running


def _ask(emulator, **more):
    return probing.probe(read_settings({"host": emulator.host, **more}))


def test_probe_knows_the_controller(emulator):
    """Version, serial number, TCP and payload come from the controller."""
    emulator.order("lift")
    found = _ask(emulator, serial="20235500001", payload=1.0)
    assert found.version[:2] == (5, 11)
    assert found.serial == "20235500001"
    assert found.tcp_offset == (0.0,) * 6


def _ask_on(emulator):
    for _ in range(100):
        _ask(emulator)


@pytest.mark.parametrize("stage", [s for s in STAGES if s not in {"I", "script", "ready", "done"}])
def test_probe_names_the_silent_stage(emulator, monkeypatch, stage):
    """A controller that falls silent anywhere in the handshake is named silent within the timeout."""
    emulator.order("lift")
    emulator.order("mute", stage=stage)
    monkeypatch.setattr(probing, "_TIMEOUT", 0.4)
    with pytest.raises(faults.ControllerSilent, match="silent at"):
        _ask(emulator)
    emulator.order("lift")


def test_probe_refuses_what_is_not_ready(emulator):
    """Local control, another arm, another payload, stops, and nobody there are told apart."""
    emulator.order("lift")
    emulator.order("remote", on=False)
    with pytest.raises(faults.NotReady, match="local control"):
        _ask(emulator)
    emulator.order("lift")
    with pytest.raises(faults.NotReady, match="serial number 7"):
        _ask(emulator, serial="7")
    with pytest.raises(faults.NotReady, match=r"payload of 3\.0 kg"):
        _ask(emulator, payload=3.0)
    for order, kind in (("protective_stop", faults.ProtectiveStop), ("emergency_stop", faults.EmergencyStop)):
        emulator.order(order)
        with pytest.raises(kind):
            _ask_on(emulator)
        emulator.order("lift")
    with pytest.raises(faults.ControllerSilent, match="30004"):
        probing.probe(read_settings({"host": "127.250.0.9"}))


def test_no_camera_is_faster_than_allowed():
    """Flange and cameras keep to their speed in m/s wherever a motion takes them, and no joint exceeds its own in rad/s."""
    with open_station() as station:
        rig = station.rig
    stage, rng = workcell_of(tomllib.loads(DEFAULT.read_text())), np.random.default_rng(3)
    reached = []
    for goal in HOME + rng.uniform(-1.5, 1.5, (12, 6)):
        speed = joint_speed(SETTINGS, rig, stage, HOME, goal)
        assert 0.05 < speed <= SETTINGS.speed
        # The joint with the longest way goes at this speed, the others in proportion: a thousandth of the way at a time.
        way = np.linspace(HOME, goal, 1001)
        places = body_of(SETTINGS.model, rig, stage, way).cameras
        seconds = np.abs(goal - HOME).max() / 1000 / speed
        fastest = np.linalg.norm(np.diff(places, axis=0), axis=-1).max() / seconds
        assert fastest <= SETTINGS.camera_speed
        reached.append(max(fastest / SETTINGS.camera_speed, speed / SETTINGS.speed))
    assert min(reached) > 0.95  # and is not slower than it must be
    alone = _turned(6, 1.0)
    assert joint_speed(SETTINGS, rig, stage, HOME, alone) == SETTINGS.speed


@pytest.mark.parametrize(
    ("start", "ended"), [(b"def another():\n  while True:\n  end\nend\n", False), (None, True)]
)
def test_a_program_of_somebody_else_is_left_alone(emulator, start, ended):
    """A program that runs on the controller is NotReady, before anything is sent; one of ours that is about to end is waited for."""
    emulator.order("lift")
    with socket.create_connection((emulator.host, 30003)) as link:
        link.sendall(start or b"def rtde_control():\n  pass\nend\n")
        until(lambda: emulator.order("status")["runtime"] == PLAYING)
        timer = threading.Timer(0.5, lambda: emulator.order("script_death") if ended else None)
        timer.start()
        with nullcontext() if ended else pytest.raises(faults.NotReady, match="another program runs"):
            _ask(emulator)
        timer.join()
        assert (emulator.order("status")["runtime"] == PLAYING) is not ended
    emulator.order("lift")
