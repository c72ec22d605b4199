"""What a disk refuses is told apart from damage, views are taken by their exact names, databases are fuzzed."""

import errno
import fcntl
import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import warnings
from contextlib import closing

import h5py
import pytest

from tests.test_recorder import _few_candidates, _record
from tofcapture.cli import main
from tofcapture.dataset.build import find_scenes
from tofcapture.errors import (
    BusyError,
    ConfigError,
    DataError,
    FormatError,
    PassedOver,
    TofError,
    UnreadableError,
)
from tofcapture.files import disk
from tofcapture.files.check import check
from tofcapture.files.disk import DiskFull, NoLocksError, check_writable, full_disk_named, hold_file
from tofcapture.files.seal import digest_path, sealed_digest
from tofcapture.files.view import find_views, open_view, view_path
from tofcapture.record import journal as journals
from tofcapture.record.daemon.store import Store
from tofcapture.record.journal import Journal, journal_path

__all__ = ["_few_candidates"]  # applies here too
PASSING = (errno.EACCES, errno.ENOLCK, errno.EOPNOTSUPP, errno.EIO, errno.ESTALE, errno.EROFS)


def test_sealed_files_are_read_without_locks(tmp_path):
    """A view that another process has locked, as a disk without locks seems to have, is read and checked."""
    _record(tmp_path, views=1)
    path = view_path(tmp_path, "mug", 0)
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        code = f"from pathlib import Path; from tofcapture.files.view import open_view; open_view(Path({str(path)!r}))"
        subprocess.run([sys.executable, "-c", code], check=True)
        assert check(tmp_path) == []


@pytest.mark.parametrize("number", PASSING)
def test_what_cannot_be_opened_is_not_damaged(tmp_path, monkeypatch, number):
    """Refused by the system, a healthy view is called that: no advice to delete it, and the recorder renames nothing."""
    _record(tmp_path, views=1)
    path = view_path(tmp_path, "mug", 0)
    for leftover in tmp_path.glob("journal.sqlite*"):
        leftover.unlink()

    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    for owner, name in ((h5py, "File"), (disk.Path, "open")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, refuse)
            (told,) = check(tmp_path)
            assert os.strerror(number) in told.message
            assert "delete" not in told.hint
            with pytest.raises(UnreadableError, match=os.strerror(number)):
                open_view(path) if owner is h5py else sealed_digest(path)
    with monkeypatch.context() as patch:
        patch.setattr(journals, "open_view", lambda _: refuse_read(path, number))
        with pytest.raises(UnreadableError):
            _record(tmp_path, views=1)
    assert path.exists()
    assert not list(tmp_path.rglob("*.damaged*"))
    assert "adopted" in _record(tmp_path, views=1).repaired[0]


def refuse_read(path, number):
    raise disk.unreadable(path, OSError(number, "x"))


def test_a_newer_layout_is_no_damage(tmp_path, monkeypatch):
    """A view whose digest is right but whose version nobody here reads is left where it lies."""
    _record(tmp_path, views=1)
    for leftover in tmp_path.glob("journal.sqlite*"):
        leftover.unlink()

    def newer(path):
        raise FormatError(f"{path}: expected version 1, got 2")

    with monkeypatch.context() as patch:
        patch.setattr(journals, "open_view", newer)
        with pytest.raises(FormatError):
            _record(tmp_path, views=1)
    assert not list(tmp_path.rglob("*.damaged*"))


