"""A daemon and recorder over a station made of arrays: no simulator, no planning of thousands, so that a view takes no time.

    python benchmarks/daemon_station.py daemon ROOT STATE [--http 127.0.0.1:0] [--station arrays | FILE.toml]

The worker's environment: ``BENCH_DELAY`` seconds per device step, ``BENCH_LOG`` a file that gets a line per move and stop of the arm,
``BENCH_FULL`` a file: while it exists, the disk refuses from the write on whose number stands in it, as full or with the errno after it;
``BENCH_STATE`` the same for the daemon's own database;
``BENCH_FAULT`` a file: while it exists, devices have the fault that it names (:data:`FAULTS`);
``BENCH_ASKS`` set: a person must confirm the scene; ``BENCH_HOST`` set: the arm has a driver host; ``BENCH_LARGE`` set: images of full size;
``BENCH_REAL`` set: the arm is a real one; ``BENCH_HOLD`` a file: while it exists, the device step whose number stands in it waits, until
the arm is stopped. The daemon's: ``BENCH_LOST`` seconds of silence after which a recorder is killed,
``BENCH_IDLE`` seconds that a connection may take. ``BENCH_SCOPE`` names what ``tofcapture stop`` of a test stops.
``BENCH_PROTECT`` a file: while it exists, the arm is in protective stop. ``BENCH_REAL`` with ``BENCH_MOVES``: the daemon was started with --allow-motion.
"""

from __future__ import annotations

import argparse
import errno
import itertools
import os
import sqlite3
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tofcapture.devices import Arm

SMALL_STATION = """
[arm]
driver = "sim"
[tof]
driver = "sim"
[stereo]
driver = "sim"
[operator]
driver = "sim"
[sim]
seed = 0
[sim.tof]
width = 24
height = 18
fx = 19.06
fy = 20.07
cx = 11.5
cy = 9.7
[sim.stereo]
width = 64
height = 48
fx = 57.0
fy = 57.0
cx = 31.5
cy = 23.5
[sim.render]
multipath = false
subpixels = 1
[plan]
table = -0.50
target = [0.70, 0.0, -0.44]
board = [0.70, 0.0, -0.22]
board_normal = [-0.258819, 0.0, 0.965926]
"""


FAULTS = ("error", "unexpected", "stopped", "millimetres", "zeros", "closed")  # of devices


class _Arrays:
    """Arm, cameras and operator in one: what a camera sees hangs on the pose alone."""

    simulated = True

    def __init__(self) -> None:
        import numpy as np

        from tofcapture.camera import Camera
        from tofcapture.devices.kinematics import HOME

        self.np, self.joints, self.role = np, HOME.copy(), ""
        self.steps, self.stopped = 0, False
        a, b = (10, 40) if "BENCH_LARGE" in os.environ else (1, 1)
        self.tof = Camera(24, 18, 20.0, 20.0, 11.5, 8.5).scaled(a)
        self.stereo = Camera(32, 24, 30.0, 30.0, 15.5, 11.5).scaled(b)

    def fault(self) -> str:
        """Name the fault of the devices, empty when they work; raise those that raise."""
        try:
            fault = Path(os.environ["BENCH_FAULT"]).read_text(encoding="ascii")
        except (KeyError, OSError):
            return ""
        from tofcapture.devices.faults import ProtectiveStop
        from tofcapture.errors import DeviceError

        if fault == "stopped":
            raise ProtectiveStop("the controller reports: protective stop")
        if fault == "error":
            raise DeviceError("the camera does not answer")
        if fault == "unexpected":
            raise LookupError("VENDOR_STATUS_17")
        return fault

    def step(self) -> None:
        time.sleep(float(os.environ.get("BENCH_DELAY", "0")))
        self.steps += 1
        while self._held() and not self.stopped:
            time.sleep(0.01)

    def _held(self) -> bool:
        try:
            return self.steps >= int(Path(os.environ["BENCH_HOLD"]).read_text(encoding="ascii"))
        except (KeyError, OSError):
            return False

    def rng(self, name: str) -> Any:
        return self.np.random.default_rng(
            [len(name), *self.np.abs(self.np.round(self.joints * 1e6)).astype(int)]
        )


