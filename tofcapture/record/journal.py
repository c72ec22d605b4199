"""The recording's journal: one row per view, in SQLite; who writes it holds the recording.

The journal says what should be there and what is; the sealed files themselves are the truth, and ``record.reconcile`` makes the
journal agree with them.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.errors import BusyError, ConfigError, DataError
from tofcapture.record.watch import is_full

if TYPE_CHECKING:
    from tofcapture.devices import Arm

_SCHEMA = """
CREATE TABLE IF NOT EXISTS views (
    scene TEXT NOT NULL, "index" INTEGER NOT NULL, pose TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('planned', 'sealed', 'failed')),
    sha256 TEXT, attempts INTEGER NOT NULL DEFAULT 0, reason TEXT NOT NULL DEFAULT '',
    planned_utc TEXT NOT NULL, changed_utc TEXT NOT NULL, step TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (scene, "index")
);
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
"""


_PLAN = """
INSERT INTO views (scene, "index", pose, state, planned_utc, changed_utc) VALUES (?, ?, ?, 'planned', ?, ?)
ON CONFLICT DO UPDATE SET pose = excluded.pose, state = 'planned', step = '', changed_utc = excluded.changed_utc WHERE state != 'sealed'
"""
_ADOPT = """
INSERT INTO views (scene, "index", pose, state, sha256, planned_utc, changed_utc) VALUES (?, ?, ?, 'sealed', ?, ?, ?)
ON CONFLICT DO UPDATE SET pose = excluded.pose, state = 'sealed', sha256 = excluded.sha256, reason = '', step = ''
"""


@dataclass(frozen=True)
class Row:
    """What the journal says of one view.

    ``pose`` is the planned view's digest, ``step`` what was begun last for a view that is not sealed (``record.watch.STEPS``).
    """

    scene: str
    index: int
    pose: str
    state: str
    sha256: str | None
    attempts: int
    reason: str
    step: str = ""


def utc_now() -> str:
    """Time of day as the journal and the files write it: ISO 8601, UTC, whole seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def journal_path(recording: Path) -> Path:
    """``RECORDING/journal.sqlite``."""
    return Path(recording) / "journal.sqlite"


@contextmanager
def hold(recording: Path) -> Iterator[None]:
    """Hold a recording for writing; the lock goes with the process, however that ends.

    Raises
    ------
    BusyError
        When another recorder holds it.
    """
    import fcntl

    # Not the database itself: closing any handle of it would drop SQLite's own locks.
    with (recording / ".lock").open("a+", encoding="ascii") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise BusyError(
                f"{recording}: another recorder (process {holder}) is at work", hint="wait for it to end"
            ) from err
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


