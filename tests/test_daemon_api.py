"""The daemon's API: who may ask, what is refused and how, and a recording from the queue to the sealed view."""

import contextlib
import dataclasses
import http.client
import json
import os
import select
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests import PATIENCE, until
from tofcapture.errors import BusyError, DataError, DeviceError, UsageError
from tofcapture.files.view import open_view
from tofcapture.record.daemon import client
from tofcapture.record.daemon.client import ask, hand_over

pytest.importorskip("aiohttp")

ROOT = Path(__file__).parents[1]
STATION = ROOT / "benchmarks" / "daemon_station.py"
client.PATIENCE = PATIENCE  # the daemon may get little of a busy machine
VERB = {"X-Tofcapture": "1", "Content-Type": "application/json"}


class Daemon:
    """A daemon in a process of its own, over the station of arrays."""

    def __init__(self, folder, process):
        self.root, self.state, self.process = folder / "root", folder / "st", process
        self.url = process.stdout.readline().strip()
        self.port = int(self.url.partition("/#")[0].rpartition(":")[2])
        self.token = self.url.partition("#token=")[2]

    def ask(self, method, path, body=None):
        return ask(method, path, body, self.state)

    def wait(self, wanted):
        def found():
            state = self.ask("GET", "/v1/state")
            return state if wanted(state) else None

        return until(found, 0.06)  # each answer costs both sides milliseconds

    def record(self, views, **more):
        """Queue the views of a mug."""
        job = {"scene": "mug", "recording": "r", "views": views, "frames": 2}
        return self.ask("POST", "/v1/jobs", {**job, **more})

    def tcp(self, method, path, headers, body=None, token=True):
        """Status and JSON over TCP."""
        link = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        try:
            shown = {"Authorization": f"Bearer {self.token}"} if token else {}
            link.request(method, path, body, {**shown, **headers})
            answer = link.getresponse()
            data = answer.read()
            return (
                answer.status,
                json.loads(data) if data.startswith(b"{") else data,
                dict(answer.getheaders()),
            )
        finally:
            link.close()


@contextmanager
def running(folder, *options, port=0, **env):
    """Start a daemon; end it by its id."""
    where = (folder / "root", folder / "st", "--http", f"127.0.0.1:{port}")
    command = [sys.executable, STATION, "daemon", *where, *options]
    full = {**os.environ, **{k: str(v) for k, v in env.items()}}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=full)
    try:
        yield Daemon(folder, process)
    finally:
        process.terminate()
        process.wait(PATIENCE)
        process.stdout.close()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory):
    """One resting daemon for all that is refused."""
    with running(tmp_path_factory.mktemp("d")) as daemon:
        daemon.ask("POST", "/v1/pause")
        yield daemon


def _over(state):
    return bool(state["job"]) and state["job"]["state"] in {"done", "failed", "stopped"}


def _held(folder, step):
    """Environment of a recorder that waits in this one of its steps (three a view) until the file is gone."""
    (folder / "hold").write_text(str(step))
    return {"BENCH_HOLD": folder / "hold"}


