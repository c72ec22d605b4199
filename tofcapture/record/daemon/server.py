"""Runs the daemon: sockets, signals, systemd."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import signal
import socket
from collections.abc import Callable
from contextlib import closing
from functools import partial

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from tofcapture.errors import BusyError, ConfigError, UsageError
from tofcapture.record.daemon import systemd
from tofcapture.record.daemon.api import PAGE_FILES, Api
from tofcapture.record.daemon.events import Streams
from tofcapture.record.daemon.guard import Connections, Guard, Watched
from tofcapture.record.daemon.settings import Settings
from tofcapture.record.daemon.state import StateFolder, only_one, token_of
from tofcapture.record.daemon.store import Store
from tofcapture.record.daemon.supervisor import Supervisor

_BACKLOG = 512


def tcp_address(text: str) -> tuple[str, int]:
    """Read ``127.0.0.1:8765``.

    Raises
    ------
    UsageError
        It is no loopback address with a port.
    """
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


def serve(settings: Settings, http: tuple[str, int] | None, announce: Callable[[str | None], None]) -> None:
    """Run until SIGTERM or SIGINT.

    Parameters
    ----------
    settings
        See there.
    http
        Loopback address to listen on too; port 0 takes a free one.
    announce
        Called when everything listens, with the page's address, token included, or ``None`` without TCP.

    Raises
    ------
    BusyError
        Another daemon runs in this folder, or the port is taken.
    """
    if not settings.root.is_dir():
        raise ConfigError(f"{settings.root}: expected a folder for recordings", hint="make it first")
    with only_one(settings.state), closing(Store(settings.state.database)) as store:
        asyncio.run(_serve(settings, store, http, announce))


async def _serve(
    settings: Settings, store: Store, http: tuple[str, int] | None, announce: Callable[[str | None], None]
) -> None:
    token, connections = token_of(settings.state), Connections()
    streams = Streams(store, connections)
    supervisor = Supervisor(settings, store, streams.publish)
    guard = Guard(token, frozenset(PAGE_FILES), connections)
    api = Api(supervisor, streams, guard)
    runner = web.AppRunner(
        api.application(),
        access_log=None,
        handler_cancellation=True,
        shutdown_timeout=0.5,
        lingering_time=1.0,
    )
    logging.getLogger("aiohttp.server").addFilter(_is_our_fault)
    await runner.setup()
    end = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end.set)
    listening = await _listen(runner, settings.state, http, guard, connections)
    work = asyncio.create_task(supervisor.run())
    work.add_done_callback(lambda _: end.set())
    life = asyncio.create_task(_show_life(supervisor))
    api.page_url = _url(listening, token)
    announce(api.page_url)
    systemd.notify("READY=1")
    await end.wait()
    systemd.notify("STOPPING=1")
    life.cancel()
    for server in listening:
        server.close()
    await supervisor.close()
    streams.close()
    await runner.cleanup()
    await work


async def _listen(
    runner: web.AppRunner,
    state: StateFolder,
    http: tuple[str, int] | None,
    guard: Guard,
    connections: Connections,
) -> list[asyncio.Server]:
    """Listen on the Unix socket, and on TCP when wanted."""
    loop = asyncio.get_running_loop()
    make = partial(_connection, runner, connections)
    servers = [await loop.create_unix_server(make, path=str(state.socket), backlog=_BACKLOG)]
    state.socket.chmod(0o600)
    if http is not None:
        try:
            tcp = await loop.create_server(make, *http, backlog=_BACKLOG)
        except OSError as err:
            raise BusyError(
                f"cannot listen on {http[0]}:{http[1]}: {err.strerror}", hint="take another port"
            ) from err
        guard.serve_tcp(tcp.sockets[0].getsockname()[1])
        servers.append(tcp)
    return servers


def _is_our_fault(record: logging.LogRecord) -> bool:
    """Tell our errors from clients that do not speak HTTP: those must not fill the log."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


def _connection(runner: web.AppRunner, connections: Connections) -> Watched:
    server = runner.server
    if server is None:
        raise AssertionError
    return Watched(server(), connections)


def _url(listening: list[asyncio.Server], token: str) -> str | None:
    for server in listening:
        for link in server.sockets:
            if link.family != socket.AF_UNIX:
                host, port = link.getsockname()[:2]
                name = f"[{host}]" if ":" in host else host
                return f"http://{name}:{port}/#token={token}"
    return None


async def _show_life(supervisor: Supervisor) -> None:
    """Tell systemd that the loop turns; a recorder that hangs is the supervisor's business."""
    period = systemd.watchdog_period()
    while True:
        counts = supervisor.progress.counts()
        systemd.notify(f"STATUS={supervisor.phase}, view {counts['sealed']}/{counts['total']}", "WATCHDOG=1")
        await asyncio.sleep(min(period or 5.0, 5.0))
