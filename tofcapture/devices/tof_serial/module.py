"""A simulated module on a pseudo terminal (or a TCP port), to test a host against, or a firmware's rig against a host.

::

    python -m tofcapture.devices.tof_serial.module --link /tmp/tof0
    python -m tofcapture.devices.tof_serial.module --tcp 7000         # port = "socket://127.0.0.1:7000"

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
from pathlib import Path

import numpy as np

from tofcapture.devices.tof_serial.core import ModuleCore
from tofcapture.devices.tof_serial.noise import Noise
from tofcapture.devices.tof_serial.packet import PROTOCOL
from tofcapture.devices.tof_serial.synthetic import simulated_info, synthetic

_IDLE = 0.05  # s between looks at the clock while nothing comes


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
    parser = argparse.ArgumentParser(
        prog="python -m tofcapture.devices.tof_serial.module", description=__doc__
    )
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
    return parser.parse_args()


def main() -> None:
    """Run the simulated module."""
    args = _arguments()
    width, height = (int(v) for v in args.size.split("x"))
    info = simulated_info(width, height, boot=secrets.randbits(32))
    core = ModuleCore(info, synthetic(info, args.seed), args.protocol, frozenset(args.reset_in))
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


if __name__ == "__main__":
    main()