def test_records_a_scene_with_pause_and_previews(tmp_path):
    """A queued scene is recorded; pause rests between views, resume goes on; views, pictures and events say so."""
    with running(tmp_path, **_held(tmp_path, 5)) as daemon:
        job = daemon.record(6)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1 and (s["doing"] or {}).get("step") == "tof")
        daemon.ask("POST", "/v1/pause")
        (tmp_path / "hold").unlink()
        resting = daemon.wait(lambda s: s["phase"] == "paused")
        assert resting["progress"]["sealed"] == 2
        time.sleep(0.4)
        assert daemon.ask("GET", "/v1/state")["progress"] == resting["progress"]
        metrics = set(daemon.tcp("GET", "/metrics", {})[1].splitlines())
        assert {b"tofcapture_recorder_up 1", b"tofcapture_paused 1"} <= metrics
        daemon.ask("POST", "/v1/resume")
        assert daemon.wait(_over)["job"]["state"] == "done"
        views = daemon.ask("GET", "/v1/views")["views"]
        assert [v["state"] for v in views] == ["sealed"] * 6
        assert {"saturated", "stereo_coverage", "motion_m", "frame_drops"} <= views[0]["quality"].keys()
        for name in ("amplitude", "depth", "stereo"):
            status, picture, _ = daemon.tcp("GET", f"/v1/preview/{name}", {})
            assert (status, picture[:4]) == (200, b"\x89PNG")
        assert daemon.ask("GET", f"/v1/jobs/{job['id']}")["state"] == "done"
        with _stream(daemon, "?after=0") as link:
            told = _events(link, lambda kind, data: kind == "sealed" and data["progress"]["sealed"] == 6)
        assert {"paused", "resumed"} <= {kind for _, kind, _ in told}
        metrics = set(daemon.tcp("GET", "/metrics", {})[1].splitlines())
        assert {b"tofcapture_views_sealed_total 6", b"tofcapture_paused 0"} <= metrics
    for view in views:
        assert (
            open_view(tmp_path / "root" / "r" / "views" / "mug" / f"view-{view['index']:03d}.h5").scene
            == "mug"
        )


def _stream(daemon, query="", head=""):
    """Open a stream of events; the socket, its headers read."""
    link = socket.create_connection(("127.0.0.1", daemon.port), timeout=PATIENCE)
    host = f"Host: 127.0.0.1:{daemon.port}\r\nAuthorization: Bearer {daemon.token}\r\n"
    link.sendall(f"GET /v1/events{query} HTTP/1.1\r\n{host}{head}\r\n".encode())
    return link


def _events(link, last):
    """Events of a stream up to the first for which ``last(kind, data)`` holds: (number or ``None``, kind, data)."""
    field, found = {}, []
    with link.makefile("r", encoding="utf-8") as lines:
        while not (found and last(*found[-1][1:])):
            name, _, value = lines.readline().strip().partition(": ")
            if name:
                field[name] = value
            elif "event" in field:
                number = int(field["id"]) if "id" in field else None
                found.append((number, field["event"], json.loads(field["data"])))
                field = {}
    return found


def _idle_again(kind, data):
    return kind == "state" and data["state"]["phase"] == "idle" and bool(data["state"]["queue"].get("done"))


def test_events_come_live_and_again(tmp_path):
    """A stream tells what happens as it happens, numbered; a client that comes back is told what it missed, once."""
    with running(tmp_path) as daemon:
        daemon.ask("POST", "/v1/pause")
        with _stream(daemon) as link:
            assert link.recv(4096).startswith(b"HTTP/1.1 200")
            daemon.record(3)
            daemon.ask("POST", "/v1/resume")
            live = _events(link, _idle_again)
        kinds = [kind for _, kind, _ in live if kind != "health"]
        assert kinds[0] == "queued"
        assert [k for k in kinds if k in {"planned", "step", "sealed"}] == [
            "planned",
            *(["step"] * 4 + ["sealed"]) * 3,
        ]
        sealed = [data for _, kind, data in live if kind == "sealed"]
        assert [d["progress"]["sealed"] for d in sealed] == [1, 2, 3]
        assert all(d["utc"] and d["sha256"] and d["quality"]["frames"] == 2 for d in sealed)
        numbers = [number for number, kind, _ in live if kind != "health"]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        for query, head in ((f"?after={numbers[2]}", ""), ("", f"Last-Event-ID: {numbers[2]}\r\n")):
            with _stream(daemon, query, head) as link:
                again = _events(link, _idle_again)
            assert [event for event in again if event[1] != "health"] == [
                event for event in live if event[1] != "health"
            ][3:]


