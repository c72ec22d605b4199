"""PNG: images without loss, of 8 or 16 bits, with text or a colour table."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NONE, _UP = 0, 2  # PNG's filters; the difference to the row above suits smooth surfaces
_GREY, _COLOUR, _INDEXED = 0, 2, 3


def png_bytes(
    image: NDArray[Any],
    text: Mapping[str, str] | None = None,
    colours: NDArray[np.uint8] | None = None,
    level: int = 6,
) -> bytes:
    """Encode an image; the same input gives the same bytes.

    Parameters
    ----------
    image
        Grey (H, W) of uint8 or uint16, colours (H, W, 3) of uint8, or indices (H, W) of uint8 into ``colours``.
    text
        Text chunks, Latin-1.
    colours
        (256, 3) colour table.
    level
        Of compression, 0 to 9.
    """
    H, W = image.shape[:2]
    rows = image.astype(image.dtype.newbyteorder(">")).reshape(H, -1).view(np.uint8)
    filtered = _NONE if colours is not None else _UP
    if filtered == _UP:
        rows = rows - np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    lines = np.hstack([np.full((H, 1), filtered, np.uint8), rows])
    kind = _COLOUR if image.ndim == 3 else _GREY if colours is None else _INDEXED
    parts = [(b"IHDR", struct.pack(">IIBBBBB", W, H, 8 * image.dtype.itemsize, kind, 0, 0, 0))]
    parts += [
        (b"tEXt", key.encode("latin-1") + b"\0" + value.encode("latin-1"))
        for key, value in (text or {}).items()
    ]
    parts += [] if colours is None else [(b"PLTE", colours.tobytes())]
    parts += [(b"IDAT", zlib.compress(lines.tobytes(), level)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts
    )
