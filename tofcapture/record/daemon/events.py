"""Server-sent events: every client gets what happens, from where it left off; a slow one is dropped, never waited for."""

from __future__ import annotations

import asyncio

from aiohttp import web

from tofcapture.record.daemon.guard import HEADERS, refusal
from tofcapture.record.daemon.store import Event, Store

MOST_STREAMS = 512
_BACKLOG = 256  # events that a client may be behind
_QUIET = 15.0  # s without an event until a comment shows that the line stands
_WRITE = 20.0  # s that a client may take to read

_Queue = asyncio.Queue[tuple[int, bytes] | None]  # (id, text) of events; None ends the stream


class Streams:
    """All open event streams."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._queues: set[_Queue] = set()
        self._closed = False

    def __len__(self) -> int:
        return len(self._queues)

    def publish(self, event: Event) -> None:
        """Hand an event to every client; encoded once."""
        item = (event.id, event.text())
        for queue in self._queues:
            if queue.qsize() < _BACKLOG:
                queue.put_nowait(item)
            else:
                _end(queue)

    def close(self) -> None:
        """End all streams; clients come back when there is a daemon again."""
        self._closed = True
        for queue in self._queues:
            _end(queue)

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Stream to one client until it leaves."""
        if self._closed or len(self._queues) >= MOST_STREAMS:
            return refusal(503, "streams", f"expected at most {MOST_STREAMS} event streams")
        after = _after(request)
        response = web.StreamResponse(headers={**HEADERS, "Content-Type": "text/event-stream"})
        queue: _Queue = asyncio.Queue()
        self._queues.add(queue)
        try:
            await response.prepare(request)
            await self._feed(response, queue, after)
        except (ConnectionError, TimeoutError):
            pass
        finally:
            self._queues.discard(queue)
        return response

    async def _feed(self, response: web.StreamResponse, queue: _Queue, after: int | None) -> None:
        last = self._store.last_event() if after is None else after
        await _write(response, b"retry: 1000\n: hello\n\n")
        for event in self._store.events(last) if after is not None else ():
            await _write(response, event.text())
            last = event.id
        while True:
            try:
                async with asyncio.timeout(_QUIET):
                    item = await queue.get()
            except TimeoutError:
                item = (0, b": alive\n\n")
            if item is None:
                return
            number, text = item
            if number == 0 or number > last:
                await _write(response, text)


def _end(queue: _Queue) -> None:
    while not queue.empty():
        queue.get_nowait()
    queue.put_nowait(None)


async def _write(response: web.StreamResponse, text: bytes) -> None:
    async with asyncio.timeout(_WRITE):
        await response.write(text)


def _after(request: web.Request) -> int | None:
    """Read where a client left off; ``None`` when it wants only what is new."""
    given = request.query.get("after", request.headers.get("Last-Event-ID"))
    if given is None:
        return None
    if not (given.isascii() and given.isdigit() and len(given) <= 16):
        raise web.HTTPBadRequest(reason="after: expected the number of an event")
    return int(given)
