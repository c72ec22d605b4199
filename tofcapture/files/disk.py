"""Tell apart what a disk refuses: full, read-only, without locks, held by another, unreadable just now, damaged."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TextIO

from tofcapture.errors import BusyError, ConfigError, DataError, TofError, UnreadableError

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS}
# A damaged file causes none of these.
_PASSING = _NO_LOCKS | {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.EAGAIN, errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EBUSY,
    errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOTCONN, errno.EHOSTDOWN, errno.ENODEV, errno.ENXIO, errno.EREMOTEIO,
}  # fmt: skip
_WHOLE = "it may be whole: look at its permissions, its disk and who holds it, then run the same again"


class DamagedError(DataError):
    """A database is not what was written; the hint says how to go on without it."""


class NoLocksError(ConfigError):
    """The disk keeps no locks."""


class DiskFull(ConfigError):  # noqa: N818  the disk's state
    """The disk takes no more; what is sealed stays, the same command goes on when there is room."""


_FOLDERS = {
    "manifest.json": "a dataset", "shards": "a dataset that is not finished", "views": "a recording",
    "index.json": "a cache", "model.safetensors": "the folder of a run", "depth.npy": "a prediction",
}  # fmt: skip


def what_is(path: Path) -> str:
    """Say in a word or two what lies there, by its form: a recording, a shard, nothing; for errors."""
    if path.is_dir():
        if path.resolve().parent.name == "views":
            return f"one scene of the recording {path.parent.parent}"
        return next((what for name, what in _FOLDERS.items() if (path / name).exists()), "another folder")
    if not path.exists():
        return "nothing"
    if path.suffix == ".h5":
        named = {"shards": "a shard", "views": "a view file"}
        return named.get(path.parent.name) or named.get(path.parent.parent.name, "a file .h5")
    return f"a file {path.suffix}".rstrip()


def errno_of(error: BaseException) -> int | None:
    """Find the system's error number; HDF5 hides it in its own words."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    found = re.search(r"errno = (\d+)", str(error))
    return int(found[1]) if found and isinstance(error, (OSError, RuntimeError)) else None


def is_full(error: BaseException) -> bool:
    """Tell whether an error says that the disk takes no more: full, over quota, at a limit, or read-only."""
    if isinstance(error, sqlite3.OperationalError):
        return "full" in str(error) or "readonly" in str(error)
    hidden = isinstance(error, (OSError, RuntimeError)) and "no space left" in str(error).lower()
    return hidden or errno_of(error) in _NO_ROOM


@contextmanager
def full_disk_named(where: Path) -> Iterator[None]:
    """Turn every way in which libraries say that the disk is full into :class:`DiskFull`."""
    try:
        yield
    except (OSError, RuntimeError, sqlite3.OperationalError) as err:
        if not is_full(err):
            raise
        fixed = errno_of(err) == errno.EROFS or "readonly" in str(err)
        raise DiskFull(
            f"{where}: the disk takes no more: {str(err).partition('(')[0].strip()}",
            hint=f"{'mount it writable' if fixed else 'free some space'}, then run the same again",
        ) from err


def unreadable(path: Path, error: BaseException) -> UnreadableError | None:
    """Name what keeps a file from being read just now; ``None`` when the error may come from damage."""
    number = errno_of(error)
    if number not in _PASSING:
        return None
    return UnreadableError(f"{path}: cannot be read just now: {os.strerror(number or 0)}", hint=_WHOLE)


