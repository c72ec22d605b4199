"""Parts of the daemon by themselves: pictures, queue, addresses, what systemd hears, what counts as a full disk."""

import asyncio
import contextlib
import errno
import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests import PATIENCE
from tests.sealed import simulate
from tests.test_daemon_api import STATION
from tofcapture.cli import main
from tofcapture.colours import GREY
from tofcapture.errors import BusyError, ConfigError, DataError, UsageError
from tofcapture.files.disk import is_full
from tofcapture.record.daemon import settings, store, worker

cv2 = pytest.importorskip("cv2")


def test_pictures_show_near_far_and_nothing(tmp_path):
    """Near is dark, far is bright, nothing is grey; large ones are thinned; both depths have one scale, in metres."""
    view = simulate("box", 0)
    view.stereo.points[..., 2] = np.linspace(0.5, 1.5, view.stereo.points.shape[1])
    view.stereo.points[:, :20] = np.nan
    scales = worker.save(view, tmp_path)
    shown = _decoded((tmp_path / "stereo.png").read_bytes())
    assert max(shown.shape) <= 320
    assert (shown[:, 0] == GREY).all()
    row = shown[1].sum(axis=1)
    assert row[21] < row[30] < row[50]
    assert scales["depth"] == scales["stereo"] != scales["amplitude"]
    low, high = float(scales["depth"]["ticks"][0]), float(scales["depth"]["ticks"][-1])
    assert (scales["depth"]["unit"], len(scales["depth"]["colours"])) == ("m", 9)
    assert 0.3 < low < 0.8 < high < 1.5


def _decoded(png):
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def test_the_oldest_events_go(tmp_path, monkeypatch):
    """A daemon that runs for years keeps its newest events only, and numbers go on."""
    monkeypatch.setattr(store, "KEPT_EVENTS", 300)
    store.Store(tmp_path / "q").close()
    with sqlite3.connect(tmp_path / "q") as old:
        old.executemany("INSERT INTO events (utc, kind, data) VALUES ('', 'log', ?)", [("{}",)] * 999)
    old.close()
    queue = store.Store(tmp_path / "q")
    assert queue.remember("log", {}).id == queue.last_event() == 1000
    assert [event.id for event in queue.events(0)] == list(range(701, 1001))
    queue.close()


def _asked(queue, *scenes):
    return [queue.add({"recording": "r", "scene": s, "views": 2, "frames": 1})[0].id for s in scenes]


def _waiting(queue):
    return "".join(job.scene for job in queue.ahead())


def test_waiting_jobs_take_another_place(tmp_path):
    """Any place, any number of times; what comes later comes last, what is put back comes first; others do not move."""
    queue = store.Store(tmp_path / "q")
    a, b, _, d = _asked(queue, *"abcd")
    for number, place, order in ((d, 1, "dabc"), (d, 2, "adbc"), (a, 99, "dbca"), (b, 2, "dbca")):
        queue.reorder(number, place)
        assert _waiting(queue) == order
    _asked(queue, "e")
    assert _waiting(queue) == "dbcae"
    queue.move(d, "running")
    queue.reorder(a, 1)
    assert _waiting(queue) == "dabce"
    queue.move(d, "queued")
    assert queue.next().scene == "d"
    queue.move(d, "done")
    for number, error in ((d, BusyError), (99, DataError)):
        with pytest.raises(error):
            queue.reorder(number, 1)
    assert _waiting(queue) == "abce"
    assert [job.scene for job in queue.ended()] == ["d"]
    queue.close()


def test_the_longest_queue_can_be_reordered(tmp_path, monkeypatch):
    """As many jobs as may wait; all of them are listed."""
    queue = store.Store(tmp_path / "q")
    with contextlib.closing(sqlite3.connect(tmp_path / "q")) as other, other:
        other.executemany(
            "INSERT INTO jobs (recording, scene, views, frames, state, utc, changed_utc) VALUES ('r', ?, 1, 1, 'queued', '', '')",
            [(str(n),) for n in range(store.MOST_WAITING)],
        )
    queue.reorder(1000, 1)
    assert [job.id for job in queue.ahead()] == [1000, *range(1, 1000)]
    queue.close()


def test_a_queue_of_an_earlier_version_is_taken_over(tmp_path):
    """Its jobs are there, in their order."""
    old = sqlite3.connect(tmp_path / "q")
    old.executescript(store._SCHEMA.replace(" retake INTEGER, place INTEGER,", ""))
    old.execute(
        "INSERT INTO jobs (recording, scene, views, frames, state, utc, changed_utc) VALUES ('r', 's', 1, 1, 'queued', '', '')"
    )
    old.commit()
    old.close()
    queue = store.Store(tmp_path / "q")
    assert (queue.next().scene, queue.next().retake) == ("s", None)
    queue.close()


