"""The API: what may be asked, what is checked of it, what is answered. One table of routes serves and documents.

``python -m tofcapture.record.daemon.app`` prints the OpenAPI document that is made of the routes (docs/openapi.json).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from aiohttp import web

from tofcapture import __version__
from tofcapture.errors import UsageError
from tofcapture.record.daemon.guard import BODY_LIMIT, Guard, Handler, body_of
from tofcapture.record.daemon.settings import PICTURES
from tofcapture.record.daemon.store import Streams
from tofcapture.record.daemon.supervisor import Supervisor

PAGE = Path(__file__).with_name("page")
PAGE_FILES = {
    "/": ("index.html", "text/html"),
    "/app.js": ("app.js", "text/javascript"),
    "/picture.js": ("picture.js", "text/javascript"),
    "/words.js": ("words.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}

_STREAM = "/v1/events"
_LOG = timedelta(hours=12)

Schema = dict[str, Any]
_TOLD = json.loads(Path(__file__).with_name("api.json").read_text(encoding="utf-8"))
SCHEMAS: Schema = _TOLD["schemas"]  # of bodies and answers
ERRORS: Schema = _TOLD["errors"]  # what each code means
PARAMETERS: Schema = _TOLD["parameters"]  # of paths, queries and headers


def check(schema: Mapping[str, Any], value: Any, where: str = "body") -> None:
    """Make sure that a value is what a schema of this module says.

    Raises :class:`UsageError`: the first thing that is wrong.
    """
    if schema["type"] == "object":
        if not isinstance(value, dict):
            raise UsageError(f"{where}: expected an object, got {type(value).__name__}")
        known = schema["properties"]
        if unknown := sorted(value.keys() - known.keys()):
            raise UsageError(
                f"{where}: does not know {unknown[0][:80]!r}", hint=f"it knows {', '.join(known)}"
            )
        if missing := [key for key in schema.get("required", ()) if key not in value]:
            raise UsageError(f"{where}: {missing[0]} is missing")
        for key, found in value.items():
            check(known[key], found, f"{where}.{key}")
    elif schema["type"] == "boolean":
        if not isinstance(value, bool):
            raise UsageError(f"{where}: expected true or false, got {str(value)[:40]}")
    elif schema["type"] == "string":
        # fullmatch: in Python "$" also matches ahead of a newline.
        if not isinstance(value, str) or not re.fullmatch(schema["pattern"].strip("^$"), value):
            raise UsageError(f"{where}: expected text like {schema['pattern']}, got {str(value)[:80]!r}")
    else:
        low, high = schema["minimum"], schema["maximum"]
        if type(value) is not int or not low <= value <= high:
            raise UsageError(f"{where}: expected a whole number from {low} to {high}, got {str(value)[:40]}")


@dataclass(frozen=True)
class Route:
    """Something that may be asked: served by ``handler``, a method of :class:`Api`, and documented by its docstring.

    ``answer`` names a schema or a media type, ``body`` a schema; every POST has one. ``codes`` come besides the usual ones.
    """

    method: str
    path: str
    handler: Callable[..., Any]
    answer: str
    codes: tuple[int, ...]
    body: str | None

    def document(self) -> Schema:
        """Write the route's OpenAPI operation."""
        named = re.findall(r"{(\w+)}", self.path) + (["after"] if self.path == _STREAM else [])
        usual = (200, 400, 401, 403, 408, 413, 415, 422, 500, 507) if self.body else (200, 401, 403, 500)
        codes = sorted({*usual, *self.codes, *([404] if "{" in self.path else [])})
        answer = _content(self.answer)
        out: Schema = {
            "summary": (self.handler.__doc__ or "").rstrip("."),
            "responses": {
                str(code): {"description": ERRORS.get(str(code), self.answer)}
                | (answer if code < 400 else _content("Error"))
                for code in codes
            },
            "parameters": [
                {"name": key, **PARAMETERS[key]} for key in (["X-Tofcapture"] if self.body else []) + named
            ],
        }
        return out | ({"requestBody": {"required": True, **_content(self.body)}} if self.body else {})

    def bind(self, api: Api) -> Handler:
        """Make the handler that aiohttp calls; it checks what was given against the schemas."""

        async def handle(request: web.Request) -> web.StreamResponse:
            given: dict[str, Any] = dict(request.match_info)
            if self.body:
                schema, body = SCHEMAS[self.body], await body_of(request)
                check(schema, body)
                given |= {k: s["default"] for k, s in schema["properties"].items() if "default" in s} | body
            answer = self.handler(api, **given)
            return answer if isinstance(answer, web.Response) else web.json_response(answer)

        return handle