class _Role(Arm):
    simulated = True
    person = "BENCH_ASKS" in os.environ
    can_turn = False

    def __init__(self, bench: _Arrays, role: str) -> None:
        self.bench, self.role = bench, role

    def describe(self) -> Any:
        from tofcapture.frames import ArmInfo, StereoInfo, TofInfo

        if self.role == "arm":
            return ArmInfo("ur10e", "arrays")
        if self.role == "tof":
            return TofInfo("arrays", "A", self.bench.tof, self.bench.np.zeros(3))
        return StereoInfo("arrays", "A", self.bench.stereo)

    def state(self) -> Any:
        from tofcapture.devices.kinematics import MODELS, forward
        from tofcapture.frames import ArmState

        return ArmState(self.bench.joints.copy(), forward(MODELS["ur10e"], self.bench.joints), 1)

    def kinematics(self) -> Any:
        from tofcapture.devices.kinematics import MODELS

        return MODELS["ur10e"]

    def check_move(self, start: Any, goal: Any) -> None:
        del start, goal

    def cautions(self) -> list[str]:
        return []

    def move_to(self, joints: Any) -> Any:
        self._note("move")
        if Path(os.environ.get("BENCH_PROTECT", "/nowhere")).exists():
            from tofcapture.devices.faults import ProtectiveStop

            raise ProtectiveStop("the arm is in protective stop")
        self.bench.step()
        self.bench.joints = self.bench.np.array(joints)
        return self.state()

    def stop(self) -> None:
        self.bench.stopped = True
        self._note("stop")

    def _note(self, word: str) -> None:
        if log := os.environ.get("BENCH_LOG"):
            with Path(log).open("a", encoding="ascii") as file:
                file.write(f"{word}\n")

    def capture(self, frames: int | None = None) -> Any:
        from tofcapture.frames import StereoFrame, TofBurst

        np, rng, fault = self.bench.np, self.bench.rng(self.role), self.bench.fault()
        self.bench.step()
        if self.role == "tof":
            raw = rng.integers(0, 4096, (frames, 8, *self.bench.tof.shape)).astype(np.uint16)
            return TofBurst(raw, np.arange(frames), np.full(frames, 40.0), self.describe())
        points = rng.uniform(0.4, 1.0, (*self.bench.stereo.shape, 3)).astype(np.float32)
        if fault == "millimetres":
            points *= 1000
        if fault == "zeros":
            points[:4] = 0
        return StereoFrame(points, 2, self.describe())

    def place(self, scene: str) -> None:
        del scene

    def truth(self) -> None:
        return None


@contextmanager
def _open_arrays(path: Path | None = None, seed: int | None = None, allow_motion: bool = False) -> Any:
    import numpy as np

    from tofcapture.devices.station import Station, read_station
    from tofcapture.errors import DeviceError
    from tofcapture.poses import transform
    from tofcapture.rig import Rig

    del path, allow_motion
    config, bench = read_station(None, seed), _Arrays()
    if bench.fault() == "closed":
        raise DeviceError("1 of 4 devices do not open: tof: the port is gone")
    _Role.simulated = "BENCH_REAL" not in os.environ
    places = transform(np.eye(3), [-0.05, 0.08, 0.0]), transform(np.eye(3), [0.0, -0.035, 0.08])
    station = Station(
        *(_Role(bench, role) for role in ("arm", "tof", "stereo", "operator")),
        Rig(bench.tof, bench.stereo, *places),
        config,
    )
    try:
        yield station
    except BaseException:
        station.arm.stop()
        raise


class HostArm(Arm):
    """An arm in a process of its own, that only takes its time."""

    simulated = True

    def __init__(self, table: object, context: object) -> None:
        del table, context

    def describe(self) -> Any:
        """Say what it is."""
        from tofcapture.frames import ArmInfo

        return ArmInfo("ur10e", "hosted")

    def move_to(self, joints: Any) -> Any:
        """Take time."""
        time.sleep(float(os.environ.get("BENCH_DELAY", "0")))
        return joints

    def stop(self) -> None:
        """Nothing moves."""


class _Followed:
    """The station's arm, which moves when the hosted one has."""

    simulated = True

    def __init__(self, hosted: Any, arm: Any) -> None:
        self._hosted, self._arm = hosted, arm

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def move_to(self, joints: Any) -> Any:
        self._hosted.move_to(joints)
        return self._arm.move_to(joints)

    def stop(self) -> None:
        self._hosted.stop()
        self._arm.stop()


def _with_host(open_real: Callable[..., Any]) -> Callable[..., Any]:
    """Put the arm of a station into a driver host."""
    from dataclasses import replace

    from tofcapture.devices.host import hosted
    from tofcapture.devices.registry import StationContext

    @contextmanager
    def opened(path: Path | None = None, seed: int | None = None, *, allow_motion: bool = False) -> Any:
        with open_real(path, seed, allow_motion=allow_motion) as station:
            context = StationContext(config=station.config, folder=Path())
            with hosted("arm", "daemon_station:HostArm")({}, context) as arm:
                yield replace(station, arm=_Followed(arm, station.arm))

    return opened


