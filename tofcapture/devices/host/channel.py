"""Messages between a station and a driver's process: small ones as packets, arrays in shared memory.

Large arrays go through an anonymous memory file whose descriptor travels with the packet: nothing has a name, nothing is
left over when either side is killed. Messages are pickles; both ends are this program.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
import struct
from typing import Any

_PACKET = 32768  # bytes; more goes through shared memory
_ALIGN = 64
_COUNT = struct.Struct("<Q")


def pair() -> tuple[socket.socket, socket.socket]:
    """Two connected ends."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def send(end: socket.socket, message: Any) -> None:
    """Send one message.

    Raises
    ------
    OSError
        The other end is gone.
    """
    large: list[memoryview] = []

    def out_of_band(buffer: pickle.PickleBuffer) -> bool:
        view = buffer.raw()
        if view.nbytes < _PACKET:
            return True
        large.append(view)
        return False

    body = pickle.dumps(message, protocol=5, buffer_callback=out_of_band)
    if not large and len(body) < _PACKET:
        end.send(_COUNT.pack(0) + body)
        return
    parts = [memoryview(body), *large]
    memory = os.memfd_create("tofcapture")
    try:
        _fill(memory, parts)
        head = _COUNT.pack(len(parts)) + b"".join(_COUNT.pack(part.nbytes) for part in parts)
        socket.send_fds(end, [head], [memory])
    finally:
        os.close(memory)


def _fill(memory: int, parts: list[memoryview]) -> None:
    os.ftruncate(memory, sum(_room(part.nbytes) for part in parts))
    with mmap.mmap(memory, 0) as mapped:
        at = 0
        for part in parts:
            mapped[at : at + part.nbytes] = part
            at += _room(part.nbytes)


def _room(size: int) -> int:
    return -(-size // _ALIGN) * _ALIGN or _ALIGN


def receive(end: socket.socket) -> Any:
    """Wait for one message; its arrays are views of the shared memory, private and writable.

    Raises
    ------
    EOFError
        The other end is closed.
    OSError
        The connection broke.
    """
    packet, descriptors, _, _ = socket.recv_fds(end, _PACKET + _COUNT.size, 1)
    if not packet:
        raise EOFError
    (count,) = _COUNT.unpack_from(packet)
    if count == 0:
        return pickle.loads(packet[_COUNT.size :])  # noqa: S301  both ends are this program
    sizes = [size for (size,) in _COUNT.iter_unpack(packet[_COUNT.size :])]
    (memory,) = descriptors
    try:
        mapped = memoryview(
            mmap.mmap(memory, 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_WRITE)
        )
    finally:
        os.close(memory)
    views, at = [], 0
    for size in sizes:
        views.append(mapped[at : at + size])
        at += _room(size)
    return pickle.loads(views[0], buffers=views[1:])  # noqa: S301
