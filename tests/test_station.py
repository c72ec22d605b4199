"""Stations: drivers found by name, all failures at once, closed in reverse order, whatever happens."""

import io
from dataclasses import dataclass

import numpy as np
import pytest

from tofcapture.devices import Arm, Operator, StereoDevice, TofCamera, registry, station
from tofcapture.devices.console import ConsoleOperator
from tofcapture.devices.registry import StationContext, load_driver, make_device
from tofcapture.devices.station import open_station, read_station
from tofcapture.errors import ConfigError, DeviceError, MotionRefused
from tofcapture.frames import ArmInfo, ArmState


@dataclass
class _Entry:
    """Stands for an entry point."""

    name: str
    target: object
    value: str = "somewhere:DRIVERS"

    def load(self):
        if isinstance(self.target, Exception):
            raise self.target
        return self.target


class _Device(Arm, TofCamera, StereoDevice, Operator):
    """Writes down what is done to it."""

    def __init__(self, role, log, broken=False):
        self.role, self.log, self.broken = role, log, broken

    def __enter__(self):
        if self.broken:
            raise DeviceError(f"{self.role} is unplugged", hint=f"plug the {self.role} in")
        self.log.append(f"open {self.role}")
        return self

    def __exit__(self, *_):
        self.log.append(f"close {self.role}")

    simulated = False

    def stop(self):
        self.log.append(f"stop {self.role}")

    def describe(self):
        return ArmInfo("ur10e", "1")

    def state(self):
        return ArmState(np.zeros(6), np.eye(4), 1)

    def move_to(self, joints):
        self.log.append("move")
        return self.state()


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """A station file of fake drivers; ``broken`` names the roles that do not open."""
    log, broken = [], set()
    drivers = {
        role: lambda table, context, role=role: _Device(role, log, role in broken) for role in registry.ROLES
    }

    def arm(table, context):
        log.append(f"consent {context.allow_motion}")
        return _Device("arm", log, "arm" in broken)

    drivers["arm"] = arm
    monkeypatch.setattr(
        registry,
        "entry_points",
        lambda group: [_Entry("fake", drivers), _Entry("bad", ImportError("no libfoo"))],
    )
    monkeypatch.setattr(station, "load_rig", lambda path: path.name)
    file = tmp_path / "station.toml"
    file.write_text(
        "".join(f'[{role}]\ndriver = "fake"\n' for role in registry.ROLES) + '[rig]\npath = "rig.toml"\n'
    )
    return file, log, broken


def test_opens_and_closes_in_reverse(fake):
    """Devices open in order and close in reverse; the rig is the named file."""
    file, log, _ = fake
    with open_station(file) as opened:
        assert opened.rig == "rig.toml"
        assert [entry for entry in log if "open" in entry] == [f"open {role}" for role in registry.ROLES]
        log.clear()
    assert log == [f"close {role}" for role in reversed(registry.ROLES)]


def test_error_stops_the_arm_first(fake):
    """After an error the arm is stopped before anything is closed, and the error goes on."""
    file, log, _ = fake
    with pytest.raises(KeyboardInterrupt), open_station(file):
        raise KeyboardInterrupt
    log = log[len(registry.ROLES) + 1 :]
    assert log[0] == "stop arm"
    assert log[1:] == [f"close {role}" for role in reversed(registry.ROLES)]


def test_a_real_arm_moves_only_when_allowed(fake, monkeypatch):
    """Without ``allow_motion``, which is the default, a real arm is read and stopped but never moved; a simulated one moves."""
    file, log, _ = fake
    with open_station(file) as opened:
        assert not opened.simulated
        assert opened.arm.state().joints.shape == (6,)
        assert opened.arm.describe().serial == "1"
        with pytest.raises(MotionRefused, match="real and motion was not allowed") as caught:
            opened.arm.move_to(np.zeros(6))
        assert "--allow-motion" in caught.value.hint
        opened.arm.stop()
    assert "move" not in log
    assert "stop arm" in log
    with open_station(file, allow_motion=True) as opened:
        opened.arm.move_to(np.zeros(6))
    assert log.count("move") == 1
    monkeypatch.setattr(_Device, "simulated", True)
    with open_station(file) as opened:
        assert opened.simulated
        opened.arm.move_to(np.zeros(6))
    assert log.count("move") == 2
    assert not StationContext({}, file.parent).allow_motion


def test_drivers_hear_whether_motion_is_allowed(fake):
    """The consent of a run reaches every driver of the station, and is no by default."""
    file, log, _ = fake
    for allowed in ({}, {"allow_motion": False}, {"allow_motion": True}):
        with open_station(file, **allowed):
            pass
    assert [entry for entry in log if "consent" in entry] == ["consent False"] * 2 + ["consent True"]


