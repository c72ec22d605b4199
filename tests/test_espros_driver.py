"""The driver espros: the vendor's real client against an emulated TOFcam-660."""

import logging
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE
from tests.espros_emulator import Emulator
from tests.still_station import CAMERA as CAMERA_
from tests.still_station import recorded
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.tof.espros import Espros
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.ops.phase import Decoder
from tofcapture.testing import check_tof

tofCam660 = pytest.importorskip(
    "epc.tofCam660.tofCam660", reason="epc-tofcam-toolkit is not installed: pip install --group device-tests"
)
CAMERA = {"width": 320, "height": 240, "fx": 266.0, "fy": 266.0, "cx": 159.5, "cy": 119.5}
TABLE = {"address": "127.0.0.1", "serial": "7-4321", "mhz": [24.0, 6.0], "exposure": 400e-6, "camera": CAMERA}
WALL = np.broadcast_to(np.linspace(0.5, 7.0, 320), (240, 320))
SOON = 15.0 + PATIENCE


@pytest.fixture
def camera(monkeypatch):
    """Emulate a camera; the client's fixed ports are moved, so that tests run beside each other."""
    logging.getLogger("TOFcam660").setLevel(logging.CRITICAL)

    def make(**how):
        emulator = Emulator(how.pop("range_m", WALL), **how)
        monkeypatch.setattr(tofCam660, "DEFAULT_TCP_PORT", emulator.port)
        monkeypatch.setattr(tofCam660, "DEFAULT_DATA_RX_PORT", emulator.data_port)
        return emulator

    return make


def driver(**table):
    return Espros({**TABLE, **table}, StationContext({}, Path()))


def test_two_frequencies_by_switching_give_the_range(camera):
    """Frames at 24 and 6 MHz in turn decode to the range that the camera sees, over 25 m; flags stay what they were."""
    with camera() as emulator, driver() as tof:
        burst = tof.capture(3)
    assert burst.raw.shape == (3, 8, 240, 320)
    np.testing.assert_array_equal(burst.info.illuminator, np.zeros(3))  # where nobody measured the lamp
    assert burst.raw.dtype == np.uint16
    assert (burst.raw[:, :, 0, 0] == 64002).all()
    assert (burst.raw[:, :, 0, 1] == 64003).all()
    assert burst.info.saturated(burst.raw)[..., 0, :2].all()
    assert burst.celsius == pytest.approx(35.12)
    found = Decoder(burst.info).burst(burst.raw, 25.0)
    rays = burst.info.camera.unproject(np.ones((240, 320)))
    range_ = found.depth * np.linalg.norm(rays, axis=-1)
    good = np.isfinite(range_)
    assert good.mean() > 0.95
    assert np.median(np.abs(range_ - WALL)[good]) < 0.01
    assert emulator.log.count(7) == 6  # a request for each image


def test_a_frequency_between_the_calibrated_ones(camera):
    """Flexible modulation is used for any other frequency."""
    with camera() as emulator, driver(mhz=[20.0]) as tof:
        burst = tof.capture(1)
        assert emulator.mhz == 20.0
    assert burst.info.modulation_hz == (20e6,) * 4


def test_the_contract_holds(camera):
    """The conformance suite passes with the real client."""
    with camera():
        check_tof(driver)
    assert registry.load_driver("espros").keys() == {"tof"}


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("mute", "setting it up|connecting"),
        ("no data", "Failed to receive image data"),
        ("unplugged", "taking a frame"),
        ("binned", "four images of 240 x 320"),
        ("stolen", "exposure of 400 us"),
    ],
)
def test_faults_have_names_in_time(camera, fault, words):
    """A camera that says nothing, sends nothing, is unplugged in mid-burst or changed by another ends in a named error in 15 s."""
    begun = time.monotonic()
    with camera(fault=fault, after=3), pytest.raises(DeviceError, match=words), driver() as tof:
        tof.capture(10)
    assert time.monotonic() - begun < SOON


def test_absent_or_another_camera(camera):
    """Nobody at the address, and another camera there, are told apart; after a cut cable the next burst comes."""
    begun = time.monotonic()
    with camera() as gone:
        pass
    with pytest.raises(DeviceError, match="No camera found"), driver():
        pass
    assert time.monotonic() - begun < SOON
    assert gone.images == 0
    with camera(chip=(7, 99)), pytest.raises(DeviceError, match="it is 7-99"), driver():
        pass
    with camera() as emulator, driver() as tof:
        tof.capture(1)
        emulator.unplug()
        with pytest.raises(DeviceError, match="taking a frame"):
            tof.capture(1)
        assert len(tof.capture(1).raw) == 1


@pytest.mark.parametrize(
    "table", [{"mhz": []}, {"mhz": [30.0]}, {"mhz": [6, 6]}, {"mhz": "24"}, {"speed": 1}]
)
def test_wrong_settings_are_refused(table):
    """Frequencies that the chip cannot make are refused before anything opens."""
    with pytest.raises(ConfigError):
        driver(**table)
    with pytest.raises(ConfigError, match="expected serial"):
        Espros({k: v for k, v in TABLE.items() if k != "serial"}, StationContext({}, Path()))


def test_a_recording_is_made_and_checks(camera, monkeypatch, tmp_path):
    """From the emulated camera to a recording that ``check`` passes."""
    range_ = 1.5 * np.linalg.norm(CAMERA_.unproject(np.ones(CAMERA_.shape)), axis=-1)
    with camera(range_m=range_):
        view = recorded(monkeypatch, tmp_path, CAMERA_, TABLE, tof=Espros)
    assert view.tof.info.modulation_hz == (24e6,) * 4 + (6e6,) * 4
    assert view.provenance["quality"]["misread"] == 0
    assert view.provenance["arm"]["model"] == "tripod"
