"""Take the raw bytes of known cameras apart; docs/howto/own-data.md says which.

Every layout was read from drivers and descriptions that others published, none on a camera. ``guessed`` says what is arithmetic
or convention of ours: look at the picture of ``import --dry-run`` before you trust it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, FormatError
from tofcapture.files.camera_bytes import FEMTO_IMAGES, femto_frame, unpack_y12p, with_sign
from tofcapture.importing.said import Facts, Said

Images = NDArray[Any]  # (n, H, W)
_QUARTERS, _THIRDS = (0, 90, 180, 270), (0, 120, 240)


@dataclass(frozen=True)
class Layout:
    """Say how a camera's bytes lie."""

    camera: str  #: In words.
    sizes: tuple[int, ...]  #: Bytes of a unit that it writes; empty: any, of a shape that is said.
    decode: Callable[[bytes, tuple[int, int]], Images]  #: Bytes of one unit, and (H, W), to images.
    shape: tuple[int, int] | None  #: (H, W) of an image; ``None``: said.
    mhz: tuple[float, ...]  #: Frequencies in the order of the images; empty: said.
    deg: tuple[float, ...]  #: Phases of each.
    saturation: float  #: Counts.
    offset: bool = True  #: Taps carry an offset.
    guessed: str = ""  #: What nobody confirmed.


def facts_of_layout(name: str) -> Facts:
    """Return the channels of a layout's images, in order."""
    found = layout_named(name)
    hz = tuple(1e6 * f for f in found.mhz for _ in found.deg)
    turns = max(len(found.mhz), 1)
    phases = tuple(float(p) for p in np.radians(found.deg * turns))
    return Facts(
        modulation_hz=hz, phase_rad=phases, saturation=found.saturation, offset=found.offset, model=name
    )


def facts_of_bytes(path: Path, name: str) -> Facts:
    """Return the channels of a file's images: its own headers name them, or the layout does."""
    shape = layout_named(name).shape
    own = femto_channels(path.read_bytes(), shape) if name.startswith("femto") and shape else None
    return own.over(facts_of_layout(name)) if own else facts_of_layout(name)


def layout_named(name: str) -> Layout:
    """Look a layout up; :class:`ConfigError` lists all."""
    if name not in LAYOUTS:
        raise ConfigError(f"layout: expected one of {', '.join(LAYOUTS)}, got {name!r}", hint="--layout NAME")
    return LAYOUTS[name]


def layout_of(path: Path, said: Said) -> str:
    """Name the layout of a file of bytes: the one that is said, else the one whose size it has; empty when neither is."""
    if "layout" in said.raw:
        layout_named(str(said.raw["layout"]))
        return str(said.raw["layout"])
    if "shape" in said.raw:
        return ""
    size = path.stat().st_size
    fits = {v.decode: n for n, v in reversed(LAYOUTS.items()) if size and any(size % s == 0 for s in v.sizes)}
    if len(fits) > 1:
        raise ConfigError(
            f"{path}: {size} bytes may be of {', '.join(sorted(fits.values()))}",
            hint="--layout NAME, or --shape H,W",
        )
    return next(iter(fits.values()), "")


def decode(data: bytes, name: str, shape: tuple[int, ...], where: str) -> Images:
    """Take the bytes of one unit or several apart into images (n, H, W); :class:`FormatError` for another number of bytes."""
    layout = layout_named(name)
    size = shape[-2:] if len(shape) >= 2 else layout.shape
    if size is None:
        raise FormatError(f"{where}: {name} does not say its size", hint="--shape H,W")
    units = layout.sizes or (2 * size[0] * size[1],)
    unit = next((u for u in units if data and len(data) % u == 0), 0)
    if not unit:
        known = " or ".join(map(str, units))
        raise FormatError(
            f"{where}: expected a multiple of {known} bytes of {name}, got {len(data)}",
            hint=f"{layout.camera}; is it cut short, of another mode, or another layout?",
        )
    parts = [layout.decode(data[i : i + unit], (size[0], size[1])) for i in range(0, len(data), unit)]
    return np.concatenate(parts)


def _ten_bits(data: bytes) -> NDArray[Any]:
    """Unpack RAW10: four pixels in five bytes, the high ones first."""
    b = np.frombuffer(data, np.uint8).reshape(-1, 5).astype(np.uint16)
    low = b[:, 4:] >> np.array([0, 2, 4, 6], np.uint16) & 3
    return (b[:, :4] << 2 | low).reshape(-1)


def _b0410(data: bytes, size: tuple[int, int]) -> Images:
    return with_sign(unpack_y12p(data), 11).reshape(-1, *size)


def _b0548(data: bytes, size: tuple[int, int]) -> Images:
    H, W = size
    words = np.frombuffer(data, "<u2") if len(data) % (W * 2405 * 2) == 0 else unpack_y12p(data)
    return np.concatenate([_four_of(half, H) for half in words.reshape(-1, 2405, W)])


