"""Bodies of packets: fixed little-endian layouts, each with ``pack`` and ``unpack``; docs/serial-protocol.md lists them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Self

from tofcapture.devices.tof_serial.packet import packed_size

CELSIUS_UNKNOWN = -0x8000
DATA = struct.Struct("<IHI")  # burst, frame, offset; then the whitened bytes


class MalformedError(ValueError):
    """A body whose CRC is right but whose layout is not: an error in the other side's software."""


class Progress(IntEnum):
    """State of a burst in the module."""

    NONE = 0
    EXPOSING = 1
    READY = 2


class Reason(IntEnum):
    """Reason of a module's refusal."""

    UNKNOWN_KIND = 1
    MALFORMED = 2
    NO_SUCH_BURST = 3
    TOO_MANY_FRAMES = 4
    BUSY = 5
    OUT_OF_RANGE = 6
    SENSOR = 7


class Body:
    """A body of numbers in a fixed layout, the dataclass's fields in order; bytes behind it belong to later versions."""

    LAYOUT: ClassVar[struct.Struct]

    def pack(self) -> bytes:
        """Write the body."""
        return self.LAYOUT.pack(*vars(self).values())

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body; raises MalformedError when it is too short or impossible."""
        return cls(*cls._numbers(body))

    @classmethod
    def _numbers(cls, body: bytes) -> tuple[Any, ...]:
        if len(body) < cls.LAYOUT.size:
            raise MalformedError(
                f"{cls.__name__}: expected at least {cls.LAYOUT.size} bytes, got {len(body)}"
            )
        return cls.LAYOUT.unpack_from(body)

    @classmethod
    def _rows(cls, body: bytes, row: struct.Struct, count: int) -> list[tuple[int, ...]]:
        """Rows that follow the fixed layout."""
        if len(body) < cls.LAYOUT.size + count * row.size:
            raise MalformedError(f"{cls.__name__}: expected {count} rows, got {len(body)} bytes")
        return [row.unpack_from(body, cls.LAYOUT.size + i * row.size) for i in range(count)]


@dataclass(frozen=True)
class Info(Body):
    """INFO, the answer to HELLO."""

    firmware: tuple[int, int]  # major, minor
    boot: int  # differs after each start of the module
    width: int
    height: int
    bits: int  # of a value: 12 or 16
    frames: int  # that the module's memory holds
    chunk: int  # bytes of the largest DATA payload that it sends
    exposure_us: int  # of one phase image
    period_us: int  # from one frame's start to the next
    intrinsics: tuple[int, int, int, int]  # fx, fy, cx, cy in 1/65536 pixel; all zero when unknown
    illuminator_um: tuple[int, int, int]  # light source in the camera's frame
    hz: tuple[int, ...]  # modulation frequency of each phase image
    phase: tuple[int, ...]  # demodulation phase of each, in 1/65536 turn
    model: str  # ASCII
    serial: str

    LAYOUT = struct.Struct("<HHIHHBBHHII4I3i32s16s")
    _CHANNEL = struct.Struct("<IH")

    @property
    def frame_bytes(self) -> int:
        """Bytes of one packed frame."""
        return packed_size(len(self.hz) * self.height * self.width, self.bits)

    def pack(self) -> bytes:
        """Write the body."""
        head = self.LAYOUT.pack(
            *self.firmware, self.boot, self.width, self.height, self.bits, len(self.hz), self.frames, self.chunk,
            self.exposure_us, self.period_us, *self.intrinsics, *self.illuminator_um,
            self.model.encode("ascii", "replace"), self.serial.encode("ascii", "replace"),
        )  # fmt: skip
        return head + b"".join(self._CHANNEL.pack(*c) for c in zip(self.hz, self.phase, strict=True))

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body; raises MalformedError when it is too short or impossible."""
        v = cls._numbers(body)
        major, minor, boot, width, height, bits, channels, frames, chunk, exposure, period = v[:11]
        rows = cls._rows(body, cls._CHANNEL, channels)
        if bits not in (12, 16) or not (width and height and channels and frames and chunk and period):
            raise MalformedError(
                f"Info: impossible: {width} x {height} x {channels}, {bits} bits, {frames} frames"
            )
        return cls(
            (major, minor), boot, width, height, bits, frames, chunk, exposure, period, v[11:15], v[15:18],
            tuple(r[0] for r in rows), tuple(r[1] for r in rows), _text(v[18]), _text(v[19]),
        )  # fmt: skip


@dataclass(frozen=True)
class Time(Body):
    """TIME, the answer to SYNC: boot number, and microseconds on the module's clock when SYNC arrived."""

    boot: int
    clock_us: int
    LAYOUT = struct.Struct("<IQ")


@dataclass(frozen=True)
class Capture(Body):
    """CAPTURE: expose ``frames`` frames as burst ``burst``; the same number again does nothing."""

    burst: int
    frames: int
    LAYOUT = struct.Struct("<IH")


@dataclass(frozen=True)
class BurstState(Body):
    """STATE, the answer to CAPTURE, STATUS and RELEASE: which burst the memory holds, and how many frames are exposed."""

    boot: int
    burst: int
    progress: int
    done: int
    LAYOUT = struct.Struct("<IIBH")


@dataclass(frozen=True)
class FrameKey(Body):
    """META (and the beginning of READ, FRAME and DATA): one frame of one burst."""

    burst: int
    frame: int
    LAYOUT = struct.Struct("<IH")


@dataclass(frozen=True)
class Frame(Body):
    """FRAME, the answer to META."""

    burst: int
    frame: int
    size: int  # bytes of the packed frame
    crc: int  # CRC-32 of them, before whitening
    clock_us: int  # module clock at the start of the exposure
    centi_celsius: int  # -32768 when unknown
    saturated: int  # number of saturated values
    LAYOUT = struct.Struct("<IHIIQhI")

    @property
    def celsius(self) -> float:
        """Degrees, NaN when unknown."""
        return float("nan") if self.centi_celsius == CELSIUS_UNKNOWN else self.centi_celsius / 100


@dataclass(frozen=True)
class Read(Body):
    """READ: send these byte ranges (start, stop) of a frame in payloads of at most ``chunk`` bytes, then END."""

    burst: int
    frame: int
    chunk: int
    ranges: tuple[tuple[int, int], ...]
    LAYOUT = struct.Struct("<IHHB")
    _RANGE = struct.Struct("<II")

    def pack(self) -> bytes:
        """Write the body."""
        head = self.LAYOUT.pack(self.burst, self.frame, self.chunk, len(self.ranges))
        return head + b"".join(self._RANGE.pack(a, b - a) for a, b in self.ranges)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body; raises MalformedError when it is too short."""
        burst, frame, chunk, count = cls._numbers(body)
        rows = cls._rows(body, cls._RANGE, count)
        return cls(burst, frame, chunk, tuple((a, a + n) for a, n in rows))


@dataclass(frozen=True)
class Refused(Body):
    """REFUSED: why, and a sentence for people."""

    reason: int
    text: str
    LAYOUT = struct.Struct("<B")

    def pack(self) -> bytes:
        """Write the body."""
        return self.LAYOUT.pack(self.reason) + self.text.encode("ascii", "replace")

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Read the body; raises MalformedError when it is empty."""
        (reason,) = cls._numbers(body)
        return cls(reason, _text(body[1:]))


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("ascii", errors="replace")
