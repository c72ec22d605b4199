"""The driver femto over files and pipes that hold pictures as the vendor's code describes them; no camera was seen."""

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE
from tests.still_station import recorded
from tests.test_importing_vendors import femto_picture
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.tof.femto import FemtoTof
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.files.camera_bytes import FEMTO
from tofcapture.ops.phase import Decoder
from tofcapture.testing import check_tof

CAMERAS = {
    "narrow": Camera(640, 576, 504.0, 504.0, 319.5, 287.5),
    "wide": Camera(512, 512, 252.0, 252.0, 255.5, 255.5),
}
MHZ = [197.0, 192.0, 54.0]
SOON = 15.0 + PATIENCE


def table(mode, path):
    camera = CAMERAS[mode]
    numbers = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    return {
        "mode": mode,
        "device": str(path),
        "serial": "F1",
        "exposure": 12.8e-3,
        "mhz": MHZ,
        "camera": numbers,
    }


def driver(named, path, **change):
    return FemtoTof({**table(named, path), **change}, StationContext({}, Path()))


def pictures(mode, count, depth=1.2, **how):
    """Bytes of ``count`` pictures of a wall."""
    camera, rng = CAMERAS[mode], np.random.default_rng(0)
    range_ = depth * np.linalg.norm(camera.unproject(np.ones(camera.shape)), axis=-1)
    phi = 4 * np.pi * 1e6 * np.repeat(MHZ, 3)[:, None, None] * range_ / SPEED_OF_LIGHT
    phi += np.tile(np.arange(3) * 2 * np.pi / 3, 3)[:, None, None]
    taps = [2000 * np.cos(phi) + rng.normal(0, 3, phi.shape) for _ in range(count)]
    size = FEMTO[mode].size
    return b"".join(femto_picture(np.rint(t).astype(int), MHZ, **how).ljust(size, b"\0")[:size] for t in taps)


@pytest.mark.parametrize(("mode", "each"), [("narrow", True), ("wide", True), ("wide", False)])
def test_pictures_give_the_range(mode, each, tmp_path):
    """Nine images, each after a header or all after one, decode to the range that they were made of; the laser's warmth is told."""
    path = tmp_path / "pictures.raw"
    path.write_bytes(pictures(mode, 1, each=each, padded=each))
    with driver(mode, path) as tof:
        burst = tof.capture(1)
    assert burst.raw.dtype == np.int16
    assert burst.celsius == pytest.approx(41.5)
    depth = Decoder(burst.info).burst(burst.raw, 25.0).depth
    assert np.nanmedian(np.abs(depth - 1.2)) < 0.005
    assert np.isfinite(depth).mean() > 0.95
    assert registry.load_driver("femto").keys() == {"tof"}


def test_a_recording_is_made_and_checks(monkeypatch, tmp_path):
    """From a file of pictures through the conformance suite to a recording that ``check`` passes."""
    path = tmp_path / "pictures.raw"
    path.write_bytes(pictures("wide", 4, 1.5))
    check_tof(lambda: driver("wide", path), frames=1)
    view = recorded(monkeypatch, tmp_path, CAMERAS["wide"], table("wide", path), tof=FemtoTof)
    assert view.tof.info.modulation_hz == tuple(np.repeat(MHZ, 3) * 1e6)
    assert view.provenance["quality"]["misread"] == 0


def test_faults_have_names_in_time(tmp_path):
    """Absent, unplugged in mid-burst, silent, in another mode, of other channels: each a named error within 15 s."""
    begun, path = time.monotonic(), tmp_path / "pictures.raw"
    with pytest.raises(DeviceError, match="no /dev/video97"), driver("wide", "/dev/video97"):
        pass
    path.write_bytes(pictures("wide", 1) + b"Y1" * 1000)
    with driver("wide", path) as tof, pytest.raises(DeviceError, match="ended after 2000"):
        tof.capture(3)
    path.write_bytes(pictures("narrow", 1))
    with driver("wide", path) as tof, pytest.raises(DeviceError, match=r"says 9 of \(576, 640\)"):
        tof.capture(1)
    path.write_bytes(pictures("wide", 1))
    with (
        driver("wide", path, mhz=[198, 189, 54]) as tof,
        pytest.raises(DeviceError, match=r"197.00 MHz at 0 deg"),
    ):
        tof.capture(1)
    pipe, done = tmp_path / "pipe", threading.Event()
    os.mkfifo(pipe)

    def hang():
        with pipe.open("wb") as end:
            end.write(b"Y1" * 1000)
            end.flush()
            done.wait(30)

    threading.Thread(target=hang, daemon=True).start()
    with pytest.raises(DeviceError, match="no frame for 5 s"), driver("wide", pipe) as tof:
        tof.capture(1)
    done.set()
    assert time.monotonic() - begun < SOON


@pytest.mark.parametrize(
    "change", [{"mode": "mega"}, {"mhz": [197, 54]}, {"camera": {"width": 24}}, {"gain": 2}]
)
def test_wrong_settings_are_refused(change):
    """Another mode, two frequencies, another size and a setting that nobody has are refused before anything opens."""
    with pytest.raises(ConfigError):
        driver("wide", "x", **change)
