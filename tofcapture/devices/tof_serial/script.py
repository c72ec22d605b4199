"""Scripts: what a side of a conversation sends and for how long it listens, without a port and without a clock."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import TypeVar

from tofcapture.devices.tof_serial.packet import Packet

MS = 1_000_000  # ns

T = TypeVar("T")


@dataclass(frozen=True)
class Ask:
    """Send these bytes, then listen until packets come or the host clock says ``until`` (ns)."""

    send: bytes
    until: int


@dataclass(frozen=True)
class Heard:
    """What came, and the host clock (ns) right after."""

    now: int
    packets: tuple[Packet, ...] = ()


Script = Generator[Ask, Heard, T]
NOW = Ask(b"", 0)
"""Tells the time and sends nothing."""


@dataclass(frozen=True)
class Timing:
    """How long the host waits; nanoseconds.

    Attributes
    ----------
    reply
        For the answer to a short request.
    gap
        Between two chunks, for the largest chunk.
    tries
        Of each short request.
    """

    reply: int = 200 * MS
    gap: int = 250 * MS
    tries: int = 10
