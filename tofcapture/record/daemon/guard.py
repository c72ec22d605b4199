"""Who may ask, and how slowly: everything that is decided before a request is looked at.

Over the Unix socket: this user (or root), known from the kernel. Over TCP: a Host that is ours (no DNS rebinding), no foreign
Origin, and the token. Over both: verbs need a header that no foreign page can send, and JSON that says so.
"""

from __future__ import annotations

import asyncio
import hmac
import os
import socket
import struct
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from aiohttp import web
from aiohttp.typedefs import Middleware

from tofcapture.errors import BusyError, DataError, TofError, UsageError

BODY_LIMIT = 64 * 1024  # bytes
_CONNECTIONS = 1024
_IDLE = 30.0  # s that a connection may take to send a request, or to take an answer
_BODY = 5.0  # s for a body

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
}


def refusal(
    code: int, kind: str, message: str, hint: str = "", headers: Mapping[str, str] | None = None
) -> web.Response:
    """Every error looks like this."""
    body = {"error": {"kind": kind, "message": message, "hint": hint}}
    return web.json_response(body, status=code, headers=headers)


class Connections:
    """Closes connections that take too long: with slow headers, with answers not read; and those that are too many."""

    def __init__(self) -> None:
        self._open: dict[asyncio.BaseTransport, asyncio.TimerHandle | None] = {}

    def __len__(self) -> int:
        return len(self._open)

    def opened(self, transport: asyncio.BaseTransport) -> bool:
        """Count a connection in; false when there are too many."""
        if len(self._open) >= _CONNECTIONS:
            return False
        self._open[transport] = None
        self.waiting(transport)
        return True

    def waiting(self, transport: asyncio.BaseTransport | None) -> None:
        """From now on the other end must hurry."""
        if transport in self._open:
            self.busy(transport)
            abort = getattr(transport, "abort", transport.close)
            self._open[transport] = asyncio.get_running_loop().call_later(_IDLE, abort)

    def busy(self, transport: asyncio.BaseTransport | None) -> None:
        """A request is whole: now it is our turn."""
        if transport is not None and (timer := self._open.get(transport)):
            timer.cancel()

    def closed(self, transport: asyncio.BaseTransport) -> None:
        """Count a connection out."""
        self.busy(transport)
        self._open.pop(transport, None)