def is_there(path: Path) -> bool:
    """Tell whether there is something; :class:`UnreadableError` when the disk does not say."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as err:
        raise UnreadableError(f"{path}: cannot be looked at: {err.strerror}", hint=_WHOLE) from err
    return True


def check_writable(folder: Path, hint: str) -> None:
    """Refuse, before the work, to put its result where nothing can be written. Raises :class:`ConfigError`."""
    near = next(p for p in (folder.absolute(), *folder.absolute().parents) if p.exists())
    if not near.is_dir() or not os.access(near, os.W_OK | os.X_OK):
        why = "read-only, or another user's" if near.is_dir() else "no folder"
        raise ConfigError(f"{near}: expected a folder to write into, it is {why}", hint=hint)


@contextmanager
def hold_file(path: Path, what: str, hint: str) -> Iterator[None]:
    """Hold a lock file that names this process; the lock goes with the process, however that ends.

    Raises :class:`BusyError`: another process holds it: ``what``, its id, ``hint``; :class:`ConfigError`: it cannot be written.
    """
    try:
        opened = path.open("a+", encoding="ascii")
    except PermissionError as err:
        raise ConfigError(
            f"{path}: cannot be written: {err.strerror}", hint="take a folder of yours"
        ) from err
    with opened as file:
        file.seek(0)
        lock(file, f"{what} (process {file.read().strip() or 'unknown'})", hint)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def lock(file: TextIO, busy: str, hint: str) -> None:
    """Lock an open file. Raises :class:`BusyError`: ``busy``, ``hint``; :class:`NoLocksError`."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as err:
        raise BusyError(busy, hint=hint) from err
    except OSError as err:
        if err.errno not in _NO_LOCKS:
            raise
        where = f"{file.name}: its disk keeps no locks: {err.strerror}"
        raise NoLocksError(where, hint="write to a local disk; tofcapture doctor --folder says more") from err


class Database:
    """An SQLite database whose every transaction is on disk when its call returns.

    Every method names what fails: :class:`DiskFull`; :class:`BusyError`, another process holds it for longer than ``patience``
    seconds; :class:`UnreadableError`, it cannot be opened; :class:`DamagedError`, it is not ``what`` any more, with ``hint``.
    """

    def __init__(self, path: Path, schema: str, what: str, hint: str, patience: float = 5.0) -> None:
        self.path, self._what, self._hint = path, what, hint
        with self._named():
            self._db = sqlite3.connect(path, timeout=patience, isolation_level=None)
            try:
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute("PRAGMA synchronous=FULL")
                self._db.executescript(schema)
                _look_over(self._db)
            except BaseException:
                self._db.close()
                raise

    def close(self) -> None:
        """Close it."""
        with self._named():
            self._db.close()

    def do(self, sql: str, values: Sequence[object] = ()) -> list[Any]:
        """Execute a statement; its rows."""
        with self._named():
            return self._db.execute(sql, values).fetchall()

    def insert(self, sql: str, values: Sequence[object]) -> int:
        """Insert a row; its number."""
        with self._named():
            return int(self._db.execute(sql, values).lastrowid or 0)

    def damaged(self, said: object) -> DamagedError:
        """Say that its content is not what was written."""
        return DamagedError(f"{self.path}: not {self._what}, or damaged: {said}", hint=self._hint)

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            with full_disk_named(self.path):
                yield
        except (sqlite3.Error, ValueError) as err:  # a garbled message is no text
            raise _no_damage(self.path, err) or self.damaged(err) from err


def _look_over(db: sqlite3.Connection) -> None:
    if (said := db.execute("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
        raise sqlite3.DatabaseError(str(said).splitlines()[-1])


def _no_damage(path: Path, err: Exception) -> TofError | None:
    """Name an error that no damage causes."""
    if "locked" in str(err):
        return BusyError(f"{path}: another process holds it", hint="let it end, then run the same again")
    if any(words in str(err) for words in ("unable to open", "disk I/O", "locking protocol", "permission")):
        return UnreadableError(f"{path}: cannot be opened just now: {err}", hint=_WHOLE)
    return None


def read_rows(path: Path, sql: str, what: str, hint: str) -> list[Any]:
    """Read rows of a database and leave it as it is, also on a read-only disk or one without locks: then from a copy.

    Raises as :class:`Database` does.
    """
    try:
        try:
            return _rows(f"{path.absolute().as_uri()}?mode=ro", sql)
        except sqlite3.OperationalError as err:
            if "locked" in str(err):
                raise
        with tempfile.TemporaryDirectory(prefix="tofcapture-") as name:
            for part in (path, path.with_name(f"{path.name}-wal")):
                if part.exists():
                    shutil.copyfile(part, Path(name) / part.name)
            return _rows((Path(name) / path.name).as_uri(), sql)
    except OSError as err:
        raise UnreadableError(f"{path}: cannot be read just now: {err.strerror}", hint=_WHOLE) from err
    except (sqlite3.Error, ValueError) as err:
        damage = DamagedError(f"{path}: not {what}, or damaged: {err}", hint=hint)
        raise _no_damage(path, err) or damage from err


def _rows(uri: str, sql: str) -> list[Any]:
    with closing(sqlite3.connect(uri, uri=True)) as db:
        _look_over(db)
        return db.execute(sql).fetchall()
