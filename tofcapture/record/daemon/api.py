"""What each path of the API does; ``schema`` says what may be asked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from tofcapture.record.daemon.events import Streams
from tofcapture.record.daemon.guard import BODY_LIMIT, Guard, Handler, body_of
from tofcapture.record.daemon.preview import NAMES
from tofcapture.record.daemon.schema import JOB_WISH, NOTHING, check, defaults, document
from tofcapture.record.daemon.snapshot import health, snapshot
from tofcapture.record.daemon.supervisor import Supervisor

PAGE = Path(__file__).with_name("page")
PAGE_FILES = {
    "/": ("index.html", "text/html"),
    "/app.js": ("app.js", "text/javascript"),
    "/picture.js": ("picture.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}


class Api:
    """The handlers of one daemon."""

    def __init__(self, supervisor: Supervisor, streams: Streams, guard: Guard) -> None:
        self._do, self._streams, self._guard = supervisor, streams, guard
        self.page_url: str | None = None

    def application(self) -> web.Application:
        """Everything routed."""
        app = web.Application(middlewares=[self._guard.middleware()], client_max_size=BODY_LIMIT)
        routes: list[tuple[str, str, Handler]] = [
            ("GET", "/v1/state", self.state),
            ("GET", "/v1/views", self.views),
            ("GET", "/v1/jobs", self.jobs),
            ("POST", "/v1/jobs", self.add),
            ("GET", "/v1/jobs/{id}", self.job),
            ("POST", "/v1/jobs/{id}/cancel", self.cancel),
            ("GET", "/v1/events", self._streams.serve),
            ("GET", "/v1/preview/{name}", self.preview),
            ("GET", "/v1/page", self.page),
            ("GET", "/metrics", self.metrics),
            ("GET", "/openapi.json", self.openapi),
            *(
                (("POST", f"/v1/{verb}", self._verb(getattr(self._do, verb))))
                for verb in ("pause", "resume", "stop", "confirm")
            ),
            *(("GET", path, _file(*file)) for path, file in PAGE_FILES.items()),
        ]
        for method, path, handler in routes:
            app.router.add_route(method, path, handler)
        return app

    async def state(self, request: web.Request) -> web.Response:
        """Everything at a glance."""
        del request
        return web.json_response(snapshot(self._do))

    async def views(self, request: web.Request) -> web.Response:
        """Views of the job in hand."""
        del request
        return web.json_response(self._do.progress.table())

    async def jobs(self, request: web.Request) -> web.Response:
        """The newest jobs."""
        del request
        return web.json_response({"jobs": [job.table() for job in self._do.store.jobs()]})

    async def add(self, request: web.Request) -> web.Response:
        """Queue a scene."""
        wish = await body_of(request)
        check(JOB_WISH, wish)
        job, new = self._do.add({**defaults(JOB_WISH), **wish})
        return web.json_response(job.table(), status=201 if new else 200)

    async def job(self, request: web.Request) -> web.Response:
        """One job."""
        return web.json_response(self._do.store.job(_number(request)).table())

    async def cancel(self, request: web.Request) -> web.Response:
        """Take a job out."""
        check(NOTHING, await body_of(request))
        return web.json_response(self._do.cancel(_number(request)).table())

    async def preview(self, request: web.Request) -> web.Response:
        """The latest picture."""
        name = request.match_info["name"]
        path = self._do.settings.state.previews / f"{name}.png"
        if name not in NAMES or not path.exists():
            raise web.HTTPNotFound(reason="there is no such picture yet")
        return web.Response(body=path.read_bytes(), content_type="image/png")

    async def page(self, request: web.Request) -> web.Response:
        """Where the page is."""
        del request
        return web.json_response({"url": self.page_url})

    async def openapi(self, request: web.Request) -> web.Response:
        """The API's description."""
        del request
        return web.json_response(document())

    async def metrics(self, request: web.Request) -> web.Response:
        """Numbers for Prometheus."""
        del request
        return web.Response(text="\n".join(self._metrics()) + "\n", content_type="text/plain")

    def _metrics(self) -> list[str]:
        do = self._do
        found = health(do)
        values: dict[str, Any] = {
            "views_sealed_total": do.sealed,
            "views_failed_total": do.failed,
            "recorder_restarts_total": do.restarts,
            "recorder_up": int(found["recorder"] == "alive"),
            "paused": int(do.phase == "paused"),
            "disk_free_bytes": found["disk_free_bytes"] or 0,
            "event_streams": len(self._streams),
        }
        lines = []
        for name, value in values.items():
            kind = "counter" if name.endswith("_total") else "gauge"
            lines += [f"# TYPE tofcapture_{name} {kind}", f"tofcapture_{name} {value}"]
        lines.append("# TYPE tofcapture_jobs gauge")
        lines += [f'tofcapture_jobs{{state="{state}"}} {n}' for state, n in do.store.counts().items()]
        lines.append("# TYPE tofcapture_http_responses_total counter")
        lines += [f'tofcapture_http_responses_total{{code="{c}"}} {n}' for c, n in self._guard.codes.items()]
        return lines

    def _verb(self, verb: Callable[[], object]) -> Handler:
        async def handle(request: web.Request) -> web.Response:
            check(NOTHING, await body_of(request))
            verb()
            return web.json_response(snapshot(self._do))

        return handle


def _number(request: web.Request) -> int:
    given = request.match_info["id"]
    if not (given.isascii() and given.isdigit() and len(given) <= 16):
        raise web.HTTPNotFound(reason="there is no such job")
    return int(given)


def _file(name: str, kind: str) -> Handler:
    async def handle(request: web.Request) -> web.Response:
        del request
        return web.Response(body=(PAGE / name).read_bytes(), content_type=kind, charset="utf-8")

    return handle
