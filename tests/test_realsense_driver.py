"""The driver realsense: the real library over its own software device."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE
from tests.still_station import recorded
from tests.test_arducam_driver import SMALL, frames, table, wall
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.stereo import realsense
from tofcapture.devices.stereo.realsense import RealSense
from tofcapture.devices.tof.arducam import ArducamTof
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.testing import check_stereo

rs = pytest.importorskip(
    "pyrealsense2", reason="pyrealsense2 is not installed: pip install --group device-tests"
)
SOON = 15.0 + PATIENCE
W, H, UNIT = 320, 240, 0.0001


class Emulated:
    """A D435 that sees a wall, as a software device of the library; in the dark without its projector."""

    def __init__(self, serial="8196"):
        self.device, self.lit, self._end = rs.software_device(), [], threading.Event()
        self.silent = self.unplugged = False
        self.device.register_info(rs.camera_info.name, "RealSense D435")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.sensor = self.device.add_sensor("Stereo Module")
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = W, H, 250.0, 255.0, 159.5, 119.5
        lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
        video = rs.video_stream()
        video.type, video.index, video.uid, video.width, video.height = rs.stream.depth, 0, 1, W, H
        video.fps, video.bpp, video.fmt, video.intrinsics = 30, 2, rs.format.z16, lens
        self.profile = self.sensor.add_video_stream(video)
        self.sensor.add_read_only_option(rs.option.depth_units, UNIT)
        self.sensor.add_option(rs.option.emitter_enabled, rs.option_range(0, 1, 0, 1), True)
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        number = 0
        while not self._end.wait(1 / 60):
            if self.silent:
                continue
            number += 1
            lit = self.sensor.get_option(rs.option.emitter_enabled) == 1.0
            self.lit.append(lit)
            frame = rs.software_video_frame()
            pixels = np.full((H, W), round(1.5 / UNIT) if lit else 0, np.uint16)
            pixels[0] = 0
            frame.pixels, frame.stride, frame.bpp = pixels, 2 * W, 2
            frame.timestamp, frame.domain, frame.frame_number = (
                number * 16.0,
                rs.timestamp_domain.system_time,
                number,
            )
            frame.profile, frame.depth_units = self.profile.as_video_stream_profile(), UNIT
            try:
                self.sensor.on_video_frame(frame)
            except RuntimeError:
                continue  # nobody listens

    def close(self):
        self._end.set()


@pytest.fixture
def camera(monkeypatch):
    """Have the library find one emulated camera while it is plugged in; its software devices are in no list of USB devices."""
    emulated = Emulated()

    class Context:
        def query_devices(self):
            return [] if emulated.unplugged else [emulated.device]

    monkeypatch.setattr(rs, "context", Context)
    yield emulated
    emulated.close()


def driver(folder, **table):
    settings = {"serial": "8196", "size": [W, H], "fps": 30, "timeout": 1.0, **table}
    return RealSense(settings, StationContext({}, Path(folder)))


def test_points_scale_and_missing(camera, tmp_path):
    """Depth units, intrinsics and missing pixels are the camera's; the projector is lit for the exposure only."""
    with driver(tmp_path) as stereo:
        frame = stereo.capture()
        assert camera.sensor.get_option(rs.option.emitter_enabled) == 0.0
    assert np.isnan(frame.points[0]).all()
    np.testing.assert_allclose(frame.points[1:, :, 2], 1.5, atol=1e-6)
    np.testing.assert_allclose(
        frame.points[10, 20], [1.5 * (20 - 159.5) / 250, 1.5 * (10 - 119.5) / 255, 1.5], atol=1e-6
    )
    assert driver(tmp_path).describe().model == "RealSense D435"  # without opening, from the file
    assert registry.load_driver("realsense").keys() == {"stereo"}


def test_the_contract_holds(camera, tmp_path):
    """The conformance suite passes with the real library."""
    with driver(tmp_path):
        pass  # it says once what it is
    check_stereo(lambda: driver(tmp_path))


def test_a_recording_is_made_and_checks(camera, monkeypatch, tmp_path):
    """From the library's software device to a recording that ``check`` passes."""
    with driver(tmp_path):
        pass
    (tmp_path / "frames.raw").write_bytes(frames("b0410", wall("b0410", 1.5), 4))
    stereo, tof = {"serial": "8196", "size": [W, H], "fps": 30}, table("b0410", tmp_path / "frames.raw")
    view = recorded(monkeypatch, tmp_path, SMALL, tof, stereo, stereo=RealSense, tof=ArducamTof)
    assert view.stereo.info.camera.fx == 250.0
    np.testing.assert_allclose(np.nanmedian(view.stereo.points[..., 2]), 1.5, atol=1e-4)


def write_bag(path, camera):
    """Record a second of an emulated camera's wall to a file, by the library."""
    camera.sensor.set_option(rs.option.emitter_enabled, 1.0)
    recorder = rs.recorder(str(path), camera.device)
    sensor, queue = recorder.query_sensors()[0], rs.frame_queue(9)
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(queue)
    for _ in range(30):
        queue.wait_for_frame(5000)
    sensor.stop()
    sensor.close()


def test_a_bag_is_played(camera, monkeypatch, tmp_path):
    """What the library recorded to a bag comes out of it again."""
    write_bag(tmp_path / "wall.db3", camera)
    monkeypatch.undo()  # the library's own context
    with driver(tmp_path, bag="wall.db3", settle=1) as stereo:
        frame = stereo.capture()
    np.testing.assert_allclose(np.nanmedian(frame.points[..., 2]), 1.5, atol=1e-4)


def test_faults_have_names_in_time(camera, tmp_path):
    """Absent, another mode, silent, unplugged between frames, calibrated anew: each a named error within 15 s."""
    begun = time.monotonic()
    with (
        pytest.raises(DeviceError, match="no RealSense camera 77; there are: 8196"),
        driver(tmp_path, serial="77"),
    ):
        pass
    with pytest.raises(DeviceError, match="320 x 240 at 30"), driver(tmp_path, size=[848, 480]):
        pass
    with driver(tmp_path) as stereo:
        stereo.capture()
        camera.silent = True
        with pytest.raises(DeviceError, match="capturing with 8196"):
            stereo.capture()
        camera.silent = False
        assert np.isfinite(stereo.capture().points).any()
        camera.silent = camera.unplugged = True
        with pytest.raises(DeviceError, match="capturing with 8196"):
            stereo.capture()
        with pytest.raises(DeviceError, match="no RealSense camera 8196; there are: none"):
            stereo.capture()
        camera.silent = camera.unplugged = False
        assert np.isfinite(stereo.capture().points).any()
    file = tmp_path / "realsense-8196.toml"
    file.write_text(file.read_text().replace("fx = 250.0", "fx = 255.0"))
    with pytest.raises(DeviceError, match="calibration is not the one"), driver(tmp_path):
        pass
    with pytest.raises(DeviceError, match="no bag"), driver(tmp_path, bag="none.bag"):
        pass
    assert time.monotonic() - begun < SOON


@pytest.mark.parametrize("table", [{"serial": 8196}, {"speed": 1}])
def test_wrong_settings_are_refused(table, tmp_path):
    """What no camera has is refused before anything opens."""
    with pytest.raises(ConfigError):
        driver(tmp_path, **table)
    with pytest.raises(ConfigError, match="has not said"):
        driver(tmp_path).describe()
    assert realsense.DRIVERS.keys() == {"stereo"}
