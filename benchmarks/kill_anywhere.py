"""Kills daemon, recorder and driver hosts at random moments, and fills the disk, until a number of recordings is whole.

    python benchmarks/kill_anywhere.py --kills 200 --full 20
    python benchmarks/kill_anywhere.py --hours 12

With ``--hours`` it is a night of that length in compressed time: a view stands for twelve seconds, jobs of 25 views wait in the
queue, and each is met by two faults of any kind (:data:`FAULTS`). A person resumes when the cause is gone.

After every blow: no job has failed; each view that was ever sealed is still there, byte for byte, the same file (nothing is sealed twice). After
every recording: each HDF5 dataset of each view equals that of a recording that was never disturbed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from daemon_station import FAULTS, SMALL_STATION

from tofcapture.errors import DeviceError, TofError
from tofcapture.files.check import check
from tofcapture.files.seal import sha256_of, stored_digest
from tofcapture.record.daemon.client import ask

STATION = Path(__file__).with_name("daemon_station.py")
STEPS = ("moving", "tof", "stereo", "sealing")
SECONDS = 12.0  # that a view of a night stands for
STRIKES = 2  # on each job of a night
_REFUSALS = ("ENOSPC", "EDQUOT", "EROFS", "EIO", "EACCES")


class Rig:
    """A daemon that is started again whenever it is dead, and what it has sealed so far."""

    def __init__(self, folder: Path, station: str, scene: str, views: int) -> None:
        self.folder, self.station, self.scene, self.views = folder, station, scene, views
        self.root, self.state = folder / "root", folder / "st"
        self.full, self.fault, self.queue_full = folder / "full", folder / "fault", folder / "queue-full"
        self.process: subprocess.Popen[str] | None = None
        self.sealed: dict[Path, tuple[int, int, str]] = {}
        self.starts = 0

    def up(self) -> None:
        """Start the daemon if it is dead."""
        if self.process is not None and self.process.poll() is None:
            return
        command = [sys.executable, STATION, "daemon", self.root, self.state, "--station", self.station]
        env = {
            **os.environ,
            "BENCH_FULL": str(self.full),
            "BENCH_FAULT": str(self.fault),
            "BENCH_STATE": str(self.queue_full),
            "BENCH_LOST": "6" if self.station == "arrays" else "20",
            "BENCH_SCOPE": f"kill-anywhere-{os.getpid()}",  # nobody else's stop is meant for this
            "BENCH_DELAY": "0.02",
            "BENCH_HOST": "1",
            "OMP_NUM_THREADS": "1",
        }
        self.starts += 1
        with (self.folder / "log").open("a") as log:
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=env)
        assert self.process.stdout is not None
        self.process.stdout.readline()

    def down(self) -> None:
        """End the daemon politely."""
        if self.process is not None:
            self.process.terminate()
            self.process.wait(60)

    def ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> dict[str, Any] | None:
        """Ask; ``None`` when the daemon is dying."""
        with contextlib.suppress(DeviceError):
            return ask(method, path, body, self.state)
        return None

    def drive(self, recording: str) -> str:
        """Make sure that work on a recording goes on; say how its newest job stands."""
        self.up()
        state = self.ask("GET", "/v1/state")
        if state is None:
            return "?"
        jobs = (self.ask("GET", "/v1/jobs") or {"jobs": []})["jobs"]
        mine = [job for job in jobs if job["recording"] == recording]
        wrong = [job for job in jobs if job["state"] in {"failed", "stopped"}]
        assert not wrong, f"failed by another's fault: {wrong}"
        if not mine:
            wish = {"scene": self.scene, "recording": recording, "views": self.views, "frames": 2}
            self.ask("POST", "/v1/jobs", wish)
        elif state["phase"] == "paused":
            self.ask("POST", "/v1/resume")
        return mine[0]["state"] if mine else "?"

    def targets(self) -> dict[str, list[int]]:
        """Process ids by kind: the daemon, its recorder, and whatever the recorder started."""
        assert self.process is not None
        recorder = _children(self.process.pid)
        return {
            "daemon": [self.process.pid],
            "recorder": recorder,
            "host": [pid for parent in recorder for pid in _children(parent)],
        }

    def look(self) -> None:
        """Fail unless everything that was sealed is untouched."""
        for path in sorted(self.root.glob("*/views/*/view-*.h5")):
            if path not in self.sealed and (told := stored_digest(path)):
                stat = path.stat()
                self.sealed[path] = (stat.st_ino, stat.st_mtime_ns, told)
        for path, (inode, changed, told) in self.sealed.items():
            stat = path.stat()
            assert (stat.st_ino, stat.st_mtime_ns) == (inode, changed), f"{path} was sealed twice"
            assert sha256_of(path) == told, f"{path} is damaged"


def _children(pid: int) -> list[int]:
    with contextlib.suppress(OSError):
        return [int(x) for x in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def _moment(rig: Rig, rng: random.Random) -> None:
    """Wait for a moment to strike: a step of a view, or just some time."""
    if rng.random() < 0.3:
        time.sleep(rng.uniform(0, 2.0))
        return
    step, end = rng.choice(STEPS), time.monotonic() + 15
    while time.monotonic() < end:
        state = rig.ask("GET", "/v1/state")
        if state is None or state["phase"] == "paused" or not state["queue"].get("running"):
            return
        if (state["doing"] or {}).get("step") == step:
            break
        time.sleep(0.004)
    time.sleep(rng.uniform(0, 0.03))


def strike(rig: Rig, rng: random.Random, tally: dict[str, int]) -> None:
    """Kill one process."""
    _moment(rig, rng)
    targets = {kind: pids for kind, pids in rig.targets().items() if pids}
    kind = rng.choice(sorted(targets))
    with contextlib.suppress(ProcessLookupError):
        os.kill(rng.choice(targets[kind]), signal.SIGKILL)
        tally[kind] = tally.get(kind, 0) + 1
    if kind == "daemon" and rig.process is not None:
        rig.process.wait()


def fill(rig: Rig, rng: random.Random, recording: str, tally: dict[str, int]) -> None:
    """Fill the disk from a random write on, see the queue rest for it, make room."""
    number = rng.randint(1, 120)
    rig.full.write_text(str(number), encoding="ascii")
    end = time.monotonic() + 60
    try:
        while time.monotonic() < end:
            rig.up()
            state = rig.ask("GET", "/v1/state")
            if state and state["phase"] == "paused" and "disk" in state["reason"]:
                tally["disk full"] = tally.get("disk full", 0) + 1
                return
            if rig.drive(recording) == "done":
                return
            time.sleep(0.05)
    finally:
        rig.look()
        rig.full.unlink()


def wait_for(rig: Rig, recording: str, words: str = "") -> bool:
    """Wait until the queue rests, for a reason with these words; false when the recording was done before."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        rig.up()
        state = rig.ask("GET", "/v1/state")
        if state and state["phase"] == "paused" and words in state["reason"]:
            return True
        if state and state["phase"] == "idle":
            return False
        if not state or state["phase"] == "paused":
            rig.drive(recording)
        time.sleep(0.02)
    raise AssertionError(f"the queue does not rest: {rig.ask('GET', '/v1/state')}")


