"""``tofcapture stop``: everything of this user that records is stopped, whatever else is broken; what is not is said."""

import http.client
import json
import os
import resource
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager

import pytest

from tests import PATIENCE, alive, until
from tests.test_daemon_api import STATION, running
from tofcapture.cli import main
from tofcapture.record import stopping
from tofcapture.record.observer import Stopped

pytest.importorskip("aiohttp")


@pytest.fixture
def scope(monkeypatch, tmp_path):
    """A name of its own: a test must not stop what else records on this machine, nor see the arms that others hold."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    name = f"test-{os.getpid()}-{time.monotonic_ns()}"
    monkeypatch.setattr(stopping, "PREFIX", name)
    return name


@contextmanager
def child(scope, code, **more):
    """A Python process of this scope that prints a line when it is ready, ended by its id."""
    text = f"from tofcapture.record import stopping\nstopping.PREFIX = {scope!r}\n{code}"
    process = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True, **more)
    try:
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE)
        process.stdout.close()


def _stop(capsys, state):
    """Run the command: exit code, what it said."""
    code = main(["stop", "--state", str(state)])
    said = capsys.readouterr()
    return code, said.out + said.err


def _channels(count):
    return until(lambda: [c for c in stopping._channels() if not c.foreign()][count - 1 :])


def test_a_recorder_without_a_daemon_is_stopped(tmp_path, scope, capsys, monkeypatch):
    """It ends by itself with the code of an interruption; what is sealed stays, and the same command goes on."""
    command = ["record", "--scene", "mug", "--out", str(tmp_path / "r"), "--views", "5", "--foreground"]
    code = (
        f"import sys; sys.path.insert(0, {str(STATION.parent)!r})\n"
        "import daemon_station; from tofcapture.cli import main; from tofcapture.devices import station\n"
        "station.open_station = daemon_station._open_arrays; daemon_station._few_candidates()\n"
        f"sys.exit(main({command!r}))"
    )
    monkeypatch.setenv("BENCH_HOLD", str(tmp_path / "hold"))
    (tmp_path / "hold").write_text("5")
    with child(scope, code, stderr=subprocess.PIPE) as recorder:
        until(lambda: list(tmp_path.glob("r/views/mug/view-*.h5")))
        code, said = _stop(capsys, tmp_path / "no-daemon")
        assert code == 0, said
        assert f"mug into {tmp_path / 'r'} (process {recorder.pid}): stopped" in said
        assert recorder.wait(PATIENCE) == 130
        assert "stopped by the operator" in recorder.stderr.read()
        recorder.stderr.close()
    assert not list(tmp_path.rglob("*.partial"))
    assert len(list(tmp_path.glob("r/views/mug/view-*.h5"))) == 1


@pytest.mark.parametrize("queue", ["whole", "garbage"])
def test_the_daemon_and_its_recorder_are_stopped(tmp_path, scope, capsys, queue):
    """Also when the queue's file is garbage by now: the arm is told by a way that asks no database."""
    log, hold = tmp_path / "log", tmp_path / "hold"
    hold.write_text("4")
    with running(tmp_path, BENCH_SCOPE=scope, BENCH_LOG=log, BENCH_HOLD=hold) as daemon:
        daemon.record(5)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1)
        if queue == "garbage":
            for name in ("queue.sqlite", "queue.sqlite-wal"):  # the third is mapped into the daemon's memory
                (daemon.state / name).write_bytes(b"\xff" * 9000)
        code, said = _stop(capsys, daemon.state)
        assert (code, "stop" in log.read_text()) == (0, True), said
        assert f"the daemon over {daemon.root}" in said
        assert f"mug into {daemon.root / 'r'} (process " in said
        if queue == "whole":
            state = daemon.wait(lambda s: s["phase"] == "paused")
            assert (state["job"]["state"], state["reason"]) == ("stopped", "stopped by the operator")
        until(lambda: len([c for c in stopping._channels() if not c.foreign()]) <= 1)


def test_the_api_stops_while_the_queue_is_locked(tmp_path, scope):
    """Another process holds the database: the arm does not wait for it, and the answer says that it was heard."""
    log, hold = tmp_path / "log", tmp_path / "hold"
    hold.write_text("4")
    with running(tmp_path, BENCH_SCOPE=scope, BENCH_LOG=log, BENCH_HOLD=hold) as daemon:
        daemon.record(5)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1)
        with sqlite3.connect(daemon.state / "queue.sqlite", isolation_level=None) as other:
            other.execute("BEGIN EXCLUSIVE")
            assert daemon.ask("POST", "/v1/stop")["reason"] == "stopped by the operator"
            until(lambda: "stop" in log.read_text())
            other.execute("ROLLBACK")
        other.close()
        assert daemon.wait(lambda s: s["phase"] == "paused")["job"]["state"] == "stopped"


def test_what_does_not_answer_is_killed(tmp_path, scope, capsys):
    """A frozen process cannot stop its arm; it is killed, which its driver hosts notice, and that is said."""
    code = "import os, signal\nwith stopping.stoppable('frozen'): os.kill(os.getpid(), signal.SIGSTOP)"
    with child(scope, code) as frozen:
        _channels(1)
        until(lambda: " T " in _stat(frozen.pid))
        code, said = _stop(capsys, tmp_path)
        assert code == 0, said
        assert f"(process {frozen.pid}): it did not answer; it was killed" in said
        until(lambda: not alive(frozen.pid))


def _stat(pid):
    with open(f"/proc/{pid}/stat") as file:
        return file.read()


