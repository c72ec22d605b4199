"""Chunks that are packed here and unpacked by HDF5."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.files.chunks import ChunkWriter, fletcher32, pack, packable

FILTERS = {"shuffle": True, "compression": "gzip", "compression_opts": 1, "fletcher32": True}
KINDS = st.sampled_from(["<f4", "<f8", "<u2", "u1", "?", "<i8"])


def content(seed, dtype, size):
    """Noise, runs, repetitions and gaps, in pieces of random lengths."""
    rng = np.random.default_rng(seed)
    pieces = [
        rng.normal(size=size) * 100,
        np.full(size, 7.0),
        np.tile(rng.normal(size=17), size)[:size],
        np.full(size, np.nan if np.dtype(dtype).kind == "f" else 0),
    ]
    order = rng.permutation(4)
    with np.errstate(invalid="ignore"):
        return np.concatenate([pieces[k][: rng.integers(1, size + 1)] for k in order]).astype(dtype)


@given(st.integers(0, 2**31), KINDS, st.sampled_from([1, 5, 300, 20_000]))
@settings(max_examples=40, deadline=None)
def test_hdf5_unpacks_what_is_packed_here(tmp_path_factory, seed, dtype, size):
    """Checksum, deflate and shuffle are HDF5's own, to the last bit."""
    data = content(seed, dtype, size)
    path = tmp_path_factory.mktemp("c") / "a.h5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("a", data.shape, data.dtype, chunks=data.shape, **FILTERS)
        assert packable(dataset)
        ChunkWriter().put(dataset, data)
    with h5py.File(path) as file:
        assert file["a"][()].tobytes() == data.tobytes()


@given(st.binary(min_size=1, max_size=5000))
@settings(max_examples=40, deadline=None)
def test_the_checksum_is_hdf5s(data):
    """Fletcher-32 word by word, with its end-around carries, gives the same."""
    low = high = 0
    for at in range(0, len(data), 2):
        word = (data[at] << 8) | (data[at + 1] if at + 1 < len(data) else 0)
        low += word
        low = (low & 0xFFFF) + (low >> 16)
        high += low
        high = (high & 0xFFFF) + (high >> 16)
    assert fletcher32(data) == (high << 16) | low


def test_noise_is_stored_and_runs_vanish():
    """Bytes of noise cost no more than themselves, constants next to nothing."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, 100_000).astype(np.uint8)
    assert len(pack(noise)) < 1.002 * noise.nbytes
    assert len(pack(np.zeros(100_000, np.float32))) < 4000
    assert pack(noise) == pack(noise.copy())


def shard_of(path, rows, filters):
    """A file with rows (N, F, 5) in chunks of one frame."""
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("a", rows.shape, rows.dtype, chunks=(1, 1, 5), **filters)
        writer = ChunkWriter()
        for i, row in enumerate(rows):
            writer.put(dataset, row, i)
    return writer


@pytest.mark.parametrize("filters", [FILTERS, {"compression": "gzip"}])
def test_rows_and_their_verification(tmp_path, filters):
    """Rows arrive whole, with these filters or others; a bit that changes afterwards is noticed."""
    rows = np.random.default_rng(1).integers(0, 4096, (3, 2, 5)).astype(np.uint16)
    writer = shard_of(tmp_path / "a.h5", rows, filters)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        assert (file["a"][()] == rows).all()
        assert writer.differing(file) is None
        file["a"][2, 1, 3] ^= 1
    with h5py.File(tmp_path / "a.h5") as file:
        assert writer.differing(file) in {"/a", "a"}


def test_packed_chunks_are_copied_where_they_fit(tmp_path):
    """A burst goes from one file to another without being unpacked; other chunks are refused, nothing is written."""
    rows = np.random.default_rng(2).integers(0, 4096, (2, 2, 5)).astype(np.uint16)
    with h5py.File(tmp_path / "b.h5", "w") as source, h5py.File(tmp_path / "c.h5", "w") as file:
        good = source.create_dataset("good", (2, 5), np.uint16, chunks=(1, 5), **FILTERS)
        other = source.create_dataset("other", (2, 5), np.uint16, chunks=(2, 5), **FILTERS)
        good[...] = other[...] = rows[1]
        target = file.create_dataset("a", rows.shape, np.uint16, chunks=(1, 1, 5), **FILTERS)
        writer = ChunkWriter()
        assert not writer.copy(target, rows[1], 1, other)
        assert writer.copy(target, rows[1], 1, good)
        assert (target[1] == rows[1]).all()
        assert not target[0].any()
        assert writer.differing(file) is None
        assert not ChunkWriter().copy(target, rows[1], 0, good.parent.create_dataset("plain", data=rows[1]))