def test_the_time_left_follows_the_pace(tmp_path):
    """No time is named before a view is there, at rest, and at the end; between, it is that of the views that are left."""
    delay = 0.1
    with running(tmp_path, BENCH_DELAY=delay, **_held(tmp_path, 7)) as daemon:
        assert daemon.ask("GET", "/v1/state")["progress"]["eta_s"] is None
        begun = time.monotonic()
        daemon.record(6)
        progress = daemon.wait(lambda s: s["progress"]["sealed"] == 2)["progress"]
        # Three devices take their time for each view; all views so far took no longer than the test did.
        slowest = (time.monotonic() - begun) / 2
        assert 3 * delay * 4 <= progress["eta_s"] <= slowest * 4 + 0.1
        daemon.ask("POST", "/v1/pause")
        (tmp_path / "hold").unlink()
        assert daemon.wait(lambda s: s["phase"] == "paused")["progress"]["eta_s"] is None
        daemon.ask("POST", "/v1/resume")
        assert daemon.wait(_over)["progress"]["eta_s"] == 0


def _recorder(daemon):
    """The recorder's process id."""
    pid = daemon.process.pid
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


def test_a_recorder_that_hangs_is_found_and_replaced(tmp_path):
    """A recorder that says nothing is called silent, killed when its time is over, and another one does its work."""
    with running(tmp_path, BENCH_LOST=8, **_held(tmp_path, 4)) as daemon, _stream(daemon) as link:
        daemon.record(8)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1 and s["health"]["recorder"] == "alive")
        os.kill(_recorder(daemon), signal.SIGSTOP)
        (tmp_path / "hold").unlink()
        silent = _events(link, lambda kind, data: kind == "health" and data["recorder"] == "silent")[-1][2]
        assert silent["silence_s"] >= 3
        assert silent["restarts"] == 0
        state = daemon.wait(_over)
        assert (state["job"]["state"], state["health"]["restarts"]) == ("done", 1)
        assert state["progress"]["sealed"] == 8


def test_a_real_arm_does_not_move_unasked(tmp_path):
    """A daemon that nobody allowed to move the arm moves no real one: the job waits, and the daemon says for what."""
    log = tmp_path / "log"
    with running(tmp_path, BENCH_REAL=1, BENCH_LOG=log) as daemon:
        assert daemon.ask("GET", "/v1/state")["allow_motion"] is False
        daemon.record(2)
        state = daemon.wait(lambda s: s["phase"] == "paused")
        assert "--allow-motion" in state["reason"]
        assert state["queue"] == {"queued": 1}
    assert "move" not in (log.read_text() if log.exists() else "")


def test_stop_keeps_what_is_sealed(tmp_path):
    """Stop ends the job at once and stops the arm; the same scene asked again goes on, once per request id."""
    log = tmp_path / "log"
    with running(tmp_path, BENCH_LOG=log, **_held(tmp_path, 4)) as daemon:
        daemon.record(5, request_id="a")
        daemon.wait(lambda s: s["progress"]["sealed"] == 1)
        daemon.ask("POST", "/v1/stop")
        assert daemon.wait(_over)["job"]["state"] == "stopped"
        assert "stop" in log.read_text()
        assert daemon.record(5, request_id="a")["state"] == "stopped"
        with pytest.raises(BusyError):
            daemon.record(6, request_id="a")
        daemon.record(5, request_id="b")
        waiting = daemon.record(5, scene="cup")
        assert daemon.ask("POST", f"/v1/jobs/{waiting['id']}/cancel")["state"] == "stopped"
        (tmp_path / "hold").unlink()
        daemon.ask("POST", "/v1/resume")
        assert daemon.wait(lambda s: s["queue"].get("done") == 1)["progress"]["sealed"] == 5


