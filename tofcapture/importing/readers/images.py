"""Read 16-bit images (.png, .tif, .pgm) and files of plain words (.raw, .bin) whose size is said."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, FormatError
from tofcapture.importing.readers.vendors import decode, facts_of_bytes, layout_of
from tofcapture.importing.rules import roughness
from tofcapture.importing.said import Said
from tofcapture.importing.source import Piece

IMAGES = (".png", ".tif", ".tiff", ".pgm", ".pfm", ".bmp")
BINARY = (".raw", ".bin")
_CHANNELS = 16  # at most, of an image whose words have the channels last
_FLOATS = 0.99  # of the pixels, that have sizes of a measurement


def claims(path: Path) -> bool:
    """Tell by the suffix."""
    return path.is_file() and path.suffix.lower() in (*IMAGES, *BINARY)


def pieces(path: Path, said: Said) -> Iterator[Piece]:
    """List the one image, or the words, of a file."""
    if path.suffix.lower() in IMAGES:
        yield Piece("", path, partial(read_image, path))
        return
    shape, dtype = tuple(map(int, said.tuple_of("raw", "shape"))), str(said.raw.get("dtype", ""))
    if not (layout := layout_of(path, said)):
        yield Piece("", path, partial(read_words, path, shape, dtype))
        return
    yield Piece("", path, partial(_decoded, path, layout, shape), facts=facts_of_bytes(path, layout))


def _decoded(path: Path, layout: str, shape: tuple[int, ...]) -> NDArray[Any]:
    images = decode(path.read_bytes(), layout, shape, str(path))
    return images[0] if len(images) == 1 else images


def read_image(path: Path) -> NDArray[Any]:
    """Read one grey image (H, W), or the pages of a TIFF (N, H, W), or its samples (H, W, N).

    Raises :class:`FormatError` for anything else, :class:`ConfigError` without OpenCV.
    """
    try:
        import cv2
    except ImportError as err:
        raise ConfigError(
            f"{path}: reading images needs OpenCV",
            hint="pip install opencv-python-headless, or convert to .npy",
        ) from err
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what cannot be read is told below
    tiff = path.suffix.lower() in {".tif", ".tiff"}
    if tiff:
        pages = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)[1]
    else:
        pages = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED)]
    found = [np.asarray(p) for p in pages if p is not None]
    coloured = any(p.ndim == 3 and (p[..., :1] != p[..., :3]).any() for p in found)
    if tiff and (coloured or not found):
        whole = _tiff(path)
        coloured, found = whole.ndim == 3 and whole.shape[-1] in (3, 4), [whole]
    if not found:
        raise FormatError(f"{path}: expected an image", hint="copy it again")
    if coloured:
        raise FormatError(
            f"{path}: expected one channel of grey, got colours",
            hint="a coloured picture of a depth is no measurement; export 16-bit grey, or name other files in import.toml",
        )
    grey = [p[..., 0] if p.ndim == 3 and p.shape[-1] in (3, 4) else p for p in found]
    return grey[0] if len(grey) == 1 else np.stack(grey)


def _tiff(path: Path) -> NDArray[Any]:
    """Read what OpenCV does not: more samples than colours have, other compressions."""
    try:
        import tifffile

        return np.asarray(tifffile.imread(path))
    except (ImportError, ValueError, OSError, KeyError) as err:
        hint = "pip install tifffile imagecodecs, or np.save(name, tifffile.imread(path)); or copy it again"
        raise FormatError(f"{path}: expected a TIFF of grey pages that OpenCV reads: {err}", hint) from err


def _are_floats(data: bytes, kind: str, pixels: int) -> bool:
    """Tell whether bytes are floats of depths or counts: pairs of 16-bit counts have exponents that no measurement has."""
    if len(data) % (pixels * 4):
        return False
    size = np.abs(np.frombuffer(data, kind))
    size = size[np.isfinite(size) & (size > 0)]
    return bool(size.size and ((size > 1e-4) & (size < 1e6)).mean() > _FLOATS)


def read_words(path: Path, shape: tuple[int, ...], dtype: str = "") -> NDArray[Any]:
    """Read words (n, H, W) of a file that does not say its size.

    ``shape`` ends with H and W; a longer one is that of the array. ``dtype`` is NumPy's, such as ``>u2``; without one words have
    16 bits, or 32 where these are floats, and their byte order is the one in which neighbours are alike. Raises
    :class:`FormatError`: sizes that do not fit.
    """
    if len(shape) < 2 or min(shape, default=0) < 1:
        raise FormatError(
            f"{path}: a binary file does not say its size",
            hint="--shape H,W, or [raw] shape = [H, W] in import.toml",
        )
    try:
        kind = np.dtype(dtype or "<u2")
    except TypeError as err:
        raise ConfigError(
            f"{path}: dtype: expected one of NumPy such as '<u2' or '>i2', got {dtype!r}"
        ) from err
    data, (rows, columns) = path.read_bytes(), shape[-2:]
    if not data or len(data) % (rows * columns * kind.itemsize):
        size = len(data) / kind.itemsize
        raise FormatError(
            f"{path}: expected a multiple of {rows} x {columns} {8 * kind.itemsize}-bit words, got {size:g}",
            hint=f"rows of metadata count: {size / columns:g} rows of {columns} in all"
            if size % columns == 0 or size < rows * columns
            else f"is there a header of {len(data) % (rows * columns * kind.itemsize)} bytes? np.save(name, np.fromfile(path, '<u2', offset=...))",
        )
    if not dtype and (
        floats := next((k for k in ("<f4", ">f4") if _are_floats(data, k, rows * columns)), "")
    ):
        kind = np.dtype(floats)
    images = np.frombuffer(data, dtype=kind).reshape(-1, rows, columns)
    if not dtype and kind.kind == "u":
        last = len(shape) > 2 and columns <= _CHANNELS  # interleaved: the next word is no neighbour
        images = min(
            (images, images.byteswap()), key=lambda i: roughness(np.swapaxes(i, 1, 2) if last else i)
        )
    out = images.astype(kind.newbyteorder("="))
    return out.reshape(shape) if len(shape) > 2 and out.size == np.prod(shape) else out
