"""The driver genicam: the real Aravis library and its own fake camera, which is told the features of a 3-D camera."""

import struct
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE
from tests.still_station import recorded
from tests.test_arducam_driver import SMALL, frames, table, wall
from tofcapture.camera import Camera
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.stereo.genicam import GenICam, points_of
from tofcapture.devices.tof.arducam import ArducamTof
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.testing import check_stereo

SOON = 15.0 + PATIENCE
pytestmark = pytest.mark.filterwarnings("ignore::ImportWarning")  # of PyGObject
SCALE, OFFSET = 0.01, 1000.0  # mm a count, mm
FEATURES = f"""
<Float Name="Scan3dFocalLength"><Value>560.0</Value></Float>
<Float Name="Scan3dPrincipalPointU"><Value>255.5</Value></Float>
<Float Name="Scan3dPrincipalPointV"><Value>250.0</Value></Float>
<Float Name="Scan3dCoordinateScale"><Value>{SCALE}</Value></Float>
<Float Name="Scan3dCoordinateOffset"><Value>{OFFSET}</Value></Float>
<Float Name="Scan3dInvalidDataValue"><Value>0.0</Value></Float>
<Integer Name="LaserPower"><Value>7</Value></Integer>
</RegisterDescription>"""


def aravis():
    """Load the library that Debian has, or skip."""
    gi = pytest.importorskip("gi", reason="PyGObject is not installed: see docs/devices.md")
    try:
        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as err:
        pytest.skip(f"Aravis is not installed: {err}")
    return Aravis


@pytest.fixture(scope="module")
def fake(tmp_path_factory):
    """Aravis whose fake camera calls its 16-bit image a range image, and has a scale, intrinsics and a projector."""
    library = aravis()
    library.enable_interface("Fake")
    library.update_device_list()
    xml = library.Camera.new("Fake_1").get_device().get_genicam_xml()[0]
    xml = xml.replace('Name="Mono16"', 'Name="Coord3D_C16"').replace("</RegisterDescription>", FEATURES)
    file = tmp_path_factory.mktemp("aravis") / "camera.xml"
    file.write_text(xml)
    library.set_fake_camera_genicam_filename(str(file))
    return library


def driver(folder, **more):
    settings = {"device": "Fake_1", "pixels": "Coord3D_C16", "timeout": 2.0, **more}
    return GenICam(settings, StationContext({}, Path(folder)))


def test_range_images_become_points(fake, tmp_path):
    """Scale, offset, missing pixels and intrinsics are the camera's own; its projector is lit for its exposure only."""
    power, lit = [], {"lit": {"LaserPower": 9}, "dark": {"LaserPower": 0}}
    with driver(tmp_path, exposure=5e-3, **lit) as stereo:
        assert stereo._camera.get_integer("LaserPower") == 0
        assert stereo._camera.get_exposure_time() == 5000
        acquire = stereo._camera.acquisition

        def spied(timeout):
            power.append(stereo._camera.get_integer("LaserPower"))
            return acquire(timeout)

        class Spy:
            def __getattr__(self, name):
                return spied if name == "acquisition" else getattr(real, name)

        real, stereo._camera = stereo._camera, Spy()
        frame = stereo.capture()
        assert power == [9]
        assert real.get_integer("LaserPower") == 0
    z = frame.points[..., 2]
    counts = (z * 1e3 - OFFSET) / SCALE
    good = np.isfinite(z)
    assert 0 < np.isnan(z).sum() < z.size / 10  # counts of 0
    np.testing.assert_allclose(counts[good], np.rint(counts[good]), atol=0.05)
    v, u = np.argwhere(good)[1234]
    np.testing.assert_allclose(frame.points[v, u, 0], z[v, u] * (u - 255.5) / 560, atol=1e-6)
    np.testing.assert_allclose(frame.points[v, u, 1], z[v, u] * (v - 250.0) / 560, atol=1e-6)
    assert driver(tmp_path).describe().model == "Fake"  # without opening, from the file
    assert registry.load_driver("genicam").keys() == {"stereo"}