def test_an_ended_job_is_tried_again(tmp_path):
    """Retry asks for the same once more, and keeps what was; what has not ended cannot be tried again."""
    with running(tmp_path, **_held(tmp_path, 4)) as daemon:
        first = daemon.record(3, seed=5)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1)
        with pytest.raises(BusyError):
            daemon.ask("POST", f"/v1/jobs/{first['id']}/retry")
        daemon.ask("POST", "/v1/stop")
        daemon.wait(_over)
        (tmp_path / "hold").unlink()
        again = daemon.ask("POST", f"/v1/jobs/{first['id']}/retry")
        assert {k: again[k] for k in ("scene", "views", "frames", "seed")} == {
            k: first[k] for k in ("scene", "views", "frames", "seed")
        }
        daemon.ask("POST", "/v1/resume")
        daemon.wait(lambda s: s["queue"].get("done"))
        jobs = daemon.ask("GET", "/v1/jobs")["jobs"]
        assert [(job["id"], job["state"], job["reason"]) for job in jobs] == [
            (again["id"], "done", ""),
            (first["id"], "stopped", "stopped by the operator"),
        ]


def test_jobs_are_reordered_and_told_in_their_order(tmp_path):
    """The list is the running one, those that wait in the order in which they will run, then those that ended."""
    with running(tmp_path) as daemon:
        daemon.ask("POST", "/v1/pause")
        a, b, c = (daemon.record(1, scene=name)["id"] for name in "abc")
        daemon.ask("POST", f"/v1/jobs/{c}/move", {"place": 1})
        daemon.ask("POST", f"/v1/jobs/{a}/cancel")
        assert [job["id"] for job in daemon.ask("GET", "/v1/jobs")["jobs"]] == [c, b, a]
        with pytest.raises(BusyError):
            daemon.ask("POST", f"/v1/jobs/{a}/move", {"place": 1})
        daemon.ask("POST", "/v1/resume")
        daemon.wait(lambda s: s["queue"].get("done") == 2)
        told = [e for e in daemon.ask("GET", "/v1/log")["events"] if e["event"] == "planned"]
        assert [e["job"] for e in told] == [c, b]


def test_one_view_is_taken_again(tmp_path):
    """It alone; the one before lies beside it. A view that is not planned is no view."""
    with running(tmp_path) as daemon:
        daemon.record(3)
        daemon.wait(_over)
        folder = tmp_path / "root" / "r" / "views" / "mug"
        before = {path.name: path.stat().st_mtime_ns for path in folder.glob("view-*.h5")}
        old = (folder / "view-001.h5").read_bytes()
        daemon.record(3, retake=1)
        daemon.wait(lambda s: s["queue"].get("done") == 2)
        after = {path.name: path.stat().st_mtime_ns for path in folder.glob("view-*.h5")}
        assert (folder / "view-001.h5.retaken").read_bytes() == old
        assert {name for name in before if after[name] != before[name]} == {"view-001.h5"}
        assert open_view(folder / "view-001.h5").index == 1
        daemon.record(3, retake=7)
        daemon.wait(lambda s: s["queue"].get("failed"))
        assert "retake" in daemon.ask("GET", "/v1/jobs")["jobs"][0]["reason"]


def test_what_moves_a_real_arm_wants_its_reach_clear(tmp_path):
    """Adding, resuming, confirming, trying again: none of it without a word that everybody is out of reach."""
    with running(tmp_path, BENCH_REAL=1, BENCH_MOVES=1, BENCH_ASKS=1) as daemon:
        job = {"scene": "mug", "recording": "r", "views": 1, "frames": 1}
        daemon.ask(
            "POST", "/v1/jobs", {**job, "clear": True}
        )  # after it the daemon knows that the arm is real
        daemon.wait(lambda s: s["phase"] == "waiting")
        assert daemon.ask("GET", "/v1/state")["real"] is True
        ways = [("/v1/jobs", job), ("/v1/confirm", {}), ("/v1/resume", {}), ("/v1/resume", {"clear": False})]
        for path, body in ways:
            with pytest.raises(UsageError, match="clear"):
                daemon.ask("POST", path, body)
        daemon.ask("POST", "/v1/confirm", {"clear": True})
        done = daemon.wait(_over)["job"]
        with pytest.raises(UsageError, match="clear"):
            daemon.ask("POST", f"/v1/jobs/{done['id']}/retry")
        assert len(daemon.ask("GET", "/v1/jobs")["jobs"]) == 1
        daemon.ask("POST", f"/v1/jobs/{done['id']}/retry", {"clear": True})


