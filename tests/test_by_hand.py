"""A rig that a person carries, or that stands on a tripod: the recorder waits until it stands still, and takes the view."""

import io
import json
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests import PATIENCE
from tofcapture.cli import main
from tofcapture.devices import registry
from tofcapture.devices.by_hand import ByHand, PoseStream, Tripod
from tofcapture.devices.console import ConsoleOperator
from tofcapture.devices.faults import NotSettled
from tofcapture.devices.kinematics import HOME, MODELS, forward
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim.drivers import SimStereo, SimTof
from tofcapture.devices.sim.world import shared_world
from tofcapture.devices.station import open_station
from tofcapture.errors import ConfigError, DeviceError, MotionStopped
from tofcapture.files.view import find_views, open_view
from tofcapture.poses import exp
from tofcapture.record.observer import Stopped
from tofcapture.record.recorder import record
from tofcapture.testing import check_arm

STATION = """
[arm]
driver = "carried"
hold = 1.0
patience = 12.0
[tof]
driver = "carried"
[stereo]
driver = "carried"
[operator]
driver = "carried"
[sim]
seed = 3
[sim.render]
multipath = false
subpixels = 1
[sim.tof]
width = 120
height = 90
fx = 95.3
fy = 100.4
cx = 57.9
cy = 50.2
[sim.stereo]
width = 320
height = 256
fx = 288.75
fy = 288.75
cx = 159.5
cy = 127.5
"""
START = forward(MODELS["ur10e"], HOME)
mm, deg = 1e-3, np.pi / 180


def at(x=0.0, y=0.0, z=0.0, tilt=0.0):
    """Where the flange is held, off the start: millimetres and degrees."""
    return START @ exp(np.array([x * mm, y * mm, z * mm, tilt * deg, 0.0, 0.0]))


class _Rig(ByHand):
    """Simulated, so that the simulated cameras ask no arm but the world; else the driver itself."""

    simulated = True


class _Stand(_Rig, Tripod):
    """The same on a tripod."""


class _Person:
    """Carries the rig: ``script`` has a pose for each time that somebody looks, the last one for ever."""

    def __init__(self, script):
        self.script, self.looks, self.told, self.turns = list(script), 0, [], []
        self.restless = []  # where the rig goes each time that it should be held

    def drivers(self):
        person = self

        class Stereo(SimStereo):
            def capture(self):
                pose = person.script[min(person.looks, len(person.script) - 1)]
                person.looks += 1
                shared_world(self._context).set_pose(
                    pose, pose.round(6).tobytes() + bytes([person.looks % 251])
                )
                return super().capture()

        class Operator(ConsoleOperator):
            def __init__(self, table, context):
                super().__init__(table, context, io.StringIO(), io.StringIO("\n" * 99))
                self._context = context

            def place(self, scene):
                shared_world(self._context).place(scene)
                super().place(scene)

            def turn(self, scene, angle):
                super().turn(scene, angle)
                person.turns.append(round(np.degrees(angle)))

            def tell(self, text):
                person.told.append(text)
                if "hold on" in text and person.restless:
                    person.script = [person.restless.pop(0)]

            def truth(self):
                return shared_world(self._context).truth()

        return {"arm": _Rig, "tof": SimTof, "stereo": Stereo, "operator": Operator}


@pytest.fixture
def carried(monkeypatch, tmp_path):
    """Make a station whose rig a scripted person carries; returns its file and the person."""

    def make(script, text=STATION, fixed=False):
        person = _Person(script)
        drivers = person.drivers()
        if fixed:
            drivers["arm"] = _Stand
        real = registry.load_driver
        monkeypatch.setattr(
            registry, "load_driver", lambda name: drivers if name == "carried" else real(name)
        )
        path = tmp_path / "station.toml"
        path.write_text(text)
        return path, person

    return make


def test_overshoot_and_tremble_are_waited_for(carried, tmp_path):
    """Nothing is taken while the rig comes, overshoots and trembles; then each view is, where it came to rest."""
    rng = np.random.default_rng(0)
    first = [at(z=z) for z in (-90, -60, -30, 0, 25, 12, -4)]  # overshoots its place and comes back
    first += [at(*rng.normal(0, 6, 3)) for _ in range(6)]  # trembles
    first += [at()] * 8
    second = [at(x=x, z=60) for x in (20, 60, 110)] + [at(x=110, z=60, tilt=8)] * 9
    path, person = carried(first + second)
    with open_station(path) as station:
        result = record(station, "mug", tmp_path / "rec", views=2, frames=2)
    assert result.recorded == (0, 1), result.reasons
    views = [open_view(p) for p in find_views(tmp_path / "rec")["mug"]]
    for view, pose in zip(views, (at(), at(x=110, z=60, tilt=8)), strict=True):
        seen = np.nanmedian(view.stereo.points[..., 2])
        assert np.isnan(view.arm_before.joints).all()
        assert np.isfinite(seen)
        assert view.provenance["arm"]["model"] == "by hand"
        assert view.provenance["simulated"] is True
        # The truth of the simulator is of where the rig came to rest.
        assert np.isfinite(view.truth.depth).any(), pose
    assert not np.allclose(views[0].truth.depth, views[1].truth.depth, equal_nan=True)
    assert list(dict.fromkeys(t.partition(":")[0] for t in person.told)) == [
        "view 0 of 'mug'",
        "view 1 of 'mug'",
    ]