def test_the_log_is_of_the_last_hours(tmp_path):
    """Oldest first, without single steps and without what is older, the newest when there are too many."""
    queue = store.Store(tmp_path / "q")
    with contextlib.closing(sqlite3.connect(tmp_path / "q")) as other, other:
        other.executemany(
            "INSERT INTO events (utc, kind, data) VALUES (?, ?, '{}')",
            [("2026-01-01T00:00:00+00:00", "log"), ("2026-01-02T00:00:00+00:00", "step")]
            + [("2026-01-02T00:00:00+00:00", "log")] * 501,
        )
    assert [event.id for event in queue.log("2026-01-01T12:00:00+00:00")] == list(range(4, 504))
    queue.close()


def test_a_stream_too_many_is_refused(tmp_path, monkeypatch):
    """Who asks for events of a daemon that has as many listeners as it bears, or that ends, is told to come back."""
    pytest.importorskip("aiohttp")
    queue = store.Store(tmp_path / "q")
    for most, close in ((0, False), (1, True)):
        monkeypatch.setattr(store, "MOST_STREAMS", most)
        streams = store.Streams(queue)
        if close:
            streams.close()
        answer = asyncio.run(streams.serve(None))
        assert (answer.status, len(streams)) == (503, 0)
        assert f"at most {most} event streams" in answer.text
    queue.close()


def test_queue_outlives_its_process(tmp_path):
    """Jobs, events and numbers of events go on where they were; a request id counts once."""
    request = {"request_id": "a", "recording": "r", "scene": "s", "views": 2, "frames": 1}
    queue = store.Store(tmp_path / "q")
    job, new = queue.add(request)
    assert new
    assert queue.add(request) == (job, False)
    queue.move(job.id, "running")
    first = queue.remember("log", {"text": "x"})
    queue.close()
    queue = store.Store(tmp_path / "q")
    assert queue.next() == replace(job, state="running", changed_utc=queue.next().changed_utc)
    assert queue.remember("log", {}).id == first.id + 1
    assert [event.id for event in queue.events(first.id)] == [first.id + 1]
    with pytest.raises(BusyError):
        queue.add({**request, "views": 3})
    with pytest.raises(DataError):
        queue.job(99)
    queue.close()
    (tmp_path / "bad").write_bytes(b"no database" * 100)
    with pytest.raises(DataError):
        store.Store(tmp_path / "bad")


@pytest.mark.parametrize(
    "text", ["0.0.0.0:80", "192.168.0.2:80", "example.org:80", "127.0.0.1", "127.0.0.1:99999", ":80"]
)
def test_only_loopback(text):
    """The daemon listens to no network."""
    pytest.importorskip("aiohttp")
    from tofcapture.record.daemon.server import tcp_address

    with pytest.raises(UsageError):
        tcp_address(text)
    assert tcp_address("[::1]:80") == ("::1", 80)


def test_folder_is_refused_or_made_private(tmp_path):
    """An open folder is closed, a path too long for a socket is refused, a short token is none."""
    loose = tmp_path / "loose"
    loose.mkdir(mode=0o777)
    folder = settings.open_folder(loose)
    assert loose.stat().st_mode & 0o777 == 0o700
    assert settings.token_of(folder) == settings.token_of(folder)
    folder.token.write_text("x" * 32)
    assert settings.token_of(folder) == "x" * 32
    folder.token.write_text("x" * 31)
    with pytest.raises(ConfigError, match="token"):
        settings.token_of(folder)
    with pytest.raises(ConfigError, match="socket"):
        settings.open_folder(tmp_path / ("x" * 120))


def test_the_pace_is_that_of_the_recorder_at_work(monkeypatch):
    """After a crash the time left counts from the new recorder's plan, with the views that it has sealed."""
    from tofcapture.record.daemon.supervisor import Progress

    now, progress = [0.0], Progress()
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    plan = {"kind": "planned", "views": [{"index": i, "state": "planned"} for i in range(6)]}
    sealed = {"kind": "sealed", "quality": {}, "sha256": "x"}
    progress.begin(1, ("r", "mug"))
    for seconds, message in (
        *(
            (0, plan),
            (10, {**sealed, "index": 0}),
            (20, {**sealed, "index": 1}),
            (100, {"kind": "opened", "simulated": True}),
        ),
        *((200, {**plan, "views": plan["views"][2:]}), (230, {**sealed, "index": 2})),
    ):
        now[0] = seconds
        progress.hear(message)
    assert progress.counts() == {"sealed": 1, "failed": 0, "total": 4, "eta_s": 90.0}


def test_full_disks_are_told_apart():
    """Full in the words of the system, of SQLite and of HDF5; other errors are none of it."""
    assert is_full(OSError(errno.ENOSPC, "x"))
    assert is_full(sqlite3.OperationalError("database or disk is full"))
    assert is_full(
        RuntimeError("Can't decrement id ref count (errno = 28, error message = 'No space left on device')")
    )
    assert not is_full(OSError(errno.EIO, "x"))
    assert not is_full(ValueError("no space left"))