class Watched(asyncio.Protocol):
    """A server's protocol whose connection is counted and timed."""

    def __init__(self, inner: asyncio.Protocol, connections: Connections) -> None:
        self._inner, self._connections = inner, connections
        self._transport: asyncio.BaseTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Let in, or hang up."""
        if self._connections.opened(transport):
            self._transport = transport
            self._inner.connection_made(transport)
        else:
            transport.close()

    def data_received(self, data: bytes) -> None:
        """Hand on."""
        if self._transport:
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Hand on."""
        return self._inner.eof_received() if self._transport else None

    def connection_lost(self, exc: Exception | None) -> None:
        """Count out."""
        if self._transport:
            self._connections.closed(self._transport)
            self._inner.connection_lost(exc)

    def pause_writing(self) -> None:
        """Hand on."""
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Hand on."""
        self._inner.resume_writing()


def is_local(request: web.Request) -> bool:
    """Tell whether a request came over the Unix socket."""
    link = _socket_of(request)
    return link is not None and link.family == socket.AF_UNIX


def _socket_of(request: web.Request) -> Any:
    return request.transport.get_extra_info("socket") if request.transport else None


def _same_user(request: web.Request) -> bool:
    """Ask the kernel who is at the other end of a Unix socket."""
    link = _socket_of(request)
    if link is None or not hasattr(socket, "SO_PEERCRED"):
        return link is not None
    _, uid, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return uid in {os.getuid(), 0}


class Guard:
    """Stands before every handler.

    Parameters
    ----------
    token
        What TCP clients must show.
    open_paths
        Given without a token: the files of the page, which say nothing.
    connections
        To be told when a request begins and ends.
    """

    def __init__(self, token: str, open_paths: frozenset[str], connections: Connections) -> None:
        self._token, self._open_paths, self._connections = token, open_paths, connections
        self.hosts: frozenset[str] = frozenset()
        self.codes: dict[int, int] = {}

    def serve_tcp(self, port: int) -> None:
        """Set which names of this machine are ours."""
        self.hosts = frozenset(f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]"))

    def middleware(self) -> Middleware:
        """For ``web.Application``."""

        @web.middleware
        async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self.pass_on(request, handler)

        return guard

    async def pass_on(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse, or let handle; every error becomes JSON."""
        self._connections.busy(request.transport)
        try:
            response = self._refuse(request) or await self._handle(request, handler)
        finally:
            self._connections.waiting(request.transport)
        self.codes[response.status] = self.codes.get(response.status, 0) + 1
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    def _refuse(self, request: web.Request) -> web.Response | None:
        if is_local(request):
            if not _same_user(request):
                return refusal(403, "peer", "this socket serves another user")
        elif refused := self._refuse_tcp(request):
            return refused
        if request.method in {"GET", "HEAD", "OPTIONS"}:
            return None
        return self._refuse_verb(request)

    def _refuse_tcp(self, request: web.Request) -> web.Response | None:
        host, origins = request.headers.getall("Host", []), request.headers.getall("Origin", [])
        if len(host) != 1 or host[0].lower() not in self.hosts:
            return refusal(
                403, "host", "the Host is not this daemon's", "use the address that the daemon printed"
            )
        ours = {f"http://{name}" for name in self.hosts}
        if any(origin.lower() not in ours for origin in origins):
            return refusal(403, "origin", "pages of other sites may not ask")
        if request.headers.get("Sec-Fetch-Site", "none") not in {"none", "same-origin"}:
            return refusal(403, "origin", "pages of other sites may not ask")
        if request.method == "GET" and request.path in self._open_paths:
            return None
        scheme, _, shown = request.headers.get("Authorization", "").partition(" ")
        right = hmac.compare_digest(shown.encode("utf-8", "surrogateescape"), self._token.encode())
        if scheme.lower() != "bearer" or not right:
            headers = {"WWW-Authenticate": "Bearer"}
            return refusal(401, "token", "expected the daemon's token", "tofcapture status --url", headers)
        return None

    def _refuse_verb(self, request: web.Request) -> web.Response | None:
        if request.headers.get("X-Tofcapture") != "1":
            return refusal(403, "header", "expected the header X-Tofcapture: 1")
        if request.content_type != "application/json":
            return refusal(415, "type", f"expected application/json, got {request.content_type[:80]}")
        return None

    async def _handle(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            return await handler(request)
        except web.HTTPException as err:
            allow = {"Allow": err.headers["Allow"]} if "Allow" in err.headers else None
            return refusal(err.status, "http", err.reason, headers=allow)
        except TofError as err:
            return refusal(_code(err), type(err).__name__, err.message, err.hint)
        except TimeoutError:
            answer = refusal(408, "slow", f"the body did not come within {_BODY:.0f} s")
            answer.force_close()
            return answer


def _code(err: TofError) -> int:
    for kind, code in ((DataError, 404), (BusyError, 409), (UsageError, 422)):
        if isinstance(err, kind):
            return code
    return 422


async def body_of(request: web.Request) -> Any:
    """Read the body as strict JSON.

    Raises
    ------
    web.HTTPException
        400 when it is none, 413 when it is too large.
    TimeoutError
        It came too slowly.
    """
    import json

    async with asyncio.timeout(_BODY):
        data = await request.read()
    try:
        return json.loads(data.decode("utf-8"), parse_constant=_no_constant, parse_float=_number)
    except (ValueError, RecursionError) as err:
        raise web.HTTPBadRequest(reason="the body is not JSON") from err


def _number(text: str) -> float | int:
    """A whole number may be written 25.0."""
    value = float(text)
    return int(value) if value.is_integer() else value


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")
