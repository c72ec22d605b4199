"""Frames on the wire: chunks put together, whitening so that images are not all zero bytes, and 12-bit packing."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

_KEY = ((167 * np.arange(256) + 13) % 256).astype(np.uint8)


def packed_size(values: int, bits: int) -> int:
    """Bytes of so many values of 12 or 16 bits."""
    return (values * bits + 7) // 8


def pack12(values: NDArray[np.uint16]) -> bytes:
    """Pack 12-bit values, low bits first: a and b become ``a & 255, a >> 8 | (b & 15) << 4, b >> 4``.

    ``values`` are of any shape, uint16, each below 4096; an odd count is filled up with a zero half byte.
    """
    flat = np.ascontiguousarray(values, dtype="<u2").reshape(-1)
    odd = flat.size % 2
    pairs = np.append(flat, np.uint16(0)) if odd else flat
    a, b = pairs[0::2], pairs[1::2]
    out = np.empty((pairs.size // 2, 3), dtype=np.uint8)
    out[:, 0], out[:, 1], out[:, 2] = a & 255, a >> 8 | (b & 15) << 4, b >> 4
    return out.tobytes()[: packed_size(flat.size, 12)]


def unpack12(data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Undo :func:`pack12`: (packed_size(count, 12),) uint8 become (count,) uint16."""
    pairs = (count + 1) // 2
    words = np.zeros(pairs, dtype="<u4")
    # Each pair is read as one 32-bit word at its first byte; the last one would need a byte that is not there.
    if pairs > 1:
        words[:-1] = np.ndarray((pairs - 1,), dtype="<u4", buffer=data, strides=(3,))
    tail = data[3 * (pairs - 1) :] if pairs else data
    words.view(np.uint8)[4 * (pairs - 1) :][: tail.size] = tail
    high = words & 0xFFF000
    high <<= 4
    words &= 0xFFF
    words |= high
    return words.view("<u2")[:count]


def whiten(data: NDArray[np.uint8], offset: int = 0) -> None:
    """XOR in place with a fixed sequence, its own inverse: byte i of a frame with ``(167 i + 13) mod 256``.

    The sequence runs through all byte values, so constant stretches of an image give one zero in 256 bytes, and a COBS
    decoder has long blocks to copy.

    ``data`` is (N,) uint8; ``offset`` is the place of its first byte within its frame.
    """
    key = np.roll(_KEY, -(offset % 256))
    whole = data.size // 256 * 256
    rows = data[:whole].reshape(-1, 256)
    np.bitwise_xor(rows, key, out=rows)
    data[whole:] ^= key[: data.size - whole]


def values(data: NDArray[np.uint8], shape: tuple[int, ...], bits: int) -> NDArray[np.uint16]:
    """Turn a frame's bytes into its values (shape) uint16; ``bits`` is 12 (packed) or 16 (little-endian)."""
    flat = unpack12(data, int(np.prod(shape))) if bits == 12 else data.view("<u2")
    return flat.reshape(shape)


class Assembly:
    """One frame of ``size`` bytes, put together from chunks that come in any order, twice, or not at all."""

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
        whiten(data)
        return data if zlib.crc32(self._bytes) == crc else None