def test_a_person_who_gives_up_ends_the_run_and_it_goes_on_later(carried, tmp_path):
    """A rig that never rests, or never leaves the view before, ends the run by name; the same command goes on."""
    rng = np.random.default_rng(1)
    path, person = carried([at()] * 6 + [at(*rng.normal(0, 30, 3)) for _ in range(90)])
    with open_station(path) as station, pytest.raises(Stopped, match="did not stand still within 12 s"):
        record(station, "mug", tmp_path / "rec", views=2, frames=2)
    person.script, person.looks = [at(y=90)] * 9, 0
    with open_station(path) as station:
        result = record(station, "mug", tmp_path / "rec", views=2, frames=2)
    assert (result.recorded, result.kept) == ((1,), (0,))
    person.script, person.looks = [at()], 0
    with (
        open_station(path) as station,
        pytest.raises(Stopped, match="did not leave the place of the view before"),
    ):
        record(station, "cup", tmp_path / "rec", views=2, frames=2)
    assert len(find_views(tmp_path / "rec")["cup"]) == 1


def test_motion_during_the_exposures_is_refused_and_tried_again(carried, tmp_path):
    """Who moves the rig between the first exposure and the last gets the view asked for again, where it is."""
    path, person = carried([at()])
    person.restless = [at(z=12)]
    with open_station(path) as station:
        result = record(station, "mug", tmp_path / "rec", views=1, frames=2)
    assert result.recorded == (0,)
    assert len(person.told) == 4  # asked twice
    person.restless = [at(z=12 * k) for k in range(2, 9)]
    with open_station(path) as station, pytest.raises(NotSettled, match="mm during the view"):
        record(station, "cup", tmp_path / "rec", views=1, frames=2)


def test_a_tripod_takes_one_view_for_each_turn(carried, tmp_path):
    """A tripod asks nobody to carry it; the object is turned by prompt, and there are no more views than turns."""
    path, person = carried([at()], fixed=True)
    with open_station(path) as station:
        result = record(station, "mug", tmp_path / "rec", views=4, frames=2, turns=4)
        alone = record(station, "cup", tmp_path / "rec", views=4, frames=2)
    assert result.recorded == (0, 1, 2, 3)
    assert person.turns == [0, 90, 180, 270]
    assert alone.recorded == (0,)
    assert "only 1 of 4 views" in alone.plan.shortfall()[0]
    assert {open_view(p).provenance["turn_deg"] for p in find_views(tmp_path / "rec")["mug"]} == {
        0,
        90,
        180,
        270,
    }


def test_the_commands(carried, tmp_path, capsys):
    """``record`` and its dry run work for a rig without motors, and ``check`` passes what they made."""
    path, _ = carried([at()] * 7 + [at(y=70)] * 9)
    out = tmp_path / "rec"
    assert (
        main(
            [
                "record",
                "--scene",
                "mug",
                "--views",
                "2",
                "--station",
                str(path),
                "--out",
                str(out),
                "--dry-run",
            ]
        )
        == 0
    )
    assert "a person brings the rig to each" in capsys.readouterr().out
    command = [
        "record",
        "--scene",
        "mug",
        "--views",
        "2",
        "--frames",
        "2",
        "--station",
        str(path),
        "--out",
        str(out),
    ]
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["recorded"] == [0, 1]
    assert main(["check", str(out)]) == 0


def test_a_tripod_with_simulated_cameras(tmp_path):
    """The command records through the driver as it is registered, real time and all."""
    path, out = tmp_path / "station.toml", tmp_path / "rec"
    text = STATION.replace("patience = 12.0\n", "").replace('"carried"\nhold', '"tripod"\nhold')
    path.write_text(text.replace('"carried"', '"sim"'))
    command = ["record", "--scene", "mug", "--views", "1", "--frames", "2", "--station", str(path)]
    assert main([*command, "--out", str(out)]) == 0
    assert main(["check", str(out)]) == 0
    view = open_view(find_views(out)["mug"][0])
    assert view.provenance["simulated"] is False
    assert view.provenance["arm"] == {"model": "tripod", "serial": "no poses"}


class _Tracker:
    """Sends poses to a port, from a thread: ``pose(t)`` after t seconds, with noise; None is silence."""

    def __init__(self, pose):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._pose, self._end = pose, threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)

    def _send(self):
        rng, start = np.random.default_rng(0), time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            while not self._end.wait(0.01):
                if (pose := self._pose(time.monotonic() - start)) is not None:
                    x, y, z = np.array(pose) + rng.normal(0, 1e-4, 3)
                    link.sendto(f"0 {x} {y} {z} 0 0 0 1".encode(), ("127.0.0.1", self.port))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self._thread.join()


