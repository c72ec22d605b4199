"""Show a Rerun file in Rerun's window, or in a browser of this machine.

Rerun by itself listens on every interface and reports how it is used. Here its window gets a configuration that says no.
Its page is served by us on the loopback interface, with a policy that lets the browser ask nobody else.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import ProxyHandler, build_opener

from tofcapture.errors import ConfigError, DeviceError

LOOPBACK = "127.0.0.1"
PORT = 9090
_DATA = "view.rrd"
_ASSETS = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")
_PATIENCE = 20.0  # s until Rerun's own server answers
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob:; worker-src 'self' blob:"
)
# Whoever is asked elsewhere answers "nothing", so that the page neither reports nor complains; the policy above is the lock.
_GUARD = """<script>
const own = window.fetch;
window.fetch = (what, ...rest) => new URL(what.url ?? what, location).origin === location.origin
  ? own(what, ...rest) : Promise.resolve(new Response(null, { status: 204 }));
</script>"""


def _program() -> str:
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.exists() else shutil.which("rerun")
    if not found:
        raise ConfigError(
            "the viewer Rerun is not installed", hint="pip install 'tofcapture[view]', or ask for --png"
        )
    return found


def quiet_environment(folder: Path) -> dict[str, str]:
    """Environment in which Rerun reports nothing; its configuration is put into an empty folder."""
    said = {"analytics_enabled": False, "analytics_id": "", "metadata": {}}
    (folder / "rerun").mkdir()
    (folder / "rerun" / "analytics.json").write_text(json.dumps(said), encoding="utf-8")
    return {**os.environ, "XDG_CONFIG_HOME": str(folder), "RUST_LOG": "error"}


def show_window(rrd: Path) -> None:
    """Show a file in Rerun's window until it is closed; :class:`DeviceError` where there is no screen, for instance."""
    with tempfile.TemporaryDirectory(prefix="tofcapture-view-") as folder:
        words = [_program(), "--bind", LOOPBACK, "--port", "auto", str(rrd)]
        done = subprocess.run(
            words, env=quiet_environment(Path(folder)), capture_output=True, text=True, check=False
        )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing said"])[-1][:200]
        raise DeviceError(
            f"Rerun's window did not open: {last}",
            hint="no screen? use --web, --save FILE.rrd or --png FILE.png",
        )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def save_page(folder: Path) -> None:
    """Take Rerun's page from its own server into a folder, without what it would load from elsewhere."""
    with tempfile.TemporaryDirectory(prefix="tofcapture-view-") as quiet:
        port = _free_port()
        bound = ("--bind", LOOPBACK, "--port", str(_free_port()))
        process = subprocess.Popen(
            [_program(), *bound, "--serve-web", "--web-viewer-port", str(port)],
            env=quiet_environment(Path(quiet)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            for name in _ASSETS:
                (folder / name).write_bytes(_asked(port, name))
        finally:
            os.killpg(process.pid, signal.SIGTERM)  # `rerun` is a script that starts the program proper
            process.wait(timeout=10)
    page = folder / "index.html"
    text = re.sub(r"<link[^>]*https://[^>]*>", "", page.read_text(encoding="utf-8"))
    page.write_text(text.replace("<head>", "<head>" + _GUARD, 1), encoding="utf-8")


def _asked(port: int, name: str) -> bytes:
    end, direct = time.monotonic() + _PATIENCE, build_opener(ProxyHandler({}))
    while True:
        try:
            with direct.open(f"http://{LOOPBACK}:{port}/{name}", timeout=_PATIENCE) as answer:
                return bytes(answer.read())
        except (URLError, OSError) as err:
            if time.monotonic() > end:
                raise DeviceError(
                    f"Rerun's page did not come: {err}", hint="use --save FILE.rrd or --png FILE.png"
                ) from err
            time.sleep(0.1)


class _Page(SimpleHTTPRequestHandler):
    """Hands out the files of a folder, to this machine and under its own name only."""

    def send_head(self) -> Any:
        """Answer with the page of the data; refuse who comes by another name: somebody else's page asks."""
        host = self.headers.get("Host", "")
        if host.rpartition(":")[0] not in {LOOPBACK, "localhost"}:
            return self.send_error(403)
        if self.path != "/":
            return super().send_head()
        self.send_response(303)
        data = f"/?url=http://{host}/{_DATA}&hide_welcome_screen&notebook=0&persist=0"
        self.send_header("Location", data)
        self.send_header("Content-Length", "0")
        return self.end_headers()

    def end_headers(self) -> None:
        """Let the browser ask nobody else."""
        self.send_header("Content-Security-Policy", _POLICY)
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name of the base class
        """Say nothing of every request."""


@contextmanager
def page_server(rrd: Path, port: int = PORT) -> Iterator[ThreadingHTTPServer]:
    """Give a server of the page of a file on the loopback interface; another port is taken where the wanted one is not free.

    Raises :class:`ConfigError`: Rerun is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="tofcapture-view-") as folder:
        save_page(Path(folder))
        (Path(folder) / _DATA).symlink_to(rrd.resolve())
        handler = partial(_Page, directory=folder)
        try:
            server = ThreadingHTTPServer((LOOPBACK, port), handler)
        except OSError:
            server = ThreadingHTTPServer((LOOPBACK, 0), handler)
        with server:
            yield server


def show_page(rrd: Path) -> None:
    """Serve the page of a file until Ctrl-C, and say where."""
    with page_server(rrd) as server:
        where = f"http://{LOOPBACK}:{server.server_port}"
        print(f"open {where} in a browser of this machine; Ctrl-C ends", file=sys.stderr, flush=True)
        server.serve_forever()