def test_a_person_is_asked_for_the_scene(tmp_path):
    """Where a person places scenes, the recorder waits for a confirmation."""
    with running(tmp_path, BENCH_ASKS=1) as daemon:
        daemon.record(2)
        state = daemon.wait(lambda s: s["asks"])
        assert (state["asks"], state["phase"]) == ("mug", "waiting")
        daemon.ask("POST", "/v1/confirm")
        assert daemon.wait(_over)["job"]["state"] == "done"


def test_sigterm_with_open_streams(tmp_path):
    """SIGTERM in mid-recording, streams open: the arm is stopped, all is over, and the next daemon waits."""
    log = tmp_path / "log"
    with running(tmp_path, BENCH_LOG=log, **_held(tmp_path, 2)) as daemon:
        daemon.record(4)
        daemon.wait(lambda s: s["doing"])
        links = [_stream(daemon) for _ in range(20)]
        assert all(link.recv(20) for link in links)
        daemon.process.send_signal(signal.SIGTERM)
        assert daemon.process.wait(PATIENCE) == 0
        for link in links:
            link.close()
    assert "stop" in log.read_text()
    assert not list((tmp_path / "root").rglob("*.partial"))
    with running(tmp_path) as daemon:
        state = daemon.ask("GET", "/v1/state")
        assert (state["phase"], state["queue"]) == ("paused", {"queued": 1})
        daemon.ask("POST", "/v1/resume")
        assert daemon.wait(_over)["job"]["state"] == "done"


def test_the_daemon_dies_and_the_arm_stops(tmp_path):
    """Killed without warning, the daemon takes its recorder along, which stops the arm first."""
    log = tmp_path / "log"
    with running(tmp_path, BENCH_LOG=log, **_held(tmp_path, 1)) as daemon:
        daemon.record(20)
        until(log.exists)
        daemon.process.kill()
        until(lambda: "stop" in log.read_text())


def test_only_one_daemon(daemon):
    """A second daemon in the same folder is refused."""
    command = [sys.executable, STATION, "daemon", daemon.root, daemon.state]
    second = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "BusyError" in second.stderr
    assert second.returncode != 0
    assert daemon.ask("GET", "/v1/state")["pid"] == daemon.process.pid


def test_files_are_private(daemon):
    """Folder, socket and token are for the daemon's user alone."""
    assert daemon.state.stat().st_mode & 0o777 == 0o700
    assert (daemon.state / "daemon.sock").stat().st_mode & 0o777 == 0o600
    assert (daemon.state / "token").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    "path", ["/v1/state", "/v1/views", "/v1/events", "/v1/preview/depth", "/metrics", "/openapi.json", "/no"]
)
def test_without_token_nothing_answers(daemon, path):
    """Every path but the page's own files wants the token; a wrong one is no better, nor one in the address."""
    assert daemon.tcp("GET", path, {}, token=False)[0] == 401
    assert daemon.tcp("GET", path, {"Authorization": "Bearer " + "x" * 43}, token=False)[0] == 401
    assert daemon.tcp("GET", f"{path}?token={daemon.token}", {}, token=False)[0] == 401
    assert daemon.tcp("POST", "/v1/stop", VERB, "{}", token=False)[0] == 401


def test_page_is_static_and_strict(daemon):
    """The page's files come without a token, hold no secret, and forbid everything foreign."""
    for path in ("/", "/app.js", "/picture.js", "/style.css"):
        status, body, headers = daemon.tcp("GET", path, {}, token=False)
        assert status == 200
        assert daemon.token.encode() not in body
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert b"http://" not in body.replace(b"http://www.w3.org/2000/svg", b"")
        assert b"https://" not in body


