"""Write once: a temporary name, fsync, digest, read-only, rename, fsync of the folder.

The digest of a sealed file lies beside it (``view-007.sha256``, in the form that ``sha256sum -c`` reads), so that a flipped
byte anywhere, in data or in HDF5's own structures, is found.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from tofcapture.errors import DataError

PARTIAL = ".partial"


def partial_path(path: Path) -> Path:
    """Temporary name of a file in the making; what an earlier, killed writer left there is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + PARTIAL)
    partial.unlink(missing_ok=True)
    return partial


def digest_path(path: Path) -> Path:
    """Where the digest of a sealed file lies."""
    return path.with_suffix(".sha256")


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def stored_digest(path: Path) -> str | None:
    """Digest that was stored when ``path`` was sealed; ``None`` when there is none or it cannot be read."""
    try:
        words = digest_path(path).read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError):
        return None
    return words[0] if words else None


def sealed_digest(path: Path) -> str:
    """Hash a file and make sure that it is what was sealed.

    Returns
    -------
    SHA-256 of its bytes; without a stored digest there is nothing to compare with.

    Raises
    ------
    DataError
        When the file cannot be read, or its bytes are not those that were sealed.
    """
    stored = stored_digest(path)
    try:
        found = sha256_of(path)
    except OSError as err:
        raise DataError(f"{path}: cannot be read: {err}") from err
    if stored not in (None, found):
        raise DataError(
            f"{path}: expected sha256 {str(stored)[:12]}..., got {found[:12]}...: changed after it was sealed",
            hint="restore it from a copy, or delete it and run the same command again",
        )
    return found


def fsync(path: Path) -> None:
    """Make sure that a file, or a folder's list of names, is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: Path, text: str) -> None:
    """Replace a text file atomically: readers see the old one or the new one, also after a power cut."""
    partial = partial_path(path)
    partial.write_text(text, encoding="utf-8")
    fsync(partial)
    partial.replace(path)
    fsync(path.parent)


def seal(partial: Path, path: Path) -> str:
    """Make a finished temporary file permanent and read-only.

    The digest is stored first: a file under its final name always has one.

    Returns
    -------
    SHA-256 of the file, hexadecimal.
    """
    digest = sha256_of(partial)
    fsync(partial)
    partial.chmod(0o444)
    write_text(digest_path(path), f"{digest}  {path.name}\n")
    partial.replace(path)
    fsync(path.parent)
    return digest
