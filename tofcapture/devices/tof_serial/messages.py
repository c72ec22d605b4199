"""Bodies of packets: fixed little-endian layouts, each with ``pack`` and ``unpack``; docs/serial-protocol.md lists them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Self

from tofcapture.devices.tof_serial.packing import packed_size

CELSIUS_UNKNOWN = -0x8000


class MalformedError(ValueError):
    """A body whose CRC is right but whose layout is not: an error in the other side's software."""


def _unpack(layout: struct.Struct, body: bytes, what: str) -> tuple[Any, ...]:
    if len(body) < layout.size:
        raise MalformedError(f"{what}: expected at least {layout.size} bytes, got {len(body)}")
    return layout.unpack_from(body)


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("ascii", errors="replace")


class Progress(IntEnum):
    """Where a burst stands in the module."""

    NONE = 0
    EXPOSING = 1
    READY = 2


class Reason(IntEnum):
    """Why a module refused."""

    UNKNOWN_KIND = 1
    MALFORMED = 2
    NO_SUCH_BURST = 3
    TOO_MANY_FRAMES = 4
    BUSY = 5
    OUT_OF_RANGE = 6
    SENSOR = 7


@dataclass(frozen=True)
class Info:
    """INFO, the answer to HELLO.

    Attributes
    ----------
    firmware
        (major, minor).
    boot
        Differs after each start of the module.
    width, height, bits
        Pixels of one phase image; 12 or 16 bits per value.
    frames
        Frames that the module's memory holds.
    chunk
        Largest DATA payload that it sends, bytes.
    exposure_us
        Integration time of one phase image.
    period_us
        From one frame's start to the next.
    intrinsics
        fx, fy, cx, cy in 1/65536 pixel; all zero when the module does not know them.
    illuminator_um
        Light source in the camera's frame, micrometres.
    hz, phase
        Of each phase image: modulation frequency, and demodulation phase in 1/65536 turn.
    model, serial
        ASCII.
    """

    firmware: tuple[int, int]
    boot: int
    width: int
    height: int
    bits: int
    frames: int
    chunk: int
    exposure_us: int
    period_us: int
    intrinsics: tuple[int, int, int, int]
    illuminator_um: tuple[int, int, int]
    hz: tuple[int, ...]
    phase: tuple[int, ...]
    model: str
    serial: str

    _LAYOUT = struct.Struct("<HHIHHBBHHII4I3i32s16s")
    _CHANNEL = struct.Struct("<IH")

    @property
    def values(self) -> int:
        """Values of one frame."""
        return len(self.hz) * self.height * self.width

    @property
    def frame_bytes(self) -> int:
        """Bytes of one packed frame."""
        return packed_size(self.values, self.bits)

    def pack(self) -> bytes:
        """Write the body."""
        head = self._LAYOUT.pack(
            *self.firmware, self.boot, self.width, self.height, self.bits, len(self.hz), self.frames, self.chunk,
            self.exposure_us, self.period_us, *self.intrinsics, *self.illuminator_um,
            self.model.encode("ascii", "replace"), self.serial.encode("ascii", "replace"),
        )  # fmt: skip
        return head + b"".join(self._CHANNEL.pack(*c) for c in zip(self.hz, self.phase, strict=True))

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body; bytes behind it belong to later versions."""
        v = _unpack(cls._LAYOUT, body, "INFO")
        major, minor, boot, width, height, bits, channels, frames, chunk, exposure, period = v[:11]
        if len(body) < cls._LAYOUT.size + channels * cls._CHANNEL.size:
            raise MalformedError(f"INFO: expected {channels} channels, got {len(body)} bytes")
        if bits not in (12, 16) or not (width and height and channels and frames and chunk and period):
            raise MalformedError(
                f"INFO: impossible: {width} x {height} x {channels}, {bits} bits, {frames} frames"
            )
        rows = [
            cls._CHANNEL.unpack_from(body, cls._LAYOUT.size + i * cls._CHANNEL.size) for i in range(channels)
        ]
        return cls(
            (major, minor), boot, width, height, bits, frames, chunk, exposure, period, v[11:15], v[15:18],
            tuple(r[0] for r in rows), tuple(r[1] for r in rows), _text(v[18]), _text(v[19]),
        )  # fmt: skip


@dataclass(frozen=True)
class Time:
    """TIME, the answer to SYNC: boot number, and microseconds on the module's clock when SYNC arrived."""

    boot: int
    clock_us: int
    _LAYOUT = struct.Struct("<IQ")

    def pack(self) -> bytes:
        """Write the body."""
        return self._LAYOUT.pack(self.boot, self.clock_us)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        return cls(*_unpack(cls._LAYOUT, body, "TIME"))


