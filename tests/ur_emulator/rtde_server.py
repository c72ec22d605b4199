"""Port 30004: recipes, data packages, and one writer for each input."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable, Sequence

from tests.ur_emulator.outputs import TYPES, input_type
from tests.ur_emulator.robot import Robot
from tofcapture.devices.ur_rtde import link as wire
from tofcapture.errors import DeviceError

_POLYSCOPE = (5, 11, 1, 108318)
_RATE = 500.0  # Hz of an e-series controller


def pack(recipe: wire.Recipe, values: Sequence[wire.Value]) -> bytes:
    """Turn values, in the recipe's order, into bytes."""
    flat: list[float] = []
    for value in values:
        flat.extend(value if isinstance(value, tuple) else (value,))
    return recipe.layout.pack(*flat)


class RtdeServer:
    """All RTDE clients of one robot.

    Parameters
    ----------
    robot
        The robot they watch and command.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._clients: set[_Client] = set()
        robot.faults.on_drop = self.drop

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Talk to one client until it goes."""
        client = _Client(self._robot, writer, self._taken)
        self._clients.add(client)
        with contextlib.suppress(ConnectionError, DeviceError, asyncio.CancelledError):
            await client.talk(reader)
        self._clients.discard(client)
        writer.close()

    def _taken(self) -> set[str]:
        """Inputs that have a writer."""
        return set().union(*(client.inputs for client in self._clients))

    def drop(self) -> None:
        """Cut all connections, as a pulled cable does that is plugged in again."""
        for client in list(self._clients):
            client.cut()

    def send(self) -> None:
        """Send every client the data that are due."""
        if self._robot.faults.frozen:
            return
        for client in list(self._clients):
            client.send()

    @property
    def fastest(self) -> float:
        """Highest rate that a client asked for, Hz."""
        return max((client.rate for client in self._clients), default=0.0)


class _Client:
    """One connection."""

    def __init__(self, robot: Robot, writer: asyncio.StreamWriter, taken: Callable[[], set[str]]) -> None:
        self._robot, self._writer, self._taken = robot, writer, taken
        self.inputs: set[str] = set()
        self._recipes: dict[int, wire.Recipe] = {}
        self._outputs: wire.Recipe | None = None
        self._started, self._next, self.rate = False, 0.0, 0.0

    async def talk(self, reader: asyncio.StreamReader) -> None:
        splitter = wire.Splitter()
        if self._robot.faults.silent("connect"):
            await reader.read()
        while data := await reader.read(65536):
            for kind, payload in splitter.feed(data):
                await self._answer(kind, payload)

    async def _answer(self, kind: int, payload: bytes) -> None:
        if kind == wire.DATA:
            self._write_registers(payload)
            return
        if self._robot.faults.silent(chr(kind)):
            return
        if self._robot.faults.delay:
            await asyncio.sleep(self._robot.faults.delay)
        reply = self._reply(kind, payload)
        if reply is not None:
            self._writer.write(wire.package(kind, reply))

    def _reply(self, kind: int, payload: bytes) -> bytes | None:
        if kind == wire.VERSION:
            return bytes([payload == b"\x00\x02"])
        if kind == wire.CONTROLLER:
            return struct.pack(">4I", *_POLYSCOPE)
        if kind == wire.OUTPUTS:
            return self._set_outputs(payload)
        if kind == wire.INPUTS:
            return self._set_inputs(payload)
        if kind in {wire.START, wire.PAUSE}:
            accepted = self._outputs is not None or kind == wire.PAUSE
            self._started = accepted and kind == wire.START
            return bytes([accepted])
        return None

    def _set_outputs(self, payload: bytes) -> bytes:
        names = wire.split_names(payload[8:])
        known = TYPES.keys() - self._robot.faults.lacking
        types = [TYPES[name] if name in known else "NOT_FOUND" for name in names]
        self.rate = min(max(struct.unpack(">d", payload[:8])[0], 1.0), _RATE)
        if names and "NOT_FOUND" not in types:
            self._outputs = wire.Recipe(names, types)
        return bytes([self._outputs is not None and "NOT_FOUND" not in types]) + ",".join(types).encode()

    def _set_inputs(self, payload: bytes) -> bytes:
        names = wire.split_names(payload)
        foreign = self._taken() - self.inputs
        types = ["IN_USE" if n in foreign else input_type(n) for n in names]
        if {"IN_USE", "NOT_FOUND"} & set(types):
            return bytes([0]) + ",".join(types).encode()
        number = len(self._recipes) + 1
        self._recipes[number] = wire.Recipe(names, types)
        self.inputs |= set(names)
        return bytes([number]) + ",".join(types).encode()

    def _write_registers(self, payload: bytes) -> None:
        """Take values in; a package of the wrong size is dropped, as the controller drops it."""
        recipe = self._recipes.get(payload[0] if payload else 0)
        if recipe is None or len(payload) != recipe.layout.size + 1:
            return
        for name, value in recipe.unpack(payload[1:]).items():
            number = name.rpartition("_")[2]
            if name.startswith("input_int_register_"):
                self._robot.int_in[int(number)] = int(value)  # type: ignore[arg-type]
                if number == "0":
                    self._robot.written_at = self._robot.now
            elif name.startswith("input_double_register_"):
                self._robot.double_in[int(number)] = float(value)  # type: ignore[arg-type]

    def send(self) -> None:
        if not self._started or self._outputs is None or self._robot.now < self._next:
            return
        if self._robot.faults.silent("U") or self._writer.is_closing():
            return
        self._next = max(self._next + 1 / self.rate, self._robot.now - 0.1)
        values = [self._value(name) for name in self._outputs.names]
        self._writer.write(wire.package(wire.DATA, b"\x01" + pack(self._outputs, values)))

    def _value(self, name: str) -> wire.Value:
        value = self._robot.output(name)
        if value is not None:
            return value
        return (0,) * int(TYPES[name][6:7]) if TYPES[name].startswith("VECTOR") else 0

    def cut(self) -> None:
        self._started = False
        self._writer.transport.abort()
