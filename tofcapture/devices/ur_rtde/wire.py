"""RTDE, the Real-Time Data Exchange protocol of Universal Robots, version 2: packages and types, no sockets.

Everything is big-endian. A package is ``uint16 size`` (header included), ``uint8 kind``, payload. See the manufacturer's
"Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

from tofcapture.errors import DeviceError

VERSION, CONTROLLER, TEXT = ord("V"), ord("v"), ord("M")
OUTPUTS, INPUTS, START, PAUSE, DATA = ord("O"), ord("I"), ord("S"), ord("P"), ord("U")

PORT = 30004
_HEADER = struct.Struct(">HB")
_LAYOUT = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

Value = float | tuple[float, ...]


def package(kind: int, payload: bytes = b"") -> bytes:
    """Put a header before a payload of at most 65532 bytes."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class Splitter:
    """Cuts a stream, which joins and splits packages as it likes, back into packages."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Take bytes, yield (kind, payload) of every complete package.

        Raises
        ------
        DeviceError
            A size below that of a header: the other side does not speak RTDE.
        """
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
    """A fixed list of typed values, as agreed at setup.

    Parameters
    ----------
    names
        Variables, in order.
    types
        Their RTDE type names.

    Raises
    ------
    DeviceError
        A type that RTDE does not have.
    """

    def __init__(self, names: Sequence[str], types: Sequence[str]) -> None:
        unknown = sorted({t for t in types if t not in _LAYOUT})
        if unknown or len(names) != len(types):
            raise DeviceError(f"RTDE: expected a known type for each of {len(names)} variables, got {types}")
        self.names = tuple(names)
        self._counts = [int(_LAYOUT[t][:-1] or 1) for t in types]
        self._struct = struct.Struct(">" + "".join(_LAYOUT[t] for t in types))

    @property
    def size(self) -> int:
        """Bytes of the values, without the recipe's number."""
        return self._struct.size

    def pack(self, values: Sequence[Value]) -> bytes:
        """Values in order to bytes."""
        flat: list[float] = []
        for value in values:
            flat.extend(value if isinstance(value, tuple) else (value,))
        return self._struct.pack(*flat)

    def unpack(self, data: bytes) -> dict[str, Value]:
        """Bytes to values by name: numbers, or tuples for vectors.

        Raises
        ------
        DeviceError
            Not the recipe's size.
        """
        if len(data) != self.size:
            raise DeviceError(f"RTDE: expected {self.size} bytes of data, got {len(data)}")
        flat = iter(self._struct.unpack(data))
        taken = [tuple(next(flat) for _ in range(count)) for count in self._counts]
        return {n: t if len(t) > 1 else t[0] for n, t in zip(self.names, taken, strict=True)}


def split_names(payload: bytes) -> list[str]:
    """Names of a comma-separated list; empty ones, as after a trailing comma, are dropped."""
    return [name for name in payload.decode("ascii", "replace").split(",") if name]
