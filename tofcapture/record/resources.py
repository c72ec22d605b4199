"""Define what a recorder needs before it starts: room on the disk, its recording, its arm, leave to move it."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from tofcapture.errors import BusyError, ConfigError, MotionRefused

if TYPE_CHECKING:
    from tofcapture.devices import Arm
    from tofcapture.devices.station import Station

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
_VIEW_BYTES = 40e6  # a view of a full-size rig with truth, and room to spare
_RESERVE_BYTES = 0.5e9


class DiskFull(ConfigError):  # noqa: N818  the disk's state
    """The disk takes no more; what is sealed stays, the same command goes on when there is room."""


def is_full(error: BaseException) -> bool:
    """Tell whether an error says that the disk takes no more: full, over quota, at a limit, or read-only."""
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        return True
    text = str(error).lower()
    if isinstance(error, sqlite3.OperationalError):
        return "full" in text or "readonly" in text
    # HDF5 hides errno in its own words, and fails once more when the file is closed.
    return isinstance(error, (OSError, RuntimeError)) and "no space left" in text


@contextmanager
def full_disk_named(where: Path) -> Iterator[None]:
    """Turn every way in which libraries say that the disk is full into :class:`DiskFull`."""
    try:
        yield
    except (OSError, RuntimeError, sqlite3.OperationalError) as err:
        if not is_full(err):
            raise
        raise DiskFull(
            f"{where}: the disk takes no more: {str(err).partition('(')[0].strip()}",
            hint="free some space, then run the same again",
        ) from err


def check_space(recording: Path, views: int) -> None:
    """Refuse to begin what the disk cannot hold. Raises :class:`DiskFull`: there is no room for so many views."""
    free = shutil.disk_usage(recording).free
    needed = views * _VIEW_BYTES + _RESERVE_BYTES
    if free < needed:
        raise DiskFull(
            f"{recording}: expected {needed / 1e9:.1f} GB of free disk, got {free / 1e9:.1f} GB",
            hint="free some space, or ask for fewer views",
        )


@contextmanager
def hold_file(path: Path, what: str, hint: str) -> Iterator[None]:
    """Hold a lock file that names this process; the lock goes with the process, however that ends.

    Raises :class:`BusyError`: another process holds it: ``what``, its id, ``hint``.
    """
    with path.open("a+", encoding="ascii") as file:
        file.seek(0)
        _lock(file, f"{what} (process {file.read().strip() or 'unknown'})", hint)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def holder(path: Path) -> int | None:
    """Find the process that holds a lock file of :func:`hold_file`, 0 where it says none; ``None`` when nobody does."""
    with suppress(FileNotFoundError), path.open(encoding="ascii") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return int(file.read().strip() or 0)
    return None


@contextmanager
def hold_arm(arm: Arm) -> Iterator[None]:
    """Hold a real arm for this process: two recorders of two recordings must not move it in turn.

    Raises :class:`BusyError`: another process of this machine moves it.
    """
    if arm.simulated:
        yield
        return
    info = arm.describe()
    name = hashlib.sha256(f"{info.model}|{info.serial}".encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"tofcapture-arm-{name}.lock"
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except PermissionError:  # another user's file in a sticky folder can be locked, but not created
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(handle) as file:
        _lock(file, f"the arm {info.model} {info.serial} is moved by another process", "tofcapture status")
        yield


def _lock(file: TextIO, busy: str, hint: str) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as err:
        raise BusyError(busy, hint=hint) from err


def check_motion_allowed(station: Station, allowed: bool, hint: str) -> None:
    """Refuse to begin with a real arm that nobody allowed to move.

    Raises :class:`MotionRefused`: the arm is real, and ``--allow-motion`` was not given; ``hint`` says what to do.
    """
    if not (station.simulated or allowed):
        model = station.arm.describe().model
        raise MotionRefused(f"the arm {model} is real and --allow-motion was not given", hint=hint)
