"""Stops at chosen moments of a move, at every layer, on an arm that is emulated or simulated, and when it came to rest.

``python -m tests.stopping LAYER HOST STATION.toml MS ...`` makes the trials in a process of its own and prints them as JSON: the
vendor's library, used directly, does not leave a process in peace.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests import PATIENCE, emulated, franka_sim
from tests.ur_emulator.__main__ import CONTROL
from tofcapture.devices.arm.franka import FrankaArm
from tofcapture.devices.kinematics import HOME
from tofcapture.devices.registry import StationContext, make_device
from tofcapture.devices.station import open_station, read_station
from tofcapture.devices.ur_rtde.arm import UrArm
from tofcapture.errors import MotionStopped
from tofcapture.record import recorder
from tofcapture.record.daemon.client import ask
from tofcapture.record.observer import Observer, Stopped
from tofcapture.record.plan import plan_scene

LAYERS = ("direct", "host", "station", "recorder", "daemon")
HALTED = 0.3  # s within which the arm must be at rest
_LEAD = 0.1  # s before the move in which stops may come
_LOOK = 0.7  # s for which the arm is watched after the stop
_STILL = 0.02  # rad/s
_ROOT = Path(__file__).parents[1]
# Their classes, where a move begins, and where it goes.
_ARMS: dict[str, tuple[type, Any, Any]] = {
    "ur_rtde": (UrArm, HOME, emulated.THERE),
    "franka": (FrankaArm, franka_sim.HOME, franka_sim.THERE),
}


class Witness:
    """Reads the arm's joints 200 times a second from a connection of its own, and its clock where it has one."""

    def __init__(self, host: str) -> None:
        self._link = socket.create_connection((host, CONTROL), PATIENCE)
        self._lines = self._link.makefile("rwb")
        self.seen: list[tuple[float, float, list[float]]] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(0.005):
            self._lines.write(b'{"do": "status"}\n')
            self._lines.flush()
            status = json.loads(self._lines.readline())
            now = time.monotonic()
            self.seen.append((now, status.get("clock", now), status["joints"]))

    def end(self) -> None:
        """Look no more."""
        self._over.set()
        self._thread.join()
        self._link.close()

    def moved(self, since: float) -> tuple[float, float, float]:
        """Seconds of ours and of the arm after ``since`` at which it moved last, and degrees that it turned from then on."""
        times, clock = np.array([t for t, _, _ in self.seen]), np.array([c for _, c, _ in self.seen])
        joints = np.array([q for _, _, q in self.seen])
        fast = np.abs(np.diff(joints, axis=0)).max(axis=1) > _STILL * np.diff(clock)
        last = int(np.flatnonzero(fast).max(initial=-1)) + 1
        after = joints[max(int(np.searchsorted(times, since)) - 1, 0) :]
        turned = float(np.degrees(np.ptp(after, axis=0).max()))
        return max(times[last] - since, 0.0), max(clock[last] - np.interp(since, times, clock), 0.0), turned


def _trial(host: str, delay: float, move: Callable[[], Any], stop: Callable[[], Any]) -> dict[str, Any]:
    """One stop, ``delay`` seconds after the move is asked for."""
    witness, start = Witness(host), time.monotonic() + _LEAD
    at = []

    def press() -> None:
        time.sleep(max(0.0, start + delay - time.monotonic()))
        at.append(time.monotonic())
        stop()

    thread = threading.Thread(target=press)
    thread.start()
    time.sleep(start - time.monotonic())
    said = "arrived"
    try:
        move()
    except (MotionStopped, Stopped):
        said = "stopped"
    except Exception as err:
        said = f"{type(err).__name__}: {err}"
    thread.join()
    return _judged(witness, delay, at[0], said)


def _judged(witness: Witness, delay: float, at: float, said: str) -> dict[str, Any]:
    time.sleep(max(0.0, at + _LOOK - time.monotonic()))
    witness.end()
    seconds, arms, turned = witness.moved(at)
    return {
        "ms": round(1e3 * delay),
        "said": said,
        "rest_s": round(seconds, 3),
        "arm_s": round(arms, 3),
        "turned_deg": round(turned, 2),
    }


def _context(file: Path) -> StationContext:
    return StationContext(read_station(file), file.parent, allow_motion=True)


def _rig() -> Any:
    with open_station() as station:
        return station.rig


@contextlib.contextmanager
def _arm(layer: str, file: Path) -> Iterator[Any]:
    if layer == "station":
        with open_station(file, allow_motion=True) as station:
            yield station.arm
        return
    context = _context(file)
    table = {k: v for k, v in context.config["arm"].items() if k != "driver"}
    own = _ARMS[context.config["arm"]["driver"]][0]
    with own(table, context) if layer == "direct" else make_device("arm", context) as arm:
        arm.equip(_rig())
        yield arm


