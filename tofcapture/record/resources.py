"""Define what a recorder needs before it starts: room on the disk, its recording, its arm, leave to move it."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tofcapture.errors import ConfigError, MotionRefused, TofError
from tofcapture.files.disk import DiskFull, full_disk_named, hold_file, lock

if TYPE_CHECKING:
    from tofcapture.devices import Arm
    from tofcapture.devices.station import Station

__all__ = [
    "DiskFull",
    "FolderGone",
    "HeldFolders",
    "check_motion_allowed",
    "check_space",
    "full_disk_named",
    "hold_arm",
    "hold_file",
    "inode_of",
]

_VIEW_BYTES = 40e6  # a view of a full-size rig with truth, and room to spare
_RESERVE_BYTES = 0.5e9


def check_space(recording: Path, views: int) -> None:
    """Refuse to begin what the disk cannot hold. Raises :class:`DiskFull`: there is no room for so many views."""
    free = shutil.disk_usage(recording).free
    needed = views * _VIEW_BYTES + _RESERVE_BYTES
    if free < needed:
        raise DiskFull(
            f"{recording}: expected {needed / 1e9:.1f} GB of free disk, got {free / 1e9:.1f} GB",
            hint="free some space, or ask for fewer views",
        )


class HeldFolders:
    """The folders that a run writes into, each told by device and inode, from the top down.

    A path says little: a disk that was unmounted leaves an empty folder of the same name.
    """

    def __init__(self, *folders: Path) -> None:
        self._known = {folder: identity_of(folder) for folder in folders}

    def check(self) -> None:
        """Raise :class:`FolderGone` unless every folder is the one that it was."""
        for folder, known in self._known.items():
            if (now := identity_of(folder)) != known:
                why = "is not there any more" if now is None else "is another folder now"
                raise FolderGone(
                    f"{folder} {why}: moved, deleted or unmounted", hint="put it back or mount it, then go on"
                )

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Check before and after; an error of the disk in between is that of a folder that went."""
        self.check()
        try:
            yield
        except (OSError, TofError):
            self.check()
            raise
        self.check()


class FolderGone(ConfigError):  # noqa: N818  the disk's state
    """A folder that is recorded into was moved, deleted or unmounted; what is sealed is where it went."""


def identity_of(folder: Path) -> tuple[int, int] | None:
    """Device and inode of a folder; ``None`` where there is none."""
    try:
        found = folder.stat()
    except OSError:
        return None
    return (found.st_dev, found.st_ino) if folder.is_dir() else None


def inode_of(folder: Path) -> int | None:
    """Inode of a folder, ``None`` where there is none; a device's number may change when a machine starts."""
    known = identity_of(folder)
    return known and known[1]


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
    """Hold a real arm for this process: two recorders of two recordings must not move it in turn. A person's hands are free.

    Raises :class:`BusyError`: another process of this machine moves it.
    """
    if arm.simulated or arm.by_hand:
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
        lock(file, f"the arm {info.model} {info.serial} is moved by another process", "tofcapture status")
        yield


def check_motion_allowed(station: Station, allowed: bool, hint: str) -> None:
    """Refuse to begin with a real arm that nobody allowed to move.

    Raises :class:`MotionRefused`: the arm is real, and ``--allow-motion`` was not given; ``hint`` says what to do.
    """
    if not (station.simulated or station.arm.by_hand or allowed):
        model = station.arm.describe().model
        raise MotionRefused(f"the arm {model} is real and --allow-motion was not given", hint=hint)