def refuse_writes(rig: Rig, rng: random.Random, recording: str) -> str:
    """Have the disk refuse from a random write on."""
    name = rng.choice(_REFUSALS)
    rig.full.write_text(f"{rng.randint(1, 200)} {name}", encoding="ascii")
    try:
        wait_for(rig, recording)
    finally:
        rig.look()
        rig.full.unlink()
    return f"disk {name}"


def take_away(rig: Rig, rng: random.Random, recording: str) -> str:
    """Move the root or the recording away, as unmounting does, with an empty folder in its place; and back."""
    _moment(rig, rng)
    path = rig.root if rng.random() < 0.5 else rig.root / recording
    if not path.is_dir():
        return "nothing"
    away, empty = path.with_name("away"), rng.random() < 0.7
    path.rename(away)
    if empty:
        path.mkdir()
    wait_for(rig, recording)
    assert not path.exists() or not list(path.rglob("*.h5")), "it recorded into another folder"
    if path.exists():
        shutil.rmtree(path)
    away.rename(path)
    rig.look()
    return f"{'root' if path == rig.root else 'recording'} taken away"


def break_devices(rig: Rig, rng: random.Random, recording: str) -> str:
    """Have the devices fail until the queue rests."""
    _moment(rig, rng)
    fault = rng.choice(FAULTS)
    rig.fault.write_text(fault, encoding="ascii")
    try:
        wait_for(rig, recording)
    finally:
        rig.fault.unlink()
    return f"devices: {fault}"