@contextmanager
def hold_arm(arm: Arm) -> Iterator[None]:
    """Hold a real arm for this process: two recorders of two recordings must not move it in turn.

    Raises
    ------
    BusyError
        When another process of this machine moves it.
    """
    import fcntl

    if arm.simulated:
        yield
        return
    info = arm.describe()
    name = hashlib.sha256(f"{info.model}|{info.serial}".encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"tofcapture-arm-{name}.lock"
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except PermissionError:  # another user's file in a sticky folder can be locked, but not created
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(handle):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            raise BusyError(
                f"the arm {info.model} {info.serial} is moved by another process", hint="tofcapture status"
            ) from err
        yield


class Journal:
    """Open journal of a recording; one transaction per call, on disk when the call returns.

    Parameters
    ----------
    recording
        The folder; must exist.
    """

    def __init__(self, recording: Path) -> None:
        path = journal_path(recording)
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(_SCHEMA)
            self._grow()
        except sqlite3.DatabaseError as err:
            if is_full(err):
                raise
            raise DataError(
                f"{path}: not a journal: {err}", hint="move it away: it is rebuilt from the view files"
            ) from err

    def _grow(self) -> None:
        """Add what journals of earlier versions lack."""
        if "step" not in {row[1] for row in self._db.execute("PRAGMA table_info(views)")}:
            self._db.execute("ALTER TABLE views ADD COLUMN step TEXT NOT NULL DEFAULT ''")

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def rows(self, scene: str | None = None) -> list[Row]:
        """All rows, or those of one scene, by scene and number."""
        where, values = ("WHERE scene = ?", (scene,)) if scene else ("", ())
        found = self._db.execute(
            f'SELECT scene, "index", pose, state, sha256, attempts, reason, step FROM views {where} ORDER BY scene, "index"',  # noqa: S608
            values,
        )
        return [Row(*row) for row in found]

    def agree(self, facts: Mapping[str, Any]) -> None:
        """Remember facts of the recording, or compare with the remembered ones.

        Parameters
        ----------
        facts
            Name -> JSON types: cameras, frames per burst ...

        Raises
        ------
        ConfigError
            When a fact differs from what the recording was begun with.
        """
        for key, value in facts.items():
            text = json.dumps(value, sort_keys=True)
            self._db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?)", (key, text))
            known = self._db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()[0]
            if known != text:
                raise ConfigError(
                    f"the recording was begun with another {key}: expected {_first_difference(json.loads(known), value)}",
                    hint="go on with the same station and options, or record into another folder",
                )

    def expect(self, scene: str, poses: Mapping[int, str]) -> set[int]:
        """Note planned views (index -> digest of the pose) and say which of them are there already.

        Raises
        ------
        ConfigError
            When a view of that number was recorded at another pose.
        """
        sealed = {row.index: row.pose for row in self.rows(scene) if row.state == "sealed"}
        for index in sorted(sealed.keys() & poses.keys()):
            if sealed[index] != poses[index]:
                raise ConfigError(
                    f"view {index} of {scene!r} was recorded at pose {sealed[index]}, the plan wants {poses[index]}",
                    hint="use the same --seed and --station as before, or record into another folder",
                )
        now = utc_now()
        self._db.execute("BEGIN")
        for index, pose in poses.items():
            self._db.execute(_PLAN, (scene, index, pose, now, now))
        self._db.execute("COMMIT")
        return sealed.keys() & poses.keys()

    def step(self, scene: str, index: int, step: str) -> None:
        """Note what is about to be done for a view."""
        self._set(scene, index, "step = ?", step)

    def attempt(self, scene: str, index: int) -> None:
        """Count one more attempt, before anything moves."""
        self._set(scene, index, "attempts = attempts + 1")

    def seal(self, scene: str, index: int, sha256: str) -> None:
        """Note that a view is on disk under its name."""
        self._set(scene, index, "state = 'sealed', reason = '', step = '', sha256 = ?", sha256)

    def fail(self, scene: str, index: int, reason: str) -> None:
        """Note that a view was given up."""
        self._set(scene, index, "state = 'failed', step = '', reason = ?", reason)

    def forget(self, scene: str, index: int, reason: str) -> None:
        """Plan a view again whose file is gone."""
        self._set(scene, index, "state = 'planned', sha256 = NULL, step = '', reason = ?", reason)

    def adopt(self, scene: str, index: int, pose: str, sha256: str) -> None:
        """Note a verified file that the journal did not know to be sealed."""
        now = utc_now()
        self._db.execute(_ADOPT, (scene, index, pose, sha256, now, now))

    def _set(self, scene: str, index: int, change: str, *values: object) -> None:
        self._db.execute(
            f'UPDATE views SET {change}, changed_utc = ? WHERE scene = ? AND "index" = ?',  # noqa: S608
            (*values, utc_now(), scene, index),
        )


def _first_difference(known: Any, now: Any, where: str = "") -> str:
    """Say where two JSON values first differ: ``.serial = 'A', got 'B'``."""
    if isinstance(known, dict) and isinstance(now, dict):
        for key in sorted({*known, *now}):
            if known.get(key) != now.get(key):
                return _first_difference(known.get(key), now.get(key), f"{where}.{key}")
    return f"{where.lstrip('.') or 'value'} = {known!r}, got {now!r}"