def test_the_contract_holds_and_a_recording_checks(fake, tmp_path, monkeypatch):
    """The conformance suite passes with the real library, and ``check`` passes what is recorded."""
    with driver(tmp_path):
        pass  # it says once what it is
    check_stereo(lambda: driver(tmp_path))

    class Calm(GenICam):
        """Its fake image runs on from frame to frame: here by less than a tripod may tremble."""

        def connect(self, stack):
            super().connect(stack)
            self._scale = self._scale * 1e-3

    (tmp_path / "frames.raw").write_bytes(frames("b0410", wall("b0410", 1.3), 4))
    stereo = {"device": "Fake_1", "pixels": "Coord3D_C16"}
    tof = table("b0410", tmp_path / "frames.raw")
    view = recorded(monkeypatch, tmp_path, SMALL, tof, stereo, stereo=Calm, tof=ArducamTof)
    assert view.stereo.info.camera.fx == 560.0
    assert np.isfinite(view.stereo.points).any()


@pytest.mark.parametrize(
    ("number", "kind", "whole"), [(0x026000C0, "f", True), (0x023000B9, "H", True), (0x012000BF, "f", False)]
)
def test_formats_of_the_standard(number, kind, whole):
    """Clouds of floats and of counts, and range of floats, become metres; what is marked, or no number, is NaN."""
    camera, none = Camera(2, 2, 2.0, 2.0, 0.5, 0.5), 0.0
    z = [1500.0, 0.0, 1600.0, 1700.0]
    rows = [(300.0, 200.0, d) if whole else (d,) for d in z]
    data = b"".join(struct.pack(f"<{len(r)}{kind}", *(int(x) if kind == "H" else x for x in r)) for r in rows)
    points = points_of(data, number, camera, np.full(3, 1e-3), np.zeros(3), none)
    assert points.dtype == np.float32
    assert np.isnan(points[0, 1]).all()
    first = [0.3, 0.2, 1.5] if whole else [1.5 * -0.5 / 2, 1.5 * -0.5 / 2, 1.5]
    np.testing.assert_allclose(points[0, 0], first, rtol=1e-6)


def test_faults_have_names_in_time(fake, tmp_path):
    """Absent, another format, an unknown feature, another region, calibrated anew, no frame: each a named error within 15 s."""
    begun = time.monotonic()
    with (
        pytest.raises(DeviceError, match=r"no GenICam camera Acme-1; there are: .*Fake_1"),
        driver(tmp_path, device="Acme-1"),
    ):
        pass
    with (
        driver(tmp_path, pixels="RGB8") as stereo,
        pytest.raises(DeviceError, match="the frame holds 0x2180014"),
    ):
        stereo.capture()
    with pytest.raises(DeviceError, match="opening Fake_1"), driver(tmp_path, dark={"NoSuchFeature": 1}):
        pass
    with driver(tmp_path) as stereo:
        stereo._camera.set_region(0, 0, 256, 256)
        with pytest.raises(DeviceError, match=r"the frame is \(256, 256\)"):
            stereo.capture()
    with driver(tmp_path, timeout=1.0) as stereo:
        stereo._camera.set_frame_rate(0.2)  # too slow for the time that it has
        with pytest.raises(DeviceError, match="no frame within 1 s"):
            stereo.capture()
    file = tmp_path / "genicam-Fake_1.toml"
    file.write_text(file.read_text().replace("fx = 560.0", "fx = 555.0"))
    with pytest.raises(DeviceError, match="calibration is not the one"), driver(tmp_path):
        pass
    assert time.monotonic() - begun < SOON


def test_unplugged_in_a_burst(fake, tmp_path):
    """A camera of GigE Vision on loopback that goes away between frames is named within 15 s."""
    camera = {"width": 512, "height": 512, "fx": 560.0, "fy": 560.0, "cx": 255.5, "cy": 255.5}
    with subprocess.Popen(
        ["arv-fake-gv-camera-0.8", "-i", "127.0.0.1"], stdout=subprocess.DEVNULL
    ) as process:
        try:
            time.sleep(1.0)
            with driver(tmp_path, device="127.0.0.1", pixels="Mono16", camera=camera) as stereo:
                stereo.capture()
                process.kill()
                begun = time.monotonic()
                with pytest.raises(DeviceError, match=r"127.0.0.1"):
                    stereo.capture()
                assert time.monotonic() - begun < SOON
        finally:
            process.kill()


@pytest.mark.parametrize("wrong", [{"device": 7}, {"lit": 5}, {"gain": 2}])
def test_wrong_settings_are_refused(wrong, tmp_path):
    """What no camera has is refused before anything opens."""
    with pytest.raises(ConfigError):
        driver(tmp_path, **wrong)
    with pytest.raises(ConfigError, match="has not said"):
        driver(tmp_path).describe()
