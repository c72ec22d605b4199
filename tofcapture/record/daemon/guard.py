"""Define who may ask, and how slowly: everything that is decided before a request is looked at.

Over the Unix socket: this user (or root), known from the kernel. Over TCP: a Host that is ours (no DNS rebinding), no foreign
Origin, and the token. Over both: verbs need a header that no foreign page can send, and JSON that says so.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import os
import socket
import struct
import time
import traceback
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from typing import Any

from aiohttp import web
from aiohttp.http_exceptions import PayloadEncodingError
from aiohttp.web_protocol import RequestHandler

from tofcapture.errors import BusyError, DataError, TofError, UnreadableError
from tofcapture.files.disk import DamagedError, DiskFull

BODY_LIMIT = 64 * 1024  # bytes
MOST_CONNECTIONS = 1024
MOST_STRANGERS = 256  # connections of each listener that have not shown yet that they may ask
IDLE = 30.0  # s that a connection may take to send a request, or to take an answer
_BODY = 5.0  # s for a body
_CODES: dict[type[TofError], int] = {
    DamagedError: 500, UnreadableError: 500, DataError: 404, BusyError: 409, DiskFull: 507, TofError: 422
}  # fmt: skip

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
    """Answer with an error; every error looks like this."""
    body = {"error": {"kind": kind, "message": message, "hint": hint}}
    return web.json_response(body, status=code, headers=headers)


class Guard:
    """Stands before every handler: TCP clients must show the token, but for the files of the page, which say nothing."""

    def __init__(self, token: str, open_paths: frozenset[str]) -> None:
        self._token, self._open_paths = token, open_paths
        self._hosts: frozenset[str] = frozenset()
        self._busy: set[RequestHandler] = set()
        self._waiting: dict[RequestHandler, float] = {}  # since when
        self._strangers: list[dict[RequestHandler, None]] = []  # of each listener, the oldest first
        self.codes: dict[int, int] = {}

    def serve_tcp(self, port: int) -> None:
        """Set which names of this machine are ours."""
        self._hosts = frozenset(f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]"))

    def door(self, server: web.Server) -> Callable[[], RequestHandler]:
        """Let one listener's connections in. Of strangers the oldest goes when there are too many: there is always room."""
        strangers: dict[RequestHandler, None] = {}
        self._strangers.append(strangers)

        def enter() -> RequestHandler:
            if len(strangers) >= MOST_STRANGERS:
                oldest = next(iter(strangers))
                del strangers[oldest]
                if oldest.transport is not None:
                    oldest.transport.abort()
            strangers[stranger := server()] = None
            return stranger

        return enter

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse, or let handle; every error becomes JSON."""
        self._busy.add(request.protocol)
        try:
            response: web.StreamResponse | None = self._refuse(request)
            if response is None:
                for strangers in self._strangers:
                    strangers.pop(request.protocol, None)
                response = await _handle(request, handler)
        finally:
            self._busy.discard(request.protocol)
            self._waiting[request.protocol] = time.monotonic()
        self.codes[response.status] = self.codes.get(response.status, 0) + 1
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def hang_up(self, server: web.Server) -> None:
        """Close connections that take too long, to ask or to take an answer, and those that are too many."""
        while True:
            now, known = time.monotonic(), self._waiting
            self._waiting = {c: known.get(c, now) for c in server.connections if c not in self._busy}
            slow = [c for c, since in self._waiting.items() if now - since > IDLE]
            excess = max(0, len(server.connections) - MOST_CONNECTIONS)
            for connection in (*slow, *list(self._waiting)[::-1][:excess]):
                if connection.transport is not None:
                    connection.transport.abort()
            await asyncio.sleep(min(1.0, IDLE / 4))

    def _refuse(self, request: web.Request) -> web.Response | None:
        link = request.transport.get_extra_info("socket") if request.transport else None
        if link is not None and link.family == socket.AF_UNIX:
            if not _same_user(link):
                return refusal(403, "peer", "this socket serves another user")
        elif refused := self._refuse_tcp(request):
            return refused
        if request.method in {"GET", "HEAD", "OPTIONS"}:
            return None
        if request.headers.get("X-Tofcapture") != "1":
            return refusal(403, "header", "expected the header X-Tofcapture: 1")
        if request.content_type != "application/json":
            return refusal(415, "type", f"expected application/json, got {request.content_type[:80]}")
        return None

    def _refuse_tcp(self, request: web.Request) -> web.Response | None:
        host, origins = request.headers.getall("Host", []), request.headers.getall("Origin", [])
        if len(host) != 1 or host[0].lower() not in self._hosts:
            hint = "use the address that the daemon printed"
            return refusal(403, "host", "the Host is not this daemon's", hint)
        ours = {f"http://{name}" for name in self._hosts}
        foreign = any(origin.lower() not in ours for origin in origins)
        if foreign or request.headers.get("Sec-Fetch-Site", "none") not in {"none", "same-origin"}:
            return refusal(403, "origin", "pages of other sites may not ask")
        if request.method == "GET" and request.path in self._open_paths:
            return None
        scheme, _, shown = request.headers.get("Authorization", "").partition(" ")
        right = hmac.compare_digest(shown.encode("utf-8", "surrogateescape"), self._token.encode())
        if scheme.lower() != "bearer" or not right:
            headers = {"WWW-Authenticate": "Bearer"}
            return refusal(401, "token", "expected the daemon's token", "tofcapture status --url", headers)
        return None


def _same_user(link: Any) -> bool:
    """Ask the kernel who is at the other end of a Unix socket."""
    if not hasattr(socket, "SO_PEERCRED"):
        return True
    _, uid, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return uid in {os.getuid(), 0}


async def _handle(request: web.Request, handler: Handler) -> web.StreamResponse:
    try:
        return await handler(request)
    except web.HTTPException as err:
        allow = {"Allow": err.headers["Allow"]} if "Allow" in err.headers else None
        return refusal(err.status, "http", err.reason, headers=allow)
    except TofError as err:
        code = next(code for kind, code in _CODES.items() if isinstance(err, kind))
        return refusal(code, type(err).__name__, err.message, err.hint)
    except TimeoutError:
        answer = refusal(408, "slow", f"the body did not come within {_BODY:.0f} s")
        answer.force_close()
        return answer
    except PayloadEncodingError as err:
        return refusal(400, "http", f"the body cannot be read: {err.message}")
    except Exception as err:
        traceback.print_exc()
        return refusal(500, type(err).__name__, str(err), "the daemon's log says where")


def speak_json() -> None:
    """Have aiohttp's own refusals, of what is no HTTP, look like ours."""
    usual = RequestHandler.handle_error

    def handle_error(handler: RequestHandler, request: Any, status: int = 500, *more: Any) -> web.Response:
        usual(handler, request, status, *more)  # logs it, and raises where an answer has begun
        answer = refusal(status, "http", _phrase(status), "send HTTP/1.1", HEADERS)
        answer.force_close()
        return answer

    RequestHandler.handle_error = handle_error  # type: ignore[method-assign, assignment]


def _phrase(status: int) -> str:
    return HTTPStatus(status).description or HTTPStatus(status).phrase


async def body_of(request: web.Request) -> Any:
    """Read the body as strict JSON.

    Raises :class:`web.HTTPException`: 400, it is none, or 413, it is too large; :class:`TimeoutError`: it came too slowly.
    """
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