def test_only_exact_names_are_views(tmp_path, capsys):
    """Copies and conflicts are none, whatever they are called; every command that reads a recording names them."""
    _record(tmp_path, views=3)
    folder = tmp_path / "views" / "mug"
    odd = [
        "view-000 (1).h5",
        "view-1.h5",
        "view-0002.h5",
        "Copy of view-001.h5",
        "view-000.sync-conflict-1.h5",
    ]
    for name in odd:
        shutil.copy(folder / "view-000.h5", folder / name)
    for name in ("view-007.h5", "view-008.h5"):
        shutil.copy(folder / "view-000.h5", folder / name)
    shutil.copy(digest_path(folder / "view-000.h5"), digest_path(folder / "view-007.h5"))
    shutil.copytree(folder, tmp_path / "views" / "a-copy-of-mug")
    shutil.copytree(folder, tmp_path / "views" / "mug (copy)")
    with pytest.warns(PassedOver) as told:
        found = find_views(tmp_path)
    assert {scene: [p.name for p in paths] for scene, paths in found.items()} == {
        "mug": ["view-000.h5", "view-001.h5", "view-002.h5"]
    }
    words = " ".join(str(w.message) for w in told)
    assert all(name in words for name in (*odd, "view-007.h5", "view-008.h5", "mug (copy)", "a-copy-of-mug"))
    assert "view-007.h5: passed over: a copy of mug/view-000.h5" in words
    with pytest.warns(PassedOver):
        assert len(find_scenes([tmp_path])["mug"][1]) == 3
    problems = [p.message for p in check(tmp_path)]
    assert len(problems) == len(told)
    assert all(message.startswith("passed over") for message in problems)
    shown = str(tmp_path / "x.png")
    where = str(tmp_path)
    for command in (
        ["align", where],
        ["figure", "acquisition", where, "--out", shown],
        ["view", where, "--png", shown],
    ):
        main(command)
        assert "view-000 (1).h5: passed over" in capsys.readouterr().err


def _mount_read_only(folder, at):
    """Mount a folder once more, read-only; skip where that is not allowed."""
    at.mkdir()
    for words in (["--bind", folder, at], ["-o", "remount,bind,ro", at]):
        if (
            os.getuid()
            or subprocess.run(["mount", *map(str, words)], capture_output=True, check=False).returncode
        ):
            pytest.skip("mounting is not allowed here")


def test_a_read_only_mount_is_read(tmp_path, capsys):
    """``check`` and readers work on a read-only disk, also with a journal that was never tidied; what must write says so first."""
    _record(tmp_path / "r", views=2)
    db = sqlite3.connect(journal_path(tmp_path / "r"))
    db.execute("UPDATE views SET reason = 'x'")
    db.commit()  # and left open: its write-ahead log stays
    ro = tmp_path / "ro"
    _mount_read_only(tmp_path / "r", ro)
    try:
        assert (ro / "journal.sqlite-wal").stat().st_size
        assert check(ro) == []
        assert len(find_views(ro)["mug"]) == 2
        assert main(["align", str(ro)]) == 3
        assert "--out" in capsys.readouterr().err
        assert main(["build-dataset", str(tmp_path / "r"), "--out", str(ro / "d")]) == 3
        with pytest.raises(DiskFull) as told:
            _record(ro, views=2)
        assert "writable" in told.value.hint
    finally:
        db.close()
        subprocess.run(["umount", ro], check=True)


def test_a_folder_that_cannot_be_written_is_named_first(tmp_path, monkeypatch):
    """Read-only, another user's, or a file; a folder that is not there yet is judged by the one above."""
    check_writable(tmp_path / "new" / "er", "")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="no folder"):
        check_writable(tmp_path / "file" / "x", "")
    monkeypatch.setattr(os, "access", lambda path, _: path != tmp_path)
    with pytest.raises(ConfigError, match="read-only"):
        check_writable(tmp_path / "new", "")


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_disk_without_locks_is_named(tmp_path, monkeypatch, number):
    """Recording is refused there, with a word on what to do."""

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(disk.fcntl, "flock", refuse)
    with pytest.raises(NoLocksError, match=r"\.lock.*locks") as told:
        _record(tmp_path)
    assert "local disk" in told.value.hint


def test_a_held_journal_is_no_damage(tmp_path, monkeypatch):
    """Locked by another process the journal is called that; ``check`` reads it all the same or says so."""
    _record(tmp_path, views=1)
    monkeypatch.setattr(Journal.__init__.__globals__["Database"].__init__, "__defaults__", (0.1,))
    with closing(sqlite3.connect(journal_path(tmp_path), isolation_level=None)) as db:
        db.execute("BEGIN IMMEDIATE")
        with pytest.raises(BusyError, match=r"journal\.sqlite"):
            _record(tmp_path, views=2)
        assert check(tmp_path) == []
        db.execute("ROLLBACK")
    assert _record(tmp_path, views=2).recorded == (1,)


