"""Runs the daemon: sockets, signals, systemd."""

from __future__ import annotations

import asyncio
import getpass
import ipaddress
import logging
import os
import resource
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from tofcapture.errors import BusyError, ConfigError, UsageError
from tofcapture.record.daemon.app import PAGE_FILES, Api
from tofcapture.record.daemon.guard import Guard, speak_json
from tofcapture.record.daemon.settings import Settings, StateFolder, only_one, token_of
from tofcapture.record.daemon.store import Store, Streams
from tofcapture.record.daemon.supervisor import Supervisor
from tofcapture.record.stopping import stoppable

_BACKLOG = 512
_DESCRIPTORS = 4096  # of this process, where the system allows them: more than the guard lets in
_UNIT = Path(__file__).with_name("tofcapture.service")

Address = tuple[str, int]


def tcp_address(text: str) -> Address:
    """Read ``127.0.0.1:8765``. Raises :class:`UsageError`: it is no loopback address with a port."""
    host, _, port = text.rpartition(":")
    host = {"localhost": "127.0.0.1"}.get(host, host.strip("[]"))
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback or not port.isdigit() or int(port) > 65535:
        raise UsageError(
            f"--http: expected a loopback address like 127.0.0.1:8765, got {text!r}",
            hint="from another machine: ssh -L 8765:127.0.0.1:8765 THIS_MACHINE",
        )
    return host, int(port)


def serve(settings: Settings, http: Address | None, announce: Callable[[str | None], None]) -> None:
    """Run until SIGTERM or SIGINT; listen on a loopback address too, where port 0 takes a free one.

    ``announce`` is called when everything listens, with the page's address, token included, or ``None`` without TCP.
    Raises :class:`BusyError`: another daemon runs in this folder, or the port is taken.
    """
    if not settings.root.is_dir():
        raise ConfigError(f"{settings.root}: expected a folder for recordings", hint="make it first")
    with only_one(settings.state), closing(Store(settings.state.database)) as store:
        asyncio.run(_serve(settings, store, http, announce))


async def _serve(
    settings: Settings, store: Store, http: Address | None, announce: Callable[[str | None], None]
) -> None:
    token, streams = token_of(settings.state), Streams(store)
    guard = Guard(token, frozenset(PAGE_FILES))
    supervisor = Supervisor(settings, store, streams.publish)
    api = Api(supervisor, streams, guard)
    runner = web.AppRunner(
        api.application(),
        access_log=None,
        handler_cancellation=True,
        shutdown_timeout=0.5,
        lingering_time=1.0,
    )
    speak_json()
    logging.getLogger("aiohttp.server").addFilter(_is_our_fault)
    await runner.setup()
    end = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, end.set)
    assert runner.server is not None
    listening = await _listen(runner.server, guard, settings.state, http)
    api.page_url = _page_url(listening, token, guard)
    work = asyncio.create_task(supervisor.run())
    work.add_done_callback(lambda _: end.set())
    helpers = [asyncio.create_task(t) for t in (_show_life(supervisor), guard.hang_up(runner.server))]
    # Heard by a thread, whatever the loop does; the recorder hears it by itself.
    stop = partial(asyncio.get_running_loop().call_soon_threadsafe, supervisor.stop)
    with stoppable(f"the daemon over {settings.root}, which rests", stop):
        announce(api.page_url)
        notify("READY=1")
        await end.wait()
    notify("STOPPING=1")
    for server in listening:
        server.close()
    for helper in helpers:
        helper.cancel()
    await supervisor.close()
    streams.close()
    await runner.cleanup()
    await work


async def _listen(
    server: web.Server, guard: Guard, state: StateFolder, http: Address | None
) -> list[asyncio.Server]:
    """Listen on the Unix socket, and on TCP when wanted. What connects to one takes no room of the other."""
    loop, most = asyncio.get_running_loop(), resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    room = _DESCRIPTORS if most == resource.RLIM_INFINITY else min(_DESCRIPTORS, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (room, most))
    found = [await loop.create_unix_server(guard.door(server), str(state.socket), backlog=_BACKLOG)]
    state.socket.chmod(0o600)
    if http is not None:
        try:
            found.append(await loop.create_server(guard.door(server), *http, backlog=_BACKLOG))
        except OSError as err:
            raise BusyError(
                f"cannot listen on {http[0]}:{http[1]}: {err.strerror}", hint="take another port"
            ) from err
    return found


def _page_url(listening: list[asyncio.Server], token: str, guard: Guard) -> str | None:
    """Find the address of the page, if TCP is served at all; the guard hears the port."""
    for server in listening[1:]:
        host, port = server.sockets[0].getsockname()[:2]
        guard.serve_tcp(port)
        name = f"[{host}]" if ":" in host else host
        return f"http://{name}:{port}/#token={token}"
    return None


def _is_our_fault(record: logging.LogRecord) -> bool:
    """Tell our errors from clients that do not speak HTTP: those must not fill the log."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


async def _show_life(supervisor: Supervisor) -> None:
    """Tell systemd that the loop turns; a recorder that hangs is the supervisor's business."""
    period = watchdog_period()
    while True:
        counts = supervisor.progress.counts()
        notify(f"STATUS={supervisor.phase}, view {counts['sealed']}/{counts['total']}", "WATCHDOG=1")
        await asyncio.sleep(min(period or 5.0, 5.0))


def notify(*lines: str) -> None:
    """Send lines (``READY=1`` ...) to systemd, where it started us and listens."""
    if where := os.environ.get("NOTIFY_SOCKET"):
        address = "\0" + where[1:] if where.startswith("@") else where
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link,
        ):
            link.connect(address)
            link.send("\n".join(lines).encode())


def watchdog_period() -> float | None:
    """Find the seconds between signs of life that systemd wants (half its limit); ``None`` when it wants none."""
    limit = os.environ.get("WATCHDOG_USEC", "")
    meant = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    return int(limit) / 2e6 if limit.isdigit() and int(limit) and meant else None


def unit(root: Path, state: Path) -> str:
    """Write the systemd unit; it never allows motion of a real arm, that is given anew by a person."""
    program = f"{sys.executable} -m tofcapture"
    text = _UNIT.read_text(encoding="utf-8")
    return text.format(program=program, root=root.resolve(), state=state.resolve(), user=getpass.getuser())