def _refusal(flag: Path) -> Callable[[], int]:
    """Count writes; tell the errno that each meets, 0 for none."""
    count = itertools.count(1)

    def refused() -> int:
        number = next(count)
        try:
            first, _, name = flag.read_text(encoding="ascii").partition(" ")
            return getattr(errno, name or "ENOSPC") if number >= int(first or 1) else 0
        except (OSError, ValueError):
            return 0

    return refused


def _fill_database(refused: Callable[[], int]) -> None:
    """Make writes to SQLite fail in its own words."""
    from tofcapture.files.disk import Database

    words = {errno.ENOSPC: "database or disk is full", errno.EROFS: "attempt to write a readonly database"}

    def refuse(real: Callable[..., Any]) -> Callable[..., Any]:
        def write(self: Any, sql: str, *values: Any) -> Any:
            with self._named():
                if not sql.startswith(("SELECT", "PRAGMA")) and (number := refused()):
                    raise sqlite3.OperationalError(words.get(number, "disk I/O error"))
            return real(self, sql, *values)

        return write

    Database.do, Database.insert = refuse(Database.do), refuse(Database.insert)


def _fill_disk(flag: Path) -> None:
    """Make every kind of write fail, from the one on that the flag file names, for as long as it exists."""
    import h5py

    from tofcapture.files import view

    refused = _refusal(flag)

    def refuse(real: Callable[..., Any]) -> Callable[..., Any]:
        def write(*args: Any, **more: Any) -> Any:
            if number := refused():
                raise OSError(number, os.strerror(number))
            return real(*args, **more)

        return write

    view.create, view.write_attrs = refuse(view.create), refuse(view.write_attrs)
    os.fsync, Path.write_text = refuse(os.fsync), refuse(Path.write_text)
    h5py.File.close = refuse(h5py.File.close)
    _fill_database(refused)


def _few_candidates() -> None:
    from tofcapture.record import plan
    from tofcapture.record.plan import object_sampling

    sampling = object_sampling()
    few = type(sampling)(sampling.axis, directions=60, distances=(0.5, 0.8))
    plan.object_sampling = lambda: few


def _scope() -> None:
    """Be heard by those who stop what is of this scope, and by nobody else."""
    from tofcapture.record import stopping

    stopping.PREFIX = os.environ.get("BENCH_SCOPE", stopping.PREFIX)


def worker(station: str) -> None:
    """Run the recorder's process on this station."""
    from tofcapture.devices import station as stations
    from tofcapture.record.daemon import worker as real

    _scope()
    if station == "arrays":
        stations.open_station = _open_arrays
    if "BENCH_HOST" in os.environ:
        known = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(__file__).parent), *known]))
        stations.open_station = _with_host(stations.open_station)
    _few_candidates()
    if flag := os.environ.get("BENCH_FULL"):
        _fill_disk(Path(flag))
    real.main()


def daemon(args: argparse.Namespace) -> None:
    """Run a daemon whose recorder is :func:`worker`."""
    from tofcapture.record.daemon import guard
    from tofcapture.record.daemon.server import serve, tcp_address
    from tofcapture.record.daemon.settings import Settings, open_folder

    _scope()
    if flag := os.environ.get("BENCH_STATE"):
        _fill_database(_refusal(Path(flag)))
    guard.IDLE = float(os.environ.get("BENCH_IDLE", guard.IDLE))
    args.root.mkdir(parents=True, exist_ok=True)
    toml = None if args.station == "arrays" else Path(args.station)
    lost = float(os.environ.get("BENCH_LOST", "20"))
    command = (sys.executable, __file__, "worker", "--station", args.station)
    settings = Settings(
        args.root.resolve(), open_folder(args.state), toml, "BENCH_MOVES" in os.environ, command, lost
    )
    serve(settings, tcp_address(args.http) if args.http else None, lambda url: print(url, flush=True))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["daemon", "worker"])
    parser.add_argument("root", type=Path, nargs="?")
    parser.add_argument("state", type=Path, nargs="?")
    parser.add_argument("--http")
    parser.add_argument("--station", default="arrays")
    given = parser.parse_args()
    if given.what == "worker":
        worker(given.station)
    else:
        daemon(given)
