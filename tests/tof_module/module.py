"""A simulated module on a pseudo terminal (or a TCP port), to test a host against, or a firmware's rig against a host.

::

    python -m tests.tof_module --link /tmp/tof0
    python -m tests.tof_module --tcp 7000         # port = "socket://127.0.0.1:7000"

Prints one line, the port to open, then runs until it is ended.
"""

from __future__ import annotations

import argparse
import os
import secrets
import select
import signal
import socket
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.tof_module.core import ModuleCore
from tests.tof_module.synthetic import simulated_info, synthetic
from tofcapture.devices.tof_serial.packet import PROTOCOL

_IDLE = 0.05  # s between looks at the clock while nothing comes


@dataclass
class Noise:
    """Damages pieces of a stream.

    Attributes
    ----------
    rng
        Source of damage.
    drop, flip, duplicate, insert
        Chance of each byte to vanish, to have bits flipped, to come twice, to be followed by a random one.
    truncate
        Chance of each byte that it and the rest of its piece never arrive.
    """

    rng: np.random.Generator
    drop: float = 0.0
    flip: float = 0.0
    duplicate: float = 0.0
    insert: float = 0.0
    truncate: float = 0.0

    @classmethod
    def every(cls, rng: np.random.Generator, rate: float) -> Noise:
        """All five kinds at the same rate per byte."""
        return cls(rng, rate, rate, rate, rate, rate)

    def __call__(self, piece: bytes) -> bytes:
        """Damage one piece, usually a packet."""
        rates = (self.drop, self.flip, self.duplicate, self.insert, self.truncate)
        if not piece or not any(rates):
            return piece
        # How many bytes are hit is binomial; which ones and how, uniform and by rate.
        hits = self.rng.binomial(len(piece), min(1.0, sum(rates)))
        if not hits:
            return piece
        out = bytearray(piece)
        places = np.sort(self.rng.choice(len(piece), hits, replace=False))[::-1]
        kinds = self.rng.choice(len(rates), hits, p=np.array(rates) / sum(rates))
        for place, kind in zip(places.tolist(), kinds.tolist(), strict=True):
            self._hit(out, place, kind)
        return bytes(out)

    def _hit(self, out: bytearray, place: int, kind: int) -> None:
        if kind == 0:
            del out[place]
        elif kind == 1:
            out[place] ^= int(self.rng.integers(1, 256))
        elif kind == 2:
            out.insert(place, out[place])
        elif kind == 3:
            out.insert(place + 1, int(self.rng.integers(256)))
        else:
            del out[place:]


def clock_us(drift_ppm: float = 0.0) -> Callable[[], int]:
    """Make a module's clock: microseconds since now, running off by some parts per million."""
    start = time.monotonic_ns()
    return lambda: int((time.monotonic_ns() - start) * (1 + drift_ppm * 1e-6)) // 1000


def serve(
    core: ModuleCore, descriptor: int, clock: Callable[[], int], noise: Noise | None = None, rate: float = 0.0
) -> None:
    """Let a module speak on an open descriptor until the other side closes it.

    Parameters
    ----------
    core
        The module.
    descriptor
        Terminal or socket, read and written.
    clock
        Microseconds.
    noise
        Damages what is sent and what is received.
    rate
        Bytes per second sent at most; 0 for no limit.
    """
    damage = noise or (lambda piece: piece)
    pending = b""
    while True:
        pending = pending or damage(core.outgoing())
        readable, writable, _ = select.select([descriptor], [descriptor] if pending else [], [], _IDLE)
        if readable:
            data = _read(descriptor)
            if not data:
                return
            core.receive(damage(data), clock())
        if writable:
            sent = _write(descriptor, pending)
            pending = pending[sent:]
            if rate:
                time.sleep(sent / rate)


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 65536)
    except OSError:
        return b""  # the other end of a pseudo terminal has gone


def _write(descriptor: int, data: bytes) -> int:
    try:
        return os.write(descriptor, data)
    except BlockingIOError:
        return 0
    except OSError:
        return len(data)


def open_terminal(link: Path | None = None) -> tuple[int, int, str]:
    """Open a raw pseudo terminal; returns our end, the other end (kept open so that hosts may come and go), its name."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    name = os.ttyname(theirs)
    if link is not None:
        link.unlink(missing_ok=True)
        link.symlink_to(name)
        name = str(link)
    return ours, theirs, name


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.tof_module", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--link", type=Path, help="symbolic link to make to the terminal")
    parser.add_argument(
        "--tcp", type=int, metavar="PORT", help="listen on 127.0.0.1 instead (0: any free port)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the frames and of the noise")
    parser.add_argument("--size", default="240x180", metavar="WxH")
    parser.add_argument("--rate", type=float, default=0.0, help="bytes per second, 0 for as fast as it goes")
    parser.add_argument("--drift", type=float, default=0.0, help="ppm that the module's clock runs fast")
    parser.add_argument("--noise", type=float, default=0.0, help="damage of each of five kinds, per byte")
    parser.add_argument("--protocol", type=int, default=PROTOCOL, help="version to pretend")
    parser.add_argument(
        "--reset-in", type=int, action="append", default=[], metavar="N", help="start anew in burst N"
    )
    parser.add_argument("--pull-in", type=int, metavar="N", help="end in burst N, as a pulled cable does")
    return parser.parse_args()


def main() -> None:
    """Run the simulated module."""
    args = _arguments()
    width, height = (int(v) for v in args.size.split("x"))
    info = simulated_info(width, height, boot=secrets.randbits(32))
    core = ModuleCore(
        info, synthetic(info, args.seed), args.protocol, frozenset({*args.reset_in, args.pull_in})
    )
    if args.pull_in is not None:
        core.reset = lambda _: os._exit(0)
    noise = Noise.every(np.random.default_rng([args.seed, 1]), args.noise) if args.noise else None
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    clock = clock_us(args.drift)
    with suppress(KeyboardInterrupt):
        if args.tcp is not None:
            _listen(args.tcp, lambda descriptor: serve(core, descriptor, clock, noise, args.rate))
        ours, _theirs, name = open_terminal(args.link)
        print(name, flush=True)
        serve(core, ours, clock, noise, args.rate)


def _listen(port: int, serve_one: Callable[[int], None]) -> None:
    """Serve one host after the other on a loopback port."""
    with socket.create_server(("127.0.0.1", port)) as server:
        print(f"socket://127.0.0.1:{server.getsockname()[1]}", flush=True)
        while True:
            connection, _ = server.accept()
            with connection:
                connection.setblocking(False)
                serve_one(connection.fileno())
