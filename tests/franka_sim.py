"""franky-sim, a simulated Franka Research 3 that speaks the robot's own protocol, in a process of its own.

Run as a module it serves the address of its first argument, obeys lines on its standard input (``mode NAME``, ``report``, ``clear``),
and answers ``report`` with what its joints did since ``clear``.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np

from tests.emulated import CAMERAS

# The simulator has a floor at the height of the base: the table stands on it.
STATION = (
    CAMERAS
    + """
[arm]
driver = "franka"
host = "{host}"
realtime = "ignore"
speed = 1.0
camera_speed = 1.5
acceleration = 1.4
settle = 0.05
[plan]
table = 0.05
target = [0.50, 0.0, 0.13]
board = [0.50, 0.0, 0.13]
board_normal = [0.0, 0.0, 1.0]
keep_out_radius = 0.15
keep_out_height = 0.20
home = [0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398]
"""
)
_GAINS = {
    "kp": (2000.0, 2000.0, 1500.0, 1500.0, 400.0, 400.0, 100.0),
    "kv": (200.0, 200.0, 150.0, 150.0, 20.0, 20.0, 5.0),
}
HOME = np.array([0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398])
THERE = np.add(HOME, [0.4, 0.1, 0.0, 0.1, 0.0, 0.1, -0.2])


def station_file(folder, host, more=""):
    """``station.toml`` of small simulated cameras on the simulated arm."""
    file = folder / "station.toml"
    file.write_text(STATION.format(host=host).replace("settle = 0.05\n", f"settle = 0.05\n{more}\n"))
    return file


class FrankaSim:
    """The simulator's process, at an address of this process's own; stopped on leaving."""

    def __init__(self, number=1):
        self.host = f"127.{os.getpid() >> 8 & 255}.{os.getpid() & 255}.{number}"

    def __enter__(self):
        command = [sys.executable, "-m", "tests.franka_sim", self.host]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self._process.stdout.readline().strip() == "ready"
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()

    def order(self, line):
        """Say a line; returns what is answered."""
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def hang(self):
        """Make it silent, its connections open."""
        self._process.send_signal(signal.SIGSTOP)

    def wake(self):
        """Let it go on."""
        self._process.send_signal(signal.SIGCONT)

    def die(self):
        """End it."""
        self._process.kill()


def _serve(host):
    from franky_sim import FrankaRobotServer, SimulationServer
    from franky_sim.franka_robot_protocol import RobotMode
    from franky_sim.mujoco_simulator import MujocoSimulator

    own, told = FrankaRobotServer.robot_state.fget, {}

    def state(self):
        found = own(self)
        return found.replace(robot_mode=told["mode"]) if told else found

    FrankaRobotServer.robot_state = property(state)
    seen = []
    with MujocoSimulator(enable_visualization=False) as sim:
        robot = sim.add_robot(initial_q=HOME, **_GAINS)  # with its own the wrist trembles at rest
        with SimulationServer(sim, [host]) as server:
            threading.Thread(target=_obey, args=(told, seen, RobotMode), daemon=True).start()
            print("ready", flush=True)
            while True:
                server.run_once()
                inner = robot.state
                seen.append((time.monotonic(), *inner.q))


def _obey(told, seen, modes):
    for line in sys.stdin:
        word, *rest = line.split()
        answer = True
        if word == "mode":
            told.clear()
            if rest[0] != "own":
                told["mode"] = modes[rest[0]]
        elif word == "clear":
            seen.clear()
        elif word == "report":
            answer = [list(row) for row in list(seen)]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        _serve(sys.argv[1])
