"""RTDE, the Real-Time Data Exchange protocol of Universal Robots, version 2: packages, types and codes; no sockets.

Everything is big-endian. A package is ``uint16 size`` (header included), ``uint8 kind``, payload. See the manufacturer's
"Real-Time Data Exchange (RTDE) Guide".

Bits of ``safety_status_bits``: 0 normal, 1 reduced, 2 protective stop, 3 recovery, 4 safeguard, 5 system emergency stop,
6 robot emergency stop, 7 emergency stopped, 8 violation, 9 fault, 10 stopped due to safety. This file alone gives them
and the modes a meaning.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

from tofcapture.devices import faults
from tofcapture.errors import DeviceError

VERSION, CONTROLLER, TEXT = ord("V"), ord("v"), ord("M")
OUTPUTS, INPUTS, START, PAUSE, DATA = ord("O"), ord("I"), ord("S"), ord("P"), ord("U")

PORT = 30004
_HEADER = struct.Struct(">HB")
_LAYOUT = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip

PLAYING = 2
_RUNNING = 7
_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirming safety", 2: "booting", 3: "power off", 4: "power on",
    5: "idle, brakes closed", 6: "backdrive", 8: "updating firmware",
}  # fmt: skip
_STATES = {0: "is stopping", 1: "stopped", 3: "is pausing", 4: "is paused", 5: "is resuming"}
_STOPS: tuple[tuple[int, type[faults.ArmFault], str], ...] = (
    (1 << 5 | 1 << 6 | 1 << 7, faults.EmergencyStop, "emergency stop"),
    (1 << 8, faults.SafetyStop, "safety violation"),
    (1 << 9, faults.SafetyStop, "safety fault"),
    (1 << 2, faults.ProtectiveStop, "protective stop"),
    (1 << 4, faults.SafetyStop, "safeguard stop"),
    (1 << 3, faults.SafetyStop, "recovery mode"),
    (1 << 10, faults.SafetyStop, "stopped for safety"),
)

Value = float | tuple[float, ...]


def package(kind: int, payload: bytes = b"") -> bytes:
    """Put a header before a payload of at most 65532 bytes."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class Splitter:
    """Cuts a stream, which joins and splits packages as it likes, back into packages."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Take bytes, yield (kind, payload) of every complete package; raises DeviceError when this is no RTDE."""
        self._buffer += data
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if size < _HEADER.size:
                raise DeviceError(f"RTDE: expected a package of 3 bytes or more, got size {size}")
            if len(self._buffer) < size:
                return
            payload = bytes(self._buffer[_HEADER.size : size])
            del self._buffer[:size]
            yield kind, payload


class Recipe:
    """A fixed list of variables and their RTDE types, as agreed at setup; raises DeviceError for an unknown type."""

    def __init__(self, names: Sequence[str], types: Sequence[str]) -> None:
        unknown = sorted({t for t in types if t not in _LAYOUT})
        if unknown or len(names) != len(types):
            raise DeviceError(f"RTDE: expected a known type for each of {len(names)} variables, got {types}")
        self.names = tuple(names)
        self._counts = [int(_LAYOUT[t][:-1] or 1) for t in types]
        self.layout = struct.Struct(">" + "".join(_LAYOUT[t] for t in types))

    def unpack(self, data: bytes) -> dict[str, Value]:
        """Turn bytes into values by name: numbers, or tuples for vectors. Raises DeviceError for another size."""
        if len(data) != self.layout.size:
            raise DeviceError(f"RTDE: expected {self.layout.size} bytes of data, got {len(data)}")
        flat = iter(self.layout.unpack(data))
        taken = [tuple(next(flat) for _ in range(count)) for count in self._counts]
        return {n: t if len(t) > 1 else t[0] for n, t in zip(self.names, taken, strict=True)}


def split_names(payload: bytes) -> list[str]:
    """Names of a comma-separated list; empty ones, as after a trailing comma, are dropped."""
    return [name for name in payload.decode("ascii", "replace").split(",") if name]


def danger(bits: int, mode: int) -> faults.ArmFault | None:
    """Name what stands in the way of motion, by ``safety_status_bits`` and ``robot_mode``; the gravest state first."""
    for mask, kind, name in _STOPS:
        if bits & mask:
            return kind(f"the controller reports: {name}")
    if mode != _RUNNING:
        return faults.NotReady(f"the arm is not running: {_MODES.get(mode, f'mode {mode}')}")
    return None


def halted(runtime: int) -> faults.ArmFault | None:
    """Name what is wrong with the control script, by ``runtime_state``."""
    if runtime == PLAYING:
        return None
    return faults.ProgramStopped(f"the control script {_STATES.get(runtime, f'is in state {runtime}')}")
