"""Consistent Overhead Byte Stuffing: any bytes become bytes without 0x00, which then marks the end of a packet.

Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Trans. Networking 7(2), 1999. Encoded, a packet is a chain of
blocks: a code byte n in 1..255, then n - 1 bytes that are not zero; a block with n < 255 stands for its bytes and a zero,
but the zero after the last block is not sent. The overhead is at most one byte in 254, plus one.
"""

from __future__ import annotations

_FULL = 255


def encode(data: bytes) -> bytes:
    """Stuff bytes; the result holds no 0x00 and ends without the delimiter."""
    out = bytearray()
    runs = data.split(b"\0")
    for turn, run in enumerate(runs):
        full, rest = divmod(len(run), _FULL - 1)
        for i in range(full):
            out.append(_FULL)
            out += run[i * (_FULL - 1) : (i + 1) * (_FULL - 1)]
        # A run of exactly 254 at the very end needs no empty block after it: nothing follows that could be a zero.
        if rest or not full or turn < len(runs) - 1:
            out.append(rest + 1)
            out += run[full * (_FULL - 1) :]
    return bytes(out)


def decode(data: bytes | bytearray) -> bytes | None:
    """Undo :func:`encode`.

    Parameters
    ----------
    data
        What stood between two delimiters, so without 0x00.

    Returns
    -------
    The bytes, or ``None`` when the chain of blocks does not end where the data end, or holds 0x00.
    """
    if not data or 0 in data:
        return None
    i, n = 0, len(data)
    out = bytearray(data)
    codes, before = [], _FULL
    while i < n:
        step = data[i]
        # The code byte of a block stands where the zero of the block before belongs, unless that block was full.
        if before == _FULL:
            codes.append(i)
        else:
            out[i] = 0
        before = step
        i += step
    if i != n:
        return None
    for place in reversed(codes):
        del out[place]
    return bytes(out)
