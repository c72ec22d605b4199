"""The daemon's heart: takes jobs from the queue, runs a recorder for each, and decides what its end means."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import sys
import time
import traceback
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

from tofcapture import __version__
from tofcapture.errors import BusyError, TofError, UsageError
from tofcapture.files.view import check_scene_name
from tofcapture.record.daemon.settings import Settings
from tofcapture.record.daemon.store import WISH, Event, Job, Store
from tofcapture.record.journal import utc_now
from tofcapture.record.resources import inode_of

GRACE = 3.0  # s from the order to stop until a recorder is killed
_SILENT = 3.0  # s without a sign of life until health says so
_HEALTH = 2.0  # s between health events
_BACKOFF = (0.2, 1.0, 3.0)  # s before a crashed recorder of a simulated arm is started again
_LOCKED = 0.2  # s until a database that another process holds is tried again
_LINE = 4 * 1024 * 1024  # bytes; a plan of thousands of views fits
_STOPPED = "stopped by the operator"
_ENDS = {"done", "stopped", "error"}  # kinds of a recorder's last message


class RecorderProcess:
    """A started recorder: orders in, messages out, and how long it has been silent."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self._heard = time.monotonic()

    @classmethod
    async def start(cls, job: Mapping[str, Any], settings: Settings) -> Self:
        """Start a recorder on a job, in a session of its own: Ctrl-C at a terminal reaches the daemon alone."""
        pipe = asyncio.subprocess.PIPE
        # Numerical libraries that spin on every core would take them from the daemon.
        env = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}
        process = await asyncio.create_subprocess_exec(
            *settings.worker, stdin=pipe, stdout=pipe, start_new_session=True, limit=_LINE, env=env
        )
        started = cls(process)
        started.send(job)
        return started

    @property
    def silence(self) -> float:
        """Seconds since the last message."""
        return time.monotonic() - self._heard

    def send(self, message: Mapping[str, Any]) -> None:
        """Send the job, or an order; one that has ended already hears nothing, which is right."""
        pipe = self._process.stdin
        if pipe is not None and not pipe.is_closing():
            with contextlib.suppress(OSError):
                pipe.write(json.dumps(message).encode() + b"\n")

    async def messages(self) -> AsyncIterator[dict[str, Any]]:
        """Hear what it tells, until it ends; signs of life are counted, not passed on."""
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self._heard = time.monotonic()
            try:
                message = json.loads(line)
            except ValueError:
                continue  # the last line of a killed process
            if message["kind"] != "alive":
                yield message

    def kill(self) -> None:
        """End it now; driver hosts notice that their parent is gone and stop what they drive."""
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    async def end(self) -> None:
        """Wait until it has ended; it is killed when it takes too long."""
        try:
            async with asyncio.timeout(GRACE):
                await self._process.wait()
        except TimeoutError:
            self.kill()
            await self._process.wait()


