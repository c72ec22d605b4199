"""The driver arducam over files and pipes that hold frames as the modules write them."""

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE
from tests.still_station import recorded
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.tof.arducam import ArducamTof
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.files.camera_bytes import ARDUCAM, unpack_y12p, with_sign
from tofcapture.ops.phase import Decoder
from tofcapture.testing import check_tof

SMALL = Camera(240, 180, 190.0, 190.0, 119.5, 89.5)
LARGE = Camera(640, 480, 560.0, 560.0, 319.5, 239.5)
SOON = 15.0 + PATIENCE


def camera_of(mode):
    return SMALL if "b0410" in mode else LARGE


def table(mode, path):
    camera = camera_of(mode)
    numbers = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    return {"mode": mode, "device": str(path), "serial": "A1", "exposure": 4e-4, "camera": numbers}


def driver(mode, path):
    return ArducamTof(table(mode, path), StationContext({}, Path()))


def packed(values):
    """Y12P of values (..., 2 N): written from the layout's words, not from our reader."""
    v = (values.astype(np.int32) & 0x7FF).astype(np.uint32).reshape(-1, 2)
    return (
        np.stack([v[:, 0] >> 4, v[:, 1] >> 4, (v[:, 1] & 15) << 4 | v[:, 0] & 15], axis=1)
        .astype(np.uint8)
        .tobytes()
    )


def frames(mode, range_, count, seed=0):
    """Bytes of ``count`` frames of ours, of surfaces at a range (H, W), metres."""
    layout, rng = ARDUCAM[mode], np.random.default_rng(seed)
    out = []
    for _ in range(count):
        hz, phases = np.array(layout.modulation_hz), np.array(layout.phase_rad)
        phi = 4 * np.pi * hz[:, None, None] * range_ / SPEED_OF_LIGHT
        taps = np.rint(700 * np.cos(phi + phases[:, None, None]) + rng.normal(0, 3, phi.shape))
        for taken in np.split(taps, layout.frames):
            rows = np.full(
                (layout.rows, layout.width), 123.0
            )  # what lies between the images is not looked at
            for start, image in zip(layout.starts, taken, strict=True):
                rows[start : start + layout.height] = image
            out.append(packed(rows))
    return b"".join(out)


def wall(mode, depth=1.2):
    camera = camera_of(mode)
    return depth * np.linalg.norm(camera.unproject(np.ones(camera.shape)), axis=-1)


def test_twelve_bits_and_signs():
    """Two pixels in three bytes, and the low eleven bits of each as a signed number."""
    assert unpack_y12p(bytes([0xAB, 0xCD, 0xFE])).tolist() == [0xABE, 0xCDF]
    values = np.arange(-1024, 1024, dtype=np.int16)
    assert (with_sign(unpack_y12p(packed(values)), 11) == values).all()


@pytest.mark.parametrize("mode", ARDUCAM)
def test_every_mode_gives_the_range(mode, tmp_path):
    """Frames in the written layout decode to the range that they were made of."""
    path = tmp_path / "frames.raw"
    range_ = wall(mode)
    path.write_bytes(frames(mode, range_, 2))
    with driver(mode, path) as tof:
        burst = tof.capture(2)
    assert burst.raw.dtype == np.int16
    depth = Decoder(burst.info).burst(burst.raw, 25.0).depth
    assert np.nanmedian(np.abs(depth - 1.2)) < 0.005
    assert np.isfinite(depth).mean() > 0.95
    assert registry.load_driver("arducam").keys() == {"tof"}


def test_rows_with_padding_are_read(tmp_path):
    """A driver of the kernel may pad rows; what lies there is no pixel."""
    layout = ARDUCAM["b0410"]
    data = np.frombuffer(frames("b0410", wall("b0410"), 1)[: layout.size], np.uint8).reshape(180, 360)
    wide = np.pad(data, ((0, 0), (0, 24)), constant_values=255).tobytes()
    assert (layout.images(wide) == layout.images(data.tobytes())).all()


def test_the_contract_holds(tmp_path):
    """The conformance suite passes on a file that does not end too soon."""
    path = tmp_path / "frames.raw"
    path.write_bytes(frames("b0410", wall("b0410"), 8))
    check_tof(lambda: driver("b0410", path), frames=2)


def test_a_recording_is_made_and_checks(monkeypatch, tmp_path):
    """From a file of frames to a recording that ``check`` passes."""
    path = tmp_path / "frames.raw"
    path.write_bytes(frames("b0548-double", wall("b0548-double", 1.5), 4))
    view = recorded(monkeypatch, tmp_path, LARGE, table("b0548-double", path), tof=ArducamTof)
    assert view.tof.info.modulation_hz == (90e6,) * 4 + (15e6,) * 4
    assert view.provenance["quality"]["misread"] == 0


def test_faults_have_names_in_time(tmp_path):
    """Absent, unplugged in mid-burst, silent and of another mode: each a named error within 15 s."""
    pytest.importorskip("linuxpy", reason="linuxpy is not installed: pip install 'tofcapture[v4l2]'")
    begun, path = time.monotonic(), tmp_path / "frames.raw"
    with pytest.raises(DeviceError, match="no /dev/video97"), driver("b0410", "/dev/video97"):
        pass
    whole = frames("b0410", wall("b0410"), 3)
    path.write_bytes(whole[:-1000])
    with driver("b0410", path) as tof, pytest.raises(DeviceError, match="ended after"):
        tof.capture(3)
    with driver("b0548", path) as tof, pytest.raises(DeviceError, match="ended after"):
        tof.capture(1)
    with (
        pytest.raises(DeviceError, match="no frame for 5 s"),
        driver("b0410", _pipe(tmp_path, whole[:70000])) as tof,
    ):
        tof.capture(3)
    with pytest.raises(DeviceError, match="/dev/null"), driver("b0410", "/dev/null") as tof:
        tof.capture(1)
    assert time.monotonic() - begun < SOON


def _pipe(folder, data):
    """A camera that hangs after some bytes: a pipe that stays open."""
    path = folder / "pipe"
    os.mkfifo(path)

    def write():
        with path.open("wb") as pipe:
            pipe.write(data)
            pipe.flush()
            time.sleep(8)

    threading.Thread(target=write, daemon=True).start()
    return path


def test_a_dropped_frame_breaks_no_burst(monkeypatch, tmp_path):
    """A frame that the kernel dropped costs the four that it belongs to, not the order of the phases."""
    path = tmp_path / "frames.raw"
    path.write_bytes(frames("b0410", wall("b0410"), 3))
    with driver("b0410", path) as tof:
        own = tof._next
        numbers = iter([0, 1, 3, 4, 5, 6, 7, 8])
        monkeypatch.setattr(tof, "_next", lambda: (next(numbers), own()[1]))
        burst = tof.capture(1)
        assert next(numbers) == 8
    assert burst.raw.shape == (1, 4, 180, 240)


@pytest.mark.parametrize("change", [{"mode": "b0999"}, {"camera": {"width": 24}}, {"connection": "usb"}])
def test_wrong_settings_are_refused(change):
    """Another mode, another size of the image, and settings of the vendor's package are refused at once."""
    with pytest.raises(ConfigError):
        ArducamTof({**table("b0410", "x"), **change}, StationContext({}, Path()))
