"""Chunks as HDF5 stores them under shuffle, deflate and Fletcher-32, made here instead of in HDF5's filters.

The bytes of numbers are shuffled into planes: all first bytes, all second bytes ... HDF5 gives every plane to the same
deflate, which looks long for repetitions in what is noise. Here each plane gets the strategy that suits it; one deflate stream
may mix them, and any HDF5 reads it. Measured in docs/decisions/0017-view-compression.md.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator
from itertools import product
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Chunk = tuple[int, ...]
"""Index of a chunk's first element."""

PIPELINE = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32)
STORED = (0, zlib.Z_DEFAULT_STRATEGY)
RUNS = (1, zlib.Z_RLE)
REPEATS = (1, zlib.Z_DEFAULT_STRATEGY)
PROBES, PROBE = 4, 4096  # pieces of a plane that are tried, bytes of each
WORTH = 0.95  # repetitions are looked for where they save a twentieth over runs
NOISE = 0.9  # what cannot be made smaller than this is stored as it is
_RAW = -zlib.MAX_WBITS
_MEMORY = 9
_HEADER = b"\x78\x01"  # zlib, window of 32 KiB, fastest
_LAST = b"\x03\x00"  # an empty last block
_BLOCK = 256  # words whose weighted sum is exact in float64


def _deflate(plane: bytes | memoryview, how: tuple[int, int]) -> bytes:
    """Deflate without header by a level and a strategy; it ends on a byte, so that another piece can follow."""
    packer = zlib.compressobj(how[0], zlib.DEFLATED, _RAW, _MEMORY, how[1])
    return packer.compress(plane) + packer.flush(zlib.Z_SYNC_FLUSH)


