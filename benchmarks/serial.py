"""Cost to the host of one frame of 8 x 180 x 240 values (691,200 bytes) that comes over a serial link.

    python benchmarks/serial.py [--frames 200]

Prints process CPU milliseconds per frame, by size of chunk: from the bytes of the wire to uint16 values (delimiters, COBS,
CRC-32 of each packet, assembly, whitening, CRC-32 of the frame, 12-bit unpacking).
"""

from __future__ import annotations

import argparse
import time
import zlib

import numpy as np

from tofcapture.devices.tof_serial.messages import DATA
from tofcapture.devices.tof_serial.packet import (
    Assembly,
    Kind,
    Packet,
    Parser,
    encode,
    pack12,
    values,
    whiten,
)

READ = 65536  # bytes that one read of the port brings
SHAPE = (8, 180, 240)


def wire_of(data: bytes, chunk: int) -> bytes:
    """Return what the module sends for one packed frame."""
    white = np.frombuffer(data, np.uint8).copy()
    whiten(white)
    sent = white.tobytes()
    return b"".join(
        encode(Packet(Kind.DATA, 1, DATA.pack(1, 0, at) + sent[at : at + chunk], i))
        for i, at in enumerate(range(0, len(sent), chunk))
    )


def receive(wire: bytes, size: int, crc: int, shape: tuple[int, ...]) -> np.ndarray:
    """All that the host does with one frame."""
    parser, assembly = Parser(), Assembly(size)
    for at in range(0, len(wire), READ):
        for packet in parser.feed(wire[at : at + READ]):
            assembly.put(DATA.unpack_from(packet.body)[2], memoryview(packet.body)[DATA.size :])
    data = assembly.take(crc)
    assert data is not None
    return values(data, shape, 12)


def cost(frames: int, wire: bytes, raw: np.ndarray, data: bytes) -> tuple[float, float]:
    """Mean and least process CPU ms per frame."""
    crc, spent = zlib.crc32(data), []
    for _ in range(frames):
        start = time.process_time()
        got = receive(wire, len(data), crc, raw.shape)
        spent.append(1e3 * (time.process_time() - start))
    assert (got == raw).all()
    return float(np.mean(spent)), float(np.min(spent))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=200)
    frames = parser.parse_args().frames
    rng = np.random.default_rng(0)
    wave = 900 + 350 * np.cos(np.linspace(0, 12, np.prod(SHAPE))).reshape(SHAPE)
    images = {
        "wall": np.rint(wave + 4 * rng.standard_normal(SHAPE)).astype(np.uint16),
        "dark": np.zeros(SHAPE, np.uint16),
        "random": rng.integers(0, 4096, SHAPE).astype(np.uint16),
    }
    for name, raw in images.items():
        data = pack12(raw)
        for chunk in (1024, 4096, 8192, 16384):
            mean, least = cost(frames, wire_of(data, chunk), raw, data)
            print(
                f"{name:7s} chunk {chunk:6d}: {mean:5.2f} ms CPU per frame (least {least:5.2f})", flush=True
            )


if __name__ == "__main__":
    main()
