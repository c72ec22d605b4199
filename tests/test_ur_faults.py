"""Every fault of the controller, with the real ``ur_rtde`` library against the emulator: named, and nothing hangs."""

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from tests import until
from tests.emulated import THERE, at_home, station_file
from tofcapture.devices import faults
from tofcapture.devices.station import open_station

pytest.importorskip("rtde_control", reason="the ur_rtde library is not installed")

MOVING = {
    "protective_stop": faults.ProtectiveStop,
    "emergency_stop": faults.EmergencyStop,
    "script_death": faults.ProgramStopped,
    # The library itself may crash when a cable is cut in mid-move; its process is lost then, and all else holds.
    "drop": (faults.LinkLost, faults.HostLost),
    "freeze": faults.StaleData,
    "nan": faults.StaleData,
}


def _fault_in_motion(emulator, tmp_path, order):
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        at_home(station.arm)
        emulator.order("slow", speed=0.35)  # the watchdog is sooner than the arm
        emulator.order(order, share=0.3)
        with pytest.raises(MOVING[order]) as caught:
            station.arm.move_to(THERE)
        assert caught.value.hint
        # The state is kept until a person opens the station anew, and stopping stays allowed.
        with pytest.raises(MOVING[order]):
            station.arm.state()
        station.arm.stop()
    assert np.abs(np.array(emulator.rest()["joints"]) - THERE).max() > 1e-3


@pytest.mark.parametrize("order", ["drop", "freeze"])
def test_faults_in_motion(emulator, tmp_path, order):
    """A fault in mid-move has its name, and the arm stands still soon after, on its way."""
    _fault_in_motion(emulator, tmp_path, order)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["protective_stop", "emergency_stop", "script_death", "nan"])
def test_more_faults_in_motion(emulator, tmp_path, order):
    """The other faults in mid-move."""
    _fault_in_motion(emulator, tmp_path, order)


@pytest.mark.slow
@pytest.mark.parametrize("order", list(MOVING))
def test_faults_at_rest(emulator, tmp_path, order):
    """A fault while the arm stands is noticed by the next call."""
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        emulator.order(order)
        with pytest.raises(MOVING[order]):
            until(lambda: station.arm.state() is None)


# The probe talks first; what it lets pass must hang the library: V, v and O are asked by both.
HANGS = [("I", 0), ("connect", 1), ("V", 1), ("v", 1), ("O", 1), ("O", 2), ("S", 1), ("S", 2), ("banner", 1)]


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "skip"), [*HANGS, ("dashboard", 2), ("ready", 0), ("done", 0)])
def test_the_library_is_never_waited_for(emulator, tmp_path, stage, skip):
    """A controller that falls silent once the library talks to it is named silent, though the library hangs."""
    emulator.order("mute", stage=stage, skip=skip)
    with pytest.raises(faults.ControllerSilent), open_station(station_file(tmp_path, emulator)):
        pass


@pytest.mark.slow
def test_dead_script(emulator, tmp_path):
    """A controller that never starts the script is named so."""
    emulator.order("mute", stage="script")
    with pytest.raises(faults.ProgramStopped), open_station(station_file(tmp_path, emulator)):
        pass


@pytest.mark.slow
def test_killed_driver(emulator, tmp_path):
    """SIGKILL of the driver's process in mid-move is named, and the controller's watchdog stops the arm on its way."""
    with open_station(station_file(tmp_path, emulator), allow_motion=True) as station:
        at_home(station.arm)
        emulator.order("slow", speed=0.2)

        def kill():
            until(lambda: emulator.order("status")["moving"])
            os.kill(station.arm.pid, signal.SIGKILL)

        thread = threading.Thread(target=kill)
        thread.start()
        with pytest.raises(faults.HostLost, match="exit status -9"):
            station.arm.move_to(THERE)
        thread.join()
        assert np.abs(np.array(emulator.rest()["joints"]) - THERE).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_lost_station(emulator, tmp_path, how):
    """A station's process that dies or falls silent in mid-move stops the arm on its way; the next run goes on."""
    file = station_file(tmp_path, emulator)
    with open_station(file, allow_motion=True) as station:
        at_home(station.arm)
    emulator.order("slow", speed=0.2)  # slow enough that the arm does not arrive before silence is noticed
    program = (
        "import sys; from pathlib import Path; from tofcapture.devices.station import open_station\n"
        f"with open_station(Path({str(file)!r}), allow_motion=True) as s: s.arm.move_to({THERE.tolist()})"
    )
    child = subprocess.Popen([sys.executable, "-c", program])
    until(lambda: emulator.order("status")["moving"])
    child.send_signal(how)
    assert np.abs(np.array(emulator.rest()["joints"]) - THERE).max() > 0.1
    child.kill()
    child.wait()
    emulator.calm()
    with open_station(file, allow_motion=True) as station:
        at_home(station.arm)