class Progress:
    """Tell how far the job in hand is, put together from what its recorder tells."""

    def __init__(self) -> None:
        self.job: int | None = None
        self._scene = ("", "")
        self.views: dict[int, dict[str, Any]] = {}
        self.doing: dict[str, Any] | None = None
        self.asks: str | None = None
        self.simulated: bool | None = None  # None until the station was open
        self.scales: dict[str, Any] = {}  # of the latest pictures
        self.resting = False
        self.sealed_now = 0
        self._since, self._sealed_then = 0.0, 0  # when the recorder at work began, and what was sealed before

    def begin(self, job: int, scene: tuple[str, str]) -> None:
        """Forget the job before; of the same (recording, scene) the table stays until the new plan comes."""
        if scene != self._scene:
            self.views, self._scene = {}, scene
        self.end()
        self.job, self.sealed_now = job, 0

    def end(self) -> None:
        """Do nothing any more."""
        self.doing, self.asks, self.resting = None, None, False

    def hear(self, message: Mapping[str, Any]) -> None:
        """Take in one message of the recorder."""
        kind = message["kind"]
        if kind == "opened":
            self.simulated = bool(message["simulated"])
        elif kind == "planned":
            # What was measured of a view before the recorder was started anew still holds.
            self.views = {
                v["index"]: {**self.views.get(v["index"], {}), "reason": "", **v} for v in message["views"]
            }
            self._since, self._sealed_then = time.monotonic(), self.sealed_now
        elif kind == "step" and message["step"] != "failed":
            self.doing = {"index": message["index"], "step": message["step"]}
        elif kind in {"sealed", "failed"}:
            told = {key: message[key] for key in ("quality", "sha256", "reason") if key in message}
            view = self.views.setdefault(message["index"], {"index": message["index"]})
            view.update(told, state=kind)
            self.sealed_now += kind == "sealed"
            self.scales = message.get("scales") or self.scales
            self.doing = None
        elif kind in {"ask", "answered"}:
            self.asks = str(message["scene"]) if kind == "ask" else None
        elif kind in {"paused", "resumed"}:
            self.resting, self.doing = kind == "paused", None

    def counts(self) -> dict[str, Any]:
        """Count views sealed, failed and planned; tell the seconds left at the present pace."""
        states = Counter(view["state"] for view in self.views.values())
        left = states.total() - states["sealed"] - states["failed"]
        fresh = self.sealed_now - self._sealed_then
        pace = (time.monotonic() - self._since) / fresh if fresh else None
        return {
            "sealed": states["sealed"],
            "failed": states["failed"],
            "total": states.total(),
            "eta_s": round(pace * left, 1) if pace is not None and not self.resting else None,
        }

    def table(self) -> dict[str, Any]:
        """List all views as JSON types."""
        return {"job": self.job, "views": [self.views[i] for i in sorted(self.views)]}


def _made(folder: Path) -> int | None:
    """Make a recording's folder where it can be, else the recorder will say why not; its inode."""
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
    return inode_of(folder)


