"""One frame, put together from chunks that come in any order, twice, or not at all."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.tof_serial.packing import unpack12, whiten_in_place


class Assembly:
    """Bytes of one frame and which of them are still missing.

    Parameters
    ----------
    size
        Bytes of the frame.
    """

    def __init__(self, size: int) -> None:
        self._bytes = bytearray(size)
        self.missing: list[tuple[int, int]] = [(0, size)] if size else []

    def put(self, offset: int, data: bytes | memoryview) -> int:
        """Lay a chunk in its place; returns how many of its bytes were missing. What lies outside is ignored."""
        stop = offset + len(data)
        if stop > len(self._bytes) or not data:
            return 0
        left, new = [], 0
        for i, (a, b) in enumerate(self.missing):
            if a >= stop:
                left += self.missing[i:]
                break
            low, high = max(a, offset), min(b, stop)
            if low >= high:
                left.append((a, b))
                continue
            new += high - low
            left += [r for r in ((a, low), (high, b)) if r[0] < r[1]]
        if new:
            self._bytes[offset:stop] = data
            self.missing = left
        return new

    def take(self, crc: int) -> NDArray[np.uint8] | None:
        """Bytes of the whole frame, no longer whitened; ``None`` when something is missing or its CRC-32 is another.

        To be called once: the bytes are handed over, not copied.
        """
        if self.missing:
            return None
        data = np.frombuffer(self._bytes, dtype=np.uint8)
        whiten_in_place(data)
        return data if zlib.crc32(self._bytes) == crc else None


def values(data: NDArray[np.uint8], shape: tuple[int, ...], bits: int) -> NDArray[np.uint16]:
    """Turn a frame's bytes into its values (shape) uint16; ``bits`` is 12 (packed) or 16 (little-endian)."""
    count = int(np.prod(shape))
    flat = unpack12(data, count) if bits == 12 else data.view("<u2")
    return flat.reshape(shape)
