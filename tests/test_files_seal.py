"""Sealed files: replaced atomically, hashed once, and never taken for what they are not."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from pathlib import Path

import pytest

from tests.test_files_shard import write
from tofcapture.errors import DataError
from tofcapture.files.seal import digest_once, digest_path, sealed_digest, verify, write_text
from tofcapture.files.shard import ShardReader


def test_text_files_are_replaced_atomically(tmp_path):
    """A reader sees the old text or the new one; the temporary file goes, and is called NAME.partial."""
    path = tmp_path / "x.toml"
    path.with_name("x.toml.partial").write_text("half")
    write_text(path, "a = 1\n")
    write_text(path, "a = 2\n")
    assert path.read_text() == "a = 2\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture
def later(monkeypatch):
    """A minute later: the files of a test are settled."""
    now = time.time() + 60
    monkeypatch.setattr(time, "time", lambda: now)


@pytest.fixture
def hashed(monkeypatch):
    """Names of the files whose bytes are hashed from now on."""
    names, real = [], hashlib.file_digest
    monkeypatch.setattr(
        hashlib,
        "file_digest",
        lambda file, kind: names.append(Path(file.name).name) or real(file, kind),
    )
    return names


def hashed_by_a_worker(reader):
    """How many files a process that is sent a reader hashes until it has read something."""
    count, real = [], hashlib.file_digest
    hashlib.file_digest = lambda *args: count.append(1) or real(*args)
    assert reader.raw(0, 0).any()
    return len(count)


def test_a_file_that_nobody_touches_is_hashed_once(tmp_path, later, hashed):
    """Once in this process, whoever asks, and not again in a process that a reader is sent to."""
    path = tmp_path / "mug.h5"
    write(path)
    hashed.clear()
    for _ in range(2):
        with ShardReader(path) as shard:
            assert shard.views == 2
    assert hashed == ["mug.h5"]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(hashed_by_a_worker, (ShardReader(path),)) == 0


def test_a_changed_file_is_another_one(tmp_path, later):
    """Other bytes of the same length, with the old time stamps put back, or another file under the name: hashed anew."""
    path = tmp_path / "a"
    path.write_bytes(b"first")
    before, first = path.stat(), digest_once(path)
    path.write_bytes(b"other")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert digest_once(path) == hashlib.sha256(b"other").hexdigest() != first
    (tmp_path / "b").write_bytes(b"third")
    (tmp_path / "b").replace(path)
    assert digest_once(path) == hashlib.sha256(b"third").hexdigest()


def test_a_fresh_file_is_not_remembered(tmp_path, hashed):
    """Within one tick of a file system's clock a file may change and look the same."""
    path = tmp_path / "a"
    path.write_bytes(b"x")
    assert digest_once(path) == digest_once(path)
    assert hashed == ["a", "a"]


def test_a_reader_refuses_what_was_changed_since(tmp_path, later):
    """Also when this process has read it before; a garbled digest beside it is a wrong one; without any, it is read."""
    path = tmp_path / "mug.h5"
    write(path)
    with ShardReader(path) as shard:
        assert shard.views == 2
    good = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    with pytest.raises(DataError, match="changed after it was sealed") as info:
        ShardReader(path).views  # noqa: B018
    assert "restore it from a copy" in info.value.hint
    path.write_bytes(good)
    digest_path(path).write_bytes(b"\xff")
    with pytest.raises(DataError, match="changed after it was sealed"):
        verify(path)
    digest_path(path).unlink()
    verify(path)
    with ShardReader(path) as shard:
        assert shard.views == 2
    with pytest.raises(DataError, match="expected sha256 000000000000"):
        ShardReader(path, "0" * 64).views  # noqa: B018
    with pytest.raises(DataError, match="cannot be read"):
        sealed_digest(tmp_path / "nothing.h5")
