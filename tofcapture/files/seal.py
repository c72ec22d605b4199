"""Write once: a temporary name, fsync, digest, read-only, rename, fsync of the folder.

The digest of a sealed file lies beside it (``view-007.sha256``, in the form that ``sha256sum -c`` reads), so that a flipped
byte anywhere, in data or in HDF5's own structures, is found.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tofcapture.errors import DataError, UnreadableError
from tofcapture.files.disk import is_there, unreadable

PARTIAL = ".partial"
_SETTLED = 2.0  # s; a file changed since then may change again within one tick of the file system's clock

Identity = tuple[int, ...]
_digests: dict[str, tuple[Identity, str]] = {}  # by absolute path, what this process has hashed


def partial_path(path: Path) -> Path:
    """Return the temporary name of a file in the making; what an earlier, killed writer left there is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + PARTIAL)
    partial.unlink(missing_ok=True)
    return partial


def digest_path(path: Path) -> Path:
    """Return where the digest of a sealed file lies."""
    return path.with_suffix(".sha256")


def digest_text(path: Path, digest: str) -> str:
    """Return the content of :func:`digest_path`, as ``sha256sum -c`` reads it."""
    return f"{digest}  {path.name}\n"


def stored_digest(path: Path) -> str | None:
    """Read the digest that was stored when ``path`` was sealed; ``None`` when there is none or it is garbled.

    Raises :class:`UnreadableError`: it is there, but cannot be read just now.
    """
    try:
        words = digest_path(path).read_text(encoding="ascii").split()
    except (FileNotFoundError, NotADirectoryError, UnicodeDecodeError):
        return None
    except OSError as err:
        raise _unreadable(digest_path(path), err) from err
    return words[0] if words else None


def _unreadable(path: Path, err: OSError) -> DataError:
    return unreadable(path, err) or UnreadableError(f"{path}: cannot be read: {err}")


def sha256_of(path: Path) -> str:
    """Hash a file's bytes; hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _identity(path: Path) -> Identity:
    """Device, inode, size and both times: a file that was written to since has another one."""
    s = path.stat()
    return s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns


def digest_once(path: Path) -> str:
    """Hash a file's bytes; a file that this process has hashed and nobody touched since is not read again."""
    name, before = str(path.absolute()), _identity(path)
    if (known := _digests.get(name)) is not None and known[0] == before:
        return known[1]
    digest = sha256_of(path)
    if _identity(path) == before and time.time() - max(before[-2:]) / 1e9 > _SETTLED:
        _digests[name] = before, digest
    return digest


def remembered(path: Path) -> tuple[Identity, str] | None:
    """Return what :func:`digest_once` knows of a file, for a process that this one starts."""
    return _digests.get(str(path.absolute()))


def remember(path: Path, known: tuple[Identity, str] | None) -> None:
    """Take over what another process of this machine :func:`remembered`."""
    if known is not None:
        _digests.setdefault(str(path.absolute()), known)


def sealed_digest(path: Path, promised: str | None = None) -> str:
    """Hash a file, once per process, and make sure that it is the one that was sealed; hexadecimal.

    Its digest in a manifest counts where one is promised, else the one beside it. Without either there is nothing to compare
    with. :class:`DataError` when its bytes are not those that were sealed; :class:`UnreadableError` when it cannot be read.
    """
    expected = promised or stored_digest(path)
    try:
        found = digest_once(path)
    except OSError as err:
        raise _unreadable(path, err) from err
    if expected not in (None, found):
        raise DataError(
            f"{path}: expected sha256 {str(expected)[:12]}..., got {found[:12]}...: changed after it was sealed",
            hint="restore it from a copy, or delete it and run the same command again",
        )
    return found


def verify(path: Path, promised: str | None = None) -> None:
    """Raise what :func:`sealed_digest` raises; a file without any digest is not read, a garbled digest is one that differs."""
    if promised is None and is_there(digest_path(path)):
        promised = stored_digest(path) or "unreadable"
    if promised is not None:
        sealed_digest(path, promised)


def fsync(path: Path) -> None:
    """Make sure that a file, or a folder's list of names, is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name to write under; at the end it takes the place of ``path``.

    Others see the old file or the new one, also after a power cut. A file that is not whole leaves nothing.
    """
    partial = partial_path(path)
    try:
        yield partial
        fsync(partial)
        partial.replace(path)
        fsync(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Replace a text file atomically, as :func:`replacing` does."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def seal(partial: Path, path: Path) -> str:
    """Make a finished temporary file permanent and read-only; returns its SHA-256, hexadecimal.

    The digest is stored first: a file under its final name always has one.
    """
    digest = sha256_of(partial)
    fsync(partial)
    partial.chmod(0o444)
    write_text(digest_path(path), digest_text(path, digest))
    partial.replace(path)
    fsync(path.parent)
    return digest
