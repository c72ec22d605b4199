"""Define what the daemon must not forget: its queue and what happened. SQLite; a call returns when all is on disk.

Events go to every client from where it left off; a slow one is dropped, never waited for.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from aiohttp import web

from tofcapture.errors import BusyError, DataError, TofError
from tofcapture.files.disk import Database
from tofcapture.record.daemon.guard import HEADERS, refusal
from tofcapture.record.journal import utc_now

KEPT_EVENTS = 10_000
MOST_WAITING = 1_000
STATES = ("queued", "running", "done", "failed", "stopped")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")  # of a scene or a recording

_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (
    id INTEGER PRIMARY KEY AUTOINCREMENT, request_id TEXT UNIQUE, recording TEXT NOT NULL, scene TEXT NOT NULL,
    views INTEGER NOT NULL, frames INTEGER NOT NULL, seed INTEGER, retake INTEGER, place INTEGER,
    state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'done', 'failed', 'stopped')),
    reason TEXT NOT NULL DEFAULT '', utc TEXT NOT NULL, changed_utc TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY AUTOINCREMENT, utc TEXT NOT NULL, kind TEXT NOT NULL, data TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS folders (name TEXT PRIMARY KEY, inode TEXT NOT NULL);
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
    retake: int | None  # the only view to take, again
    state: str
    reason: str
    utc: str
    changed_utc: str


_FIELDS = ", ".join(f.name for f in fields(Job))
WISH = ("request_id", "recording", "scene", "views", "frames", "seed", "retake")  # what is asked for
_AHEAD = "state IN ('queued', 'running')"
_LOG_LINES = 500


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
    """The open database; one transaction per call, which never waits: the daemon has other things to do.

    Raises as :class:`tofcapture.files.disk.Database` does.
    """

    def __init__(self, path: Path) -> None:
        hint = "move it away; recordings do not need it"
        self._db = Database(path, _SCHEMA, "a daemon's queue", hint, patience=0.0)
        there = {row[1] for row in self._db.do("PRAGMA table_info(jobs)")}
        for column in {"retake", "place"} - there:  # a queue of an earlier version
            self._db.do(f"ALTER TABLE jobs ADD COLUMN {column} INTEGER")

    def close(self) -> None:
        """Close the database."""
        self._db.close()

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
        values = [request.get(key) for key in WISH]
        made = self._db.insert(
            f"INSERT INTO jobs (request_id, {', '.join(WISH[1:])}, state, utc, changed_utc)"  # noqa: S608
            " VALUES (?, ?, ?, ?, ?, ?, ?, 'queued', ?, ?)",
            [*values, now, now],
        )
        return self.job(made), True

    def job(self, number: int) -> Job:
        """Find a job. Raises :class:`DataError`: there is none of that number."""
        if not (found := self._jobs("WHERE id = ?", number)):
            raise DataError(f"there is no job {number}")
        return found[0]

    def _jobs(self, where: str, *values: object) -> list[Job]:
        jobs = [Job(*row) for row in self._db.do(f"SELECT {_FIELDS} FROM jobs {where}", values)]  # noqa: S608
        if wrong := next((job for job in jobs if not _possible(job)), None):
            raise self._db.damaged(f"it says {wrong}")
        return jobs

    def folders(self) -> dict[str, int]:
        """Find the inodes of the folders that are held, by name: "" is the root, the others are recordings."""
        rows = self._db.do("SELECT name, inode FROM folders")
        return {str(name): int(inode) for name, inode in rows if str(inode).isdecimal()}

    def hold_folders(self, folders: Mapping[str, int | None]) -> None:
        """Remember folders by their inodes, or forget those of ``None``."""
        for name, inode in folders.items():
            if inode is None:
                self._db.do("DELETE FROM folders WHERE name = ?", (name,))
            else:  # as text: an inode may need all 64 bits
                self._db.do("INSERT OR REPLACE INTO folders VALUES (?, ?)", (name, str(inode)))

    def ended(self) -> list[Job]:
        """List the 100 jobs that ended last, the last one first."""
        return self._jobs(f"WHERE NOT {_AHEAD} ORDER BY changed_utc DESC, id DESC LIMIT 100")

    def ahead(self) -> list[Job]:
        """List the running job, then all that wait, in the order in which they will run."""
        return self._jobs(f"WHERE {_AHEAD} ORDER BY state = 'queued', coalesce(place, id), id")

    def next(self) -> Job | None:
        """Find the job to work on: the running one, else the first that waits."""
        return next(iter(self.ahead()), None)

    def reorder(self, number: int, place: int) -> None:
        """Give a waiting job another place among those that wait, 1 the next to run.

        Raises :class:`DataError`: there is no such job; :class:`BusyError`: it does not wait any more.
        """
        ahead = [job.id for job in self.ahead() if job.state == "queued" or job.id == number]
        if (job := self.job(number)).state != "queued":
            raise BusyError(f"job {number} does not wait: it is {job.state}", hint="look at the queue again")
        ahead.remove(number)
        ahead.insert(place - 1, number)
        # One statement, so that a crash leaves the old order or the new one. Numbers of later jobs are larger than any place; a
        # running job that is put back has place 0, ahead of all.
        cases = " ".join(f"WHEN {n} THEN {place}" for place, n in enumerate(ahead, start=1))
        self._db.do(f"UPDATE jobs SET place = CASE id {cases} ELSE 0 END WHERE {_AHEAD}")  # noqa: S608

    def counts(self) -> dict[str, int]:
        """Count the jobs in each state."""
        return dict(self._db.do("SELECT state, count(*) FROM jobs GROUP BY state"))

    def move(self, number: int, state: str, reason: str = "") -> Job:
        """Put a job into another state."""
        self._db.do(
            "UPDATE jobs SET state = ?, reason = ?, changed_utc = ? WHERE id = ?",
            [state, reason, utc_now(), number],
        )
        return self.job(number)

    def remember(self, kind: str, data: Mapping[str, Any]) -> Event:
        """Keep an event; the oldest go when there are too many."""
        now = utc_now()
        text = json.dumps(data, allow_nan=False)
        number = self._db.insert("INSERT INTO events (utc, kind, data) VALUES (?, ?, ?)", [now, kind, text])
        if number % 1000 == 0:
            self._db.do("DELETE FROM events WHERE id <= ?", [number - KEPT_EVENTS])
        return Event(number, now, kind, data)

    def events(self, after: int) -> Iterator[Event]:
        """List events of larger id, oldest first; a garbled one is left out."""
        rows = self._db.do("SELECT id, utc, kind, data FROM events WHERE id > ? ORDER BY id", [after])
        return _readable(rows)

    def log(self, since: str) -> list[Event]:
        """List what happened since a UTC string but single steps, oldest first, the newest 500 at most."""
        rows = self._db.do(
            "SELECT id, utc, kind, data FROM events WHERE utc >= ? AND kind != 'step' ORDER BY id DESC LIMIT ?",
            [since, _LOG_LINES],
        )
        return list(_readable(rows[::-1]))

    def last_event(self) -> int:
        """Find the id of the newest event, 0 when there is none."""
        return int(self._db.do("SELECT coalesce(max(id), 0) FROM events")[0][0])


def _readable(rows: list[Any]) -> Iterator[Event]:
    for number, utc, kind, data in rows:
        with contextlib.suppress(ValueError, TypeError):
            yield Event(int(number), str(utc), str(kind), dict(json.loads(data)))


def _possible(job: Job) -> bool:
    """Whether a job is one that was queued: what a flipped bit makes of it must not reach a path or a device."""
    numbers = all(type(n) is int and n > 0 for n in (job.id, job.views, job.frames))
    names = all(isinstance(n, str) and _NAME.fullmatch(n) for n in (job.recording, job.scene))
    texts = all(isinstance(text, str) for text in (job.reason, job.utc, job.changed_utc))
    seed, request = type(job.seed) is int or job.seed is None, isinstance(job.request_id, str | None)
    return numbers and names and texts and seed and request and job.state in STATES


MOST_STREAMS = 512
_BACKLOG = 256  # events that a client may be behind
_QUIET = 15.0  # s without an event until a comment shows that the line stands
_WRITE = 20.0  # s that a client may take to read

_Queue = asyncio.Queue[tuple[int, bytes] | None]  # (id, text) of events; None ends the stream


class Streams:
    """All open event streams."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._queues: set[_Queue] = set()
        self._closed = False

    def __len__(self) -> int:
        return len(self._queues)

    def publish(self, event: Event) -> None:
        """Hand an event to every client; encoded once."""
        item = (event.id, event.text())
        for queue in self._queues:
            if queue.qsize() < _BACKLOG:
                queue.put_nowait(item)
            else:
                _end(queue)

    def close(self) -> None:
        """End all streams; clients come back when there is a daemon again."""
        self._closed = True
        for queue in self._queues:
            _end(queue)

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Stream to one client until it leaves."""
        if self._closed or len(self._queues) >= MOST_STREAMS:
            return refusal(503, "streams", f"expected at most {MOST_STREAMS} event streams")
        after = _after(request)
        response = web.StreamResponse(headers={**HEADERS, "Content-Type": "text/event-stream"})
        queue: _Queue = asyncio.Queue()
        self._queues.add(queue)
        try:
            await response.prepare(request)
            await self._feed(response, queue, after)
        except (ConnectionError, TimeoutError, TofError):
            pass
        finally:
            self._queues.discard(queue)
        return response

    async def _feed(self, response: web.StreamResponse, queue: _Queue, after: int | None) -> None:
        last = self._store.last_event() if after is None else after
        await _write(response, b"retry: 1000\n: hello\n\n")
        for event in self._store.events(last) if after is not None else ():
            await _write(response, event.text())
            last = event.id
        while True:
            try:
                async with asyncio.timeout(_QUIET):
                    item = await queue.get()
            except TimeoutError:
                item = (0, b": alive\n\n")
            if item is None:
                return
            number, text = item
            if number == 0 or number > last:
                await _write(response, text)


def _end(queue: _Queue) -> None:
    while not queue.empty():
        queue.get_nowait()
    queue.put_nowait(None)


async def _write(response: web.StreamResponse, text: bytes) -> None:
    async with asyncio.timeout(_WRITE):
        await response.write(text)


def _after(request: web.Request) -> int | None:
    """Read where a client left off; ``None`` when it wants only what is new."""
    given = request.query.get("after", request.headers.get("Last-Event-ID"))
    if given is None:
        return None
    if not (given.isascii() and given.isdigit() and len(given) <= 16):
        raise web.HTTPBadRequest(reason="after: expected the number of an event")
    return int(given)