GOOD = {"scene": "a", "recording": "b"}
WRONG_JOBS = [
    ("malformed", '{"scene": ', 400),
    ("not UTF-8", b'{"scene": "\xff"}', 400),
    ("NaN", json.dumps({**GOOD, "views": float("nan")}), 400),
    ("too deep", "[" * 30000, 400),
    ("oversized", json.dumps({"scene": "a" * 70000}), 413),
    ("a list", "[]", 422),
    ("unknown field", json.dumps({**GOOD, "station": "/etc/passwd"}), 422),
    *((f"scene {name!r}", json.dumps({**GOOD, "scene": name}), 422) for name in ("../../etc", "a\n", "")),
    *((f"recording {name!r}", json.dumps({**GOOD, "recording": name}), 422) for name in ("../b", "/etc", 3)),
    ("a word for consent", json.dumps({**GOOD, "clear": "yes"}), 422),
    *((f"views {n!r}", json.dumps({**GOOD, "views": n}), 422) for n in (True, 0, 1001, 1.5, "3", None)),
]
FORM = {**VERB, "Content-Type": "application/x-www-form-urlencoded"}
REFUSED = [
    ("foreign Host", "GET", "/v1/state", {"Host": "evil.example"}, None, 403),
    ("rebound Host", "POST", "/v1/stop", {**VERB, "Host": "evil.example:80"}, "{}", 403),
    ("foreign Origin", "GET", "/v1/state", {"Origin": "http://evil.example"}, None, 403),
    ("null Origin", "POST", "/v1/stop", {**VERB, "Origin": "null"}, "{}", 403),
    ("cross-site", "GET", "/v1/state", {"Sec-Fetch-Site": "cross-site"}, None, 403),
    ("text/plain", "POST", "/v1/jobs", {**VERB, "Content-Type": "text/plain"}, json.dumps(GOOD), 415),
    ("a form", "POST", "/v1/stop", FORM, "a=b", 415),
    ("no header", "POST", "/v1/stop", {"Content-Type": "application/json"}, "{}", 403),
    *((name, "POST", "/v1/jobs", VERB, body, code) for name, body, code in WRONG_JOBS),
    ("wrong verb", "DELETE", "/v1/jobs", VERB, "{}", 405),
    ("no such job", "GET", "/v1/jobs/999999", {}, None, 404),
    ("a path for a picture", "GET", "/v1/preview/..%2f..%2ftoken", {}, None, 404),
    ("no picture yet", "GET", "/v1/preview/depth", {}, None, 404),
    ("no such picture", "GET", "/v1/preview/token", {}, None, 404),
    ("a word for an event", "GET", "/v1/events?after=x", {}, None, 400),
]


@pytest.mark.parametrize(
    ("method", "path", "headers", "body", "code"), [r[1:] for r in REFUSED], ids=[r[0] for r in REFUSED]
)
def test_refused(daemon, method, path, headers, body, code):
    """What must not be answered is refused with the documented error, as JSON, and changes nothing."""
    before = daemon.ask("GET", "/v1/jobs")
    status, answer, _ = daemon.tcp(method, path, headers, body)
    assert status == code
    assert set(answer["error"]) == {"kind", "message", "hint"}
    assert daemon.ask("GET", "/v1/jobs") == before


def test_cli_errors_are_told_apart(daemon, tmp_path):
    """The Unix client turns refusals into the project's errors, and says when no daemon is there."""
    with pytest.raises(UsageError, match="scene"):
        daemon.ask("POST", "/v1/jobs", {"recording": "b"})
    with pytest.raises(DataError):
        daemon.ask("GET", "/v1/jobs/12345")
    with pytest.raises(DeviceError, match="no daemon"):
        ask("GET", "/v1/state", state=tmp_path)


