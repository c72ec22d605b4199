"""PNG: images without loss, of 8 or 16 bits, with text."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_UP = 2  # PNG's filter: the difference to the row above, which suits smooth surfaces
_GREY, _COLOUR = 0, 2


def png_bytes(image: NDArray[Any], text: Mapping[str, str] | None = None) -> bytes:
    """Encode a grey (H, W) image of uint8 or uint16, or a colour one (H, W, 3) of uint8, with text chunks."""
    H, W = image.shape[:2]
    rows = image.astype(image.dtype.newbyteorder(">")).reshape(H, -1).view(np.uint8)
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    lines = np.hstack([np.full((H, 1), _UP, np.uint8), rows - above])
    kind = _GREY if image.ndim == 2 else _COLOUR
    parts = [(b"IHDR", struct.pack(">IIBBBBB", W, H, 8 * image.dtype.itemsize, kind, 0, 0, 0))]
    parts += [
        (b"tEXt", key.encode("latin-1") + b"\0" + value.encode("latin-1"))
        for key, value in (text or {}).items()
    ]
    parts += [(b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts
    )
