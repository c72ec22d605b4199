"""What the daemon must not forget: its queue, whether it is paused, and what happened. SQLite, WAL, FULL."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tofcapture.errors import BusyError, DataError
from tofcapture.record.journal import utc_now

KEPT_EVENTS = 10_000
MOST_WAITING = 1_000
OPEN = ("queued", "running")

_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (
    id INTEGER PRIMARY KEY AUTOINCREMENT, request_id TEXT UNIQUE, recording TEXT NOT NULL, scene TEXT NOT NULL,
    views INTEGER NOT NULL, frames INTEGER NOT NULL, seed INTEGER,
    state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'done', 'failed', 'stopped')),
    reason TEXT NOT NULL DEFAULT '', utc TEXT NOT NULL, changed_utc TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY AUTOINCREMENT, utc TEXT NOT NULL, kind TEXT NOT NULL, data TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
"""
_FIELDS = "id, request_id, recording, scene, views, frames, seed, state, reason, utc, changed_utc"


@dataclass(frozen=True)
class Job:
    """One scene to record, as it was asked for, and how far it got."""

    id: int
    request_id: str | None
    recording: str
    scene: str
    views: int
    frames: int
    seed: int | None
    state: str
    reason: str
    utc: str
    changed_utc: str

    def table(self) -> dict[str, Any]:
        """JSON types."""
        return asdict(self)

    def asks_for(self, wish: Mapping[str, Any]) -> bool:
        """Tell whether this is what a request wants."""
        return all(getattr(self, key) == value for key, value in wish.items())


@dataclass(frozen=True)
class Event:
    """Something that happened; ``id`` grows, also across restarts, and is 0 for what is not kept."""

    id: int
    utc: str
    kind: str
    data: Mapping[str, Any]

    def text(self) -> bytes:
        """One server-sent event."""
        head = f"id: {self.id}\n" if self.id else ""
        body = json.dumps({"utc": self.utc, **self.data}, allow_nan=False)
        return f"{head}event: {self.kind}\ndata: {body}\n\n".encode()


class Store:
    """The open database; one transaction per call, on disk when the call returns.

    Raises
    ------
    DataError
        The file is no such database.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(_SCHEMA)
        except sqlite3.DatabaseError as err:
            raise DataError(
                f"{path}: not a daemon's queue: {err}", hint="move it away; recordings do not need it"
            ) from err

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def add(self, wish: Mapping[str, Any]) -> tuple[Job, bool]:
        """Queue a job, or find the one that the same request made; the second value tells which.

        Raises
        ------
        BusyError
            The same request id asked for something else, or too many jobs wait.
        """
        request = wish.get("request_id")
        if request is not None and (known := self._find("request_id = ?", request)):
            if not known.asks_for(wish):
                raise BusyError(
                    f"request {request!r} has already asked for something else", hint="use a new request_id"
                )
            return known, False
        waiting = self._db.execute("SELECT count(*) FROM jobs WHERE state = 'queued'").fetchone()[0]
        if waiting >= MOST_WAITING:
            raise BusyError(f"{waiting} jobs are waiting already", hint="let some of them finish")
        now = utc_now()
        values = [wish.get(k) for k in ("request_id", "recording", "scene", "views", "frames", "seed")]
        made = self._db.execute(
            "INSERT INTO jobs (request_id, recording, scene, views, frames, seed, state, utc, changed_utc)"
            " VALUES (?, ?, ?, ?, ?, ?, 'queued', ?, ?)",
            [*values, now, now],
        ).lastrowid
        return self.job(int(made or 0)), True

    def job(self, number: int) -> Job:
        """One job.

        Raises
        ------
        DataError
            There is none of that number.
        """
        found = self._find("id = ?", number)
        if not found:
            raise DataError(f"there is no job {number}")
        return found

    def _find(self, where: str, value: object) -> Job | None:
        row = self._db.execute(f"SELECT {_FIELDS} FROM jobs WHERE {where}", [value]).fetchone()  # noqa: S608
        return Job(*row) if row else None

    def jobs(self, limit: int = 100) -> list[Job]:
        """The newest jobs, newest first."""
        rows = self._db.execute(f"SELECT {_FIELDS} FROM jobs ORDER BY id DESC LIMIT ?", [limit])  # noqa: S608
        return [Job(*row) for row in rows]

    def counts(self) -> dict[str, int]:
        """How many jobs are in each state."""
        return dict(self._db.execute("SELECT state, count(*) FROM jobs GROUP BY state"))

    def next(self) -> Job | None:
        """The job to work on: the oldest that is not over."""
        marks = ", ".join("?" * len(OPEN))
        row = self._db.execute(
            f"SELECT {_FIELDS} FROM jobs WHERE state IN ({marks}) ORDER BY state = 'queued', id LIMIT 1",  # noqa: S608
            OPEN,
        ).fetchone()
        return Job(*row) if row else None

    def move(self, number: int, state: str, reason: str = "") -> Job:
        """Put a job into another state."""
        self._db.execute(
            "UPDATE jobs SET state = ?, reason = ?, changed_utc = ? WHERE id = ?",
            [state, reason, utc_now(), number],
        )
        return self.job(number)

    def remember(self, kind: str, data: Mapping[str, Any]) -> Event:
        """Keep an event; the oldest go when there are too many."""
        now = utc_now()
        made = self._db.execute(
            "INSERT INTO events (utc, kind, data) VALUES (?, ?, ?)",
            [now, kind, json.dumps(data, allow_nan=False)],
        ).lastrowid
        number = int(made or 0)
        if number % 1000 == 0:
            self._db.execute("DELETE FROM events WHERE id <= ?", [number - KEPT_EVENTS])
        return Event(number, now, kind, data)

    def events(self, after: int, limit: int = KEPT_EVENTS) -> Iterator[Event]:
        """Events of larger id, oldest first."""
        rows = self._db.execute(
            "SELECT id, utc, kind, data FROM events WHERE id > ? ORDER BY id LIMIT ?", [after, limit]
        ).fetchall()
        return (Event(number, utc, kind, json.loads(data)) for number, utc, kind, data in rows)

    def last_event(self) -> int:
        """Id of the newest event, 0 when there is none."""
        return int(self._db.execute("SELECT coalesce(max(id), 0) FROM events").fetchone()[0])

    def get(self, key: str) -> Any:
        """A remembered value, ``None`` when there is none."""
        row = self._db.execute("SELECT value FROM meta WHERE key = ?", [key]).fetchone()
        return json.loads(row[0]) if row else None

    def put(self, key: str, value: Any) -> None:
        """Remember a value of JSON types."""
        self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", [key, json.dumps(value)])
