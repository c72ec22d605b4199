"""The module's side of the protocol, without input or output: what a firmware has to do, in Python."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tests.tof_module.synthetic import Source, whitened
from tofcapture.devices.tof_serial.messages import (
    CELSIUS_UNKNOWN,
    DATA,
    BurstState,
    Capture,
    Frame,
    FrameKey,
    Info,
    MalformedError,
    Progress,
    Read,
    Reason,
    Refused,
    Time,
)
from tofcapture.devices.tof_serial.packet import PROTOCOL, Kind, Packet, Parser, encode, pack12


@dataclass(frozen=True)
class _Burst:
    """A burst in memory: host's number, our count of it, frames, and the clock at its start."""

    number: int
    count: int
    frames: int
    start_us: int


class _RefusalError(Exception):
    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.refused = Refused(reason, text)


class ModuleCore:
    """A module: bytes in, bytes out; ``exposed`` counts its bursts.

    Parameters
    ----------
    info
        What HELLO answers.
    source
        Where frames come from.
    protocol
        Version written into packets; another than the host's plays a foreign firmware.
    reset_in
        Bursts (counted from 0) in the middle of which the module starts anew.
    """

    def __init__(
        self, info: Info, source: Source, protocol: int = PROTOCOL, reset_in: frozenset[int] = frozenset()
    ) -> None:
        self.info, self._source = info, source
        self._protocol, self._reset_in = protocol, reset_in
        self._parser = Parser()
        self._replies: deque[bytes] = deque()
        self._upload: Iterator[bytes] = iter(())
        self._burst: _Burst | None = None
        self.exposed = self._seq = self._birth_us = 0
        self._packed: dict[int, tuple[bytes, Frame]] = {}

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes that arrived at ``now_us`` of any monotonic clock."""
        for packet in self._parser.feed(data):
            if packet.protocol != self._protocol and packet.kind != Kind.HELLO:
                continue
            self._answer(packet, now_us)

    def outgoing(self) -> bytes:
        """Give the next packet to send; empty when there is none."""
        if self._replies:
            return self._replies.popleft()
        return next(self._upload, b"")

    def reset(self, now_us: int) -> None:
        """Start anew: memory, clock and boot number."""
        self.info = replace(self.info, boot=(self.info.boot + 1) & 0xFFFFFFFF)
        self._birth_us, self._burst = now_us, None
        self._packed.clear()
        self._replies.clear()
        self._upload = iter(())

    def _send(self, kind: Kind, token: int, body: bytes) -> bytes:
        self._seq += 1
        return encode(Packet(kind, token, body, self._seq, self._protocol))

    def _answer(self, packet: Packet, now_us: int) -> None:
        """One request, one reply; any request ends the upload that is running."""
        self._upload = iter(())
        self._perhaps_reset(now_us)
        try:
            reply = self._reply(packet, now_us)
        except MalformedError as err:
            reply = (Kind.REFUSED, Refused(Reason.MALFORMED, str(err)).pack())
        except _RefusalError as err:
            reply = (Kind.REFUSED, err.refused.pack())
        if reply is not None:
            self._replies.append(self._send(reply[0], packet.token, reply[1]))

    def _perhaps_reset(self, now_us: int) -> None:
        if self._burst is None or self._burst.count not in self._reset_in:
            return
        if now_us - self._birth_us - self._burst.start_us > self._burst.frames * self.info.period_us // 2:
            self.reset(now_us)

    def _reply(self, packet: Packet, now_us: int) -> tuple[Kind, bytes] | None:
        clock = now_us - self._birth_us
        if packet.kind == Kind.HELLO:
            return Kind.INFO, self.info.pack()
        if packet.kind == Kind.SYNC:
            return Kind.TIME, Time(self.info.boot, clock).pack()
        if packet.kind == Kind.CAPTURE:
            self._capture(Capture.unpack(packet.body), clock)
            return Kind.STATE, self._state(clock).pack()
        if packet.kind == Kind.RELEASE:
            self._burst = None
            self._packed.clear()
        if packet.kind in (Kind.STATUS, Kind.RELEASE):
            return Kind.STATE, self._state(clock).pack()
        if packet.kind == Kind.META:
            key = FrameKey.unpack(packet.body)
            return Kind.FRAME, self._frame(key.burst, key.frame, clock)[1].pack()
        if packet.kind == Kind.READ:
            self._upload = self._chunks(Read.unpack(packet.body), packet.token, clock)
            return None
        raise _RefusalError(Reason.UNKNOWN_KIND, f"kind {packet.kind}")

    def _capture(self, ask: Capture, clock: int) -> None:
        if self._burst is not None and self._burst.number == ask.burst:
            return
        if not 1 <= ask.frames <= self.info.frames:
            raise _RefusalError(
                Reason.TOO_MANY_FRAMES, f"{ask.frames} frames, memory holds {self.info.frames}"
            )
        if self._burst is not None and self._done(clock) < self._burst.frames:
            raise _RefusalError(Reason.BUSY, f"burst {self._burst.number} is being exposed")
        self._burst = _Burst(ask.burst, self.exposed, ask.frames, clock)
        self.exposed += 1
        self._packed.clear()

    def _done(self, clock: int) -> int:
        assert self._burst is not None
        return min((clock - self._burst.start_us) // self.info.period_us, self._burst.frames)

    def _state(self, clock: int) -> BurstState:
        if self._burst is None:
            return BurstState(self.info.boot, 0, Progress.NONE, 0)
        done = self._done(clock)
        progress = Progress.READY if done == self._burst.frames else Progress.EXPOSING
        return BurstState(self.info.boot, self._burst.number, progress, done)

    def _frame(self, burst: int, frame: int, clock: int) -> tuple[bytes, Frame]:
        if self._burst is None or self._burst.number != burst:
            raise _RefusalError(Reason.NO_SUCH_BURST, f"burst {burst}")
        if frame >= self._done(clock):
            raise _RefusalError(Reason.OUT_OF_RANGE, f"frame {frame} of {self._done(clock)}")
        if frame not in self._packed:
            self._packed[frame] = self._pack(self._burst, frame)
        return self._packed[frame]

    def _pack(self, burst: _Burst, frame: int) -> tuple[bytes, Frame]:
        raw, celsius = self._source(burst.count, frame)
        data = pack12(raw) if self.info.bits == 12 else raw.astype("<u2").tobytes()
        centi = CELSIUS_UNKNOWN if np.isnan(celsius) else round(100 * celsius)
        start = burst.start_us + frame * self.info.period_us
        full = int((raw >= 2**self.info.bits - 1).sum())
        meta = Frame(burst.number, frame, len(data), zlib.crc32(data), start, centi, full)
        return whitened(data), meta

    def _chunks(self, read: Read, token: int, clock: int) -> Iterator[bytes]:
        data, meta = self._frame(read.burst, read.frame, clock)
        if any(b > meta.size for _, b in read.ranges) or not 1 <= read.chunk <= self.info.chunk:
            raise _RefusalError(Reason.OUT_OF_RANGE, f"chunk {read.chunk}, {read.ranges}, {meta.size} bytes")
        return self._stream(data, read, token)

    def _stream(self, data: bytes, read: Read, token: int) -> Iterator[bytes]:
        for start, stop in read.ranges:
            for at in range(start, stop, read.chunk):
                head = DATA.pack(read.burst, read.frame, at)
                yield self._send(Kind.DATA, token, head + data[at : min(at + read.chunk, stop)])
        yield self._send(Kind.END, token, b"")
