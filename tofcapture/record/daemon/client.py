"""Asks a running daemon over its Unix socket; the standard library is enough."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofcapture.errors import BusyError, DataError, DeviceError, TofError, UsageError
from tofcapture.record.daemon.settings import state_folder

PATIENCE = 5.0  # s that the daemon may take to answer
_ERRORS = {404: DataError, 409: BusyError, 422: UsageError}


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=PATIENCE)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(PATIENCE)
        self.sock.connect(str(self._path))


def ask(
    method: str, path: str, body: Mapping[str, Any] | None = None, state: Path | None = None
) -> dict[str, Any]:
    """Ask the daemon whose folder is ``state`` (default: the user's): ``ask("POST", "/v1/jobs", {"scene": ...})``.

    Raises :class:`DeviceError`: no daemon answers; :class:`TofError` of other kinds: it refuses, in its words.
    """
    folder = state_folder(state)
    link = _UnixConnection(folder.socket)
    headers = {"X-Tofcapture": "1", "Content-Type": "application/json"}
    try:
        link.request(method, path, None if method == "GET" else json.dumps(body or {}), headers)
        answer = link.getresponse()
        found: dict[str, Any] = json.loads(answer.read())
    except (OSError, ValueError, http.client.HTTPException) as err:
        raise DeviceError(
            f"no daemon answers at {folder.socket}: {err}",
            hint="start one: tofcapture daemon --root FOLDER; or name its folder with --state",
        ) from err
    finally:
        link.close()
    if answer.status >= 400:
        error = found["error"]
        raise _ERRORS.get(answer.status, TofError)(error["message"], error["hint"])
    return found


def hand_over(recording: Path, job: Mapping[str, Any], state: Path | None = None) -> dict[str, Any] | None:
    """Queue a scene (``scene``, ``views``, ``frames``, perhaps ``seed``) with the daemon that keeps a recording.

    Returns the job; ``None`` when no daemon runs, or its recordings lie elsewhere. Raises what :func:`ask` raises.
    """
    try:
        root = Path(ask("GET", "/v1/state", state=state)["root"])
    except DeviceError:
        return None
    where = recording.resolve()
    if where.parent != root:
        return None
    return ask("POST", "/v1/jobs", {**job, "recording": where.name}, state)
