"""What the daemon must not forget: its queue and what happened. SQLite; a call returns when all is on disk."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tofcapture.errors import BusyError, DataError
from tofcapture.record.journal import open_database, utc_now
from tofcapture.record.resources import full_disk_named

KEPT_EVENTS = 10_000
MOST_WAITING = 1_000

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
"""


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


_FIELDS = ", ".join(f.name for f in fields(Job))


@dataclass(frozen=True)
class Event:
    """Something that happened; ``id`` grows, also across restarts, and is 0 for what is not kept."""

    id: int
    utc: str
    kind: str
    data: Mapping[str, Any]

    def text(self) -> bytes:
        """Write one server-sent event."""
        head = f"id: {self.id}\n" if self.id else ""
        body = json.dumps({"utc": self.utc, **self.data}, allow_nan=False)
        return f"{head}event: {self.kind}\ndata: {body}\n\n".encode()


class Store:
    """The open database; one transaction per call.

    Raises
    ------
    DataError
        The file is no such database.
    DiskFull
        By every method that writes.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._db = open_database(path, _SCHEMA, "a daemon's queue", "move it away; recordings do not need it")

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def _do(self, sql: str, values: Sequence[object] = ()) -> sqlite3.Cursor:
        with full_disk_named(self._path):
            return self._db.execute(sql, values)

    def add(self, request: Mapping[str, Any]) -> tuple[Job, bool]:
        """Queue a job, or find the one that the same request made; the second value tells whether it is new.

        Raises :class:`BusyError`: the same request id asked for something else, or too many jobs wait.
        """
        name = request.get("request_id")
        if name is not None and (known := self._jobs("WHERE request_id = ?", name)):
            if any(getattr(known[0], key) != value for key, value in request.items()):
                raise BusyError(
                    f"request {name!r} has already asked for something else", hint="use a new request_id"
                )
            return known[0], False
        if (waiting := self.counts().get("queued", 0)) >= MOST_WAITING:
            raise BusyError(f"{waiting} jobs are waiting already", hint="let some of them finish")
        now = utc_now()
        values = [request.get(k) for k in ("request_id", "recording", "scene", "views", "frames", "seed")]
        made = self._do(
            "INSERT INTO jobs (request_id, recording, scene, views, frames, seed, state, utc, changed_utc)"
            " VALUES (?, ?, ?, ?, ?, ?, 'queued', ?, ?)",
            [*values, now, now],
        ).lastrowid
        return self.job(int(made or 0)), True

    def job(self, number: int) -> Job:
        """Find a job. Raises :class:`DataError`: there is none of that number."""
        if not (found := self._jobs("WHERE id = ?", number)):
            raise DataError(f"there is no job {number}")
        return found[0]

    def _jobs(self, where: str, *values: object) -> list[Job]:
        rows = self._do(f"SELECT {_FIELDS} FROM jobs {where}", values)  # noqa: S608
        return [Job(*row) for row in rows]

    def newest(self) -> list[Job]:
        """List the newest 100 jobs, newest first."""
        return self._jobs("ORDER BY id DESC LIMIT 100")

    def next(self) -> Job | None:
        """Find the job to work on: the running one, else the one that waits longest."""
        order = "WHERE state IN ('queued', 'running') ORDER BY state = 'queued', id LIMIT 1"
        return next(iter(self._jobs(order)), None)

    def counts(self) -> dict[str, int]:
        """Count the jobs in each state."""
        return dict(self._do("SELECT state, count(*) FROM jobs GROUP BY state").fetchall())

    def move(self, number: int, state: str, reason: str = "") -> Job:
        """Put a job into another state."""
        self._do(
            "UPDATE jobs SET state = ?, reason = ?, changed_utc = ? WHERE id = ?",
            [state, reason, utc_now(), number],
        )
        return self.job(number)

    def remember(self, kind: str, data: Mapping[str, Any]) -> Event:
        """Keep an event; the oldest go when there are too many."""
        now = utc_now()
        text = json.dumps(data, allow_nan=False)
        made = self._do("INSERT INTO events (utc, kind, data) VALUES (?, ?, ?)", [now, kind, text]).lastrowid
        number = int(made or 0)
        if number % 1000 == 0:
            self._do("DELETE FROM events WHERE id <= ?", [number - KEPT_EVENTS])
        return Event(number, now, kind, data)

    def events(self, after: int) -> Iterator[Event]:
        """List events of larger id, oldest first."""
        rows = self._do("SELECT id, utc, kind, data FROM events WHERE id > ? ORDER BY id", [after]).fetchall()
        return (Event(number, utc, kind, json.loads(data)) for number, utc, kind, data in rows)

    def last_event(self) -> int:
        """Find the id of the newest event, 0 when there is none."""
        return int(self._do("SELECT coalesce(max(id), 0) FROM events").fetchone()[0])