def test_systemd_hears_of_it(tmp_path):
    """READY, signs of life and STOPPING reach systemd's socket; SIGTERM ends the daemon with 0."""
    pytest.importorskip("aiohttp")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(str(tmp_path / "n"))
        link.settimeout(PATIENCE)
        env = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "n"), "WATCHDOG_USEC": "400000"}
        command = [sys.executable, STATION, "daemon", tmp_path / "root", tmp_path / "st"]
        process = subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL)
        heard = []
        while sum("WATCHDOG=1" in line for line in heard) < 3:
            heard.append(link.recv(500).decode())
        process.send_signal(signal.SIGTERM)
        while not any("STOPPING=1" in line for line in heard):
            heard.append(link.recv(500).decode())
        assert process.wait(PATIENCE) == 0
    assert any("READY=1" in line for line in heard)
    assert any("STATUS=idle" in line for line in heard)


@pytest.mark.parametrize(
    ("limit", "other", "period"),
    [("20000000", 0, 10.0), ("20000000", 1, None), ("", 0, None), ("0", 0, None), ("soon", 0, None)],
)
def test_signs_of_life_come_twice_as_often_as_systemd_wants(monkeypatch, limit, other, period):
    """Half the limit; none where systemd asks for none, or asks another process."""
    from tofcapture.record.daemon.server import watchdog_period

    monkeypatch.setenv("WATCHDOG_USEC", limit)
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid() + other))
    assert watchdog_period() == period


@pytest.mark.parametrize("flags", [(), ("--allow-motion",)])
def test_motion_is_allowed_by_a_person_only(tmp_path, monkeypatch, flags):
    """``tofcapture daemon`` lets a real arm move when it is told to, and not otherwise."""
    pytest.importorskip("aiohttp")
    served = []
    monkeypatch.setattr("tofcapture.record.daemon.server.serve", lambda settings, *_: served.append(settings))
    assert main(["daemon", "--root", str(tmp_path / "r"), "--state", str(tmp_path / "s"), *flags]) == 0
    assert served[0].allow_motion == bool(flags)


def test_cli_without_a_daemon(tmp_path, capsys):
    """``status`` says that no daemon runs; the unit allows no motion."""
    assert main(["status", "--state", str(tmp_path)]) == 4
    assert "start one" in capsys.readouterr().err
    assert main(["daemon", "--root", str(tmp_path), "--state", str(tmp_path / "s"), "--print-unit"]) == 0
    unit = capsys.readouterr().out
    assert "Type=notify" in unit
    assert "--allow-motion" not in unit
    assert "WatchdogSec=20" in unit


def test_a_damaged_queue_is_named(tmp_path, capsys):
    """The daemon does not start on a damaged queue: it names the file and what to do, exit code 5."""
    pytest.importorskip("aiohttp")
    state = settings.open_folder(tmp_path / "s")
    store.Store(state.database).close()
    data = bytearray(state.database.read_bytes())
    data[4096:4700] = bytes(604)
    state.database.write_bytes(data)
    assert main(["daemon", "--root", str(tmp_path / "r"), "--state", str(tmp_path / "s")]) == 5
    assert re.search(r"queue\.sqlite.*\n.*move it away", capsys.readouterr().err)


def test_the_token_reaches_no_log(tmp_path, capsys, monkeypatch):
    """The page's address carries the token on a terminal only."""
    from tofcapture.cli.daemon import _announce

    _announce(tmp_path / "sock", "http://127.0.0.1:1/#token=secret")
    assert "secret" not in capsys.readouterr().err
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    _announce(tmp_path / "sock", "http://127.0.0.1:1/#token=secret")
    assert "secret" in capsys.readouterr().err


def test_a_folder_that_goes_while_the_recorder_starts_is_noticed(tmp_path):
    """Between the daemon's look and the recorder's first file lie seconds of loading: it looks again, and writes nothing."""
    root = tmp_path / "root"
    root.mkdir()
    job = {
        "scene": "mug", "recording": str(root / "r"), "views": 1, "frames": 2, "retake": None, "seed": None,
        "station": None, "allow_motion": False, "previews": str(tmp_path), "folders": {str(root): root.stat().st_ino},
    }  # fmt: skip
    root.rename(tmp_path / "away")
    root.mkdir()
    run = subprocess.run(
        [sys.executable, "-m", "tofcapture.record.daemon.worker"],
        input=json.dumps(job) + "\n", capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    last = json.loads(run.stdout.splitlines()[-1])
    assert (last["kind"], last["cause"], last["own"]) == ("error", "FolderGone", False), run.stderr
    assert list(root.iterdir()) == []
