"""Read raw frames of any make as one array, without knowing what their channels are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import FormatError
from tofcapture.importing.rules import framed, without_metadata
from tofcapture.importing.said import Said
from tofcapture.importing.source import find_pieces

NAMES = ("raw", "frames", "taps", "data")  # of the array that is meant where a file holds several
Array = NDArray[Any]


def read_raw(path: Path, counts: Sequence[int], shape: tuple[int, int] | None = None) -> Array:
    """Read raw frames.

    ``path`` is a file or a folder that :func:`tofcapture.importing.source.find_pieces` reads: one array of three or more axes, or one
    a channel in the order of their names. ``counts`` are the numbers of phase images that one frame may have, the first that
    fits. ``shape`` (H, W) is that of binary files, which do not say.

    Returns (frames, K, H, W), native byte order, rows of metadata taken off.

    :class:`DataError` or :class:`FormatError` for no such file, nothing in it, sizes that do not fit.
    """
    found = find_pieces(path, Said(raw={"shape": list(shape)} if shape else {}))
    arrays = {p.name.partition(":")[2] or p.name: p.load() for p in found}
    whole = _files(arrays, path) if path.is_dir() else _only(arrays, path)
    return without_metadata(framed(whole, counts, str(path)))


def _files(arrays: dict[str, Array], path: Path) -> Array:
    """Put the images of a folder below each other, in the order of their names."""
    sizes = {a.shape for a in arrays.values()}
    if len(sizes) > 1:
        raise FormatError(f"{path}: expected images of one size, got {sorted(sizes)}")
    planes = list(arrays.values())
    return np.concatenate(planes) if planes[0].ndim == 3 else np.stack(planes)


def _only(arrays: dict[str, Array], path: Path) -> Array:
    """Take the array called raw, or the only one with images in it, or all where each is a channel."""
    images = {k: v for k, v in arrays.items() if min(v.shape[-2:]) > 1}
    whole = {k: v for k, v in images.items() if v.ndim >= 3}
    chosen = {k: v for k, v in whole.items() if k.rsplit("/", 1)[-1].lower() in NAMES} or whole or images
    if whole and len(chosen) == 1:
        return next(iter(chosen.values()))
    shapes = {(v.shape, v.dtype.kind) for v in images.values()}
    if len(shapes) != 1 or len(images) < 2 or next(iter(images.values())).ndim > 3:
        raise FormatError(
            f"{path}: expected one array of images, or one a channel, all of one shape, got "
            f"{', '.join(f'{k} {v.shape}' for k, v in images.items()) or 'none'}",
            hint="call it raw, or save it alone as .npy",
        )
    return np.stack(list(images.values()), axis=-3)
