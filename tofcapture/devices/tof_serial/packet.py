"""Packets, the parser that finds them in a stream of bytes, and the frames that they carry; no input or output of its own.

A packet is ``header, body, CRC-32``, stuffed by COBS, with a 0x00 on both ends. docs/serial-protocol.md is the reference.
COBS (Cheshire and Baker, IEEE/ACM Trans. Networking 7(2), 1999) turns any bytes into bytes without 0x00.
Frames are whitened, so that images are not all zero bytes, and packed to 12 bits.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError

try:
    from cobs import cobs
except ImportError as err:
    raise ConfigError(
        f"the driver tof_serial needs the Python package cobs: {err}",
        hint="pip install 'tofcapture[serial]'",
    ) from err

PROTOCOL = 1
HEADER = struct.Struct("<BBHI")  # protocol, kind, sequence number, token
_CRC = struct.Struct("<I")
MAX_BODY = 16384 + 64
_MAX_PACKET = HEADER.size + MAX_BODY + _CRC.size
_MAX_ENCODED = _MAX_PACKET + _MAX_PACKET // 254 + 1


class Kind(IntEnum):
    """Kinds of packets. Those of the module have the high bit set."""

    HELLO = 0x01
    SYNC = 0x02
    CAPTURE = 0x03
    STATUS = 0x04
    META = 0x05
    READ = 0x06
    RELEASE = 0x07
    INFO = 0x81
    TIME = 0x82
    STATE = 0x84
    FRAME = 0x85
    DATA = 0x86
    END = 0x87
    REFUSED = 0xFF


@dataclass(frozen=True)
class Packet:
    """One packet whose CRC is right.

    ``kind`` may be a number that this version does not know. ``token`` is chosen by the host for each request, and
    replies repeat it. ``seq`` counts the sender's packets modulo 65536, ``protocol`` is its version.
    """

    kind: int
    token: int
    body: bytes
    seq: int = 0
    protocol: int = PROTOCOL


def encode(packet: Packet) -> bytes:
    """Bytes for the wire, delimiters on both ends: a packet after noise is then not lost with it."""
    if len(packet.body) > MAX_BODY:
        raise ValueError(f"packet: expected a body of at most {MAX_BODY} bytes, got {len(packet.body)}")
    raw = HEADER.pack(packet.protocol, packet.kind, packet.seq & 0xFFFF, packet.token) + packet.body
    stuffed: bytes = cobs.encode(raw + _CRC.pack(zlib.crc32(raw)))
    return b"\0" + stuffed + b"\0"


def decode(piece: bytes | bytearray) -> Packet | None:
    """Read what stood between two delimiters; ``None`` when it is no whole packet."""
    try:
        raw = cobs.decode(piece)
    except cobs.DecodeError:
        return None
    if not HEADER.size + _CRC.size <= len(raw) <= _MAX_PACKET:
        return None
    view = memoryview(raw)
    if zlib.crc32(view[: -_CRC.size]) != _CRC.unpack_from(raw, len(raw) - _CRC.size)[0]:
        return None
    protocol, kind, seq, token = HEADER.unpack_from(raw)
    return Packet(kind, token, raw[HEADER.size : -_CRC.size], seq, protocol)


class Parser:
    """Finds packets in bytes that arrive in any pieces; after damage it goes on at the next 0x00."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes, return the packets that they complete; never raises on any input."""
        *pieces, rest = data.split(b"\0")
        if pieces:
            pieces[0] = bytes(self._rest) + pieces[0]
            self._rest.clear()
        self._rest += rest
        if len(self._rest) > _MAX_ENCODED:
            self._rest.clear()  # no packet is that long; what follows up to the next 0x00 does not decode
        found = (decode(piece) for piece in pieces if piece and len(piece) <= _MAX_ENCODED)
        return [packet for packet in found if packet is not None]


_KEY = ((167 * np.arange(256) + 13) % 256).astype(np.uint8)


def packed_size(values: int, bits: int) -> int:
    """Bytes of so many values of 12 or 16 bits."""
    return (values * bits + 7) // 8


