"""Raw frames of any make: arrays in NPY, NPZ and HDF5, binary words, and folders of images, brought into (frames, K, H, W)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, DataError, FormatError

IMAGES = (".png", ".tif", ".tiff", ".pgm", ".bmp")
BINARY = (".raw", ".bin")
NAMES = ("raw", "frames", "taps", "data")  # of the array that is meant where a file holds several
HEADER_ROWS = 4  # at most so many rows of an image are metadata


def read_raw(path: Path, counts: Sequence[int], shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """Read raw frames.

    ``path`` is ``.npy``, ``.npz`` or ``.h5`` (the one array of 3 or more axes in it, or one array a channel in the order of their names),
    a folder of images or of binary files, or one binary file. ``counts`` are the numbers of phase images that one frame may have, the first
    that fits. ``shape`` (H, W) is that of binary files, which do not say.

    Returns (frames, K, H, W), native byte order, rows of metadata taken off.

    :class:`DataError` or :class:`FormatError` for no such file, nothing in it, sizes that do not fit.
    """
    suffix = path.suffix.lower()
    if not path.exists():
        raise DataError(f"{path}: no such file")
    if path.is_dir():
        found = _folder(path, shape)
    elif suffix in {".npy", ".npz"}:
        found = _numpy(path)
    elif suffix in {".h5", ".hdf5", ".hdf"}:
        found = _hdf5(path)
    elif suffix in BINARY:
        found = _binary(path, shape)
    else:
        raise FormatError(
            f"{path}: expected .npy, .npz, .h5, .raw, .bin or a folder of images, got {suffix!r}"
        )
    return without_metadata(_framed(found, counts, str(path)))


def _numpy(path: Path) -> NDArray[Any]:
    try:
        held = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as err:
        raise FormatError(f"{path}: expected an array in .npy or .npz format, got {err}") from err
    return held if isinstance(held, np.ndarray) else np.asarray(_only(dict(held), path))


def _hdf5(path: Path) -> NDArray[Any]:
    import h5py

    held: dict[str, Any] = {}

    def keep(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            held[name] = item

    try:
        with h5py.File(path, "r") as file:
            file.visititems(keep)
            return np.asarray(_only(held, path)[...])
    except OSError as err:
        raise FormatError(f"{path}: expected an HDF5 file, got {err}") from err


def _only(arrays: dict[str, Any], path: Path) -> Any:
    """The array called raw, or the only one with images in it, or all where each is a channel."""
    images = {k: v for k, v in arrays.items() if v.ndim >= 2 and min(v.shape[-2:]) > 1}
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
    return np.stack([np.asarray(images[k][...]) for k in sorted(images, key=_natural)], axis=-3)


def _natural(name: str) -> list[tuple[int, str]]:
    """Order names with numbers in them by the numbers."""
    return [(int(t), "") if t.isdigit() else (-1, t) for t in re.split(r"(\d+)", name)]


def _folder(path: Path, shape: tuple[int, int] | None) -> NDArray[Any]:
    """Images in the natural order of their names, one phase each."""
    files = [p for p in path.iterdir() if p.suffix.lower() in (*IMAGES, *BINARY)]
    files.sort(key=lambda p: _natural(p.name))
    if not files:
        raise DataError(
            f"{path}: expected images ({', '.join(IMAGES)}) or binary files ({', '.join(BINARY)}), found none"
        )
    planes = [_image(p) if p.suffix.lower() in IMAGES else _binary(p, shape) for p in files]
    sizes = {p.shape for p in planes}
    if len(sizes) > 1:
        raise FormatError(f"{path}: expected images of one size, got {sorted(sizes)}")
    return np.concatenate(planes) if planes[0].ndim == 3 else np.stack(planes)


def _image(path: Path) -> NDArray[Any]:
    try:
        import cv2
    except ImportError as err:
        raise ConfigError(
            f"{path}: reading images needs OpenCV",
            hint="pip install opencv-python-headless, or convert to .npy",
        ) from err
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise FormatError(f"{path}: expected an image")
    if found.ndim == 3 and (found[..., :1] != found[..., :3]).any():
        raise FormatError(f"{path}: expected one channel of grey, got colours")
    return np.asarray(found[..., 0] if found.ndim == 3 else found)


def _binary(path: Path, shape: tuple[int, int] | None) -> NDArray[Any]:
    """16-bit words; the byte order is the one in which neighbours are alike."""
    if shape is None:
        raise FormatError(f"{path}: a binary file does not say its size", hint="--shape H,W")
    words = np.frombuffer(path.read_bytes(), dtype="<u2")
    if not len(words) or len(words) % (shape[0] * shape[1]):
        raise FormatError(
            f"{path}: expected a multiple of {shape[0]} x {shape[1]} 16-bit words, got {len(words)}",
            hint=f"rows of metadata count: {len(words) / shape[1]:g} rows of {shape[1]} in all",
        )
    images = words.reshape(-1, *shape)
    return min((images, images.byteswap()), key=_roughness)


def _roughness(images: NDArray[Any]) -> float:
    rows = images.astype(np.float64)
    return float(np.median(np.abs(np.diff(rows, axis=-1)))) / max(float(np.std(rows)), 1e-9)


def _framed(raw: NDArray[Any], counts: Sequence[int], where: str) -> NDArray[Any]:
    """Bring (N, H, W), (K, H, W), (N, K, H, W) and channels-last arrays into signed (frames, K, H, W)."""
    if raw.dtype.kind not in "iuf":
        raise FormatError(f"{where}: expected numbers, got {raw.dtype}")
    raw = raw.astype(raw.dtype.newbyteorder("="), copy=False)
    if raw.ndim == 5 and 1 in raw.shape[:2]:
        raw = raw.reshape(raw.shape[0] * raw.shape[1], *raw.shape[2:])
    for read in (_as_frames, _as_turns, _as_images):
        for channels in counts:
            found = read(raw, channels)
            if found is not None and len(found):
                return signed(found)
    raise DataError(
        f"{where}: expected (frames, K, H, W), or a multiple of K images, K of {', '.join(map(str, counts))}, got shape {raw.shape}",
        hint="--mhz says how many frequencies there are, --phases how many phase images each has",
    )


def _as_frames(raw: NDArray[Any], channels: int) -> NDArray[Any] | None:
    if raw.ndim == 3:
        raw = raw[None]
    if raw.ndim == 4 and raw.shape[1] != channels and raw.shape[-1] == channels:
        raw = np.moveaxis(raw, -1, 1)
    return raw if raw.ndim == 4 and raw.shape[1] == channels else None


def _as_turns(raw: NDArray[Any], channels: int) -> NDArray[Any] | None:
    """Two frequencies that take turns from frame to frame."""
    if raw.ndim == 4 and 2 * raw.shape[1] == channels and len(raw) % 2 == 0:
        return raw.reshape(-1, channels, *raw.shape[2:])
    return None


def _as_images(raw: NDArray[Any], channels: int) -> NDArray[Any] | None:
    if raw.ndim == 3 and len(raw) % channels == 0:
        return raw.reshape(-1, channels, *raw.shape[1:])
    return None


def signed(raw: NDArray[Any]) -> NDArray[Any]:
    """Give negative numbers back their sign where they were stored as the upper half of 12, 14 or 16 bits.

    Differences of taps lie about zero: unsigned, they crowd at both ends of the scale and leave its middle empty.
    """
    if raw.dtype.kind != "u" or raw.max(initial=0) < 1 << 11:
        return raw
    bits = next(b for b in (12, 14, 16, 32, 64) if int(raw.max()) < 1 << b)
    share = raw.astype(np.float64) / (1 << bits)
    middle = float(((share > 0.3) & (share < 0.7)).mean())
    ends = min(float((share < 0.3).mean()), float((share > 0.7).mean()))
    if middle > 0.01 or ends < 0.05:
        return raw
    return np.where(share >= 0.5, raw.astype(np.int64) - (1 << bits), raw.astype(np.int64))


def without_metadata(raw: NDArray[Any]) -> NDArray[Any]:
    """Take off first and last rows that are no image: their neighbours in the column say nothing of them.

    Cameras write temperature and counters there (method.md 0.4). A row is metadata when it differs from the row inside it by more than
    five times what the rows of the image differ by.
    """
    mean = raw.reshape(-1, *raw.shape[-2:]).astype(np.float64).mean(axis=0)
    step = np.median(np.abs(np.diff(mean, axis=0)), axis=1) + 1e-9
    typical = float(np.median(step[HEADER_ROWS:-HEADER_ROWS])) if len(step) > 4 * HEADER_ROWS else np.inf
    odd = step > 5 * typical + 0.02 * float(np.median(np.abs(mean)))
    first, last = (max(np.flatnonzero(side[:HEADER_ROWS]) + 1, default=0) for side in (odd, odd[::-1]))
    return raw[..., first : raw.shape[-2] - last, :]
