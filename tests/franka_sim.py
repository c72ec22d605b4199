"""franky-sim, a simulated Franka Research 3 that speaks the robot's own protocol, in a process of its own.

Run as a module it serves the address of its first argument until its standard input closes. At the port that the UR emulator has for it,
too, it obeys lines: ``mode NAME``, ``clear``, ``report`` (answered with what its joints did since then), ``{"do": "status"}``.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import socket
import socketserver
import subprocess
import sys
import threading
import time

import numpy as np

from tests.emulated import CAMERAS
from tests.ur_emulator.__main__ import CONTROL

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
# Its own gains let the arm lag by 0.1 s and the wrist tremble at rest.
_KP = np.array([4500.0, 4500.0, 3500.0, 3500.0, 1000.0, 1000.0, 400.0])
_GAINS = {"kp": tuple(_KP), "kv": tuple(_KP / 40)}
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
        self._link = socket.create_connection((self.host, CONTROL))
        self._lines = self._link.makefile("rw")
        return self

    def __exit__(self, *_):
        self._lines.close()
        self._link.close()
        self._process.kill()
        self._process.communicate()

    def order(self, line):
        """Say a line; returns what is answered."""
        self._lines.write(line + "\n")
        self._lines.flush()
        return json.loads(self._lines.readline())

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
    seen, socketserver.ThreadingTCPServer.allow_reuse_address = [], True

    class Orders(socketserver.StreamRequestHandler):
        def handle(self):
            for line in self.rfile:
                answer = _obeyed(line.decode(), told, seen, RobotMode)
                self.wfile.write(json.dumps(answer).encode() + b"\n")

    with MujocoSimulator(enable_visualization=False) as sim:
        robot = sim.add_robot(initial_q=HOME, **_GAINS)
        with (
            SimulationServer(sim, [host]) as server,
            socketserver.ThreadingTCPServer((host, CONTROL), Orders) as orders,
        ):
            orders.daemon_threads = True
            for work in (orders.serve_forever, _end_with_parent):
                threading.Thread(target=work, daemon=True).start()
            print("ready", flush=True)
            for tick in itertools.count():
                server.run_once()
                inner = robot.state
                seen.append((time.monotonic(), 1e-3 * tick, *inner.q))


def _obeyed(line, told, seen, modes):
    if "status" in line:
        _, clock, *joints = seen[-1]
        return {"clock": clock, "joints": joints}
    word, *rest = line.split()
    if word == "mode":
        told.clear()
        if rest[0] != "own":
            told["mode"] = modes[rest[0]]
    elif word == "clear":
        del seen[:-1]
    return [(t, *q) for t, _, *q in list(seen)] if word == "report" else True


def _end_with_parent():
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        _serve(sys.argv[1])
