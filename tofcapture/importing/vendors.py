"""Raw layouts of cameras."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tofcapture.importing.said import Said
from tofcapture.importing.source import Piece


def claims(path: Path) -> bool:
    """Tell whether it is one."""
    del path
    return False


def pieces(path: Path, said: Said) -> Iterator[Piece]:
    """List frames."""
    del path, said
    yield from ()