def _suited(plane: memoryview) -> tuple[int, int]:
    """Level and strategy for a plane, as a few pieces of it tell."""
    step = max(1, (len(plane) - PROBE) // (PROBES - 1))
    probe = b"".join(plane[i : i + PROBE] for i in range(0, max(1, len(plane) - PROBE + 1), step))
    runs, repeats = len(_deflate(probe, RUNS)), len(_deflate(probe, REPEATS))
    if min(runs, repeats) > NOISE * len(probe):
        return STORED
    return REPEATS if repeats < WORTH * runs else RUNS


def fletcher32(data: bytes) -> int:
    """HDF5's checksum: two sums of big-endian 16-bit words modulo 65535, 65535 standing for zero unless all words are."""
    even = data + b"\0" if len(data) % 2 else data
    words = np.frombuffer(even, dtype=">u2")
    padded = np.zeros(-(-len(words) // _BLOCK) * _BLOCK)
    padded[len(padded) - len(words) :] = words  # leading zeros change neither sum
    rows = padded.reshape(-1, _BLOCK)
    within = rows @ np.arange(_BLOCK, 0, -1.0)
    sums = rows.sum(axis=1).astype(np.int64)
    first = int(sums.sum())
    after = _BLOCK * np.arange(len(sums) - 1, -1, -1, dtype=np.int64)
    second = int(within.astype(np.int64).sum() + ((sums % 65535) * (after % 65535)).sum())
    low, high = ((s - 1) % 65535 + 1 if s else 0 for s in (first, second))
    return (high << 16) | low


def pack(data: Array) -> bytes:
    """Shuffle, deflate and seal one chunk.

    Parameters
    ----------
    data
        Any shape, the chunk's, of little-endian numbers.

    Returns
    -------
    Bytes as HDF5 stores them under :data:`PIPELINE`; the same for the same data and version of zlib.
    """
    flat = np.ascontiguousarray(data).reshape(-1)
    size = flat.dtype.itemsize
    planes = np.ascontiguousarray(flat.view(np.uint8).reshape(-1, size).T)
    pieces = [_deflate(p.data, _suited(p.data)) for p in planes]
    check = zlib.adler32(planes.reshape(-1).data).to_bytes(4, "big")
    packed = b"".join([_HEADER, *pieces, _LAST, check])
    return packed + fletcher32(packed).to_bytes(4, "little")


def packable(dataset: h5py.Dataset) -> bool:
    """Whether a dataset is stored under exactly these filters, in chunks that divide it."""
    plist = dataset.id.get_create_plist()
    found = tuple(plist.get_filter(i)[0] for i in range(plist.get_nfilters()))
    whole = dataset.chunks is not None and all(
        n % c == 0 for n, c in zip(dataset.shape, dataset.chunks, strict=True)
    )
    return found == PIPELINE and whole and dataset.dtype.byteorder in "<|=" and dataset.dtype.kind in "biuf"


def starts(shape: tuple[int, ...], chunks: tuple[int, ...]) -> Iterator[Chunk]:
    """First elements of the chunks of an array, in order."""
    return product(*(range(0, n, c) for n, c in zip(shape, chunks, strict=True)))


class ChunkWriter:
    """Writes datasets of one file by chunks, remembers what it wrote, and compares it with what lies on the disk."""

    def __init__(self) -> None:
        self._written: dict[str, dict[Chunk, bytes]] = {}
        self._plain: dict[tuple[str, int | None], bytes] = {}
        self._first: dict[str, tuple[Chunk, bytes]] = {}

    def put(self, dataset: h5py.Dataset, data: Array, row: int | None = None) -> None:
        """Write a dataset, or one row of its first axis; the shape must be right."""
        name = str(dataset.name)
        if not packable(dataset):
            dataset[... if row is None else row] = data
            self._plain[name, row] = _digest(np.asarray(data, dtype=dataset.dtype))
            return
        below, whole = (0, data) if row is None else (row, data[None])
        for start in starts(whole.shape, dataset.chunks):
            block = whole[tuple(slice(s, s + c) for s, c in zip(start, dataset.chunks, strict=True))]
            place = (start[0] + below, *start[1:])
            self._first.setdefault(name, (place, _digest(block)))
            self._store(dataset, place, pack(block))

    def copy(self, dataset: h5py.Dataset, data: Array, row: int, source: h5py.Dataset) -> bool:
        """Write one row as the packed chunks of another dataset, which holds the same data.

        ``False``, and nothing done, where the chunks do not fit.
        """
        fits = packable(dataset) and packable(source) and dataset.dtype == source.dtype
        if not (fits and dataset.shape[1:] == source.shape and dataset.chunks == (1, *source.chunks)):
            return False
        at = list(starts(source.shape, source.chunks))
        found = [source.id.read_direct_chunk(start) for start in at]
        if any(mask for mask, _ in found):
            return False
        block = data[tuple(slice(0, c) for c in source.chunks)]
        self._first.setdefault(str(dataset.name), ((row, *at[0]), _digest(block)))
        for start, (_, packed) in zip(at, found, strict=True):
            self._store(dataset, (row, *start), bytes(packed))
        return True

    def _store(self, dataset: h5py.Dataset, start: Chunk, packed: bytes) -> None:
        dataset.id.write_direct_chunk(start, packed)
        self._written.setdefault(dataset.name, {})[start] = hashlib.sha256(packed).digest()

    def differing(self, file: h5py.File) -> str | None:
        """Name of a dataset whose bytes are not those that were written; ``None`` when all are.

        Every packed chunk is compared as it lies there, and the first one of a dataset also as HDF5 unpacks it.
        """
        for name, chunks in self._written.items():
            dataset = file[name]
            for start, digest in chunks.items():
                mask, packed = dataset.id.read_direct_chunk(start)
                if mask or hashlib.sha256(packed).digest() != digest:
                    return name
            first, expected = self._first[name]
            block = dataset[tuple(slice(s, s + c) for s, c in zip(first, dataset.chunks, strict=True))]
            if _digest(block) != expected:
                return name
        for (name, row), digest in self._plain.items():
            if _digest(np.asarray(file[name][() if row is None else row])) != digest:
                return name
        return None


def _digest(data: Array) -> bytes:
    return hashlib.sha256(np.ascontiguousarray(data).data).digest()