def test_record_hands_over(daemon, tmp_path):
    """A scene of a recording under the daemon's root goes to its queue; any other, or without a daemon, does not."""
    request = {"scene": "mug", "views": 2, "frames": 1}
    assert hand_over(tmp_path / "r", request, daemon.state) is None
    assert hand_over(daemon.root / "r", request, tmp_path) is None
    job = hand_over(daemon.root / "r", request, daemon.state)
    assert (job["recording"], job["state"]) == ("r", "queued")
    assert daemon.ask("POST", f"/v1/jobs/{job['id']}/cancel")["state"] == "stopped"


def test_slow_body_is_cut_off(daemon):
    """A body that does not come is given up with 408, others are served meanwhile."""
    head = (
        f"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1:{daemon.port}\r\nAuthorization: Bearer {daemon.token}\r\n"
    )
    with socket.create_connection(("127.0.0.1", daemon.port), timeout=PATIENCE) as link:
        link.sendall(
            f"{head}X-Tofcapture: 1\r\nContent-Type: application/json\r\nContent-Length: 50\r\n\r\n{{".encode()
        )
        assert daemon.ask("GET", "/v1/state")["phase"] == "paused"
        assert link.recv(4096).startswith(b"HTTP/1.1 408")


def test_slow_headers_are_cut_off(tmp_path):
    """A connection that sends no whole request in time is closed; one that asks now and then is not."""
    with running(tmp_path, BENCH_IDLE=4) as daemon:
        link = http.client.HTTPConnection("127.0.0.1", daemon.port, timeout=PATIENCE)
        with socket.create_connection(("127.0.0.1", daemon.port), timeout=PATIENCE) as slow:
            slow.sendall(b"GET /v1/state HTTP/1.1\r\n")
            while not select.select([slow], [], [], 0.2)[0]:
                link.request("GET", "/", headers={"Host": f"127.0.0.1:{daemon.port}"})
                assert link.getresponse().read()
                same = link.sock
            assert slow.recv(100) == b""
        assert link.sock is same
        link.close()


def test_openapi_is_what_is_served(daemon):
    """docs/openapi.json is generated from the routes that serve it."""
    from tofcapture.record.daemon.app import document
    from tofcapture.record.daemon.store import Job

    stored = json.loads((ROOT / "docs" / "openapi.json").read_text(encoding="utf-8"))
    assert stored == document() == daemon.ask("GET", "/openapi.json"), "make docs"
    known = {field.name for field in dataclasses.fields(Job)}
    assert stored["components"]["schemas"]["Job"]["properties"].keys() == known


@pytest.mark.parametrize(
    "fault",
    ["closed", *(pytest.param(f, marks=pytest.mark.slow) for f in ("unexpected", "millimetres"))],
)
def test_the_queue_does_not_burn(tmp_path, fault):
    """What the next job would meet as well puts the job back and rests; with the cause gone all jobs are done."""
    (tmp_path / "fault").write_text(fault)
    with running(tmp_path, BENCH_FAULT=tmp_path / "fault") as daemon:
        for number in range(2):
            daemon.record(1, recording=f"r{number}")
        state = daemon.wait(lambda s: s["phase"] == "paused")
        assert state["queue"] == {"queued": 2}
        assert {"closed": "do not open", "unexpected": "LookupError", "millimetres": "metres"}[
            fault
        ] in state["reason"]
        (tmp_path / "fault").unlink()
        daemon.ask("POST", "/v1/resume")
        daemon.wait(lambda s: s["queue"] == {"done": 2})


