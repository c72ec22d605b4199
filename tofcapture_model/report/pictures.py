"""Pictures as data URIs: small PNGs with colour tables, and colour bars whose numbers are text.

Pictures carry no text of their own, so that the page sets it, in its own font and colours, at any width. Colour maps are
safe for colour-blind readers; grey always means that there is no value.
"""

from __future__ import annotations

import base64
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

UInt8 = NDArray[np.uint8]

NO_VALUE = 255  # index of the colour that stands for "none"
GREY = (138, 138, 138)
_NORMAL_STEP = 4  # colours of normals in steps of 4 of 256: a degree or two, and half the bytes


@dataclass(frozen=True)
class Picture:
    """One picture of the page.

    Attributes
    ----------
    title, note
        Its caption, and a few words below it.
    alt
        What it shows, for those who cannot see it.
    uri
        ``data:`` address.
    width, height
        Pixels.
    """

    title: str
    note: str
    alt: str
    uri: str
    width: int
    height: int


@dataclass(frozen=True)
class Scale:
    """Which number has which colour.

    Attributes
    ----------
    colours
        Name of a colour map of matplotlib.
    low, high
        Ends, in ``unit``.
    unit
        As it is printed.
    power
        1 is linear; 2 gives half of the colours to the lowest quarter, for images that hold bright and dark things.
    """

    colours: str
    low: float
    high: float
    unit: str
    power: float = 1.0

    def indices(self, values: NDArray[np.floating]) -> UInt8:
        """Colour index (H, W) of values (H, W) in ``unit``; what is not finite has no value."""
        span = max(self.high - self.low, 1e-12)
        with np.errstate(invalid="ignore"):
            scaled = np.clip((values - self.low) / span, 0.0, 1.0) ** (1 / self.power) * (NO_VALUE - 1)
        return np.where(np.isfinite(values), np.rint(scaled), NO_VALUE).astype(np.uint8)

    @property
    def ticks(self) -> list[str]:
        """Five numbers along the bar, as text."""
        values = self.low + np.linspace(0, 1, 5) ** self.power * (self.high - self.low)
        digits = max(0, int(np.ceil(1.5 - np.log10(max(self.high - self.low, 1e-9)))))
        return [f"{v:.{digits}f}" for v in values]

    @property
    def bar(self) -> str:
        """Data URI of the bar itself, a strip one pixel high."""
        strip = np.arange(NO_VALUE, dtype=np.uint8)[None]
        return data_uri(indexed_png(strip, palette(self.colours)))


def palette(name: str) -> UInt8:
    """(256, 3) colours of a map of matplotlib; the last one is the grey of no value."""
    from matplotlib import colormaps

    table = colormaps[name].resampled(NO_VALUE)(np.arange(NO_VALUE), bytes=True)[:, :3]
    return np.vstack([table, [GREY]]).astype(np.uint8)


def indexed_png(indices: UInt8, colours: UInt8) -> bytes:
    """Encode (H, W) indices into (256, 3) colours as PNG; same input, same bytes."""
    height, width = indices.shape
    rows = np.hstack([np.zeros((height, 1), np.uint8), indices])
    return _png(width, height, 3, rows, colours.tobytes())


def rgb_png(image: UInt8) -> bytes:
    """Encode (H, W, 3) as PNG; every row is stored as its difference to the row above."""
    height, width, _ = image.shape
    rows = image.reshape(height, -1)
    above = np.vstack([np.zeros((1, rows.shape[1]), np.uint8), rows[:-1]])
    return _png(width, height, 2, np.hstack([np.full((height, 1), 2, np.uint8), rows - above]), b"")


def _png(width: int, height: int, kind: int, rows: UInt8, colours: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    parts = [
        (b"IHDR", header),
        (b"PLTE", colours),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(tag, data) for tag, data in parts if data or tag == b"IEND")


def _chunk(tag: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))


def data_uri(png: bytes) -> str:
    """Address that holds a PNG."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def scalar_picture(title: str, values: NDArray[Any], scale: Scale, alt: str, note: str = "") -> Picture:
    """Picture of a map.

    Parameters
    ----------
    title, alt, note
        See :class:`Picture`.
    values
        (H, W) in the unit of the scale; NaN: none.
    scale
        Colours.
    """
    png = indexed_png(scale.indices(values), palette(scale.colours))
    return Picture(title, note, alt, data_uri(png), values.shape[1], values.shape[0])


def indexed_picture(title: str, indices: UInt8, colours: UInt8, alt: str, note: str = "") -> Picture:
    """Picture of (H, W) indices into (256, 3) colours."""
    return Picture(
        title, note, alt, data_uri(indexed_png(indices, colours)), indices.shape[1], indices.shape[0]
    )


def normal_picture(title: str, normals: NDArray[np.floating], alt: str, note: str = "") -> Picture:
    """Picture of camera-facing unit normals (H, W, 3): red to the right, green upwards, blue towards the camera."""
    known = np.isfinite(normals).all(axis=-1, keepdims=True)
    colours = np.clip((np.nan_to_num(normals) * [1, -1, -1] + 1) * 127.5, 0, 255)
    coarse = np.minimum(np.rint(colours / _NORMAL_STEP) * _NORMAL_STEP, 255)
    image = np.where(known, coarse, GREY).astype(np.uint8)
    return Picture(title, note, alt, data_uri(rgb_png(image)), image.shape[1], image.shape[0])
