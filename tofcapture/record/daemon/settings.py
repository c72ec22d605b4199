"""What the daemon was started with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tofcapture.record.daemon.child import WORKER
from tofcapture.record.daemon.state import StateFolder


@dataclass(frozen=True)
class Settings:
    """What the daemon was started with.

    Attributes
    ----------
    root
        Folder of recordings; a job names a folder in it.
    state
        The daemon's own folder.
    station
        ``station.toml``; ``None`` for the embedded simulated station.
    allow_motion
        A real arm may move.
    worker
        Command of the recorder's process.
    """

    root: Path
    state: StateFolder
    station: Path | None = None
    allow_motion: bool = False
    worker: Sequence[str] = WORKER
