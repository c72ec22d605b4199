"""Packets and the parser that finds them in a stream of bytes; no input or output of its own.

A packet is ``header, body, CRC-32``, stuffed by COBS, with a 0x00 on both ends. docs/serial-protocol.md is the reference.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from enum import IntEnum

from tofcapture.devices.tof_serial import cobs

PROTOCOL = 1
HEADER = struct.Struct("<BBHI")  # protocol, kind, sequence number, token
_CRC = struct.Struct("<I")
MAX_BODY = 16384 + 64
_MAX_PACKET = HEADER.size + MAX_BODY + _CRC.size
_MAX_ENCODED = _MAX_PACKET + _MAX_PACKET // 254 + 1


class Kind(IntEnum):
    """What a packet is; those of the module have the high bit set."""

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

    Attributes
    ----------
    kind
        A :class:`Kind`, or a number that this version does not know.
    token
        Chosen by the host for each request; replies repeat it.
    body
        What the kind says.
    seq
        The sender's count of packets, modulo 65536.
    protocol
        The sender's version.
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
    return b"\0" + cobs.encode(raw + _CRC.pack(zlib.crc32(raw))) + b"\0"


def decode(piece: bytes | bytearray) -> Packet | None:
    """Read what stood between two delimiters; ``None`` when it is no whole packet."""
    raw = cobs.decode(piece)
    if raw is None or not HEADER.size + _CRC.size <= len(raw) <= _MAX_PACKET:
        return None
    view = memoryview(raw)
    if zlib.crc32(view[: -_CRC.size]) != _CRC.unpack_from(raw, len(raw) - _CRC.size)[0]:
        return None
    protocol, kind, seq, token = HEADER.unpack_from(raw)
    return Packet(kind, token, raw[HEADER.size : -_CRC.size], seq, protocol)


@dataclass
class Parser:
    """Finds packets in bytes that arrive in any pieces; after damage it goes on at the next 0x00.

    Attributes
    ----------
    packets, damaged, lost
        Counts: whole packets, pieces that were none, packets that the sender's sequence numbers miss.
    """

    packets: int = 0
    damaged: int = 0
    lost: int = 0
    _rest: bytearray = field(default_factory=bytearray)
    _skipping: bool = False
    _next: int | None = None

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes, return the packets that they complete; never raises on any input."""
        if b"\0" not in data:
            self._keep(data)
            return []
        *pieces, rest = data.split(b"\0")
        pieces[0] = bytes(self._rest) + pieces[0]
        self._rest.clear()
        if self._skipping:
            self._skipping, pieces[0] = False, b""
        found = [p for p in map(self._piece, pieces) if p is not None]
        self._keep(rest)
        return found

    def _keep(self, data: bytes) -> None:
        """Hold the beginning of a packet, but never more than the longest one."""
        if self._skipping:
            return
        self._rest += data
        if len(self._rest) > _MAX_ENCODED:
            self._rest.clear()
            self._skipping = True
            self.damaged += 1

    def _piece(self, piece: bytes) -> Packet | None:
        if not piece:
            return None
        packet = decode(piece) if len(piece) <= _MAX_ENCODED else None
        if packet is None:
            self.damaged += 1
            return None
        if self._next is not None:
            gap = (packet.seq - self._next) & 0xFFFF
            self.lost += gap if gap < 0x8000 else 0
        self._next = (packet.seq + 1) & 0xFFFF
        self.packets += 1
        return packet