def test_all_failures_at_once(fake):
    """Two broken devices are named in one error with both hints, and those that opened are closed."""
    file, log, broken = fake
    broken |= {"tof", "operator"}
    with pytest.raises(DeviceError, match="2 of 4 devices") as caught, open_station(file):
        pass
    assert "tof is unplugged" in caught.value.message
    assert "operator is unplugged" in caught.value.message
    assert "plug the tof in; plug the operator in" in caught.value.hint
    assert log[1:] == ["open arm", "open stereo", "close stereo", "close arm"]


def test_missing_rig_is_refused(fake):
    """A station whose cameras are not simulated must name a rig; its devices are closed again."""
    file, log, _ = fake
    file.write_text(file.read_text().replace('path = "rig.toml"', ""))
    with pytest.raises(ConfigError, match="rig"), open_station(file):
        pass
    assert log[-1] == "close arm"


def test_a_driver_that_lacks_a_method_is_refused_at_once(fake, monkeypatch, tmp_path):
    """A class without all of its role's protocol is named with what it lacks, before anything is opened."""
    monkeypatch.setattr(
        registry, "entry_points", lambda group: [_Entry("half", {"operator": lambda *_: object()})]
    )
    context = StationContext({"operator": {"driver": "half"}}, tmp_path)
    with pytest.raises(ConfigError, match="lacks __enter__, __exit__, can_turn") as caught:
        make_device("operator", context)
    assert "tofcapture.devices.Operator" in caught.value.hint


def test_unknown_and_broken_drivers(fake, tmp_path):
    """An unknown driver lists the known ones; one that does not import says why; a role it lacks is named."""
    context = StationContext(config={"arm": {"driver": "nothere"}, "tof": {}}, folder=tmp_path)
    with pytest.raises(ConfigError, match="bad, fake"):
        make_device("arm", context)
    with pytest.raises(ConfigError, match="libfoo"):
        load_driver("bad")
    with pytest.raises(ConfigError, match=r"\[tof\]"):
        make_device("tof", context)


@pytest.mark.parametrize("target", [None, {}, {"juggler": object}])
def test_a_driver_must_be_a_mapping_of_roles(monkeypatch, target):
    """Whatever an entry point yields that is no mapping of roles is refused."""
    monkeypatch.setattr(registry, "entry_points", lambda group: [_Entry("odd", target)])
    with pytest.raises(ConfigError, match="roles"):
        load_driver("odd")


def test_wrong_station_files(tmp_path):
    """A missing file, broken TOML and unknown tables are configuration errors that name the file."""
    with pytest.raises(ConfigError, match=r"none\.toml"):
        read_station(tmp_path / "none.toml")
    file = tmp_path / "station.toml"
    file.write_text("[arm")
    with pytest.raises(ConfigError, match=r"station\.toml"):
        read_station(file)
    file.write_text('[sim]\nseed = "x"\n')
    with pytest.raises(ConfigError, match="whole number"):
        read_station(file)
    file.write_text("[camera]\nx = 1\n")
    with pytest.raises(ConfigError, match="camera"):
        read_station(file)


def test_seed_replaces_the_files():
    """A given seed wins over the file's, and is what the station says."""
    assert read_station(None)["sim"]["seed"] == 0
    assert read_station(None, 5)["sim"]["seed"] == 5


def test_simulated_station_opens():
    """The embedded station opens, is simulated, has a nominal rig and describes itself the same each time."""
    with open_station(seed=3) as opened:
        assert opened.simulated
        assert opened.seed == 3
        assert opened.rig.tof.shape == (180, 240)
        first = opened.describe()
    with open_station(seed=3) as opened:
        assert opened.describe() == first
    assert first["arm"]["model"] == "ur10e"


def test_what_a_driver_may_leave_out():
    """An arm is real and an operator no person until a driver says so; nobody turns; nothing is found without a probe."""

    class Silent(TofCamera, Arm, Operator):
        pass

    device = Silent()
    assert (device.simulated, device.person, device.can_turn, device.probe(), device.truth()) == (
        *(False, False, False),
        *("", None),
    )
    assert device.watch(1.0) is device.equip(None) is device.interrupt() is None
    with device as same:
        assert same is device
    with pytest.raises(DeviceError, match=r"nobody can turn 'mug' by 0\.50 rad"):
        device.turn("mug", 0.5)


def test_console_operator(tmp_path):
    """The person is asked once per scene, on the given stream; ended input is an error; nobody knows the truth."""
    ask, context = io.StringIO(), StationContext({}, tmp_path)
    person = ConsoleOperator({}, context, ask, io.StringIO("\n\n"))
    person.place("mug")
    person.place("mug")
    person.place("cup")
    assert ask.getvalue().count("press Enter") == 2
    assert person.truth() is None
    with pytest.raises(DeviceError, match="ended"):
        person.place("bowl")
    with pytest.raises(ConfigError, match="volume"):
        ConsoleOperator({"volume": 3}, context)
