"""Cost to the host of one frame of 8 x 180 x 240 values (691,200 bytes) that comes over a serial link.

    python benchmarks/serial.py [--frames 200]

Prints process CPU milliseconds per frame, by size of chunk: from the bytes of the wire to uint16 values (delimiters, COBS, CRC-32 of
each packet, assembly, whitening, CRC-32 of the frame, 12-bit unpacking), and with the `cobs` C extension's decoder in
place of ours as a peer, where it is installed.
"""

from __future__ import annotations

import argparse
import time
import zlib

import numpy as np

from tofcapture.devices.tof_serial import packet as packets
from tofcapture.devices.tof_serial.assembly import Assembly, values
from tofcapture.devices.tof_serial.messages import DATA
from tofcapture.devices.tof_serial.packet import Kind, Packet, Parser, encode
from tofcapture.devices.tof_serial.packing import pack12, whiten
from tofcapture.devices.tof_serial.synthetic import simulated_info, synthetic

READ = 65536  # bytes that one read of the port brings


def wire_of(data: bytes, chunk: int) -> bytes:
    """Return what the module sends for one packed frame."""
    white = whiten(np.frombuffer(data, np.uint8)).tobytes()
    return b"".join(
        encode(Packet(Kind.DATA, 1, DATA.pack(1, 0, at) + white[at : at + chunk], i))
        for i, at in enumerate(range(0, len(white), chunk))
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
    info = simulated_info()
    wall = synthetic(info, 0)(0, 0)[0]
    images = {
        "wall": wall,
        "dark": np.zeros_like(wall),
        "random": np.random.default_rng(0).integers(0, 4096, wall.shape).astype(np.uint16),
    }
    try:
        import cobs.cobs as peer
    except ImportError:
        peer = None
        print("no peer: pip install cobs")
    ours = packets.cobs.decode
    for name, raw in images.items():
        data = pack12(raw)
        for chunk in (1024, 4096, 8192, 16384):
            wire = wire_of(data, chunk)
            mean, least = cost(frames, wire, raw, data)
            line = f"{name:7s} chunk {chunk:6d}: {mean:5.2f} ms CPU per frame (least {least:5.2f})"
            if peer is not None:
                packets.cobs.decode = lambda piece: peer.decode(bytes(piece))
                line += f", with the C decoder {cost(frames, wire, raw, data)[0]:5.2f}"
                packets.cobs.decode = ours
            print(line, flush=True)


if __name__ == "__main__":
    main()
