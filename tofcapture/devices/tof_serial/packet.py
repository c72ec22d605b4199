"""Packets and the parser that finds them in a stream of bytes; no input or output of its own.

A packet is ``header, body, CRC-32``, stuffed by COBS, with a 0x00 on both ends. docs/serial-protocol.md is the reference.
COBS (Cheshire and Baker, IEEE/ACM Trans. Networking 7(2), 1999) turns any bytes into bytes without 0x00.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

from tofcapture.errors import ConfigError

try:
    from cobs import cobs
except ImportError as err:
    raise ConfigError(
        f"the driver tof_serial needs the Python package cobs: {err}",
        hint="pip install 'tofcapture[hardware]'",
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
