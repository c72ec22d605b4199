"""The driver contract: our drivers keep it, a foreign package keeps it, and what breaks it is caught."""

import io
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofcapture.camera import Camera
from tofcapture.devices import Arm, StereoDevice, TofCamera
from tofcapture.devices.console import ConsoleOperator
from tofcapture.devices.faults import StopLatch
from tofcapture.devices.kinematics import MODELS, forward
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim.drivers import DRIVERS as SIM
from tofcapture.errors import DeviceError, MotionRefused
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo
from tofcapture.testing import ContractError, check_arm, check_operator, check_stereo, check_tof

PACKAGE = Path(__file__).parents[1] / "examples" / "driver_package"
SMALL = {
    "seed": 0,
    "render": {"multipath": False, "subpixels": 1},
    "tof": {"width": 24, "height": 18, "fx": 19.0, "fy": 20.0, "cx": 11.7, "cy": 10.1},
    "stereo": {"width": 64, "height": 50, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 24.5},
}


def _sim():
    """The roles of one small simulated station, with the arm at home and a scene on the table."""
    context = StationContext({"sim": SMALL}, Path())
    roles = {role: (lambda role=role: SIM[role]({}, context)) for role in SIM}
    roles["arm"]().__enter__()
    roles["operator"]().place("mug")
    return roles


def test_simulated_drivers_keep_it():
    """All four simulated roles keep the contract."""
    roles = _sim()
    check_tof(roles["tof"])
    check_stereo(roles["stereo"])
    check_operator(roles["operator"])
    check_arm(roles["arm"])


def test_console_keeps_it():
    """The person at the console keeps the contract."""
    context = StationContext({}, Path())
    check_operator(lambda: ConsoleOperator({}, context, io.StringIO(), io.StringIO("\n")))


def test_example_package_is_found_and_keeps_it(tmp_path):
    """The example package installs, is found by its entry point, and keeps the contract in a process of its own."""
    site = tmp_path / "site"
    command = [
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--target",
        site,
        PACKAGE,
    ]
    built = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False)
    if "hatchling" in built.stderr:
        pytest.skip("hatchling, which builds the package, is not installed")
    assert built.returncode == 0, built.stderr
    environment = {**os.environ, "PYTHONPATH": str(site)}
    ran = subprocess.run(
        [sys.executable, PACKAGE / "check_contract.py"],
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "keeps the contract" in ran.stdout


class _Tof(TofCamera):
    info = TofInfo("t", "1", Camera(4, 3, 3.0, 3.0, 1.5, 1.0), np.zeros(3))
    clock = 0

    def describe(self):
        return self.info

    def capture(self, frames):
        if frames < 1:
            raise DeviceError("too short")
        _Tof.clock += 100
        times = _Tof.clock + np.arange(frames, dtype=np.int64)
        return TofBurst(np.ones((frames, 8, 3, 4), np.uint16), times, np.full(frames, np.nan), self.info)


class _Connects(_Tof):
    def __init__(self):
        with socket.socket() as link:
            link.connect_ex(("127.0.0.1", 9))


class _Floats(_Tof):
    def capture(self, frames):
        burst = super().capture(frames)
        return replace(burst, raw=burst.raw.astype(float))


class _Frozen(_Tof):
    def capture(self, frames):
        burst = super().capture(frames)
        return replace(burst, time_ns=np.zeros(frames, np.int64))


class _Half:
    def describe(self):
        return _Tof.info


class _Codes(_Tof):
    def capture(self, frames):
        if frames < 1:
            raise OSError(17)
        return super().capture(frames)


@pytest.mark.parametrize(
    ("camera", "clause"),
    [
        (_Connects, "no I/O"),
        (_Floats, "uint16"),
        (_Frozen, "increase"),
        (_Codes, "TofErrors only"),
        (_Half, "protocol of its role, tof; got .*__enter__.*capture"),
    ],
)
def test_broken_tof_cameras_are_caught(camera, clause):
    """I/O in the constructor, wrong types, frozen clocks and vendors' exceptions are named."""
    check_tof(_Tof)
    with pytest.raises(ContractError, match=clause):
        check_tof(camera)


class _Stereo(StereoDevice):
    info = StereoInfo("s", "1", Camera(4, 3, 3.0, 3.0, 1.5, 1.0))
    clock, scale, missing = 0, 1.0, np.nan

    def describe(self):
        return self.info

    def capture(self):
        _Stereo.clock += 1
        points = np.full((3, 4, 3), self.scale, np.float32)
        points[0, 0] = self.missing
        return StereoFrame(points, _Stereo.clock, self.info)


class _Millimetres(_Stereo):
    scale = 1000.0


class _Zeros(_Stereo):
    missing = 0.0


@pytest.mark.parametrize(("camera", "clause"), [(_Millimetres, "metres"), (_Zeros, "NaN does")])
def test_broken_stereo_cameras_are_caught(camera, clause):
    """Millimetres and zeros for missing points are named."""
    check_stereo(_Stereo)
    with pytest.raises(ContractError, match=clause):
        check_stereo(camera)


class _Arm(Arm):
    clock = 0
    off = 0.0

    def __init__(self):
        self.joints, self.open, self.latch = np.zeros(6), False, StopLatch()

    def __enter__(self):
        self.open = True
        return self

    def __exit__(self, *_):
        self.open = False

    def describe(self):
        return ArmInfo("ur10e", "1")

    def state(self):
        if not self.open:
            raise DeviceError("closed")
        _Arm.clock += 1
        return ArmState(self.joints.copy(), forward(MODELS["ur10e"], self.joints), _Arm.clock)

    def move_to(self, joints):
        self.latch.check(self.latch.token)
        if np.shape(joints) != (6,) or not np.all(np.abs(joints) < 7):
            raise MotionRefused("no")
        self.joints = np.asarray(joints) + self.off
        return self.state()

    def stop(self):
        self.latch.stop()

    def resume(self):
        self.latch.resume(self.latch.token)


class _Inexact(_Arm):
    off = 0.01


class _Credulous(_Arm):
    def move_to(self, joints):
        self.joints = np.asarray(joints)
        return self.state()


class _Unknown(_Arm):
    def describe(self):
        return ArmInfo("acme 6", "1")


class _Elsewhere(_Arm):
    def kinematics(self):
        return MODELS["ur5e"]


class _Forgetful(_Arm):
    def stop(self):
        return None


class _Stubborn(_Arm):
    def resume(self):
        return None


class _Shy(_Arm):
    def check_move(self, start, goal):
        raise MotionRefused("never")


@pytest.mark.parametrize(
    ("arm", "clause"),
    [
        (_Inexact, "settled at the goal"),
        (_Credulous, "refuses NaN"),
        (_Unknown, r"kinematics\(\) gives the arm's geometry.*arm.kinematics"),
        (_Elsewhere, "lead from the measured joints to the measured pose"),
        (_Forgetful, "after stop"),
        (_Stubborn, "stopped on request"),
        (_Shy, "never"),
    ],
)
def test_broken_arms_are_caught(arm, clause):
    """Arms that miss their goal, go to NaN, forget a stop, or whose geometry is missing or another's are named."""
    check_arm(_Arm)
    with pytest.raises((ContractError, MotionRefused), match=clause):
        check_arm(arm)
    if arm is _Unknown:
        check_arm(arm, kinematics=MODELS["ur10e"])
