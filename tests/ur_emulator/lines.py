"""The ports that speak text: dashboard 29999, scripts 30001 to 30003, and the emulator's own control port."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from typing import Any

from tests.ur_emulator.robot import PLAYING, Program, Robot
from tests.ur_emulator.script import ControlScript

_PROGRAM = re.compile(rb"^def \w+\(\):.*?^end\s*$", re.DOTALL | re.MULTILINE)
_START = 0.05  # s between a script's last line and its first cycle


class Dashboard:
    """Port 29999: one line in, one line out."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Talk to one client until it quits."""
        faults = self._robot.faults
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            if faults.silent("banner"):
                await reader.read()
            writer.write(b"Connected: Universal Robots Dashboard Server\n")
            while line := await reader.readline():
                if faults.silent("dashboard"):
                    continue
                await asyncio.sleep(faults.delay)
                command = line.decode("utf-8", "replace").strip()
                writer.write(self.answer(command).encode() + b"\n")
                if command == "quit":
                    break
        writer.close()

    def answer(self, command: str) -> str:
        """Do a command and say what the controller says."""
        robot = self._robot
        playing = robot.runtime == PLAYING
        said = {
            "polyscopeversion": "URSoftware 5.11.1.108318 (Sep 22 2021)",
            "get serial number": robot.serial,
            "get robot model": robot.model.name.upper().rstrip("E"),
            "is in remote control": str(robot.remote).lower(),
            "running": f"Program running: {str(playing).lower()}",
            "robotmode": "Robotmode: RUNNING",
            "safetystatus": f"Safetystatus: {robot.safety_name}",
            "safetymode": f"Safetymode: {robot.safety_name}",
            "programstate": "PLAYING rtde_control" if playing else "STOPPED rtde_control",
            "close safety popup": "closing safety popup",
            "close popup": "closing popup",
            "power on": "Powering on",
            "brake release": "Brake releasing",
            "quit": "Disconnected",
        }
        word = command.lower()
        if word == "stop":
            robot.end_program()
            return "Stopped"
        if word == "unlock protective stop":
            late = "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"
            return "Protective stop releasing" if robot.unlock() else late
        if word.startswith(("popup", "addtolog")):
            return "showing popup" if word.startswith("popup") else "Added log message"
        return said.get(word, f"could not understand: '{command}'")


class ScriptPort:
    """Ports 30001 to 30003: takes URScript; sends nothing, which no known client minds."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._starting: set[asyncio.Task[None]] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take programs until the client goes."""
        text = b""
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while data := await reader.read(65536):
                text += data
                while found := _PROGRAM.search(text):
                    text = text[found.end() :]
                    self._begin(found.group())
        writer.close()

    def _begin(self, program: bytes) -> None:
        if self._robot.faults.silent("script"):
            return
        task = asyncio.get_running_loop().create_task(self._start(program))
        self._starting.add(task)
        task.add_done_callback(self._starting.discard)

    async def _start(self, program: bytes) -> None:
        self._robot.end_program()
        await asyncio.sleep(_START)
        self._robot.start_program(ControlScript() if b"rtde_control" in program else Program())


class ControlPort:
    """The emulator's own port: one JSON object a line, one answer a line; see :mod:`faults` for the orders."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take orders until the client goes."""
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while line := await reader.readline():
                writer.write(json.dumps(self._do(line)).encode() + b"\n")
        writer.close()

    def _do(self, line: bytes) -> dict[str, Any]:
        try:
            order = json.loads(line)
            wrong = self._order(order)
        except (ValueError, TypeError, AttributeError) as err:
            wrong = str(err)
        return {"ok": not wrong, "error": wrong, **self.status()}

    def _order(self, order: dict[str, Any]) -> str:
        robot = self._robot
        if order.get("do") == "status":
            return ""
        if order.get("do") == "remote":
            robot.remote = bool(order["on"])
            return ""
        if order.get("do") == "lift":
            robot.release()
            robot.remote = True
        return robot.faults.apply(order)

    def status(self) -> dict[str, Any]:
        """What the robot does, as JSON types."""
        robot = self._robot
        return {
            "joints": list(robot.joints),
            "velocity": list(robot.velocity),
            "moving": robot.motion is not None,
            "runtime": robot.runtime,
            "safety": robot.safety_name,
        }
