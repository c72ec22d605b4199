"""The driver arducam over a module of the SDK's shape."""

import enum
import sys
import time
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.tof.arducam import Arducam
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.testing import check_tof

CAMERA = {"width": 24, "height": 18, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 8.5}
TABLE = {"serial": "A1", "camera": CAMERA, "modulation_hz": [37.5e6] * 4, "phase_rad": [0.0, 1.57, 3.14, 4.71],
         "exposure": 4e-4}  # fmt: skip


class Code(enum.IntEnum):
    """Stands for TofErrorCode."""

    ArducamSuccess = 0
    ArducamNoPermission = 5


class FakeSdk(ModuleType):
    """``ArducamDepthCamera`` with the calls that its published examples make; ``frames`` are what it serves."""

    Connection = SimpleNamespace(CSI="csi", USB="usb")
    FrameType = SimpleNamespace(RAW="raw", DEPTH="depth")

    def __init__(self):
        super().__init__("ArducamDepthCamera")
        self.log, self.frames, self.refuse, self.lent = [], [], None, []
        self.ArducamCamera = lambda: self

    def open(self, mode, index=0):
        self.log.append(("open", mode, index))
        return Code.ArducamNoPermission if self.refuse == "open" else Code.ArducamSuccess

    def start(self, kind):
        self.log.append(("start", kind))
        return Code.ArducamNoPermission if self.refuse == "start" else Code.ArducamSuccess

    def requestFrame(self, timeout):
        frame = self.frames.pop(0) if self.frames else None
        if frame is not None:
            self.lent.append(frame)
        return frame

    def releaseFrame(self, frame):
        self.lent.remove(frame)
        if hasattr(frame, "raw_data"):
            frame.raw_data[:] = -1  # the SDK uses the memory again
        return Code.ArducamSuccess

    def stop(self):
        self.log.append("stop")
        return Code.ArducamSuccess

    def close(self):
        self.log.append("close")
        return Code.ArducamSuccess


@pytest.fixture
def sdk(monkeypatch):
    """Install the fake SDK."""
    fake = FakeSdk()
    monkeypatch.setitem(sys.modules, "ArducamDepthCamera", fake)
    return fake


def device(**table):
    return Arducam({**TABLE, **table}, StationContext({}, None))


def raw(value, shape=(72, 24)):
    return SimpleNamespace(raw_data=np.full(shape, value, dtype=np.int16))


def test_registered_under_its_name():
    """The registry finds the driver without the SDK."""
    assert registry.load_driver("arducam").keys() == {"tof"}


def test_burst_of_phase_images(sdk):
    """New frames become a burst; the frame that was waiting is not in it, every frame is given back, its memory copied."""
    stacked = SimpleNamespace(
        raw_data=np.repeat(np.arange(4, dtype=np.int16) * 100, 18)[:, None] + np.zeros((1, 24), np.int16)
    )
    sdk.frames = [raw(1), stacked, None, raw(7)]
    with device(connection="usb", index=2) as tof:
        start = time.monotonic_ns()
        burst = tof.capture(2)
    assert burst.raw.shape == (2, 4, 18, 24)
    assert burst.raw.dtype == np.uint16
    assert burst.raw[0, :, 0, 0].tolist() == [0, 100, 200, 300]
    assert (burst.raw[1] == 7).all()
    assert np.isnan(burst.celsius).all()
    assert start < burst.time_ns[0] <= burst.time_ns[1]
    assert sdk.lent == []
    assert sdk.log == [("open", "usb", 2), ("start", "raw"), "stop", "close"]


@pytest.mark.parametrize(
    ("value", "shape"), [(1, (18, 24)), (1, (144, 24)), (1, (72, 30)), (-5, (72, 24)), (5000, (72, 24))]
)
def test_raw_output_of_another_shape_is_refused(sdk, value, shape):
    """RAW frames that are no stack of the described phase images, or no 12-bit values, are refused, and the camera closed."""
    sdk.frames = [raw(value, shape)]
    with device() as tof, pytest.raises(DeviceError, match=r"phase images|12-bit"):
        tof.capture(1)
    assert sdk.lent == []
    assert sdk.log[-2:] == ["stop", "close"]


def test_depth_is_refused(sdk):
    """Depth that the SDK computed is not raw data, and is said not to be."""
    sdk.frames = [SimpleNamespace(depth_data=np.zeros((18, 24)))]
    with device() as tof, pytest.raises(DeviceError, match="depth that the SDK computed"):
        tof.capture(1)


def test_no_frames_then_again(sdk):
    """Frames that do not come are an error; the next capture opens the camera anew."""
    with device() as tof:
        with pytest.raises(DeviceError, match="no frame in 10 s"):
            tof.capture(1)
        sdk.frames = [raw(1), raw(2)]
        assert (tof.capture(1).raw == 2).all()
        with pytest.raises(ConfigError, match="at least 1"):
            tof.capture(0)
    tof.close()
    assert sum(entry[0] == "open" for entry in sdk.log) == 2


@pytest.mark.parametrize(
    ("step", "end"),
    [("open", [("open", "csi", 0)]), ("start", [("open", "csi", 0), ("start", "raw"), "close"])],
)
def test_codes_become_errors(sdk, step, end):
    """A code other than success is an error with its name; what was opened is closed."""
    sdk.refuse = step
    with pytest.raises(DeviceError, match=f"{step}.*ArducamNoPermission"):
        device().__enter__()
    assert sdk.log == end


def test_sdk_missing_names_what_to_install(monkeypatch):
    """Without the SDK, describing works and opening says what to install."""
    monkeypatch.setitem(sys.modules, "ArducamDepthCamera", None)
    assert device().describe().camera.shape == (18, 24)
    with pytest.raises(ConfigError, match="needs the Python package") as caught:
        device().__enter__()
    assert "pip install ArducamDepthCamera" in caught.value.hint


def test_wrong_tables():
    """What the SDK cannot say must stand in the table; what makes no sense is refused."""
    with pytest.raises(ConfigError, match="missing: camera"):
        Arducam({k: v for k, v in TABLE.items() if k != "camera"}, StationContext({}, None))
    for table, match in (
        ({"phases": 4}, "unknown: phases"),
        ({"connection": "wifi"}, "csi"),
        ({"phase_rad": [0.0]}, "expected a phase for each of 4 channels"),
    ):
        with pytest.raises(ConfigError, match=match):
            device(**table)


def test_keeps_the_contract(sdk):
    """The driver passes the conformance suite of ToF cameras."""
    sdk.frames = [raw(i) for i in range(40)]
    check_tof(device)