class Supervisor:
    """Works on the queue until closed; what was running when the last daemon died waits, paused, for a person."""

    def __init__(self, settings: Settings, store: Store, publish: Callable[[Event], None]) -> None:
        self.settings, self.store, self._publish = settings, store, publish
        self.progress = Progress()
        self.counters: Counter[str] = Counter()  # sealed, failed, restarts
        self._started = utc_now()
        self._recorder: RecorderProcess | None = None
        self._wake = asyncio.Event()
        self._busy = self._stopping = self._closing = False
        self._held: dict[str, int] = (
            store.folders()
        )  # inodes of the root and of the recordings that were begun
        if "" not in self._held:
            self._hold({"": inode_of(settings.root)})
        self._gone = self._look_again = (
            False  # the queue rests for a folder that went; a person has looked since
        )
        self._stored: dict[str, Any] = {"job": None, "queue": {}, "last_event": 0}
        self.reason, self.fault = "", ""  # why it rests; the kind of error, where one is why
        if settings.station is None:
            self.progress.simulated = True
        if (job := store.next()) is not None:
            if job.state == "running":
                store.move(job.id, "queued")
            self.reason = "the daemon was started with work waiting: look at the station, then resume"

    @property
    def real(self) -> bool:
        """A real arm may move, so that a person must have looked first."""
        return self.settings.allow_motion and not self.progress.simulated

    def _check_clear(self, clear: bool) -> None:
        """Raise :class:`UsageError`: a real arm may move, and nobody says that its reach is clear."""
        if self.real and not clear:
            raise UsageError(
                "a real arm may move: expected clear: true",
                hint="see that everybody is out of the arm's reach, then say so; tofcapture record says it by --allow-motion",
            )

    def add(self, request: Mapping[str, Any]) -> tuple[Job, bool]:
        """Queue a job; see :meth:`Store.add`."""
        self._check_clear(request["clear"])
        check_scene_name(request["scene"])
        if not (self.settings.root / request["recording"]).is_dir():
            self._hold({request["recording"]: None})  # whoever asks anew may begin anew
        job, new = self.store.add({key: request[key] for key in WISH if key in request})
        if new:
            self._say("queued", job=asdict(job))
            self._wake.set()
        return job, new

    def retry(self, number: int, clear: bool) -> Job:
        """Queue what an ended job asked for once more. Raises :class:`BusyError`: it has not ended."""
        job = self.store.job(number)
        if job.state in {"queued", "running"}:
            raise BusyError(f"job {number} has not ended: it is {job.state}")
        wish = {key: value for key, value in asdict(job).items() if key in WISH and key != "request_id"}
        return self.add({**wish, "clear": clear})[0]

    def reorder(self, number: int, place: int) -> Job:
        """Give a waiting job another place; see :meth:`Store.reorder`."""
        self.store.reorder(number, place)
        job = self.store.job(number)
        self._say("moved", job=asdict(job), place=place)
        return job

    def pause(self) -> None:
        """Rest at the next safe point; no further job is begun."""
        self.reason = self.reason or "paused by the operator"
        self._order("pause")
        self._tell_state()

    def resume(self, clear: bool) -> None:
        """Go on."""
        self._check_clear(clear)
        self.reason, self.fault = "", ""
        self._look_again, self._gone = self._gone, False
        if not self._stopping:
            self._order("resume")
        self._wake.set()
        self._tell_state()

    def stop(self) -> None:
        """Stop the arm now, give the job in hand up, and rest. Always possible."""
        self._stopping = self._busy
        self._order("stop")
        if self._recorder:
            asyncio.get_running_loop().call_later(GRACE, self._recorder.kill)
        self.reason, self.fault = _STOPPED, ""
        self._tell_state()

    def cancel(self, number: int) -> Job:
        """Take a waiting job out of the queue; the one in hand is stopped."""
        job = self.store.job(number)
        if job.state == "running":
            self.stop()
        elif job.state == "queued":
            job = self.store.move(number, "stopped", "removed by the operator")
            self._say("cancelled", job=asdict(job))
        return job

    def confirm(self, clear: bool) -> None:
        """Pass on that the scene is placed."""
        self._check_clear(clear)
        self._order("confirm")

    def _order(self, verb: str) -> None:
        if self._recorder:
            self._recorder.send({"do": verb})

    async def run(self) -> None:
        """Work until closed."""
        async with asyncio.TaskGroup() as tasks:
            health = tasks.create_task(self._watch_health())
            while not self._closing:
                try:
                    job = None if self.reason else self.store.next()
                    if job is None:
                        self._wake.clear()
                        await self._wake.wait()
                    else:
                        await self._work_on(job)
                except BusyError:
                    await asyncio.sleep(_LOCKED)
                except Exception as err:
                    self._give_in(err)
            health.cancel()

    def _give_in(self, err: Exception) -> None:
        """Rest because of an error that every job would meet; the job's end may not be noted, it stays as it is."""
        if not isinstance(err, TofError):
            traceback.print_exception(err)
        said = err.message if isinstance(err, TofError) else f"{type(err).__name__}: {err}"
        self.reason, self.fault = (
            ": ".join(filter(None, [said, getattr(err, "hint", "")])),
            type(err).__name__,
        )
        self._rest()
        self._say("log", text=self.reason)

    async def _folder_trouble(self, job: Job) -> str:
        """Say why a job must not be begun: the root, or its recording, is not the folder that it was, also before a restart."""
        root, again, self._look_again = self.settings.root, self._look_again, False
        held = {name: self._held[name] for name in ("", job.recording) if name in self._held}
        now = await asyncio.to_thread(lambda: {name: inode_of(root / name) for name in held})
        if again and None not in now.values():
            self._hold(now)  # a person was told, has looked, and both are there
        elif changed := [name for name in held if now[name] != held[name]]:
            self._gone = True
            what = "is not there any more" if now[changed[0]] is None else "is not the folder that it was"
            hint = "put it back or mount it, then resume; or cancel the job and ask anew"
            return f"{root / changed[0]} {what}: moved, deleted or unmounted: {hint}"
        return ""

    def _hold(self, folders: Mapping[str, int | None]) -> None:
        """Remember folders by their inodes, "" the root, for the next daemon too; None forgets."""
        self._held = {
            name: inode for name, inode in (self._held | dict(folders)).items() if inode is not None
        }
        with contextlib.suppress(
            TofError
        ):  # another process holds the database: this daemon knows all the same
            self.store.hold_folders(folders)

    async def _note(self, number: int, state: str, reason: str = "") -> None:
        """Put a job into another state, however long another process holds the database."""
        await self._patiently(lambda: self.store.move(number, state, reason))

    async def _patiently(self, store: Callable[[], object]) -> None:
        while True:
            try:
                store()
            except BusyError:
                if self._closing:
                    return  # it is left as running, which the next daemon puts back
                await asyncio.sleep(_LOCKED)
            else:
                return

    async def close(self) -> None:
        """Stop the arm, let the view in hand be sealed or rolled back, and end; the job stays in the queue."""
        self._closing = True
        self._wake.set()
        if self._recorder:
            self._order("stop")
            await self._recorder.end()

    def _rest(self) -> None:
        """Have no job in hand."""
        self._busy = self._stopping = False
        self.progress.end()

    async def _work_on(self, job: Job) -> None:
        """Run recorders on a job until its end is decided."""
        await self._note(job.id, "running")
        self._busy = True
        self.progress.begin(job.id, (job.recording, job.scene))
        self._tell_state()
        crashes = 0
        while True:
            before = self.progress.sealed_now
            last = await self._record(job)
            if not last and job.retake is not None and self.progress.sealed_now:
                last = {"kind": "done", "failed": [], "reasons": []}
            crashes = crashes + 1 if self.progress.sealed_now == before else 1
            # A real arm never moves again by itself after a crash.
            restarts = self.progress.simulated is not False and crashes <= len(_BACKOFF) and not self.reason
            if last or self._stopping or self._closing or not restarts:
                break
            self.counters["restarts"] += 1
            self._say("log", text=f"the recorder died; started again ({crashes})")
            await asyncio.sleep(_BACKOFF[crashes - 1])
        await self._decide(job, last)
        self._rest()
        self._tell_state()

    async def _record(self, job: Job) -> dict[str, Any]:
        """Run one recorder; return its last message, empty when it died."""
        if trouble := await self._folder_trouble(job):
            return {"kind": "error", "own": False, "message": trouble, "cause": "FolderGone"}
        settings = self.settings
        if job.recording not in self._held:  # made and known before the recorder may die in it
            inode = await asyncio.to_thread(_made, settings.root / job.recording)
            self._held |= {} if inode is None else {job.recording: inode}
        known = {name: self._held[name] for name in ("", job.recording) if name in self._held}
        await self._patiently(lambda: self.store.hold_folders(known))
        told = {
            **asdict(job),
            "recording": str(settings.root / job.recording),
            "station": str(settings.station) if settings.station else None,
            "allow_motion": settings.allow_motion,
            "previews": str(settings.state.previews),
            # a folder may go while the recorder starts: it looks again, right before it writes
            "folders": {str(settings.root / name): inode for name, inode in known.items()},
        }
        self._recorder = await RecorderProcess.start(told, settings)
        if self.reason:
            self._order("pause")
        if self._stopping or self._closing:
            self._order("stop")
        last: dict[str, Any] = {}
        try:
            async for message in self._recorder.messages():
                if message["kind"] in _ENDS:
                    last = message
                else:
                    self._hear(message)
        finally:
            if not last:
                self._recorder.kill()
            await self._recorder.end()
            self._recorder = None
        return last

    def _hear(self, message: dict[str, Any]) -> None:
        self.progress.hear(message)
        kind = message.pop("kind")
        self.counters[kind] += 1
        if kind == "sealed":
            message["preview"] = self.counters["sealed"]
        self._say(kind, job=self.progress.job, progress=self.progress.counts(), **message)

    async def _decide(self, job: Job, last: Mapping[str, Any]) -> None:
        """Put the job where it belongs after its recorder ended: ``failed`` is only for what is its own fault."""
        kind = last.get("kind", "died")
        if kind == "done":
            state = "failed" if last["failed"] else "done"
            await self._note(job.id, state, "; ".join(last["reasons"]))
        elif self._closing:
            await self._note(job.id, "queued")
        elif self._stopping or kind == "stopped":
            await self._note(job.id, "stopped", _STOPPED)
            self.reason = self.reason or _STOPPED
        elif kind == "error" and last["own"]:
            await self._note(job.id, "failed", last["message"])
        else:
            reason = " - ".join(filter(None, [last.get("message"), last.get("hint")]))
            await self._note(job.id, "queued")
            # Also when it was to rest anyway: a person must know.
            self.reason = reason or "the recorder died: look at the station, then resume"
            self.fault = last.get("cause", "Died")

    @property
    def phase(self) -> str:
        """One word for what is going on."""
        if self._closing or self._stopping:
            return "stopping"
        if not self._busy:
            return "paused" if self.reason else "idle"
        if self.progress.resting:
            return "paused"
        if self.reason:
            return "pausing"
        return "waiting" if self.progress.asks else "recording"

    def snapshot(self) -> dict[str, Any]:
        """Tell everything but the table of views, as JSON types."""
        progress = self.progress
        # Another process holds the database, or it is damaged: nobody waits for it, least of all a stop.
        with contextlib.suppress(TofError):
            self._stored = {
                "job": asdict(self.store.job(progress.job)) if progress.job is not None else None,
                "queue": self.store.counts(),
                "last_event": self.store.last_event(),
            }
        return {
            **self._stored,
            "version": __version__,
            "pid": os.getpid(),
            "started_utc": self._started,
            "phase": self.phase,
            "reason": self.reason,
            "fault": self.fault,
            "real": self.real,
            "allow_motion": self.settings.allow_motion,
            "simulated": progress.simulated,
            "root": str(self.settings.root),
            "station": str(self.settings.station or "simulated"),
            "progress": progress.counts(),
            "doing": progress.doing,
            "asks": progress.asks,
            "preview": self.counters["sealed"],
            "scales": progress.scales,
            "health": self._health(),
        }

    def _health(self) -> dict[str, Any]:
        """Recorder and disk."""
        silence = self._recorder.silence if self._recorder else None
        free = None
        with contextlib.suppress(OSError):
            free = shutil.disk_usage(self.settings.root).free
        return {
            "recorder": "none" if silence is None else "alive" if silence < _SILENT else "silent",
            "silence_s": round(silence, 1) if silence is not None else None,
            "disk_free_bytes": free,
            "restarts": self.counters["restarts"],
        }

    async def _watch_health(self) -> None:
        """Tell now and then how things are, and kill a recorder that hangs."""
        while True:
            if self._recorder and self._recorder.silence > self.settings.silence_limit:
                words = "tofcapture: the recorder has been silent too long: killed"
                print(words, file=sys.stderr, flush=True)
                self._recorder.kill()
            self._publish(Event(0, utc_now(), "health", self._health()))
            await asyncio.sleep(_HEALTH)

    def _tell_state(self) -> None:
        self._say("state", state=self.snapshot())

    def _say(self, kind: str, **data: object) -> None:
        """Keep and publish an event; a disk that does not take it is no reason to fall silent."""
        try:
            event = self.store.remember(kind, data)
        except TofError:
            event = Event(0, utc_now(), kind, data)
        self._publish(event)