def pack12(values: NDArray[np.uint16]) -> bytes:
    """Pack 12-bit values, low bits first: a and b become ``a & 255, a >> 8 | (b & 15) << 4, b >> 4``.

    ``values`` are of any shape, uint16, each below 4096; an odd count is filled up with a zero half byte.
    """
    flat = np.ascontiguousarray(values, dtype="<u2").reshape(-1)
    odd = flat.size % 2
    pairs = np.append(flat, np.uint16(0)) if odd else flat
    a, b = pairs[0::2], pairs[1::2]
    out = np.empty((pairs.size // 2, 3), dtype=np.uint8)
    out[:, 0], out[:, 1], out[:, 2] = a & 255, a >> 8 | (b & 15) << 4, b >> 4
    return out.tobytes()[: packed_size(flat.size, 12)]


def unpack12(data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Undo :func:`pack12`: (packed_size(count, 12),) uint8 become (count,) uint16."""
    pairs = (count + 1) // 2
    words = np.zeros(pairs, dtype="<u4")
    # Each pair is read as one 32-bit word at its first byte; the last one would need a byte that is not there.
    if pairs > 1:
        words[:-1] = np.ndarray((pairs - 1,), dtype="<u4", buffer=data, strides=(3,))
    tail = data[3 * (pairs - 1) :] if pairs else data
    words.view(np.uint8)[4 * (pairs - 1) :][: tail.size] = tail
    high = words & 0xFFF000
    high <<= 4
    words &= 0xFFF
    words |= high
    return words.view("<u2")[:count]


def whiten(data: NDArray[np.uint8], offset: int = 0) -> None:
    """XOR in place with a fixed sequence, its own inverse: byte i of a frame with ``(167 i + 13) mod 256``.

    The sequence runs through all byte values, so constant stretches of an image give one zero in 256 bytes, and a COBS
    decoder has long blocks to copy.

    ``data`` is (N,) uint8; ``offset`` is the place of its first byte within its frame.
    """
    key = np.roll(_KEY, -(offset % 256))
    whole = data.size // 256 * 256
    rows = data[:whole].reshape(-1, 256)
    np.bitwise_xor(rows, key, out=rows)
    data[whole:] ^= key[: data.size - whole]


def values(data: NDArray[np.uint8], shape: tuple[int, ...], bits: int) -> NDArray[np.uint16]:
    """Turn a frame's bytes into its values (shape) uint16; ``bits`` is 12 (packed) or 16 (little-endian)."""
    flat = unpack12(data, int(np.prod(shape))) if bits == 12 else data.view("<u2")
    return flat.reshape(shape)


class Assembly:
    """One frame of ``size`` bytes, put together from chunks that come in any order, twice, or not at all."""

    def __init__(self, size: int) -> None:
        self._bytes = bytearray(size)
        self.missing: list[tuple[int, int]] = [(0, size)] if size else []

    def put(self, offset: int, data: bytes | memoryview) -> int:
        """Lay a chunk in its place; returns how many of its bytes were missing. What lies outside is ignored."""
        stop = offset + len(data)
        if stop > len(self._bytes) or not data:
            return 0
        left, new = [], 0
        for i, (a, b) in enumerate(self.missing):
            if a >= stop:
                left += self.missing[i:]
                break
            low, high = max(a, offset), min(b, stop)
            if low >= high:
                left.append((a, b))
                continue
            new += high - low
            left += [r for r in ((a, low), (high, b)) if r[0] < r[1]]
        if new:
            self._bytes[offset:stop] = data
            self.missing = left
        return new

    def take(self, crc: int) -> NDArray[np.uint8] | None:
        """Bytes of the whole frame, no longer whitened; ``None`` when something is missing or its CRC-32 is another.

        To be called once: the bytes are handed over, not copied.
        """
        if self.missing:
            return None
        data = np.frombuffer(self._bytes, dtype=np.uint8)
        whiten(data)
        return data if zlib.crc32(self._bytes) == crc else None