def _four_of(rows: NDArray[Any], H: int) -> Images:
    """Find four images of H rows one after another among more rows: in the right place, opposite phases have the same sum."""
    best, least = None, np.inf
    for pitch in (H, H + 1, len(rows) // 4):
        last = len(rows) - 3 * pitch - H
        for first in sorted({0, 1, last // 2, last} & set(range(last + 1))):
            found = np.stack([rows[first + k * pitch :][:H] for k in range(4)])
            i = found.astype(np.float32)
            edges = np.square(
                np.diff(i, axis=1)[:, [0, -1]]
            ).mean()  # a row of metadata is unlike its neighbour
            off = float(np.square(i[0] + i[2] - i[1] - i[3]).mean() + edges)
            if off < least:
                best, least = found, off
    assert best is not None
    return best


def _femto(data: bytes, size: tuple[int, int]) -> Images:
    return femto_frame(data, size)[0]


def femto_channels(data: bytes, size: tuple[int, int]) -> Facts | None:
    """Read frequency and phase of nine images from the headers before them; ``None`` when there is one header for all."""
    heads = femto_frame(data, size)[1]
    if len(heads) != FEMTO_IMAGES or not all(h.modulation_hz for h in heads):
        return None
    return Facts(
        modulation_hz=tuple(h.modulation_hz for h in heads), phase_rad=tuple(h.phase_rad for h in heads)
    )


def _azure(data: bytes, size: tuple[int, int]) -> Images:
    blocks = np.frombuffer(data, np.uint8).reshape(9, 256 + size[0] * 1024)[:, 256:]
    d = blocks.reshape(9, size[0], 128, 8)[..., :5].reshape(9, *size).astype(np.int16)
    return np.where(d < 64, d, 64 - d).astype(np.int16)


def _kinect_table() -> NDArray[np.int16]:
    x = np.arange(1024)
    table = np.cumsum(np.r_[0, 1 << (x // 128 - (x >= 128))])[:1024]
    out = np.concatenate([table, -table])
    out[1024] = 32767  # no measurement
    return out.astype(np.int16)


def _kinect(data: bytes, size: tuple[int, int]) -> Images:
    """Unpack eleven bits a pixel; pixels of a row lie in four strides, the rows from the middle outwards."""
    H, W = size
    words = np.frombuffer(data, "<u2").reshape(10, H, 352)[:9].astype(np.uint32)
    x, y = np.arange(W), np.arange(H)
    bit = ((x >> 2) + ((x & 3) << 7)) * 11
    rows = words[:, np.where(y < H // 2, y + H // 2, H - 1 - y)]
    rows = np.concatenate([rows, np.zeros_like(rows[..., :1])], axis=-1)
    word, shift = bit >> 4, (bit & 15).astype(np.uint32)
    value = (rows[..., word] >> shift | rows[..., word + 1] << (16 - shift)) & 2047
    out: Images = _kinect_table()[value]
    out[..., [0, -1]] = 0  # border columns hold nothing
    return out


def _luxonis(data: bytes, size: tuple[int, int]) -> Images:
    """Four taps in each cell of 2 x 2, after two embedded lines."""
    H, W = 2 * size[0], 2 * size[1]
    words = np.frombuffer(data, "<u2") if len(data) == 2 * (H + 2) * W else _ten_bits(data)
    rows = words.reshape(H + 2, W)[2:]
    return np.stack([rows[0::2, 0::2], rows[1::2, 0::2], rows[1::2, 1::2], rows[0::2, 1::2]])


def _words(data: bytes, size: tuple[int, int]) -> Images:
    return np.frombuffer(data, "<u2").reshape(-1, *size)


def _opt8241(data: bytes, size: tuple[int, int]) -> Images:
    return with_sign(_words(data, size), 12)


_ORBBEC = "9 images after a header; the frequencies of the other two thirds and the phases, where each image has no header of its own"
LAYOUTS = {
    "arducam-b0410": Layout("Arducam B0410, Y12P, one phase a unit", (64800,), _b0410, (180, 240), (75,), _QUARTERS, 1023),
    "arducam-b0410-far": Layout("the same in far mode", (64800,), _b0410, (180, 240), (37.5,), (270, 0, 90, 180), 1023),
    "arducam-b0548-double": Layout(
        "Arducam B0548, 640 x 4810", (4617600, 6156800), _b0548, (480, 640), (90, 15), _QUARTERS, 4095,
        guessed="which of the rows are the images: found by opposite phases",
    ),
    "arducam-b0548": Layout(
        "Arducam B0548, 640 x 2405", (2308800, 3078400), _b0548, (480, 640), (90,), _QUARTERS, 4095,
        guessed="which of the rows are the images: found by opposite phases",
    ),
    "femto-bolt": Layout("Orbbec, Y16 of 7680 x 434", (6666240,), _femto, (576, 640), (196.75, 191.57, 53.57), _THIRDS, 32767, guessed=_ORBBEC),
    "femto-bolt-wide": Layout("Orbbec, Y16 of 8192 x 290", (4751360,), _femto, (512, 512), (196.75, 191.57, 53.57), _THIRDS, 32767, guessed=_ORBBEC),
    "azure-kinect": Layout(
        "Azure Kinect, narrow view over USB", (5310720,), _azure, (576, 640), (196.75, 191.57, 53.57), _THIRDS, 191,
        guessed="the order of the frequencies and of the phases",
    ),
    "kinect-v2": Layout(
        "Kinect v2, ten images of 11 bits", (2984960,), _kinect, (424, 512), (80, 16, 120), _THIRDS, 16384,
        guessed="phases begin where the camera's P0 table says, which is not in the packet",
    ),
    "luxonis-oak-tof": Layout(
        "Luxonis OAK-ToF, raw10 of 1280 x 962, two frequencies in turn", (1539200, 2462720), _luxonis, (480, 640), (80, 100), _QUARTERS, 1023,
        guessed="the embedded lines come first",
    ),
    "espros": Layout("ESPROS, four images of 16 bits; flags from 64000", (), _words, None, (), (0, 270, 180, 90), 64000),
    "ti-opt8241": Layout("TI OPT8241, I and Q of 12 bits", (), _opt8241, (240, 320), (40, 70), (0, 270), 2047, offset=False),
}  # fmt: skip