def by_arm(layer: str, host: str, file: Path, delays: list[float]) -> Iterator[dict[str, Any]]:
    """Stops at an arm: the driver itself, in its host, or as the station's."""
    _, home, there = _ARMS[read_station(file)["arm"]["driver"]]
    with _arm(layer, file) as arm:
        for delay in delays:
            arm.move_to(home)
            trial = _trial(host, delay, lambda: arm.move_to(there), arm.stop)
            # It holds: also for the next move, whoever asks for it.
            with contextlib.suppress(MotionStopped):
                arm.move_to(home)
                trial["said"] = "moved after a stop"
            arm.resume()
            yield trial


class _Press(Observer):
    """Presses stop about the moment at which a view's move begins."""

    def __init__(self, host: str, delay: float, stop: Callable[[], None]) -> None:
        self._host, self._delay, self._stop = host, delay, stop
        self.result: Callable[[str], dict[str, Any]] = lambda _: {}

    def before_view(self, index: int) -> None:
        """Set off; the move begins in a moment."""
        witness, at = Witness(self._host), [time.monotonic() + _LEAD + self._delay]

        def press() -> None:
            time.sleep(max(0.0, at[0] - time.monotonic()))
            at[0] = time.monotonic()
            self._stop()

        threading.Thread(target=press).start()
        self.result = lambda said: _judged(witness, self._delay, at[0], said)
        time.sleep(_LEAD)


def by_recorder(host: str, file: Path, delays: list[float]) -> Iterator[dict[str, Any]]:
    """Stops at the arm while a recorder works."""
    with open_station(file, allow_motion=True) as station, tempfile.TemporaryDirectory() as folder:
        plan, home = plan_scene(station, "mug", 1), _ARMS[read_station(file)["arm"]["driver"]][1]
        recorder.plan_scene = lambda *_: plan  # type: ignore[assignment]  # planning is most of a short run
        for n, delay in enumerate(delays):
            station.arm.move_to(home)
            press, said = _Press(host, delay, station.arm.stop), "recorded"
            try:
                recorder.record(station, "mug", Path(folder) / str(n), 1, 1, observer=press)
            except Stopped:
                said = "stopped"
            yield press.result(said)
            station.arm.resume()


def by_daemon(host: str, file: Path, delays: list[float]) -> Iterator[dict[str, Any]]:
    """Stops over the daemon's API, so long after its event that a view's move begins; before it: at the event of the plan."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        command = [
            sys.executable,
            "-m",
            "tofcapture",
            "daemon",
            "--root",
            str(folder / "root"),
            "--state",
            str(folder / "st"),
        ]
        command += ["--station", str(file), "--allow-motion"]
        with subprocess.Popen(
            command, cwd=_ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        ) as process:
            try:
                for n, delay in enumerate(delays):
                    yield _over_api(host, folder / "st", f"mug-{n}", delay)
            finally:
                process.terminate()


def _over_api(host: str, state: Path, scene: str, delay: float) -> dict[str, Any]:
    end = time.monotonic() + PATIENCE
    while not (state / "daemon.sock").exists():
        assert time.monotonic() < end, "the daemon did not start"
        time.sleep(0.05)
    after = ask("GET", "/v1/state", state=state)["last_event"]
    job = {"scene": scene, "recording": scene, "views": 1, "frames": 1, "clear": True}
    number = ask("POST", "/v1/jobs", job, state)["id"]
    ask("POST", "/v1/resume", {"clear": True}, state)
    with socket.socket(socket.AF_UNIX) as link:
        link.settimeout(PATIENCE)
        link.connect(str(state / "daemon.sock"))
        link.sendall(f"GET /v1/events?after={after} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        wanted = '"moving"' if delay >= 0 else '"planned"'
        next(
            line
            for line in link.makefile("r", encoding="utf-8")
            if line.startswith("data") and wanted in line
        )
        witness = Witness(host)
        time.sleep(max(0.0, delay))
        at = time.monotonic()
        ask("POST", "/v1/stop", {}, state)
        trial = _judged(witness, delay, at, "")
    while (found := _job(state, number)) not in {"stopped", "done", "failed"}:
        assert time.monotonic() < end, f"the job is {found}"
        time.sleep(0.05)
    return {**trial, "said": found}


def _job(state: Path, number: int) -> str:
    jobs = ask("GET", "/v1/jobs", state=state)["jobs"]
    return next(str(job["state"]) for job in jobs if job["id"] == number)


def sweep(layer: str, host: str, file: Path, delays: list[float]) -> list[dict[str, Any]]:
    """Make the trials of one layer in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "tests.stopping",
        layer,
        host,
        str(file),
        *(str(1e3 * d) for d in delays),
    ]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def faults_of(trials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those in which the arm did not come to rest in time, by its own clock, or its stop was not said."""
    return [t for t in trials if t["said"] != "stopped" or t["arm_s"] > HALTED]


def main() -> None:
    """Make trials, print them."""
    layer, host, file, *ms = sys.argv[1:]
    delays = [float(x) / 1e3 for x in ms]
    makers = {"recorder": by_recorder, "daemon": by_daemon}
    if layer in makers:
        trials = makers[layer](host, Path(file), delays)
    else:
        trials = by_arm(layer, host, Path(file), delays)
    for trial in trials:
        print(json.dumps(trial), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