def test_an_unmounted_root_is_not_recorded_into(tmp_path):
    """The disk goes while a view is taken: the queue rests, the empty folder in its place stays empty, the disk comes back."""
    with running(tmp_path, **_held(tmp_path, 4)) as daemon:
        daemon.record(3)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1 and s["doing"])
        daemon.root.rename(tmp_path / "away")
        daemon.root.mkdir()
        (tmp_path / "hold").unlink()
        for _ in range(2):  # a resume changes nothing while the disk is away
            state = daemon.wait(lambda s: s["phase"] == "paused")
            assert "unmounted" in state["reason"]
            assert state["queue"] == {"queued": 1}
            daemon.ask("POST", "/v1/resume")
        daemon.wait(lambda s: s["phase"] == "paused")
        assert not list(daemon.root.iterdir())
        daemon.root.rmdir()
        (tmp_path / "away").rename(daemon.root)
        daemon.ask("POST", "/v1/resume")
        assert daemon.wait(_over)["job"]["state"] == "done"
    assert len(list((tmp_path / "root").rglob("view-*.h5"))) == 3


def test_a_daemon_started_anew_knows_the_disk_that_is_away(tmp_path):
    """The disk goes while no daemon runs: the next one does not record into the empty folder, however often it is told to."""
    with running(tmp_path, **_held(tmp_path, 4)) as daemon:
        daemon.record(3)
        daemon.wait(lambda s: s["progress"]["sealed"] == 1 and s["doing"])
        root = daemon.root
    root.rename(tmp_path / "away")
    root.mkdir()
    (tmp_path / "hold").unlink()
    with running(tmp_path) as daemon:
        for _ in range(3):
            assert daemon.wait(lambda s: s["phase"] == "paused")["queue"] == {"queued": 1}
            daemon.ask("POST", "/v1/resume")
        assert "unmounted" in daemon.wait(lambda s: s["phase"] == "paused")["reason"]
        assert not list(root.iterdir())
        root.rmdir()
        (tmp_path / "away").rename(root)
        daemon.ask("POST", "/v1/resume")
        assert daemon.wait(_over)["job"]["state"] == "done"
    assert len(list(root.rglob("view-*.h5"))) == 3


def test_a_held_or_full_queue_answers_at_once(tmp_path):
    """Another process holds the database, or its disk is full: answers come as JSON, and nothing waits."""
    with running(tmp_path, BENCH_STATE=tmp_path / "full") as daemon:
        daemon.ask("POST", "/v1/pause")
        job = json.dumps(GOOD)
        with contextlib.closing(sqlite3.connect(daemon.state / "queue.sqlite", isolation_level=None)) as db:
            db.execute("BEGIN IMMEDIATE")
            begin = time.monotonic()
            assert daemon.ask("GET", "/v1/state")["phase"] == "paused"
            status, answer, _ = daemon.tcp("POST", "/v1/jobs", VERB, job)
            assert (status, answer["error"]["kind"]) == (409, "BusyError")
            assert time.monotonic() - begin < 4  # s; SQLite would wait for 5
            daemon.ask("POST", "/v1/stop")
            db.execute("ROLLBACK")
        (tmp_path / "full").write_text("1")
        status, answer, _ = daemon.tcp("POST", "/v1/jobs", VERB, job)
        assert (status, answer["error"]["kind"]) == (507, "DiskFull")
        (tmp_path / "full").unlink()
        assert daemon.tcp("POST", "/v1/jobs", VERB, job)[0] == 201


@pytest.mark.parametrize(
    "sent",
    [
        b"GARBAGE\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /" + b"x" * 20000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nContent-Length: -1\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01",
        b"POST /v1/jobs HTTP/1.1\r\nHost: HOST\r\nX-Tofcapture: 1\r\nAuthorization: Bearer TOKEN\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n\r\n",
    ],
)
def test_what_is_no_http_is_refused_in_json(daemon, sent):
    """aiohttp's own refusals look like all others."""
    host = f"127.0.0.1:{daemon.port}".encode()
    with socket.create_connection(("127.0.0.1", daemon.port), timeout=PATIENCE) as link:
        link.sendall(sent.replace(b"HOST", host).replace(b"TOKEN", daemon.token.encode()) + b"\n\n")
        answer = b""
        while part := link.recv(4096):
            answer += part
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.split()[1] == b"400"
    assert b"application/json" in head
    assert set(json.loads(body)["error"]) == {"kind", "message", "hint"}
