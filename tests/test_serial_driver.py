"""The driver tof_serial on a pseudo terminal and a socket, with the simulated module in its own process."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("serial")

from tests.tof_module.module import open_terminal
from tests.tof_module.synthetic import simulated_info, synthetic
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.tof_serial import DRIVERS
from tofcapture.devices.tof_serial.driver import SerialTof
from tofcapture.devices.tof_serial.session import (
    FirmwareError,
    LinkLostError,
    ModuleResetError,
    ModuleSilentError,
)
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD
from tofcapture.testing import check_tof

SIZE = (24, 18)
INFO = simulated_info(*SIZE)


class Modules:
    """Starts simulated modules, and ends those that it started."""

    def __init__(self, folder):
        self.folder, self.running = folder, []

    def __call__(self, *options, size="24x18"):
        command = [sys.executable, "-m", "tests.tof_module", "--size", size, *options]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1])
        self.running.append(process)
        return process.stdout.readline().strip()

    def kill(self):
        process = self.running.pop()
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def modules(tmp_path):
    """Start modules; whatever still runs is ended."""
    made = Modules(tmp_path)
    yield made
    while made.running:
        made.kill()


def camera(port, folder, **table):
    return SerialTof({"port": port, **table}, StationContext({}, folder))


def test_registered_under_its_name():
    """The registry finds the driver, and making it opens nothing."""
    assert registry.load_driver("tof_serial").keys() == {"tof"}


def test_capture_is_what_the_module_saw(modules, tmp_path):
    """Bursts come bit for bit, with host times a period apart inside the call, and are described alike before and after."""
    source = synthetic(INFO, 5)
    with camera(modules("--seed", "5", "--drift", "40"), tmp_path) as tof:
        for burst in range(2):
            start = time.monotonic_ns()
            taken = tof.capture(3)
            end = time.monotonic_ns()
            assert taken.raw.dtype == np.uint16
            assert (taken.raw == np.stack([source(burst, i)[0] for i in range(3)])).all()
            assert taken.celsius == pytest.approx([45.0, 45.1, 45.2])
            assert taken.time_ns.dtype == np.int64
            assert start < taken.time_ns[0]
            assert taken.time_ns[-1] < end
            assert np.diff(taken.time_ns) == pytest.approx(33_333_000, rel=2e-4)
        info = tof.describe()
    assert (info.modulation_hz, info.phase_rad) == (PAPER_MODULATION_HZ, PAPER_PHASE_RAD)
    assert info.camera.shape == (18, 24)
    assert (info.exposure, info.saturation) == (pytest.approx(400e-6), 4095.0)
    closed = camera("/dev/nowhere", tmp_path).describe()
    assert repr(closed) == repr(info)


def test_describe_needs_an_opening_or_a_table(tmp_path):
    """Before it was first opened the station's table describes the module; what is missing is named."""
    with pytest.raises(ConfigError, match="model, serial, camera"):
        camera("/dev/nowhere", tmp_path).describe()
    shape = {"width": 24, "height": 18, "fx": 20.0, "fy": 21.0, "cx": 11.0, "cy": 9.0}
    table = {"model": "m", "serial": "s", "camera": shape, "modulation_hz": [2e7] * 4, "phase_rad": [0.0, 1.5, 3.1, 4.7],
             "exposure": 4e-4, "saturation": 4095.0}  # fmt: skip
    assert camera("/dev/nowhere", tmp_path, **table).describe().camera.fy == 21.0
    with pytest.raises(ConfigError, match="expected a phase for each of 4 channels"):
        camera("/dev/nowhere", tmp_path, **{**table, "phase_rad": [0.0]}).describe()
    with pytest.raises(ConfigError, match="does not know bauds"):
        camera("/dev/nowhere", tmp_path, bauds=9)
    with pytest.raises(ConfigError, match="expected a device"):
        SerialTof({}, StationContext({}, tmp_path))


def test_description_file_that_cannot_be_used(modules, tmp_path):
    """A file of what the module said that is damaged, or cannot be written, is named with what to do."""
    (tmp_path / "tof-description.toml").write_text("model = [")
    with pytest.raises(ConfigError, match="cannot read what the camera said") as caught:
        camera("/dev/nowhere", tmp_path).describe()
    assert "delete it" in caught.value.hint
    with pytest.raises(ConfigError, match="cannot write what the camera said") as caught:
        camera(modules(), tmp_path, description="/proc/none/tof.toml").__enter__()
    assert "description" in caught.value.hint


