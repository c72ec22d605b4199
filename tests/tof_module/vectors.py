"""Test vectors for firmware authors: ``python -m tests.tof_module.vectors > docs/serial-vectors.json``."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np
from cobs import cobs

from tests.tof_module.synthetic import simulated_info, whitened
from tofcapture.devices.tof_serial.messages import (
    DATA,
    BurstState,
    Capture,
    Frame,
    FrameKey,
    Progress,
    Read,
    Reason,
    Refused,
    Time,
)
from tofcapture.devices.tof_serial.packet import Kind, Packet, encode, pack12


def _cobs() -> list[dict[str, str]]:
    plain = [b"", b"\0", b"\0\0", b"\x11\x22\x00\x33", b"\x11\0\0\0", bytes(range(1, 255)), bytes(range(1, 256)),
             bytes(range(256)), bytes(range(2, 256)) + b"\0", b"\x01" * 600]  # fmt: skip
    return [{"plain": p.hex(), "encoded": cobs.encode(p).hex()} for p in plain]


def _pixels() -> list[dict[str, Any]]:
    rows = [[0, 0], [1, 2], [0xABC, 0x123], [4095, 4095], [0x800, 0x7FF, 0x555]]
    out = []
    for row in rows:
        packed = pack12(np.array(row, dtype=np.uint16))
        out.append(
            {
                "values": row,
                "packed": packed.hex(),
                "crc32": zlib.crc32(packed),
                "whitened": whitened(packed).hex(),
            }
        )
    return out


def _bodies() -> list[tuple[Kind, str, bytes]]:
    info = simulated_info(boot=0x12345678)
    chunk = whitened(bytes(range(16)), 256)
    return [
        (Kind.HELLO, "empty", b""),
        (Kind.INFO, repr(info), info.pack()),
        (Kind.SYNC, "empty", b""),
        (Kind.TIME, "boot 0x12345678, clock 1234567890123 us", Time(0x12345678, 1234567890123).pack()),
        (Kind.CAPTURE, "burst 77, 10 frames", Capture(77, 10).pack()),
        (Kind.STATUS, "empty", b""),
        (
            Kind.STATE,
            "burst 77, exposing, 4 frames done",
            BurstState(0x12345678, 77, Progress.EXPOSING, 4).pack(),
        ),
        (Kind.META, "burst 77, frame 3", FrameKey(77, 3).pack()),
        (
            Kind.FRAME,
            "burst 77, frame 3, 518400 bytes, crc 0xcafebabe, clock 5000000 us, 45.25 C, 12 saturated",
            Frame(77, 3, 518400, 0xCAFEBABE, 5_000_000, 4525, 12).pack(),
        ),
        (
            Kind.READ,
            "burst 77, frame 3, chunk 8192, bytes 0..16384 and 20000..20100",
            Read(77, 3, 8192, ((0, 16384), (20000, 20100))).pack(),
        ),
        (Kind.DATA, "burst 77, frame 3, offset 256, bytes 0..15 whitened", DATA.pack(77, 3, 256) + chunk),
        (Kind.END, "empty", b""),
        (Kind.RELEASE, "empty", b""),
        (Kind.REFUSED, "no such burst", Refused(Reason.NO_SUCH_BURST, "burst 77").pack()),
    ]


def _packets() -> list[dict[str, Any]]:
    return [
        {
            "kind": kind.name,
            "says": says,
            "seq": 258,
            "token": 0xA0B0C0D0,
            "body": body.hex(),
            "wire": encode(Packet(kind, 0xA0B0C0D0, body, 258)).hex(),
        }
        for kind, says, body in _bodies()
    ]


def vectors() -> dict[str, Any]:
    """All test vectors as JSON types; bytes are hexadecimal."""
    key = whitened(bytes(300))
    return {
        "format": "tofcapture-serial-vectors",
        "version": 1,
        "crc32": [{"bytes": b"123456789".hex(), "crc32": zlib.crc32(b"123456789")}],
        "cobs": _cobs(),
        "whitening_sequence": key.hex(),
        "pixels": _pixels(),
        "packets": _packets(),
    }


if __name__ == "__main__":
    print(json.dumps(vectors(), indent=1))
