"""The daemon's folder: queue, token, socket, lock, previews; all of it for its user alone."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tofcapture.errors import BusyError, ConfigError

_SOCKET_LIMIT = 107  # bytes of a Unix socket's path that Linux takes


@dataclass(frozen=True)
class StateFolder:
    """Paths in the daemon's folder."""

    root: Path

    @property
    def socket(self) -> Path:
        """Where the API listens."""
        return self.root / "daemon.sock"

    @property
    def database(self) -> Path:
        """Queue and events."""
        return self.root / "queue.sqlite"

    @property
    def previews(self) -> Path:
        """Latest pictures."""
        return self.root / "preview"

    @property
    def token(self) -> Path:
        """The secret that a TCP client must show."""
        return self.root / "token"


def default_folder() -> Path:
    """``$TOFCAPTURE_STATE``, systemd's ``$STATE_DIRECTORY``, or ``~/.local/state/tofcapture``."""
    for name in ("TOFCAPTURE_STATE", "STATE_DIRECTORY"):
        if given := os.environ.get(name):
            return Path(given)
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "tofcapture"


def open_folder(root: Path | None) -> StateFolder:
    """Make the folder, or make sure that it is this user's and nobody else can look into it.

    Raises
    ------
    ConfigError
        It belongs to another user, or its path is too long for a socket.
    """
    state = StateFolder((root or default_folder()).absolute())
    if len(os.fsencode(state.socket)) > _SOCKET_LIMIT:
        raise ConfigError(
            f"{state.socket}: expected at most {_SOCKET_LIMIT} bytes, a socket's path holds no more",
            hint="give a shorter --state",
        )
    state.root.mkdir(mode=0o700, parents=True, exist_ok=True)
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

    Raises
    ------
    BusyError
        A daemon is running.
    """
    import fcntl

    with (state.root / "lock").open("a+", encoding="ascii") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            file.seek(0)
            raise BusyError(
                f"{state.root}: a daemon is running (process {file.read().strip() or 'unknown'})",
                hint="tofcapture status",
            ) from err
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        state.socket.unlink(missing_ok=True)
        try:
            yield
        finally:
            state.socket.unlink(missing_ok=True)