def test_station_overrides_intrinsics(modules, tmp_path):
    """Measured intrinsics in station.toml win over the module's own."""
    mine = {"width": 24, "height": 18, "fx": 20.5, "fy": 21.5, "cx": 11.0, "cy": 9.0}
    with camera(modules(), tmp_path, camera=mine) as tof:
        assert tof.describe().camera.fx == 20.5
        assert tof.capture(1).info.camera.fx == 20.5


def test_other_module_is_refused(modules, tmp_path):
    """A module of another size or serial than the one known here is refused by name."""
    port = modules()
    with camera(port, tmp_path):
        pass
    modules.kill()
    with pytest.raises(DeviceError, match=r"image size: expected \(18, 24\), the module says \(18, 32\)"):
        camera(modules(size="32x18"), tmp_path).__enter__()
    with pytest.raises(DeviceError, match="serial: expected mine, the module says sim-0001"):
        camera(modules(), tmp_path, serial="mine").__enter__()


def test_nothing_there(tmp_path):
    """A port that does not exist is a lost link with a hint."""
    with pytest.raises(LinkLostError, match="cannot open the port") as caught:
        camera("/dev/nowhere", tmp_path).__enter__()
    assert "dialout" in caught.value.hint


def test_pulled_cable_and_plugged_in_again(modules, tmp_path):
    """A cable pulled in mid-burst is a lost link; plugged in again, the next capture works."""
    link = tmp_path / "tof"
    port = modules("--link", str(link), "--pull-in", "1")
    with camera(port, tmp_path) as tof:
        tof.capture(1)
        with pytest.raises(LinkLostError, match="the link is gone"):
            tof.capture(16)
        modules.kill()
        with pytest.raises(LinkLostError, match="cannot open"):
            tof.capture(1)
        modules("--link", str(link))
        assert tof.capture(2).raw.shape == (2, 8, 18, 24)
        tof.close()
        tof.close()


def test_reset_in_burst_and_on(modules, tmp_path):
    """A module that starts anew in mid-burst is named; the next capture works."""
    with camera(modules("--reset-in", "1"), tmp_path) as tof:
        tof.capture(1)
        with pytest.raises(ModuleResetError, match="started anew"):
            tof.capture(4)
        assert tof.capture(2).time_ns.shape == (2,)


def test_wrong_firmware_is_named(modules, tmp_path):
    """Another protocol, and another firmware than the station wants, are refused on opening."""
    with pytest.raises(FirmwareError, match="protocol 2"):
        camera(modules("--protocol", "2"), tmp_path).__enter__()
    with pytest.raises(FirmwareError, match=r"expected 1\.1, got 1\.0"):
        camera(modules(), tmp_path, firmware="1.1").__enter__()


def test_silent_port_is_named(tmp_path):
    """A port on which nobody answers is silence, not a hang."""
    *ends, name = open_terminal()
    with pytest.raises(ModuleSilentError, match="nobody answers"):
        camera(name, tmp_path).__enter__()
    for end in ends:
        os.close(end)


def test_too_many_frames_is_the_callers_fault(modules, tmp_path):
    """More frames than the module's memory holds is refused before anything is exposed."""
    with camera(modules(), tmp_path) as tof:
        for frames in (0, 17):
            with pytest.raises(ConfigError, match="expected 1 to 16"):
                tof.capture(frames)


def test_socket_and_noise(modules, tmp_path):
    """The same driver works on a socket, through damage."""
    with camera(modules("--tcp", "0", "--noise", "2e-4", "--seed", "2"), tmp_path) as tof:
        assert (tof.capture(1).raw[0] == synthetic(INFO, 2)(0, 0)[0]).all()


def test_keeps_the_contract(modules, tmp_path):
    """The driver passes the conformance suite of ToF cameras, at home and in its own process."""
    link = tmp_path / "tof"
    modules("--link", str(link))
    with camera(str(link), tmp_path):
        pass  # the contract wants a description before anything is opened
    check_tof(lambda: camera(str(link), tmp_path))
    check_tof(lambda: DRIVERS["tof"]({"port": str(link)}, StationContext({}, tmp_path)))


def test_named_errors_cross_the_process(modules, tmp_path):
    """In its own process the driver raises the same named errors, and comes back after them."""
    link = tmp_path / "tof"
    modules("--link", str(link), "--reset-in", "0")
    with DRIVERS["tof"]({"port": str(link)}, StationContext({}, tmp_path)) as tof:
        with pytest.raises(ModuleResetError, match="started anew") as caught:
            tof.capture(4)
        assert "power supply" in caught.value.hint
        assert tof.capture(1).raw.shape == (1, 8, 18, 24)