@dataclass(frozen=True)
class Capture:
    """CAPTURE: expose ``frames`` frames as burst ``burst``; the same number again does nothing."""

    burst: int
    frames: int
    _LAYOUT = struct.Struct("<IH")

    def pack(self) -> bytes:
        """Write the body."""
        return self._LAYOUT.pack(self.burst, self.frames)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        return cls(*_unpack(cls._LAYOUT, body, "CAPTURE"))


@dataclass(frozen=True)
class State:
    """STATE, the answer to CAPTURE, STATUS and RELEASE: which burst the memory holds and how many frames are exposed."""

    boot: int
    burst: int
    progress: int
    done: int
    _LAYOUT = struct.Struct("<IIBH")

    def pack(self) -> bytes:
        """Write the body."""
        return self._LAYOUT.pack(self.boot, self.burst, self.progress, self.done)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        return cls(*_unpack(cls._LAYOUT, body, "STATE"))


@dataclass(frozen=True)
class FrameKey:
    """META (and the beginning of READ, FRAME and DATA): one frame of one burst."""

    burst: int
    frame: int
    _LAYOUT = struct.Struct("<IH")

    def pack(self) -> bytes:
        """Write the body."""
        return self._LAYOUT.pack(self.burst, self.frame)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        return cls(*_unpack(cls._LAYOUT, body, "META"))


@dataclass(frozen=True)
class Frame:
    """FRAME, the answer to META.

    Attributes
    ----------
    burst, frame
        Which.
    size, crc
        Bytes of the packed frame, and their CRC-32 before whitening.
    clock_us
        Module clock at the start of the exposure.
    centi_celsius
        1/100 degree, -32768 when unknown.
    saturated
        Number of saturated values.
    """

    burst: int
    frame: int
    size: int
    crc: int
    clock_us: int
    centi_celsius: int
    saturated: int
    _LAYOUT = struct.Struct("<IHIIQhI")

    def pack(self) -> bytes:
        """Write the body."""
        return self._LAYOUT.pack(
            self.burst, self.frame, self.size, self.crc, self.clock_us, self.centi_celsius, self.saturated
        )

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        return cls(*_unpack(cls._LAYOUT, body, "FRAME"))

    @property
    def celsius(self) -> float:
        """Degrees, NaN when unknown."""
        return float("nan") if self.centi_celsius == CELSIUS_UNKNOWN else self.centi_celsius / 100


@dataclass(frozen=True)
class Read:
    """READ: send these byte ranges of a frame in payloads of at most ``chunk`` bytes, then END."""

    burst: int
    frame: int
    chunk: int
    ranges: tuple[tuple[int, int], ...]
    _LAYOUT = struct.Struct("<IHHB")
    _RANGE = struct.Struct("<II")

    def pack(self) -> bytes:
        """Write the body; ranges are (start, stop)."""
        head = self._LAYOUT.pack(self.burst, self.frame, self.chunk, len(self.ranges))
        return head + b"".join(self._RANGE.pack(a, b - a) for a, b in self.ranges)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        burst, frame, chunk, count = _unpack(cls._LAYOUT, body, "READ")
        if len(body) < cls._LAYOUT.size + count * cls._RANGE.size:
            raise MalformedError(f"READ: expected {count} ranges, got {len(body)} bytes")
        rows = [cls._RANGE.unpack_from(body, cls._LAYOUT.size + i * cls._RANGE.size) for i in range(count)]
        return cls(burst, frame, chunk, tuple((a, a + n) for a, n in rows))


DATA = struct.Struct("<IHI")  # burst, frame, offset; then the whitened bytes


@dataclass(frozen=True)
class Refused:
    """REFUSED: why, and a sentence for people."""

    reason: int
    text: str
    _LAYOUT = struct.Struct("<B")

    def pack(self) -> bytes:
        """Write the body."""
        return self._LAYOUT.pack(self.reason) + self.text.encode("ascii", "replace")

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body."""
        (reason,) = _unpack(cls._LAYOUT, body, "REFUSED")
        return cls(reason, _text(body[1:]))
