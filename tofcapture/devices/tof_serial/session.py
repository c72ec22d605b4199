"""The host's side of the protocol, without a port and without a clock.

Every request is a generator, a *script*: it yields what to send and how long to listen (:class:`Ask`), and is sent what
came (:class:`Heard`). The same script runs on a serial port, on a socket, and in a simulation with a simulated clock::

    info = port.run(Session().hello())       # tofcapture.devices.tof_serial.port
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.tof_serial.clock import Anchor, anchor
from tofcapture.devices.tof_serial.messages import (
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
from tofcapture.devices.tof_serial.packet import PROTOCOL, Assembly, Kind, Packet, encode
from tofcapture.errors import DeviceError

MS = 1_000_000  # ns
_REPLY = 200 * MS  # wait for the answer to a short request
_GAP = 250 * MS  # wait between two chunks of the largest size
_TRIES = 10  # of each short request
_SMALLEST_CHUNK = 128
_RANGES = 16  # per READ, so that a request is short enough to survive a bad link
_STALLED = 12  # rounds in a row without one new byte
_PINGS = 8
_MATCH = {Kind.HELLO: Kind.INFO, Kind.SYNC: Kind.TIME, Kind.META: Kind.FRAME}

T = TypeVar("T")


class LinkLostError(DeviceError):
    """The port is gone: a pulled cable, a module without power, another process on the port."""


class ModuleSilentError(DeviceError):
    """The port is open but nobody answers."""


class LinkTooBadError(DeviceError):
    """The link loses so much that a frame cannot be completed, or answers never arrive."""


class ModuleResetError(DeviceError):
    """The module started anew in the middle of the work; its burst is gone."""


class FirmwareError(DeviceError):
    """The module's firmware or protocol is not one that this host, or this station, works with."""


class ModuleRefusedError(DeviceError):
    """The module says no, or says something that the protocol does not allow."""


@dataclass(frozen=True)
class Ask:
    """Send these bytes, then listen until packets come or the host clock says ``until`` (ns)."""

    send: bytes
    until: int


@dataclass(frozen=True)
class Heard:
    """Packets that came, and the host clock (ns) right after."""

    now: int
    packets: tuple[Packet, ...] = ()


Script = Generator[Ask, Heard, T]
_NOW = Ask(b"", 0)  # tells the time and sends nothing


