"""Who looks on while the recorder works, and may make it wait or end."""

from __future__ import annotations

import errno
import sqlite3
from typing import TYPE_CHECKING

from tofcapture.errors import ConfigError, TofError

if TYPE_CHECKING:
    from tofcapture.frames import View
    from tofcapture.record.plan import Plan

STEPS = ("moving", "tof", "stereo", "sealing")
"""What is done for a view, in this order; the journal holds the step before the step begins."""

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


class Stopped(TofError):  # noqa: N818  nothing is wrong
    """Somebody asked the recorder to end; the view in hand is rolled back, the others stay."""

    exit_code = 130


class DiskFull(ConfigError):  # noqa: N818  the disk's state
    """The disk takes no more; what is sealed stays, the same command goes on when there is room."""


class Watch:
    """Looks on and lets everything happen; override what you need.

    Every method is called by the recorder's own thread. ``before_view`` and ``step`` may wait, and may raise
    :class:`Stopped`.
    """

    def planned(self, plan: Plan, kept: set[int], repaired: list[str]) -> None:
        """The plan, the views that are there already, and what was put right."""

    def before_view(self, index: int) -> None:
        """The arm rests and nothing is half done: the place to pause."""

    def step(self, index: int, step: str) -> None:
        """One of :data:`STEPS` is about to begin, or ``"failed"`` has just happened."""

    def sealed(self, view: View, sha256: str) -> None:
        """A view is on disk under its name, and in the journal."""

    def failed(self, index: int, reason: str) -> None:
        """A view was given up."""


def is_full(error: BaseException) -> bool:
    """Tell whether an error says that the disk takes no more: full, over quota, at a limit, or read-only."""
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        return True
    text = str(error).lower()
    if isinstance(error, sqlite3.OperationalError):
        return "full" in text or "readonly" in text
    # HDF5 hides errno in its own words, and fails once more when the file is closed.
    return isinstance(error, (OSError, RuntimeError)) and "no space left" in text