def _tracked(tracker, **table):
    return ByHand({"poses": f"127.0.0.1:{tracker.port}", **table}, StationContext({}, Path()))


def test_poses_of_a_stream_are_recorded_and_judge():
    """A tracker's poses become the rig's; it is at rest when they are, and noise of 0.1 mm is rest."""
    with (
        _Tracker(lambda t: (max(0.0, 0.3 - 0.3 * t), 0.1, 0.5)) as tracker,
        _tracked(tracker, hold=0.3) as rig,
    ):
        before = rig.await_view(0)
        after = rig.state()
    np.testing.assert_allclose(before.T_base_flange[:3, 3], [0.0, 0.1, 0.5], atol=2e-3)
    assert np.linalg.norm(after.T_base_flange[:3, 3] - before.T_base_flange[:3, 3]) < 2e-3


@pytest.mark.slow
def test_a_tracked_rig_is_recorded(tmp_path):
    """The registered driver: a person overshoots, trembles and rests, at two places; their poses are in a recording that checks."""
    path, out, rng = tmp_path / "station.toml", tmp_path / "rec", np.random.default_rng(2)
    moved = []  # when the second place was made for

    def pose(t):
        if not moved and (out / "views/mug").is_dir() and find_views(out).get("mug"):
            moved.append(t)
        here, since = (0.4, t - moved[0]) if moved else (0.1, t)
        swing = 0.3 * max(0.0, 1.5 - since) - 0.06 * np.sin(2 * np.pi * min(since, 1.5) / 1.5)
        tremble = rng.normal(0, 0.01, 3) if 1.5 < since < 3.5 else np.zeros(3)
        return np.array([here + swing, 0.1, 0.5]) + tremble

    with _Tracker(pose) as tracker:
        text = STATION.replace('"carried"\nhold', f'"manual"\nposes = "127.0.0.1:{tracker.port}"\nhold')
        path.write_text(text.replace('"carried"', '"sim"'))
        command = ["record", "--scene", "mug", "--views", "2", "--frames", "2", "--station", str(path)]
        assert main([*command, "--out", str(out)]) == 0
    assert main(["check", str(out)]) == 0
    states = [open_view(p).arm_before for p in find_views(out)["mug"]]
    places = [s.T_base_flange[:3, 3] for s in states]
    np.testing.assert_allclose(places, [[0.1, 0.1, 0.5], [0.4, 0.1, 0.5]], atol=2e-3)
    assert all(np.isnan(s.joints).all() for s in states)


def test_the_contract_holds_with_a_stream():
    """The conformance suite passes on the driver as a station makes it."""
    with _Tracker(lambda t: (0.0, 0.0, 0.5)) as tracker:
        check_arm(lambda: _tracked(tracker, hold=0.2))


def test_faults_of_a_stream_have_names():
    """A silent tracker, a lost one, nonsense and a busy port each say what is wrong, within seconds."""
    begun = time.monotonic()
    with (
        _Tracker(lambda t: None) as silent,
        _tracked(silent) as rig,
        pytest.raises(DeviceError, match="no pose for 2 s"),
    ):
        rig.await_view(0)
    with (
        _Tracker(lambda t: (t, 0, 0) if t < 1 else None) as lost,
        _tracked(lost) as rig,
        pytest.raises(DeviceError, match="no pose"),
    ):
        rig.await_view(0)
    with (
        _Tracker(lambda t: (np.nan, 0, 0)) as blind,
        _tracked(blind) as rig,
        pytest.raises(DeviceError, match="expected 'time x y z qx qy qz qw'"),
    ):
        rig.await_view(0)
    stream = PoseStream("127.0.0.1:0".replace(":0", f":{silent.port}"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", silent.port))
        with pytest.raises(DeviceError, match="in use"):
            stream.look()
    with pytest.raises(ConfigError, match="45900"):
        PoseStream("45900")
    assert time.monotonic() - begun < 15 + PATIENCE


def test_a_stop_ends_the_waiting():
    """A stop from another thread ends the waiting at once, and holds until it is lifted."""
    with _Tracker(lambda t: (t, 0, 0)) as tracker, _tracked(tracker) as rig:
        threading.Timer(0.5, rig.stop).start()
        with pytest.raises(MotionStopped):
            rig.await_view(0)
        with pytest.raises(MotionStopped):
            rig.await_view(0)


@pytest.mark.parametrize(
    "table", [{"hold": 0}, {"patience": "long"}, {"still": float("nan")}, {"poses": "x:y"}, {"speed": 1}]
)
def test_wrong_settings_are_refused(table):
    """A setting that cannot be is refused before anything opens."""
    with pytest.raises(ConfigError):
        ByHand(table, StationContext({}, Path()))
