"""Whole stations by the command as a person types it: registered drivers in processes of their own, real client libraries, a tripod."""

import os
import pty
import subprocess
import sys

import numpy as np
import pytest
import tomli_w

from tests import test_arducam_driver, test_femto_driver, test_genicam_driver
from tests.espros_emulator import Emulator
from tests.still_station import CAMERA
from tofcapture.camera import Camera
from tofcapture.files.check import check
from tofcapture.files.view import find_views, open_view
from tofcapture.rig import Rig, dumps_rig

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ImportWarning")]
LACKING = "its client is not installed: pip install --group device-tests"
FAKE = Camera(512, 512, 560.0, 560.0, 255.5, 250.0)


def numbers(camera):
    return {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}


def recorded(folder, tof, tof_camera, stereo=None, eyes=FAKE):
    """Record a view, ``check`` it, return it. Without another stereo camera it is Aravis' fake one, whose image never stands still."""
    if stereo is None:
        test_genicam_driver.aravis()
        # A millimetre a count: this exposure leaves 1.4 m of its ramp.
        stereo = {"driver": "genicam", "device": "Fake_1", "pixels": "Mono16", "exposure": 1.1e-3}
        stereo["camera"] = numbers(eyes)
    tables = {
        "arm": {"driver": "tripod", "hold": 0.1, "still": 1e3},
        "operator": {"driver": "console"},
        "tof": tof,
        "stereo": stereo,
        "rig": {"path": "rig.toml"},
    }
    (folder / "station.toml").write_text(tomli_w.dumps(tables))
    (folder / "rig.toml").write_text(dumps_rig(Rig(tof_camera, eyes, np.eye(4), np.eye(4))))
    command = "record --scene wall --views 1 --frames 2 --station station.toml --out rec"
    person, keyboard = pty.openpty()
    os.write(person, b"\n" * 5)
    for words in (command, "check rec"):
        done = subprocess.run(
            [sys.executable, "-m", "tofcapture", *words.split()],
            cwd=folder,
            stdin=keyboard,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    os.close(person)
    os.close(keyboard)
    [path] = find_views(folder / "rec")["wall"]
    assert list(check(path)) == []
    return open_view(path)


def test_arducam(tmp_path):
    """Frames of a file, as V4L2 would give them."""
    make, file = test_arducam_driver, tmp_path / "frames.raw"
    file.write_bytes(make.frames("b0410", make.wall("b0410", 1.3), 9))
    view = recorded(tmp_path, {"driver": "arducam", **make.table("b0410", file)}, make.SMALL)
    assert view.tof.raw.shape == (2, 4, 180, 240)
    assert view.stereo.info.serial == "Fake_1"


def test_realsense(tmp_path):
    """A bag that the library recorded."""
    pytest.importorskip("pyrealsense2", reason=LACKING)
    from tests import test_realsense_driver as make

    other, file = test_arducam_driver, tmp_path / "frames.raw"
    file.write_bytes(other.frames("b0410", other.wall("b0410", 1.5), 9))
    camera = make.Emulated()
    make.write_bag(tmp_path / "wall.db3", camera)
    camera.close()
    stereo = {"driver": "realsense", "serial": "8196", "size": [make.W, make.H], "fps": 30, "settle": 1}
    eyes = Camera(make.W, make.H, 250.0, 255.0, 159.5, 119.5)
    tof = {"driver": "arducam", **other.table("b0410", file)}
    view = recorded(tmp_path, tof, other.SMALL, stereo | {"bag": "wall.db3"}, eyes)
    assert view.stereo.info.model == "RealSense D435"


def test_femto(tmp_path):
    """Pictures of a file."""
    make, file = test_femto_driver, tmp_path / "pictures.raw"
    file.write_bytes(make.pictures("wide", 9, 1.5))
    view = recorded(tmp_path, {"driver": "femto", **make.table("wide", file)}, make.CAMERAS["wide"])
    assert view.tof.raw.shape == (2, 9, 512, 512)


def test_espros(tmp_path):
    """The vendor's client at its own ports."""
    pytest.importorskip("epc.tofCam660", reason=LACKING)
    from tests.test_espros_driver import TABLE

    wall = 1.5 * np.linalg.norm(CAMERA.unproject(np.ones(CAMERA.shape)), axis=-1)
    with Emulator(wall, ports=(50660, 45454)):
        view = recorded(tmp_path, {"driver": "espros", **TABLE}, CAMERA)
    assert view.tof.raw.shape == (2, 8, 240, 320)