def hang(rig: Rig, rng: random.Random, recording: str) -> str:
    """Halt the recorder, which is found and replaced."""
    _moment(rig, rng)
    for pid in rig.targets()["recorder"]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
    end = time.monotonic() + 30
    while time.monotonic() < end and any(_stopped(pid) for pid in rig.targets()["recorder"]):
        rig.drive(recording)
        time.sleep(0.05)
    return "recorder halted"


def _stopped(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    return False


def hold_database(rig: Rig, rng: random.Random, recording: str) -> str:
    """Hold the journal or the queue for some seconds; the daemon answers all the same."""
    _moment(rig, rng)
    journal = rig.root / recording / "journal.sqlite"
    path = journal if journal.exists() and rng.random() < 0.5 else rig.state / "queue.sqlite"
    with contextlib.closing(sqlite3.connect(path, isolation_level=None, timeout=30)) as db:
        db.execute("BEGIN IMMEDIATE")
        end = time.monotonic() + rng.choice([0.5, 1.5, 7.0])
        while time.monotonic() < end:
            begin = time.monotonic()
            answered = rig.ask("GET", "/v1/state")
            assert not answered or time.monotonic() - begin < 2.0, "the daemon waits for a database"
            time.sleep(0.05)
        db.execute("ROLLBACK")
    return f"{path.name} held"


def fill_state(rig: Rig, rng: random.Random, recording: str) -> str:
    """Have the daemon's own disk refuse for some seconds."""
    rig.queue_full.write_text(f"1 {rng.choice(_REFUSALS)}", encoding="ascii")
    try:
        end = time.monotonic() + rng.uniform(0.2, 2.0)
        while time.monotonic() < end:
            rig.up()
            rig.ask("GET", "/v1/state")
            time.sleep(0.05)
    finally:
        rig.queue_full.unlink()
    del recording
    return "daemon's disk"


def kill(rig: Rig, rng: random.Random, recording: str) -> str:
    """Kill one process."""
    tally: dict[str, int] = {}
    strike(rig, rng, tally)
    del recording
    return next((f"{kind} killed" for kind in tally), "nothing")


def night(rig: Rig, args: argparse.Namespace) -> dict[str, Any]:
    """Record for some hours of compressed time, with faults of all kinds; return what happened."""
    rng, tally, begin = random.Random(args.seed), dict[str, int](), time.monotonic()
    finish(rig, "calm")
    reference = datasets(rig.root / "calm")
    jobs = max(round(args.hours * 3600 / SECONDS / rig.views), 1)
    for number in range(jobs):
        recording = f"r{number}"
        rig.drive(recording)
        if number + 1 < jobs:
            rig.drive(f"r{number + 1}")  # waits behind it, and would be burnt by what is not its fault
        for _ in range(STRIKES):
            dealt = rng.choice(BLOWS)(rig, rng, recording)
            tally[dealt] = tally.get(dealt, 0) + 1
            rig.look()
        finish(rig, recording)
        whole(rig, recording, reference)
        print(f"{number + 1} of {jobs} jobs: {tally}", file=sys.stderr, flush=True)
    hours = round(jobs * rig.views * SECONDS / 3600, 2)
    return {
        "ok": True, "hours": hours, "jobs": jobs, "sealed": len(rig.sealed), "faults": tally,
        "daemon_starts": rig.starts, "seconds": round(time.monotonic() - begin),
    }  # fmt: skip


BLOWS = (kill, kill, refuse_writes, take_away, break_devices, hang, hold_database, fill_state)


def datasets(recording: Path) -> dict[str, dict[str, Any]]:
    """Every dataset of every view, and the attributes that do not tell the time of day."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(recording.glob("views/*/view-*.h5")):
        arrays: dict[str, Any] = {}
        with h5py.File(path) as file:
            file.visititems(
                lambda name, node, into=arrays: (
                    into.update({name: node[()]}) if isinstance(node, h5py.Dataset) else None
                )
            )
            arrays.update({f"@{k}": v for k, v in file.attrs.items() if k != "provenance"})
        found[f"{path.parent.name}/{path.name}"] = arrays
    return found


def same(a: dict[str, dict[str, Any]], b: dict[str, dict[str, Any]]) -> bool:
    """Bit by bit."""
    return a.keys() == b.keys() and all(
        a[v].keys() == b[v].keys()
        and all(np.asarray(a[v][k]).tobytes() == np.asarray(b[v][k]).tobytes() for k in a[v])
        for v in a
    )


def finish(rig: Rig, recording: str, seconds: float = 180.0) -> None:
    """Let a recording be finished in peace."""
    end = time.monotonic() + seconds
    while rig.drive(recording) != "done":
        assert time.monotonic() < end, f"{recording} is not finished: {rig.ask('GET', '/v1/jobs')}"
        time.sleep(0.1)
    rig.look()


def whole(rig: Rig, recording: str, reference: dict[str, dict[str, Any]]) -> None:
    """Fail unless a finished recording is what it would be undisturbed, in the journal too, and in order for ``check``."""
    path = rig.root / recording
    assert same(datasets(path), reference), f"{recording} differs from the undisturbed one"
    with contextlib.closing(sqlite3.connect(path / "journal.sqlite")) as db:
        rows = db.execute("SELECT state, step FROM views").fetchall()
    assert rows == [("sealed", "")] * rig.views, rows
    assert list(check(path)) == []


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--full", type=int, default=20)
    parser.add_argument("--views", type=int, help="of each recording (default: 12, 25 in a night)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hours", type=float, help="of a night with faults of all kinds, instead of kills")
    parser.add_argument(
        "--per-recording", type=int, default=10, help="blows until a recording is left in peace"
    )
    parser.add_argument(
        "--station", choices=["small", "arrays"], default="small", help="small: simulated, small cameras"
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="kill-") as name:
        folder = Path(name)
        toml = folder / "small.toml"
        toml.write_text(SMALL_STATION, encoding="utf-8")
        # Only the station of arrays has faults of devices on demand.
        station = str(toml) if args.station == "small" and not args.hours else "arrays"
        rig = Rig(folder, station, "mug", args.views or (25 if args.hours else 12))
        try:
            print(json.dumps((night if args.hours else torment)(rig, args)))
        except (AssertionError, TofError):
            print((folder / "log").read_text()[-4000:], file=sys.stderr)
            raise
        finally:
            rig.down()


def torment(rig: Rig, args: argparse.Namespace) -> dict[str, Any]:
    """Strike until all blows are dealt; return the tally."""
    rng, tally, begin = random.Random(args.seed), {}, time.monotonic()
    finish(rig, "calm")
    reference = datasets(rig.root / "calm")
    number = dealt = 0
    filled = args.full / max(args.kills + args.full, 1)
    while sum(tally.values()) < args.kills + args.full:
        recording = f"r{number}"
        state = rig.drive(recording)
        if state == "done" or dealt >= args.per_recording:
            finish(rig, recording)
            whole(rig, recording, reference)
            number, dealt = number + 1, 0
            print(f"{sum(tally.values())} blows, {number} recordings: {tally}", file=sys.stderr, flush=True)
            continue
        dealt += 1
        left = args.full - tally.get("disk full", 0)
        kills_left = args.kills + args.full - sum(tally.values()) - left
        if left and (rng.random() < filled or not kills_left):
            fill(rig, rng, recording, tally)
        elif kills_left:
            strike(rig, rng, tally)
        rig.look()
    finish(rig, f"r{number}")
    whole(rig, f"r{number}", reference)
    return {
        "ok": True,
        "blows": tally,
        "recordings": number + 1,
        "sealed": len(rig.sealed),
        "daemon_starts": rig.starts,
        "seconds": round(time.monotonic() - begin),
    }


if __name__ == "__main__":
    main()