def _content(what: str) -> Schema:
    """A body of a schema, in JSON, or of a media type."""
    if what in SCHEMAS:
        return {"content": {"application/json": {"schema": {"$ref": f"#/components/schemas/{what}"}}}}
    return {"content": {what: {"schema": {"type": "string"}}}}


ROUTES: list[Route] = []
_Method = TypeVar("_Method", bound=Callable[..., Any])


def route(
    method: str, path: str, answer: str, *codes: int, body: str | None = None
) -> Callable[[_Method], _Method]:
    """Serve and document a method of :class:`Api`; see :class:`Route`."""

    def add(handler: _Method) -> _Method:
        ROUTES.append(Route(method, path, handler, answer, codes, body))
        return handler

    return add


def _job_number(text: str) -> int:
    if text.isascii() and text.isdigit() and len(text) <= 16:
        return int(text)
    raise web.HTTPNotFound(reason="there is no such job")


class Api:
    """Hold what one daemon does for each route."""

    def __init__(self, supervisor: Supervisor, streams: Streams, guard: Guard) -> None:
        self._do, self._streams, self._guard = supervisor, streams, guard
        self.page_url: str | None = None

    def application(self) -> web.Application:
        """Route everything."""
        app = web.Application(middlewares=[self._guard.middleware], client_max_size=BODY_LIMIT)
        for known in ROUTES:
            handler = self._streams.serve if known.path == _STREAM else known.bind(self)
            app.router.add_route(known.method, known.path, handler)
        for path, (name, kind) in PAGE_FILES.items():
            app.router.add_get(path, _page_file(name, kind))
        return app

    @route("GET", "/v1/state", "State")
    def state(self) -> Schema:
        """Everything at a glance."""
        return self._do.snapshot()

    @route("GET", "/v1/views", "Views")
    def views(self) -> Schema:
        """Views of the job in hand, or of the last one."""
        return self._do.progress.table()

    @route("GET", "/v1/jobs", "Jobs")
    def jobs(self) -> Schema:
        """The running job, all that wait, in their order, then the 100 that ended last."""
        store = self._do.store
        return {"jobs": [asdict(job) for job in (*store.ahead(), *store.ended())]}

    @route("POST", "/v1/jobs", "Job", 201, 409, body="JobRequest")
    def add(self, **request: Any) -> web.Response:
        """Queue a scene; 201 when it is new, 200 when the same request was made before."""
        job, new = self._do.add(request)
        return web.json_response(asdict(job), status=201 if new else 200)

    @route("GET", "/v1/jobs/{number}", "Job")
    def job(self, number: str) -> Schema:
        """One job."""
        return asdict(self._do.store.job(_job_number(number)))

    @route("POST", "/v1/jobs/{number}/cancel", "Job", body="Nothing")
    def cancel(self, number: str) -> Schema:
        """Take it out of the queue; a running one is stopped."""
        return asdict(self._do.cancel(_job_number(number)))

    @route("POST", "/v1/jobs/{number}/retry", "Job", 409, body="Consent")
    def retry(self, number: str, clear: bool) -> Schema:
        """Queue once more what an ended job asked for; the new job."""
        return asdict(self._do.retry(_job_number(number), clear))

    @route("POST", "/v1/jobs/{number}/move", "Job", 409, body="Place")
    def move(self, number: str, place: int) -> Schema:
        """Give a waiting job another place."""
        return asdict(self._do.reorder(_job_number(number), place))

    @route("POST", "/v1/pause", "State", body="Nothing")
    def pause(self) -> Schema:
        """Rest after the view in hand."""
        self._do.pause()
        return self.state()

    @route("POST", "/v1/resume", "State", body="Consent")
    def resume(self, clear: bool) -> Schema:
        """Go on."""
        self._do.resume(clear)
        return self.state()

    @route("POST", "/v1/stop", "State", body="Nothing")
    def stop(self) -> Schema:
        """Stop the arm now and give the job up; always accepted."""
        self._do.stop()
        return self.state()

    @route("POST", "/v1/confirm", "State", body="Consent")
    def confirm(self, clear: bool) -> Schema:
        """Say that the scene that was asked for is placed."""
        self._do.confirm(clear)
        return self.state()

    @route("GET", _STREAM, "text/event-stream", 400, 503)
    def events(self) -> None:
        """Tell what happens, as server-sent events, without end."""

    @route("GET", "/v1/log", "Log")
    def log(self) -> Schema:
        """What happened in the last twelve hours but single steps, oldest first, the newest 500 at most."""
        since = (datetime.now(UTC) - _LOG).isoformat(timespec="seconds")
        return {
            "events": [
                {**e.data, "id": e.id, "utc": e.utc, "event": e.kind} for e in self._do.store.log(since)
            ]
        }

    @route("GET", "/v1/preview/{name}", "image/png")
    def preview(self, name: str) -> web.Response:
        """The latest picture."""
        path = self._do.settings.state.previews / f"{name}.png"
        if name not in PICTURES or not path.exists():
            raise web.HTTPNotFound(reason="there is no such picture yet")
        return web.Response(body=path.read_bytes(), content_type="image/png")

    @route("GET", "/v1/page", "Page")
    def page(self) -> Schema:
        """Tell where the page is, token included; null without TCP."""
        return {"url": self.page_url}

    @route("GET", "/openapi.json", "Document")
    def openapi(self) -> Schema:
        """The description of this API."""
        return document()

    @route("GET", "/metrics", "text/plain")
    def metrics(self) -> web.Response:
        """Numbers for Prometheus."""
        found, counters = self._do.snapshot(), self._do.counters
        values = {
            "views_sealed_total": counters["sealed"],
            "views_failed_total": counters["failed"],
            "recorder_restarts_total": counters["restarts"],
            "recorder_up": int(found["health"]["recorder"] == "alive"),
            "paused": int(found["phase"] == "paused"),
            "disk_free_bytes": found["health"]["disk_free_bytes"] or 0,
            "event_streams": len(self._streams),
            **{f'jobs{{state="{state}"}}': n for state, n in found["queue"].items()},
            **{f'http_responses_total{{code="{code}"}}': n for code, n in self._guard.codes.items()},
        }
        kinds = {name.partition("{")[0]: "counter" if "_total" in name else "gauge" for name in values}
        lines = []
        for name, kind in kinds.items():
            lines.append(f"# TYPE tofcapture_{name} {kind}")
            lines += [f"tofcapture_{key} {n}" for key, n in values.items() if key.partition("{")[0] == name]
        return web.Response(text="\n".join(lines) + "\n", content_type="text/plain")


def _page_file(name: str, kind: str) -> Handler:
    async def handle(request: web.Request) -> web.Response:
        del request
        return web.Response(body=(PAGE / name).read_bytes(), content_type=kind, charset="utf-8")

    return handle


def document() -> Schema:
    """Write the OpenAPI document."""
    paths: dict[str, Schema] = {}
    for known in ROUTES:
        paths.setdefault(known.path, {})[known.method.lower()] = known.document()
    words = "Records scenes, one after the other; over a Unix socket, or loopback TCP with a token."
    token = {"token": {"type": "http", "scheme": "bearer"}}
    return {
        "openapi": "3.1.0",
        "info": {"title": "tofcapture daemon", "version": __version__, "summary": words},
        "paths": paths,
        "security": [{"token": []}],
        "components": {"schemas": SCHEMAS, "securitySchemes": token},
    }


if __name__ == "__main__":
    print(json.dumps(document(), indent=1))
