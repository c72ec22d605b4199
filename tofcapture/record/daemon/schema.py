"""The API as data: what may be asked, what is answered. Requests are checked against it, docs/openapi.json is made from it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from tofcapture import __version__
from tofcapture.errors import UsageError

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"

JOB_WISH: dict[str, Any] = {
    "type": "object",
    "additionalProperties": False,
    "required": ["scene", "recording"],
    "properties": {
        "scene": {
            "type": "string",
            "pattern": _NAME,
            "description": "what stands on the table; 'calibration' for the board",
        },
        "recording": {"type": "string", "pattern": _NAME, "description": "folder under the daemon's root"},
        "views": {"type": "integer", "minimum": 1, "maximum": 1000, "default": 25},
        "frames": {"type": "integer", "minimum": 1, "maximum": 1000, "default": 10},
        "seed": {
            "type": "integer",
            "minimum": 0,
            "maximum": 2**31 - 1,
            "description": "of the simulated station",
        },
        "request_id": {
            "type": "string",
            "pattern": _NAME,
            "description": "made by the client; asking twice queues once",
        },
    },
}
NOTHING: dict[str, Any] = {"type": "object", "additionalProperties": False, "properties": {}}
_ERROR: dict[str, Any] = {
    "type": "object",
    "required": ["error"],
    "properties": {
        "error": {
            "type": "object",
            "required": ["kind", "message", "hint"],
            "properties": {key: {"type": "string"} for key in ("kind", "message", "hint")},
        }
    },
}
_JOB: dict[str, Any] = {
    "type": "object",
    "required": ["id", "scene", "recording", "state", "reason"],
    "properties": {
        "id": {"type": "integer"},
        "state": {"enum": ["queued", "running", "done", "failed", "stopped"]},
        "reason": {"type": "string"},
        "scene": {"type": "string"},
        "recording": {"type": "string"},
    },
}
_STATE: dict[str, Any] = {
    "type": "object",
    "required": ["version", "phase", "reason", "job", "progress", "doing", "queue", "health", "last_event"],
    "properties": {
        "phase": {"enum": ["idle", "recording", "pausing", "paused", "stopping"]},
        "reason": {"type": "string"},
        "job": {"oneOf": [{"$ref": "#/components/schemas/Job"}, {"type": "null"}]},
        "progress": {"type": "object"},
        "root": {"type": "string"},
        "last_event": {"type": "integer"},
    },
}
_VIEWS: dict[str, Any] = {
    "type": "object",
    "required": ["job", "views"],
    "properties": {"views": {"type": "array", "items": {"type": "object"}}},
}
_JOBS: dict[str, Any] = {
    "type": "object",
    "required": ["jobs"],
    "properties": {"jobs": {"type": "array", "items": {"$ref": "#/components/schemas/Job"}}},
}
_PAGE: dict[str, Any] = {
    "type": "object",
    "required": ["url"],
    "properties": {"url": {"type": ["string", "null"]}},
}
_SCHEMAS = {
    "Error": _ERROR,
    "Job": _JOB,
    "Jobs": _JOBS,
    "JobWish": JOB_WISH,
    "Nothing": NOTHING,
    "Page": _PAGE,
    "State": _STATE,
    "Views": _VIEWS,
}

ERRORS = {
    400: "the body is no JSON object, or a parameter is wrong",
    401: "no token, or a wrong one (TCP only)",
    403: "foreign Host or Origin, another user, or the header X-Tofcapture is missing",
    404: "there is no such thing",
    405: "there is no such verb",
    408: "the body came too slowly",
    409: "it contradicts what was asked before, or the queue is full",
    413: "the body is larger than 64 KiB",
    415: "the body is not application/json",
    422: "a field is missing, unknown, or has a wrong value",
    503: "too many event streams",
}
_JSON, _REF = "application/json", "#/components/schemas/"


def check(schema: Mapping[str, Any], value: Any, where: str = "body") -> None:
    """Make sure that a value is what a schema of this module says.

    Raises
    ------
    UsageError
        The first thing that is wrong.
    """
    kind = schema.get("type")
    if kind == "object":
        _check_object(schema, value, where)
    elif kind == "string":
        # fullmatch: in Python "$" also matches ahead of a newline.
        if not isinstance(value, str) or not re.fullmatch(schema["pattern"].strip("^$"), value):
            raise UsageError(f"{where}: expected text like {schema['pattern']}, got {str(value)[:80]!r}")
    elif kind == "integer":
        low, high = schema["minimum"], schema["maximum"]
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not whole or not low <= value <= high:
            raise UsageError(f"{where}: expected a whole number from {low} to {high}, got {str(value)[:40]}")


def _check_object(schema: Mapping[str, Any], value: Any, where: str) -> None:
    if not isinstance(value, dict):
        raise UsageError(f"{where}: expected an object, got {type(value).__name__}")
    known = schema["properties"]
    if unknown := sorted(value.keys() - known.keys()):
        raise UsageError(f"{where}: does not know {unknown[0][:80]!r}", hint=f"it knows {', '.join(known)}")
    if missing := [key for key in schema.get("required", ()) if key not in value]:
        raise UsageError(f"{where}: {missing[0]} is missing")
    for key, found in value.items():
        check(known[key], found, f"{where}.{key}")


def defaults(schema: Mapping[str, Any]) -> dict[str, Any]:
    """The values of fields that need not be given."""
    return {k: s["default"] for k, s in schema["properties"].items() if "default" in s}


def _answer(text: str, schema: str | None, media: str = _JSON) -> dict[str, Any]:
    body: dict[str, Any] = {"$ref": _REF + schema} if schema else {"type": "string"}
    return {"description": text, "content": {media: {"schema": body}}}


def _get(
    summary: str, answer: dict[str, Any], *extra: int, parameters: tuple[Any, ...] = ()
) -> dict[str, Any]:
    return _operation(summary, {"200": answer}, (401, 403, *extra), parameters)


def _post(
    summary: str, answers: dict[str, Any], body: str, *extra: int, parameters: tuple[Any, ...] = ()
) -> dict[str, Any]:
    header = {
        "name": "X-Tofcapture",
        "in": "header",
        "required": True,
        "schema": {"type": "string", "enum": ["1"]},
        "description": "no page of another site can send it unasked",
    }
    out = _operation(summary, answers, (400, 401, 403, 408, 413, 415, 422, *extra), (header, *parameters))
    out["requestBody"] = {"required": True, "content": {_JSON: {"schema": {"$ref": _REF + body}}}}
    return out


def _operation(
    summary: str, answers: dict[str, Any], errors: tuple[int, ...], parameters: tuple[Any, ...]
) -> dict[str, Any]:
    responses = {**answers, **{str(code): _answer(ERRORS[code], "Error") for code in sorted(set(errors))}}
    out: dict[str, Any] = {"summary": summary, "responses": responses}
    return {**out, "parameters": list(parameters)} if parameters else out


def _paths() -> dict[str, Any]:
    state = _answer("the state after it", "State")
    number = {
        "name": "id",
        "in": "path",
        "required": True,
        "schema": {"type": "integer", "minimum": 1, "maximum": 2**53},
    }
    name = {
        "name": "name",
        "in": "path",
        "required": True,
        "schema": {"enum": ["amplitude", "depth", "stereo"]},
    }
    after = {
        "name": "after",
        "in": "query",
        "schema": {"type": "integer", "minimum": 0, "maximum": 2**53},
        "description": "start behind this event; the header Last-Event-ID does the same",
    }
    made = {"200": _answer("asked before", "Job"), "201": _answer("queued", "Job")}
    return {
        "/v1/state": {"get": _get("everything at a glance", _answer("the state", "State"))},
        "/v1/views": {"get": _get("views of the job in hand, or of the last one", _answer("views", "Views"))},
        "/v1/jobs": {
            "get": _get("the newest 100 jobs, newest first", _answer("jobs", "Jobs")),
            "post": _post("queue a scene", made, "JobWish", 409),
        },
        "/v1/jobs/{id}": {"get": _get("one job", _answer("the job", "Job"), 404, parameters=(number,))},
        "/v1/jobs/{id}/cancel": {
            "post": _post(
                "take it out of the queue; a running one is stopped",
                {"200": _answer("the job", "Job")},
                "Nothing",
                404,
                parameters=(number,),
            )
        },
        **{
            f"/v1/{verb}": {"post": _post(text, {"200": state}, "Nothing")}
            for verb, text in (
                ("pause", "rest after the view in hand"),
                ("resume", "go on"),
                ("stop", "stop the arm now and give the job up; always accepted"),
                ("confirm", "the scene that was asked for is placed"),
            )
        },
        "/v1/events": {
            "get": _get(
                "what happens, as server-sent events, without end",
                _answer("events", None, "text/event-stream"),
                400,
                503,
                parameters=(after,),
            )
        },
        "/v1/preview/{name}": {
            "get": _get("the latest picture", _answer("PNG", None, "image/png"), 404, parameters=(name,))
        },
        "/v1/page": {
            "get": _get("where the page is, token included", _answer("its address, null without TCP", "Page"))
        },
        "/metrics": {"get": _get("for Prometheus", _answer("metrics", None, "text/plain"))},
        "/openapi.json": {
            "get": _get(
                "this document",
                {"description": "OpenAPI", "content": {_JSON: {"schema": {"type": "object"}}}},
            )
        },
    }


def document() -> dict[str, Any]:
    """The OpenAPI document."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "tofcapture daemon",
            "version": __version__,
            "summary": "Records scenes, one after the other; over a Unix socket, or loopback TCP with a token.",
        },
        "paths": _paths(),
        "security": [{"token": []}],
        "components": {
            "schemas": _SCHEMAS,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


if __name__ == "__main__":
    import json

    print(json.dumps(document(), indent=1))
