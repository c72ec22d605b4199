"""What the daemon says of itself, as JSON types."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture import __version__

if TYPE_CHECKING:
    from tofcapture.record.daemon.supervisor import Supervisor

_SILENT = 3.0  # s without a sign of life until health says so


def snapshot(supervisor: Supervisor) -> dict[str, Any]:
    """Everything but the table of views."""
    progress, store = supervisor.progress, supervisor.store
    return {
        "version": __version__,
        "pid": os.getpid(),
        "started_utc": supervisor.started,
        "phase": supervisor.phase,
        "reason": supervisor.reason,
        "allow_motion": supervisor.settings.allow_motion,
        "simulated": progress.simulated,
        "root": str(supervisor.settings.root),
        "station": str(supervisor.settings.station or "simulated"),
        "job": store.job(progress.job).table() if progress.job is not None else None,
        "progress": progress.counts(),
        "doing": progress.doing,
        "asks": progress.asks,
        "queue": store.counts(),
        "preview": supervisor.previews,
        "last_event": store.last_event(),
        "health": health(supervisor),
    }


def health(supervisor: Supervisor) -> dict[str, Any]:
    """Recorder and disk."""
    silence = supervisor.silence
    recorder = "none" if silence is None else "alive" if silence < _SILENT else "silent"
    return {
        "recorder": recorder,
        "silence_s": round(silence, 1) if silence is not None else None,
        "disk_free_bytes": _free(supervisor.settings.root),
        "restarts": supervisor.restarts,
    }


def _free(folder: Path) -> int | None:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None
