"""A station on a tripod before a wall, for one camera under test: the whole way from its driver to a checked recording."""

import io
import time

import numpy as np
import tomli_w

from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.devices import StereoDevice, registry
from tofcapture.devices.by_hand import Tripod
from tofcapture.devices.console import ConsoleOperator
from tofcapture.devices.registry import StationContext
from tofcapture.files.view import find_views, open_view
from tofcapture.frames import StereoFrame, StereoInfo
from tofcapture.rig import Rig, dumps_rig

CAMERA = Camera(320, 240, 266.0, 266.0, 159.5, 119.5)


class Wall(StereoDevice):
    """A stereo camera that sees a wall, a metre and a half away."""

    depth = 1.5

    def __init__(self, table, context):
        del table, context

    def describe(self):
        return StereoInfo("wall", "1", CAMERA)

    def capture(self):
        points = CAMERA.unproject(np.full(CAMERA.shape, self.depth)).astype(np.float32)
        return StereoFrame(points, time.monotonic_ns(), self.describe())


class _Person(ConsoleOperator):
    def __init__(self, table, context):
        super().__init__(table, context, io.StringIO(), io.StringIO("\n" * 9))


def recorded(monkeypatch, folder, camera, tof_table, stereo_table=None, **drivers):
    """Record one view by the command, check it, and return it; ``drivers`` replace those of this station, by role."""
    mine = {"arm": Tripod, "stereo": Wall, "operator": _Person, **drivers}
    monkeypatch.setattr(registry, "load_driver", lambda name: mine)
    tables = {"arm": {"hold": 0.1}, "tof": tof_table, "stereo": stereo_table or {}, "operator": {}}
    station = {role: {"driver": "test", **table} for role, table in tables.items()}
    (folder / "station.toml").write_text(tomli_w.dumps({**station, "rig": {"path": "rig.toml"}}))
    eyes = mine["stereo"]({**(stereo_table or {})}, StationContext({}, folder)).describe().camera
    (folder / "rig.toml").write_text(dumps_rig(Rig(camera, eyes, np.eye(4), np.eye(4))))
    out, file = folder / "rec", str(folder / "station.toml")
    command = [
        "record",
        "--scene",
        "wall",
        "--views",
        "1",
        "--frames",
        "3",
        "--station",
        file,
        "--out",
        str(out),
    ]
    assert main(command) == 0
    assert main(["check", str(out)]) == 0
    return open_view(find_views(out)["wall"][0])
