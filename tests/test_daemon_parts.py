"""Parts of the daemon by themselves: pictures, queue, addresses, what systemd hears, what counts as a full disk."""

import errno
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests import PATIENCE
from tests.test_daemon_api import STATION
from tofcapture.cli import main
from tofcapture.colours import GREY
from tofcapture.errors import BusyError, ConfigError, DataError, UsageError
from tofcapture.record.daemon import settings, store, worker
from tofcapture.record.resources import is_full

cv2 = pytest.importorskip("cv2")


def test_pictures_show_near_far_and_nothing():
    """Near is dark, far is bright, nothing is grey; all nothing and all the same are no errors; large ones are thinned."""
    depth = np.linspace(0.5, 1.5, 100)[None].repeat(4, axis=0)
    depth[:, 50] = np.nan
    shown = _decoded(worker.picture("depth", depth))
    assert shown.shape == (4, 100, 3)
    assert shown[0, 1].sum() < shown[0, 40].sum() < shown[0, 98].sum()
    assert (shown[:, 50] == GREY).all()
    assert (_decoded(worker.picture("depth", np.full((3, 3), np.nan))) == GREY).all()
    assert _decoded(worker.picture("amplitude", np.ones((3, 3)))).shape == (3, 3, 3)
    assert max(_decoded(worker.picture("depth", np.ones((1024, 1280)))).shape) <= 320


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
    progress.begin(1)
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
    """``status`` and ``stop`` say that no daemon runs; the unit allows no motion."""
    assert main(["status", "--state", str(tmp_path)]) == 4
    assert main(["stop", "--state", str(tmp_path)]) == 4
    assert "start one" in capsys.readouterr().err
    assert main(["daemon", "--root", str(tmp_path), "--state", str(tmp_path / "s"), "--print-unit"]) == 0
    unit = capsys.readouterr().out
    assert "Type=notify" in unit
    assert "--allow-motion" not in unit
    assert "WatchdogSec=20" in unit
