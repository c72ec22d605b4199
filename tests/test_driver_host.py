"""Driver host: whatever a vendor's library does, the station gets an answer or a named error, and no process stays."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE, alive, misbehaving, until
from tofcapture.devices.faults import HostLost, ProtectiveStop
from tofcapture.devices.host import hosted, process
from tofcapture.devices.registry import StationContext
from tofcapture.errors import ConfigError, DeviceError, MotionRefused

CONTEXT = StationContext({}, Path())
CAMERA, ARM = "tests.misbehaving:Camera17", "tests.misbehaving:Arm17"


def _camera(opening=PATIENCE, capture=PATIENCE, **table):
    """A camera in a process of its own, with the seconds that its calls may take."""
    return hosted("tof", CAMERA, {"capture": capture, "__enter__": opening})(table, CONTEXT)


def test_bursts_come_through_whole():
    """A burst from the child equals the one made here, can be written to, and the child is gone after closing."""
    camera = _camera()
    assert camera.describe() is not None
    with camera:
        pid = camera.pid
        assert pid != os.getpid()
        burst = camera.capture(3)
        expected = misbehaving.Camera17({}, CONTEXT).capture(3)
        np.testing.assert_array_equal(burst.raw, expected.raw)
        assert burst.raw.dtype == np.uint16
        burst.raw[0] = 0
        np.testing.assert_array_equal(camera.capture(3).raw, expected.raw)
    assert not alive(pid)
    with pytest.raises(DeviceError, match="not open"):
        camera.capture(1)


@pytest.mark.parametrize(
    ("how", "seconds", "pattern"),
    [
        ("hang", 3.0, "took more than 3 s"),
        ("crash", PATIENCE, "exit status -11"),
        ("print", PATIENCE, "status 4; it last said: vendor says hello"),
    ],
)
def test_a_lost_camera_is_named_and_replaced(tmp_path, how, seconds, pattern):
    """A child that hangs, crashes or ends is a named error with its last words; the next call has a new child."""
    with _camera(PATIENCE, seconds, expose=how, once=str(tmp_path / "once")) as camera:
        first = camera.pid
        with pytest.raises(HostLost, match=pattern):
            camera.capture(1)
        assert camera.capture(1).raw.shape[0] == 1
        assert camera.pid != first
        assert not alive(first)


def test_a_library_that_holds_the_lock_is_noticed(monkeypatch):
    """Silence ends a call long before its deadline when the library keeps Python from running."""
    monkeypatch.setattr(process, "SILENCE", 3.0)
    with (
        _camera(expose="hang holding the lock") as camera,
        pytest.raises(HostLost, match="fell silent"),
    ):
        camera.capture(1)


def test_a_slow_driver_that_lives_is_waited_for(monkeypatch):
    """A long call is no silence as long as the driver's process can say that it lives."""
    monkeypatch.setattr(process, "SILENCE", 3.0)
    with hosted("arm", ARM)({"seconds": 4.5}, CONTEXT) as arm:
        assert arm.move_to(np.ones(6)).joints.tolist() == [1.0] * 6


def test_opening_has_a_deadline():
    """A constructor that hangs holding the lock is killed at its deadline."""
    camera = _camera(1.0, open="hang holding the lock")
    with pytest.raises(HostLost, match="__enter__ took more than 1 s"), camera:
        pass


def test_vendor_errors_are_named_and_ours_pass_as_they_are():
    """Another library's exception becomes a DeviceError with its name; ours keep message and hint. The child lives on."""
    with _camera(expose="raise") as camera:
        pid = camera.pid
        with pytest.raises(DeviceError, match="LookupError: VENDOR_STATUS_17"):
            camera.capture(1)
        assert camera.pid == pid
    with _camera(expose="refuse") as camera, pytest.raises(DeviceError, match="lens cap") as caught:
        camera.capture(1)
    assert caught.value.hint == "take it off"


def test_stop_reaches_a_move(tmp_path):
    """Another thread's stop ends a running move."""
    moving = tmp_path / "moving"

    def stop():
        until(moving.exists)
        arm.stop()

    with hosted("arm", ARM)({"seconds": 1000.0, "moving": str(moving)}, CONTEXT) as arm:
        thread = threading.Thread(target=stop)
        thread.start()
        with pytest.raises(MotionRefused, match="on request"):
            arm.move_to(np.ones(6))
        thread.join()
        assert arm.state().joints.tolist() == [0.0] * 6


def test_a_lost_arm_is_not_replaced():
    """An arm whose process died says so again and again until it is opened anew; stop stays allowed."""
    arm = hosted("arm", ARM)({"move": "crash"}, CONTEXT)
    with arm:
        for call in (lambda: arm.move_to(np.ones(6)), arm.state, arm.state):
            with pytest.raises(HostLost, match="-11"):
                call()
        arm.stop()
    with arm:
        assert arm.state().joints.shape == (6,)


def test_a_fault_stays_until_the_station_is_opened_anew():
    """A state that needs a person is repeated by every call, though the driver would answer; opening anew ends it."""
    arm = hosted("arm", ARM)({"move": "fault"}, CONTEXT)
    with arm:
        assert arm.state().joints.shape == (6,)
        for call in (lambda: arm.move_to(np.ones(6)), arm.state):
            with pytest.raises(ProtectiveStop, match="protective stop") as caught:
                call()
            assert "acknowledge" in caught.value.hint
    with arm:
        assert arm.state().joints.shape == (6,)


def test_targets_must_import():
    """A driver that does not import, and a role that is none, are refused at once."""
    with pytest.raises(DeviceError, match="nowhere"):
        hosted("tof", "nowhere.at.all:X")({}, CONTEXT)
    with pytest.raises(ConfigError, match="role"):
        hosted("operator", CAMERA)


_PARENT = """
    import sys, threading, time
    from pathlib import Path
    from tofcapture.devices.host import hosted
    from tofcapture.devices.registry import StationContext
    table = {{"{verb}": "{how}"}}
    camera = hosted("tof", "tests.misbehaving:Camera17", {{"__enter__": {deadline}}})(table, StationContext({{}}, Path()))
    def tell():
        while camera.pid is None:
            time.sleep(0.01)
        time.sleep(1.0)
        print(camera.pid, flush=True)
    threading.Thread(target=tell).start()
    with camera:
        camera.capture(1)
        time.sleep(100)
"""


def _orphan(verb, how, deadline):
    """Kill a parent in the middle of a call; the number of its child."""
    text = textwrap.dedent(_PARENT).format(verb=verb, how=how, deadline=deadline)
    parent = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)
    # The child is known once its host is; a hanging constructor keeps it from answering.
    line = parent.stdout.readline() if how != "hang holding the lock" else _child_of(parent.pid)
    parent.send_signal(signal.SIGKILL)
    parent.communicate()
    return int(line)


def _child_of(pid):
    children = until(Path(f"/proc/{pid}/task/{pid}/children").read_text)
    time.sleep(2.0)  # it begins to open, though it cannot say so
    return children.split()[0]


@pytest.mark.parametrize("how", ["hang", pytest.param("", marks=pytest.mark.slow)])
def test_no_orphans(how):
    """SIGKILL of the station's process ends the driver's process, idle or in a call."""
    child = _orphan("expose", how, PATIENCE)
    until(lambda: not alive(child))


@pytest.mark.slow
def test_no_orphans_when_the_library_holds_the_lock():
    """Even a child that cannot run Python ends: a timer in C ends it."""
    child = _orphan("open", "hang holding the lock", 6.0)
    until(lambda: not alive(child))