def _use_queue(path):
    with closing(Store(path)) as queue:
        queue.next(), queue.ended(), queue.counts(), list(queue.events(0)), queue.last_event(), queue.log("")
        job, _ = queue.add({"request_id": "new", "recording": "r", "scene": "a", "views": 2, "frames": 1})
        queue.move(job.id, "running")
        queue.remember("log", {})


def _use_journal(path):
    with closing(Journal(path.parent)) as journal:
        journal.agree({"frames": 2, "station": {"a": [1]}})
        journal.rows()
        journal.expect("mug", dict.fromkeys(range(9), ("pose",)))
        journal.seal("mug", 8, "e" * 64, "pose")
    check(path.parent)


@pytest.mark.parametrize("use", [_use_queue, _use_journal])
def test_flipped_bytes_in_a_database_are_named(tmp_path, use):
    """Flipped, cut, blanked, garbage: the database works, or it is named with what to do, exit code 5."""
    path = tmp_path / "a" / "journal.sqlite"
    path.parent.mkdir()
    (path.parent / "views").mkdir()
    use(path)
    data, rng, errors = path.read_bytes(), random.Random(0), []
    for number in range(120):
        found = bytearray(data)
        where = rng.randrange(len(data))
        if number % 4 == 0:
            for _ in range(rng.randint(1, 40)):
                found[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        elif number % 4 == 1:
            del found[where:]
        elif number % 4 == 2:
            found[where : where + 600] = bytes(len(found[where : where + 600]))
        else:
            found[where : where + 100] = rng.randbytes(len(found[where : where + 100]))
        for leftover in path.parent.glob("journal.sqlite*"):
            leftover.unlink()
        path.write_bytes(found)
        try:
            use(path)
        except TofError as err:
            errors.append(err)
    damaged = [
        err for err in errors if not isinstance(err, ConfigError)
    ]  # which says that other things were agreed
    assert len(damaged) > 20
    assert all(isinstance(err, DataError) and str(path) in err.message for err in damaged)
    assert all("move it away" in err.hint for err in damaged)


def test_a_full_disk_is_named_whatever_library_says_it(tmp_path):
    """errno, SQLite's words and HDF5's; a read-only disk is to be mounted, not tidied."""
    for error, hint in (
        (OSError(errno.ENOSPC, "x"), "free"),
        (OSError(errno.EROFS, "x"), "writable"),
        (sqlite3.OperationalError("attempt to write a readonly database"), "writable"),
        (RuntimeError("write failed: errno = 28, error message = 'No space left on device'"), "free"),
    ):
        with pytest.raises(DiskFull) as told, full_disk_named(tmp_path):
            raise error
        assert hint in told.value.hint
    with pytest.raises(OSError, match="x"), full_disk_named(tmp_path):
        raise OSError(errno.EIO, "x")


def test_a_lock_names_its_holder(tmp_path):
    """A second holder is told the process."""
    held = [hold_file(tmp_path / "l", "busy", "wait") for _ in range(2)]
    with held[0], pytest.raises(BusyError, match=f"busy.*{os.getpid()}"):
        held[1].__enter__()


def test_notes_stay_out_of_json(tmp_path, capsys):
    """What is passed over is told on stderr, once, and a result on stdout stays one JSON object."""
    _record(tmp_path, views=2)
    folder = tmp_path / "views" / "mug"
    shutil.copy(folder / "view-000.h5", folder / "view-000 (1).h5")
    out = str(tmp_path / "d")
    with warnings.catch_warnings():
        main(["build-dataset", str(tmp_path), "--out", out, "--json"])
    said = capsys.readouterr()
    json.loads(said.out)
    assert said.err.count("passed over") == 1
