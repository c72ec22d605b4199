"""Define what the daemon is started with, and its own folder: queue, token, socket, lock, previews."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tofcapture.errors import ConfigError
from tofcapture.record.resources import hold_file

PICTURES = ("amplitude", "depth", "stereo")  # of the latest view
_ELSEWHERE = "give a folder of your own: --state FOLDER, or TOFCAPTURE_STATE"
_SOCKET_LIMIT = 107  # bytes of a Unix socket's path that Linux takes


class StateFolder:
    """Paths in the daemon's folder ``root``, all of them for its user alone."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.socket = root / "daemon.sock"  # where the API listens
        self.database = root / "queue.sqlite"  # queue and events
        self.previews = root / "preview"  # latest pictures
        self.token = root / "token"  # the secret that a TCP client must show
        self.lock = root / "lock"  # held by the running daemon, whose process it names
        self.socket_fits = len(os.fsencode(self.socket)) <= _SOCKET_LIMIT


@dataclass(frozen=True)
class Settings:
    """Hold what the daemon was started with."""

    root: Path  # of recordings; a job names a folder in it
    state: StateFolder
    station: Path | None = None  # station.toml; None: the embedded simulated station
    allow_motion: bool = False  # a real arm may move
    worker: Sequence[str] = (sys.executable, "-m", "tofcapture.record.daemon.worker")
    silence_limit: float = 20.0  # s without a sign of life after which a recorder is killed


def state_folder(root: Path | None) -> StateFolder:
    """Find the daemon's folder: ``root``, ``$TOFCAPTURE_STATE``, systemd's, or ``~/.local/state/tofcapture``."""
    named = root or os.environ.get("TOFCAPTURE_STATE") or os.environ.get("STATE_DIRECTORY")
    try:
        base = os.environ.get("XDG_STATE_HOME") or named or Path.home() / ".local" / "state"
    except RuntimeError as err:
        raise ConfigError(f"the daemon's folder: {err}", hint=_ELSEWHERE) from err
    return StateFolder(Path(named or Path(base) / "tofcapture").absolute())


def open_folder(root: Path | None) -> StateFolder:
    """Make the folder, or make sure that it is this user's and nobody else can look into it.

    Raises :class:`ConfigError`: it belongs to another user, or its path is too long for a socket.
    """
    state = state_folder(root)
    if not state.socket_fits:
        raise ConfigError(
            f"{state.socket}: expected at most {_SOCKET_LIMIT} bytes, a socket's path holds no more",
            hint="give a shorter --state",
        )
    try:
        state.root.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as err:
        raise ConfigError(f"{state.root}: cannot be made: {err.strerror}", hint=_ELSEWHERE) from err
    if state.root.stat().st_uid != os.getuid():
        raise ConfigError(
            f"{state.root}: belongs to another user", hint="give a folder of your own with --state"
        )
    state.root.chmod(0o700)
    state.previews.mkdir(mode=0o700, exist_ok=True)
    return state


def token_of(state: StateFolder) -> str:
    """Read the token; make one when there is none. The file is readable by its user alone."""
    try:
        handle = os.open(state.token, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except FileExistsError:
        state.token.chmod(0o600)
    else:
        with os.fdopen(handle, "w", encoding="ascii") as file:
            file.write(secrets.token_urlsafe(32))
            file.flush()
            os.fsync(handle)
    token = state.token.read_text(encoding="ascii").strip()
    if len(token) < 32:
        raise ConfigError(f"{state.token}: expected a token of 32 characters or more", hint="delete the file")
    return token


@contextmanager
def only_one(state: StateFolder) -> Iterator[None]:
    """Hold the folder: one daemon per folder. A socket that a dead one left is removed.

    Raises :class:`BusyError`: a daemon is running.
    """
    with hold_file(state.lock, f"{state.root}: a daemon is running", "tofcapture status"):
        state.socket.unlink(missing_ok=True)
        try:
            yield
        finally:
            state.socket.unlink(missing_ok=True)