def test_an_arm_that_cannot_be_stopped_is_said(tmp_path, scope, capsys):
    """Its process is killed; the other recorder is stopped all the same."""
    code = (
        "import time\ndef broken(): raise OSError('no link')\n"
        "with stopping.stoppable('broken', broken), stopping.stoppable('sound'): time.sleep(999)"
    )
    with child(scope, code) as process:
        _channels(2)
        code, said = _stop(capsys, tmp_path)
        assert "broken" in said
        assert "OSError: no link; it was killed" in said
        assert process.wait(PATIENCE) == -signal.SIGKILL


def test_nothing_to_stop_is_no_success(tmp_path, scope, capsys):
    """Whoever asks sees something move: it names the red button, and advises to start nothing."""
    code, said = _stop(capsys, tmp_path)
    assert code == 4
    assert "red button" in said
    assert "start" not in said
    assert main(["stop", "--state", str(tmp_path), "--json"]) == 4
    assert json.loads(capsys.readouterr().out)["ok"] is False


def test_a_daemon_elsewhere_that_does_not_answer_is_said(tmp_path, scope, capsys):
    """One that is known by its folder alone, and is silent, was not stopped."""
    with running(tmp_path, BENCH_SCOPE=f"{scope}-elsewhere") as daemon:
        code, said = _stop(capsys, daemon.state)
        assert (code, f"process {daemon.process.pid}" in said) == (0, True)
        (daemon.state / "daemon.sock").unlink()
        code, said = _stop(capsys, daemon.state)
        assert code == 4
        assert "NOT STOPPED" in said
        assert "red button" in said


def test_an_arm_that_somebody_else_holds_is_said(tmp_path, scope, capsys):
    """A process that holds a real arm and does not listen was not stopped."""
    code = (
        "import time; from types import SimpleNamespace as N; from tofcapture.record.resources import hold_arm\n"
        "with hold_arm(N(simulated=False, by_hand=False, describe=lambda: N(model='ur5e', serial='1'))): print(1, flush=True); time.sleep(999)"
    )
    with child(scope, code, env={**os.environ, "TMPDIR": str(tmp_path)}) as process:
        assert process.stdout.readline()
        code, said = _stop(capsys, tmp_path)
        assert code == 4
        assert f"(process {process.pid})" in said
        assert "red button" in said


def test_an_order_holds_for_what_comes_later(scope):
    """Whoever looks later finds it heard; an action that fails keeps no other from its turn."""
    done = []

    def fails():
        raise OSError("x")

    stop = stopping.Stop("x", fails, lambda: done.append(1))
    stop.check()
    with pytest.raises(OSError, match="x"):
        stop.hear()
    assert done == [1]
    with pytest.raises(Stopped):
        stop.check()


def test_all_are_told_before_any_is_waited_for(scope):
    """Slow arms stop at the same time."""
    with ExitStack() as stack:
        for _ in range(5):
            stack.enter_context(stopping.stoppable("slow", lambda: time.sleep(0.3)))
        begun = time.monotonic()
        told = stopping.stop_all()
        assert [str(one) for one in told] == [f"slow (process {os.getpid()}): stopped"]
        assert time.monotonic() - begun < 1.4


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be somebody else")
def test_another_user_cannot_stop_and_is_told_so(scope):
    """His order is not followed, and he is told whose the recorder is."""
    heard = threading.Event()
    nobody = "import os, socket\nos.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
    with stopping.stoppable("mine", heard.set):
        address = stopping._channels()[0].address
        raw = f"s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM); s.bind(''); s.sendto(b'stop', {address!r})"
        ask = "print([str(one) for one in stopping.stop_all()])"
        with child(scope, f"{nobody}{raw}\n{ask}") as other:
            assert "a recorder of root" in other.stdout.readline()
        assert not heard.wait(0.2)
        stopping.stop_all()
        assert heard.is_set()


@pytest.fixture
def many_descriptors():
    """Room for more than a thousand connections of our own."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 2000:
        pytest.skip(f"this process may open {hard} files only")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("many_descriptors")
def test_idle_strangers_take_nobodys_place(tmp_path, scope):
    """With 1,100 idle TCP connections the page, the API and the stop answer within half a second."""
    with running(tmp_path, BENCH_SCOPE=scope) as daemon, ExitStack() as stack:
        known = http.client.HTTPConnection("127.0.0.1", daemon.port, timeout=PATIENCE)
        stack.callback(known.close)
        head = {"Authorization": f"Bearer {daemon.token}"}
        known.request("GET", "/v1/state", headers=head)
        assert known.getresponse().read()
        kept = known.sock
        for _ in range(1100):
            stack.enter_context(socket.create_connection(("127.0.0.1", daemon.port), timeout=PATIENCE))
        took = {"socket": [], "order": [], "TCP": []}
        for _ in range(5):
            begun = time.monotonic()
            assert daemon.ask("POST", "/v1/stop")["reason"] == "stopped by the operator"
            took["socket"].append(time.monotonic() - begun)
            begun = time.monotonic()
            assert [one.problem for one in stopping.stop_all()] == [""]
            took["order"].append(time.monotonic() - begun)
            begun = time.monotonic()
            assert daemon.tcp("GET", "/v1/state", {})[0] == 200
            took["TCP"].append(time.monotonic() - begun)
        assert all(min(times) < 0.5 for times in took.values()), took
        known.request("GET", "/v1/state", headers=head)
        assert known.getresponse().status == 200
        assert known.sock is kept  # who has shown the token keeps the place
