"""Say what every colour means: one set for viewer, figures, pages and the daemon's previews. Numpy only.

Depth is viridis, amplitude cividis, signed error red-white-blue with white at zero, unsigned errors magma. Grey is no
value. Masks and clouds use the palette of Okabe and Ito (2008), which colour-blind readers can tell apart.

Images are encoded here as PNG too: 8 or 16 bits, with text or a colour table.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tofcapture.files.layout import MaskBit

UInt8 = NDArray[np.uint8]
Kind = Literal["depth", "amplitude", "error", "expected", "angle"]
GREY = (138, 138, 138)
SENSOR = (230, 159, 0)  # orange
GROUND_TRUTH = (86, 180, 233)  # sky blue
ESTIMATE = (0, 158, 115)  # bluish green
REMOVED = (213, 94, 0)  # vermilion
BLUE = (0, 114, 178)
GOOD = ((240, 240, 240), "good: metrics are taken here")
MASK = {
    MaskBit.NOT_HIT: ((60, 60, 60), "not hit: no measured surface on this ray"),
    MaskBit.OCCLUDED: ((213, 94, 0), "occluded for the stereo camera"),
    MaskBit.GRAZING: ((204, 121, 167), "seen at more than 75 degrees"),
    MaskBit.EDGE: ((240, 228, 66), "at a depth edge"),
    MaskBit.OUTSIDE: (BLUE, "outside the object crop"),
}
"""Colour and words of every bit, the gravest first: a pixel with several bits has the colour of the first."""

NORMAL_WORDS = "red right, green up, blue towards the camera"
NO_VALUE = 255  # index of the grey
_LADDER = (1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0)
# Seventeen colours of each of matplotlib's maps, from low to high; between them they are interpolated.
_ANCHORS = {
    "viridis": "44015448186a472d7b4240863b528b33638d2c728e26828e21918c1fa08828ae803fbc735ec96284d44baddc30d8e219fde725",
    "cividis": "00224e002e6a1a386f32436d434e6c535a6d61656f6f70737d7c788c88789b9476aba072bcae6ccdbb63dec958f0d846fee838",
    "magma": "0000040a08221d114736106b51127c6a1c818326819c2e7fb73779d0416fe75263f56b5cfc8961fea772fec488fde2a3fcfdbf",
    "RdBu_r": "0530611752902a71b23f8ec06bacd19bc9e0c2ddece0ecf3f7f6f6fbe5d8fbccb4f5aa89e48066d05548ba2832930e2667001f",
}
_KINDS: dict[str, tuple[str, str, float]] = {
    "depth": ("viridis", "m", 1.0),
    "amplitude": ("cividis", "raw units", 0.5),
    "error": ("RdBu_r", "mm", 1.0),
    "expected": ("magma", "mm", 1.0),
    "angle": ("magma", "degrees", 1.0),
}


@dataclass(frozen=True)
class Scale:
    """Which number has which colour.

    Attributes
    ----------
    colours
        Name of a colour map.
    low, high
        Values at its ends; beyond them nothing changes.
    unit
        Of the values, as printed.
    gamma
        Exponent of the way from low to high; below 1 what is small is told apart better.
    """

    colours: str
    low: float
    high: float
    unit: str
    gamma: float = 1.0

    def indices(self, values: NDArray[Any]) -> UInt8:
        """(H, W) indices into :func:`palette` of values (H, W); 255 where they are not finite."""
        there = np.isfinite(values)
        share = (np.where(there, values, self.low) - self.low) / max(self.high - self.low, 1e-12)
        index = np.rint(np.clip(share, 0, 1) ** self.gamma * (NO_VALUE - 1))
        return np.where(there, index, NO_VALUE).astype(np.uint8)

    def paint(self, values: NDArray[Any]) -> UInt8:
        """(..., 3) colours of values."""
        painted: UInt8 = palette(self.colours)[self.indices(values)]
        return painted

    @property
    def ticks(self) -> list[str]:
        """Numbers at equal ways along the scale as text, its ends among them: as many as make them round."""
        span = max(self.high - self.low, 1e-9)
        counts = (5, 7, 3) if self.low < 0 else (5, 6, 4, 3)
        count = next((n for n in counts if _is_round(span / (n - 1))), 3) if self.gamma == 1 else 6
        values = self.low + np.linspace(0, 1, count) ** (1 / self.gamma) * span
        return [f"{round(v, 6):.6g}" for v in values]

    @property
    def words(self) -> str:
        """Both ends with their unit."""
        return f"{self.low:.3g} to {self.high:.3g} {self.unit}"


def _is_round(step: float) -> bool:
    """Say whether it is 1, 2, 2.5 or 5 times a power of ten."""
    return bool(np.isclose(step / 10 ** np.floor(np.log10(step) + 1e-9), [1, 2, 2.5, 5]).any())


@lru_cache
def palette(name: str) -> UInt8:
    """(256, 3) colours of a map from low to high; the last one is the grey of no value."""
    anchors = np.frombuffer(bytes.fromhex(_ANCHORS[name]), np.uint8).reshape(-1, 3)
    at, knots = np.linspace(0, 1, NO_VALUE), np.linspace(0, 1, len(anchors))
    table = np.stack([np.interp(at, knots, anchors[:, c]) for c in range(3)], axis=1)
    return np.vstack([np.rint(table), [GREY]]).astype(np.uint8)


def scale_for(
    kind: Kind, images: Sequence[NDArray[Any]], objects: Sequence[NDArray[np.bool_]] = (), unit: str = ""
) -> Scale:
    """Choose the scale that images (H, W) of one kind share; NaN: none.

    Depth shows the object: 1 to 99 percent of it with a fifth of that beside it, in whole centimetres. ``objects`` say where it is in the first
    images. Where no object is known, depth covers 2 to 75 percent of everything, which leaves out what is far behind. Errors
    end at round numbers above 95 percent, signed ones symmetric about 0; amplitude at one above 99 percent.
    """
    colours, usual, gamma = _KINDS[kind]
    if kind != "depth":
        share = 99.0 if kind == "amplitude" else 95.0
        high = round_up(percentile([np.abs(i) for i in images], share, 1.0))
        return Scale(colours, -high if kind == "error" else 0.0, high, unit or usual, gamma)
    seen = [image[where] for image, where in zip(images, objects, strict=False)]
    if any(np.isfinite(s).any() for s in seen):
        low, high = (percentile(seen, p, 0.0) for p in (1, 99))
        low, high = low - 0.2 * (high - low), high + 0.2 * (high - low)
    else:
        low, high = percentile(images, 2, 0.0), percentile(images, 75, 1.0)
    step = 10.0 if unit == "mm" else 0.01
    low, high = step * np.floor(low / step), step * np.ceil(max(high, low + 1e-3) / step)
    return Scale(colours, round(float(low), 6), round(float(high), 6), unit or usual, gamma)


def paint_normals(normals: NDArray[Any]) -> UInt8:
    """(H, W, 3) colours of camera-facing unit normals: red to the right, green upwards, blue towards the camera."""
    there = np.isfinite(normals).all(axis=-1, keepdims=True)
    colours = np.clip((np.nan_to_num(normals) * [1, -1, -1] + 1) * 127.5, 0, 255)
    return np.where(there, colours, GREY).astype(np.uint8)


def mask_classes(mask: NDArray[np.uint8]) -> UInt8:
    """0 for good pixels (H, W), otherwise 1 + the position of the gravest bit in :data:`MASK`."""
    out = np.zeros(mask.shape, np.uint8)
    for i, bit in reversed(list(enumerate(MASK, start=1))):
        out[(mask & bit) != 0] = i
    return out


def mask_colours() -> UInt8:
    """(256, 3) colours of :func:`mask_classes`; those without a meaning are white."""
    table = np.full((256, 3), 255, np.uint8)
    table[: 1 + len(MASK)] = [colour for colour, _ in (GOOD, *MASK.values())]
    return table


def round_up(value: float) -> float:
    """Next of 1, 1.5, 2, 3, 5, 7.5, 10 times a power of ten: ends of scales that can be said in words."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in _LADDER if step * power >= value * (1 - 1e-9)) * power)


def percentile(values: Sequence[NDArray[Any]], share: float, default: float) -> float:
    """Percentile (0 to 100) of everything finite in some arrays; a default where nothing is."""
    flat = np.concatenate([np.ravel(v)[np.isfinite(np.ravel(v))] for v in values] or [np.zeros(0)])
    return float(np.percentile(flat, share)) if flat.size else default


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