@dataclass
class Session:
    """Sends requests and understands replies.

    The host asks for DATA payloads of ``largest_chunk`` bytes at first, and adapts to the link.
    """

    largest_chunk: int = 16384
    chunk: int = 0
    boot: int | None = None
    foreign: int | None = None
    heard: int = 0
    _token: int = 0

    def _encode(self, kind: Kind, body: bytes) -> bytes:
        self._token = (self._token + 1) & 0xFFFFFFFF
        return encode(Packet(kind, self._token, body, self._token & 0xFFFF))

    def _mine(self, heard: Heard) -> Iterator[Packet]:
        """Packets of our protocol; refusals of the present request become errors."""
        for packet in heard.packets:
            self.heard += 1
            if packet.protocol != PROTOCOL:
                self.foreign = packet.protocol
                continue
            if packet.kind == Kind.REFUSED and packet.token == self._token:
                _refuse(_read(Refused.unpack, packet))
            yield packet

    def request(self, kind: Kind, body: bytes, unpack: Callable[[bytes], T]) -> Script[tuple[int, int, T]]:
        """Ask until answered; returns (sent_ns, received_ns, answer).

        Raises :class:`ModuleSilentError`, :class:`LinkTooBadError`: no answer: to nothing at all, or to this
        request among others; :class:`FirmwareError`: answers come in another protocol;
        :class:`ModuleRefusedError`: the module says no.
        """
        answer, before = _MATCH.get(kind, Kind.STATE), self.heard
        now = (yield _NOW).now
        for _ in range(_TRIES):
            # A token per try: a late answer to an earlier one must not be taken for a quick one.
            sent, send = now, self._encode(kind, body)
            deadline = sent + _REPLY
            while now < deadline:
                heard = yield Ask(send, deadline)
                now, send = heard.now, b""
                for packet in self._mine(heard):
                    if packet.kind == answer and packet.token == self._token:
                        return sent, now, _read(unpack, packet)
        raise self._silence(Kind(kind).name, self.heard - before)

    def _silence(self, what: str, heard: int) -> Exception:
        if self.foreign is not None:
            return FirmwareError(
                f"the module speaks protocol {self.foreign}, this host speaks {PROTOCOL}",
                hint="update the module's firmware, or tofcapture",
            )
        if heard:
            return LinkTooBadError(
                f"{what}: gave up after many tries, though {heard} packets came",
                hint="shorter or shielded cable, a lower baud rate",
            )
        return ModuleSilentError(
            f"{what}: nobody answers",
            hint="is it the right port and baud rate, and is the module powered?",
        )

    def hello(self) -> Script[Info]:
        """Greet; forget whatever the module was before."""
        self.boot = self.foreign = None
        _, _, info = yield from self.request(Kind.HELLO, b"", Info.unpack)
        self.boot = info.boot
        self.chunk = self.largest_chunk = min(info.chunk, self.largest_chunk)
        return info

    def _same_boot(self, boot: int) -> None:
        if self.boot is not None and boot != self.boot:
            self.boot = None
            raise ModuleResetError(
                "the module started anew; its burst is lost",
                hint="check its power supply; the view is taken again",
            )

    def sync(self, pings: int = _PINGS) -> Script[Anchor]:
        """Compare clocks; ModuleResetError when the module has started anew since HELLO."""
        samples = []
        for _ in range(pings):
            sent, received, time = yield from self.request(Kind.SYNC, b"", Time.unpack)
            self._same_boot(time.boot)
            samples.append((sent, time.clock_us, received))
        return anchor(samples)

    def expose(self, burst: int, frames: int, period_us: int) -> Script[None]:
        """Take a burst into the module's memory; returns when it is exposed and the rig may move.

        Raises :class:`ModuleResetError`: the module started anew meanwhile, or has forgotten the burst;
        :class:`ModuleSilentError`: the burst does not become ready.
        """
        body = Capture(burst, frames).pack()
        _, now, state = yield from self.request(Kind.CAPTURE, body, BurstState.unpack)
        deadline = now + 2000 * frames * period_us + 1000 * MS
        while True:
            self._same_boot(state.boot)
            if state.burst != burst:
                raise ModuleResetError(
                    f"the module has forgotten burst {burst}", hint="the view is taken again"
                )
            if state.progress == Progress.READY and state.done == frames:
                return
            if now > deadline:
                raise ModuleSilentError(
                    f"burst: {state.done} of {frames} frames after {(2 * frames * period_us + 1e6) / 1e6:.1f} s",
                    hint="the sensor does not deliver; power-cycle the module",
                )
            wait = now + min(1000 * period_us, 20 * MS)
            while now < wait:
                now = (yield Ask(b"", wait)).now
            _, now, state = yield from self.request(Kind.STATUS, b"", BurstState.unpack)

    def release(self) -> Script[None]:
        """Let the module forget its burst."""
        yield from self.request(Kind.RELEASE, b"", BurstState.unpack)

    def frame(self, burst: int, index: int, size: int) -> Script[tuple[Frame, NDArray[np.uint8]]]:
        """Upload a frame of ``size`` bytes; missing chunks are asked for again, in smaller pieces where the link is bad.

        Raises :class:`LinkTooBadError`: it cannot be completed; :class:`ModuleRefusedError`: the module says
        that it has another size; :class:`ModuleResetError`: the module has forgotten the burst.
        """
        _, _, meta = yield from self.request(Kind.META, FrameKey(burst, index).pack(), Frame.unpack)
        if meta.size != size:
            raise ModuleRefusedError(
                f"frame {index}: expected {size} bytes, the module has {meta.size}",
                hint="its firmware is at fault",
            )
        for _ in range(2):
            assembly = Assembly(size)
            yield from self._fill(assembly, burst, index)
            data = assembly.take(meta.crc)
            if data is not None:
                return meta, data
        raise LinkTooBadError(
            f"frame {index}: every chunk's CRC is right, the frame's is not, twice",
            hint="the module's memory or firmware is at fault",
        )

    def _fill(self, assembly: Assembly, burst: int, index: int) -> Script[None]:
        stalled, before = 0, self.heard
        while assembly.missing:
            ranges = tuple(assembly.missing[:_RANGES])
            wanted = sum(b - a for a, b in ranges)
            got = yield from self._round(assembly, Read(burst, index, self.chunk, ranges))
            stalled = 0 if got else stalled + 1
            if stalled > _STALLED:
                left = sum(b - a for a, b in assembly.missing)
                raise self._silence(f"frame {index} lacks {left} bytes", self.heard - before)
            self._adapt(got / wanted)

    def _adapt(self, share: float) -> None:
        """Halve the chunk where less than half arrives; double it where nearly all does."""
        if share < 0.5:
            self.chunk = max(_SMALLEST_CHUNK, self.chunk // 2)
        elif share > 0.95:
            self.chunk = min(self.largest_chunk, self.chunk * 2)

    def _round(self, assembly: Assembly, read: Read) -> Script[int]:
        """One READ and what comes of it; returns the number of new bytes."""
        now = (yield _NOW).now
        send, got = self._encode(Kind.READ, read.pack()), 0
        gap = _REPLY // 4 + _GAP * self.chunk // self.largest_chunk
        deadline = now + gap
        while now < deadline:
            heard = yield Ask(send, deadline)
            now, send = heard.now, b""
            for packet in self._mine(heard):
                if packet.kind == Kind.DATA:
                    new = _lay(assembly, read, packet)
                    got += new
                    # Only what is new prolongs the wait: a module that repeats itself for ever is no progress.
                    deadline = now + gap if new else deadline
                elif packet.kind == Kind.END and packet.token == self._token:
                    return got
        return got


def _lay(assembly: Assembly, read: Read, packet: Packet) -> int:
    """Put a chunk in its place, whichever request it answers; chunks of other frames are late and ignored."""
    if len(packet.body) < DATA.size:
        raise ModuleRefusedError("DATA without an offset", hint="the module's firmware is at fault")
    burst, frame, offset = DATA.unpack_from(packet.body)
    if (burst, frame) != (read.burst, read.frame):
        return 0
    return assembly.put(offset, memoryview(packet.body)[DATA.size :])


def _read(unpack: Callable[[bytes], T], packet: Packet) -> T:
    try:
        return unpack(packet.body)
    except MalformedError as err:
        raise ModuleRefusedError(
            f"the module sent what the protocol does not allow: {err}", hint="its firmware is at fault"
        ) from err


def _refuse(refused: Refused) -> None:
    if refused.reason == Reason.NO_SUCH_BURST:
        raise ModuleResetError(
            f"the module has no such burst: {refused.text}",
            hint="it may have started anew; take the view again",
        )
    name = Reason(refused.reason).name if refused.reason in set(Reason) else str(refused.reason)
    raise ModuleRefusedError(
        f"the module refuses ({name}): {refused.text}", hint="see docs/serial-protocol.md"
    )
