"""Run an emulator: ``python -m tests.ur_emulator --host 127.0.0.2``."""

from __future__ import annotations

import argparse
import asyncio
import ipaddress
import json
import os
import sys
import time
from collections.abc import Awaitable, Callable

from tests.ur_emulator.faults import Faults
from tests.ur_emulator.lines import ControlPort, Dashboard, ScriptPort
from tests.ur_emulator.robot import Robot
from tests.ur_emulator.rtde_server import RtdeServer

CONTROL = 30020
_SLOW, _FAST = 0.004, 0.002  # s between cycles
_LATE = 0.05  # s of cycles that are made up for after the machine was busy

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


def parser() -> argparse.ArgumentParser:
    """Options of the program."""
    out = argparse.ArgumentParser(prog="python -m tests.ur_emulator", description=__doc__)
    out.add_argument("--host", default="127.0.0.1", help="loopback address to listen on (default 127.0.0.1)")
    out.add_argument("--model", default="ur10e", help="ur10e or ur5e")
    out.add_argument("--serial", default="20235500001", help="the arm's serial number, digits")
    out.add_argument(
        "--stay", action="store_true", help="go on when the program that started it ends (stdin closes)"
    )
    return out


async def run(host: str, robot: Robot, *, stay: bool = False) -> None:
    """Listen on all ports and play the robot until stdin closes (for ever with ``stay``)."""
    rtde = RtdeServer(robot)
    scripts = ScriptPort(robot)
    ports: dict[int, Serve] = {
        29999: Dashboard(robot).serve,
        30001: scripts.serve,
        30002: scripts.serve,
        30003: scripts.serve,
        CONTROL: ControlPort(robot).serve,
        30004: rtde.serve,
    }
    for port, serve in ports.items():
        await asyncio.start_server(serve, host, port)
    print(json.dumps({"ready": host, "control": CONTROL}), flush=True)
    if not stay:
        asyncio.get_running_loop().add_reader(sys.stdin, _end_with_parent)
    due = time.monotonic()
    while True:
        robot.tick()
        rtde.send()
        now = time.monotonic()
        due = max(due + (_FAST if rtde.fastest > 250 else _SLOW), now - _LATE)
        await asyncio.sleep(max(0.0, due - now))


def _end_with_parent() -> None:
    """End when whoever started this has ended."""
    if not os.read(sys.stdin.fileno(), 4096):
        os._exit(0)


def main() -> None:
    """Run the program."""
    args = parser().parse_args()
    if not ipaddress.ip_address(args.host).is_loopback:
        raise SystemExit(f"--host: expected a loopback address, got {args.host}: this is no real controller")
    robot = Robot(args.model, Faults(), serial=args.serial)
    try:
        asyncio.run(run(args.host, robot, stay=args.stay))
    except KeyboardInterrupt:
        os._exit(130)


if __name__ == "__main__":
    main()
