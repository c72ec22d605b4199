"""The daemon's heart: takes jobs from the queue, runs a recorder for each, and decides what its end means."""

from __future__ import annotations

import asyncio
import sqlite3
import sys
from collections.abc import Callable, Mapping
from typing import Any

from tofcapture.files.view import check_scene_name
from tofcapture.record.daemon.child import Child, start
from tofcapture.record.daemon.progress import Progress
from tofcapture.record.daemon.settings import Settings
from tofcapture.record.daemon.snapshot import health, snapshot
from tofcapture.record.daemon.store import Event, Job, Store
from tofcapture.record.journal import utc_now
from tofcapture.record.watch import is_full

GRACE = 3.0  # s from the order to stop until a recorder is killed
_LOST = 20.0  # s without a sign of life until it is killed
_HEALTH = 2.0  # s between health events
_BACKOFF = (0.2, 1.0, 3.0)  # s before a crashed recorder of a simulated arm is started again

_KEPT = {"planned", "step", "sealed", "failed", "ask", "answered", "paused", "resumed", "log", "opened"}


class Supervisor:
    """Works on the queue until closed.

    Parameters
    ----------
    settings
        See there.
    store
        Queue and events; what was running when the last daemon died waits, paused, for a person.
    publish
        Called with every event.
    """

    def __init__(self, settings: Settings, store: Store, publish: Callable[[Event], None]) -> None:
        self.settings, self.store, self._publish = settings, store, publish
        self.progress = Progress()
        self.previews = self.restarts = self.sealed = self.failed = 0
        self.started = utc_now()
        self._child: Child | None = None
        self._wake = asyncio.Event()
        self._busy = self._stopping = self._closing = False
        self.reason = ""
        self._recover()

    def _recover(self) -> None:
        if (job := self.store.next()) is None:
            return
        if job.state == "running":
            self.store.move(job.id, "queued")
        self.reason = "the daemon was started with work waiting: look at the station, then resume"

    # What people ask for -------------------------------------------------------------------------------------------

    def add(self, wish: Mapping[str, Any]) -> tuple[Job, bool]:
        """Queue a job; see :meth:`Store.add`."""
        check_scene_name(wish["scene"])
        job, new = self.store.add(wish)
        if new:
            self._say("queued", job=job.table())
            self._wake.set()
        return job, new

    def pause(self, reason: str = "paused by the operator") -> None:
        """Rest at the next safe point; no further job is begun."""
        self.reason = self.reason or reason
        if self._child:
            self._child.order("pause")
        self._tell_state()

    def resume(self) -> None:
        """Go on."""
        self.reason = ""
        if self._child and not self._stopping:
            self._child.order("resume")
        self._wake.set()
        self._tell_state()

    def stop(self) -> None:
        """Stop the arm now, give the job in hand up, and rest. Always possible."""
        self._stopping = self._busy
        if self._child:
            self._child.order("stop")
            asyncio.get_running_loop().call_later(GRACE, self._child.kill)
        self.reason = "stopped by the operator"
        self._tell_state()

    def cancel(self, number: int) -> Job:
        """Take a waiting job out of the queue; the one in hand is stopped."""
        job = self.store.job(number)
        if job.state == "running":
            self.stop()
        elif job.state == "queued":
            job = self.store.move(number, "stopped", "cancelled")
            self._say("cancelled", job=job.table())
        return job

    def confirm(self) -> None:
        """The scene is placed."""
        if self._child:
            self._child.order("confirm")

    # What it works on ----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Work until closed."""
        async with asyncio.TaskGroup() as tasks:
            health = tasks.create_task(self._tell_health())
            while not self._closing:
                job = None if self.reason else self.store.next()
                if job is None:
                    self._wake.clear()
                    await self._wake.wait()
                else:
                    await self._try(job)
            health.cancel()

    async def close(self) -> None:
        """Stop the arm, let the view in hand be sealed or rolled back, and end; the job stays in the queue."""
        self._closing = True
        self._wake.set()
        if self._child:
            self._child.order("stop")
            await self._child.end(GRACE)

    async def _try(self, job: Job) -> None:
        """Work on a job; a disk too full to note its end leaves it as it is, for when there is room."""
        try:
            await self._do(job)
        except sqlite3.OperationalError as err:
            if not is_full(err):
                raise
            self.reason = f"{self.settings.state.root}: the disk takes no more: free some space, then resume"
            self._rest()

    def _rest(self) -> None:
        """No job is in hand."""
        self._busy = self._stopping = False
        self.progress.end()

    async def _do(self, job: Job) -> None:
        """Run recorders on a job until its end is decided."""
        self.store.move(job.id, "running")
        self._busy = True
        self.progress.begin(job.id)
        self._tell_state()
        crashes = 0
        while True:
            before = self.progress.sealed_now
            last = await self._record(job)
            crashes = crashes + 1 if self.progress.sealed_now == before else 1
            if last or self._stopping or self._closing or not self._may_restart(crashes):
                break
            self.restarts += 1
            self._say("log", text=f"the recorder died; started again ({crashes})")
            await asyncio.sleep(_BACKOFF[crashes - 1])
        self._decide(job, last)
        self._rest()
        self._tell_state()

    def _may_restart(self, crashes: int) -> bool:
        """A real arm never moves again by itself after a crash."""
        return self.progress.simulated is not False and crashes <= len(_BACKOFF) and not self.reason

    async def _record(self, job: Job) -> dict[str, Any]:
        """Run one recorder; return its last words, empty when it died."""
        settings = self.settings
        wish = {
            **job.table(),
            "recording": str(settings.root / job.recording),
            "station": str(settings.station) if settings.station else None,
            "allow_motion": settings.allow_motion,
            "previews": str(settings.state.previews),
        }
        child = self._child = await start(wish, settings.worker)
        if self.reason:
            child.order("pause")
        if self._stopping or self._closing:
            child.order("stop")
        last: dict[str, Any] = {}
        async for message in child.lines():
            if message["kind"] in {"done", "stopped", "error"}:
                last = message
            else:
                self._hear(message)
        await child.end(GRACE)
        self._child = None
        return last

    def _hear(self, message: dict[str, Any]) -> None:
        self.progress.hear(message)
        kind = message.pop("kind")
        if kind == "sealed":
            self.previews += 1
            self.sealed += 1
            message["preview"] = self.previews
        self.failed += kind == "failed"
        if kind in _KEPT:
            self._say(kind, job=self.progress.job, progress=self.progress.counts(), **message)

    def _decide(self, job: Job, last: Mapping[str, Any]) -> None:
        """Put the job where it belongs after its recorder ended."""
        kind = last.get("kind", "died")
        if kind == "done":
            state = "failed" if last["failed"] else "done"
            self.store.move(job.id, state, "; ".join(last["reasons"]))
        elif self._closing:
            self.store.move(job.id, "queued")
        elif self._stopping:
            self.store.move(job.id, "stopped", "stopped by the operator")
        elif kind == "error" and not last["lifted"]:
            self.store.move(job.id, "failed", last["message"])
        else:
            reason = " - ".join(filter(None, [last.get("message"), last.get("hint")]))
            self.store.move(job.id, "queued")
            self.reason = self.reason or reason or "the recorder died: look at the station, then resume"

    # What it tells -------------------------------------------------------------------------------------------------

    @property
    def phase(self) -> str:
        """One word for what is going on."""
        if self._closing or self._stopping:
            return "stopping"
        if not self._busy:
            return "paused" if self.reason else "idle"
        if self.progress.resting:
            return "paused"
        return "pausing" if self.reason else "recording"

    @property
    def silence(self) -> float | None:
        """Seconds since the recorder's last sign of life; ``None`` when there is no recorder."""
        return self._child.silence if self._child else None

    def _tell_state(self) -> None:
        self._say("state", state=snapshot(self))

    def _say(self, kind: str, **data: object) -> None:
        """Keep and publish an event; a full disk is no reason to fall silent."""
        try:
            event = self.store.remember(kind, data)
        except sqlite3.OperationalError as err:
            if not is_full(err):
                raise
            event = Event(0, utc_now(), kind, data)
        self._publish(event)

    async def _tell_health(self) -> None:
        while True:
            if self._child and self._child.silence > _LOST:
                print(
                    "tofcapture: the recorder has been silent too long: killed", file=sys.stderr, flush=True
                )
                self._child.kill()
            self._publish(Event(0, utc_now(), "health", health(self)))
            await asyncio.sleep(_HEALTH)
