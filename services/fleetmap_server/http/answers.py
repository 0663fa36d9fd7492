"""How every answer that is no success leaves, and how the interface's own description tells of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.routing import Match

from fleetmap.errors import FleetmapError
from fleetmap.transport.protocol import Problem
from fleetmap_server.http.stac_documents import GEOJSON, OPENAPI
from fleetmap_server.problems import (
    PROBLEM_MEDIA_TYPE,
    BadRequestError,
    NotFoundError,
    UnauthorizedError,
    problem_of,
)

_REASONS = {
    304: "The client has it already",
    400: "The request does not say what it must",
    401: "A token is needed, or this one is not known",
    403: "The token may not do this",
    404: "There is no such thing",
    405: "Not by this method",
    409: "Somebody else was first, or something is missing",
    410: "It was retired",
    412: "A precondition does not hold",
    413: "Too large",
    415: "Not in this media type",
    416: "There is no such range",
    422: "Not acceptable as what it claims to be",
    460: "The checksum does not match",
    500: "The server failed, or stored data is damaged",
    503: "Not now",
    507: "The storage is full or failing",
}
_ALWAYS = (400, 401, 403, 500, 503, 507)  # may be the answer to any request
_CHALLENGE = 'Bearer realm="fleetmap", Basic realm="fleetmap: the token is the password", charset="UTF-8"'
_METHODS = ("get", "head", "post", "put", "patch", "delete", "options")


class GeoJsonAnswer(JSONResponse):
    """A success in GeoJSON."""

    media_type = GEOJSON


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What a route documents beside its success and what may always happen; for ``responses=``."""
    return {status: {"description": _REASONS[status], "content": _PROBLEM_CONTENT} for status in statuses}


_PROBLEM_CONTENT = {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}


def explain_errors(app: FastAPI) -> None:
    """Every error leaves as a problem document; routes raise and do not catch."""

    @app.exception_handler(FleetmapError)
    @app.exception_handler(Exception)
    def failed(request: Request, error: Exception) -> Response:
        headers = {"WWW-Authenticate": _CHALLENGE} if isinstance(error, UnauthorizedError) else None
        return problem_answer(problem_of(error), headers)

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> Response:
        return problem_answer(problem_of(BadRequestError(_what_is_wrong(error))))

    @app.exception_handler(HTTPException)
    def refused(request: Request, error: HTTPException) -> Response:
        if error.status_code == 404:
            return problem_answer(problem_of(NotFoundError(f"there is nothing at {request.url.path}")))
        title = _REASONS.get(error.status_code, error.detail)
        headers = {"Allow": _allowed(request)} if error.status_code == 405 else error.headers
        return problem_answer(Problem(title=title, status=error.status_code, detail=error.detail), headers)


def _what_is_wrong(error: RequestValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(step) for step in first["loc"][1:]) or first["loc"][0]
    if first["type"] == "json_invalid":
        return f"the body is no JSON: {first['ctx']['error']}"
    if first["type"] == "model_attributes_type":
        return f"the {where} is no JSON object that is sent as application/json"
    if first["type"] == "extra_forbidden":
        return f"'{where}' is nothing that can be asked for here"
    return f"'{where}' does not hold: {first['msg'].removeprefix('Value error, ')}"


def _allowed(request: Request) -> str:
    """The methods that any route has for this path (RFC 9110, 15.5.6); the router tells those of the first."""
    return ", ".join(
        method
        for method in (name.upper() for name in _METHODS)
        if any(
            route.matches({**request.scope, "method": method})[0] is Match.FULL
            for route in request.app.router.routes
        )
    )


def problem_answer(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    """A problem document as an answer; plain ASCII, as it may repeat what a client sent."""
    told = dict(headers or {})
    if problem.retry_after_s is not None:
        told["Retry-After"] = str(max(1, round(problem.retry_after_s)))
    content = json.dumps(problem.model_dump(exclude_none=True))
    return Response(content, problem.status, told, PROBLEM_MEDIA_TYPE)


def describe(app: FastAPI) -> None:
    """Serve the description of all routes at ``/api``, with the problems that any request may meet."""

    def description() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _with_problems(
                get_openapi(
                    title=app.title, version=app.version, openapi_version=app.openapi_version, routes=app.routes
                )
            )
        return app.openapi_schema

    app.openapi = description  # type: ignore[method-assign]  # FastAPI's documented way

    @app.get("/api", include_in_schema=False)
    def api() -> Response:
        return Response(json.dumps(app.openapi()), media_type=OPENAPI)


def _with_problems(schema: dict[str, Any]) -> dict[str, Any]:
    for path in schema["paths"].values():
        for method in _METHODS:
            if method in path:
                _document_problems(path[method])
    schemas = schema.setdefault("components", {}).setdefault("schemas", {})
    schemas["Problem"] = Problem.model_json_schema(mode="serialization")
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    schema["components"]["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer"},
        "password": {"type": "http", "scheme": "basic", "description": "the token is the password"},
    }
    schema["security"] = [{}, {"token": []}, {"password": []}]
    return schema


def _document_problems(operation: dict[str, Any]) -> None:
    """FastAPI tells of its own 422 for what is a 400 here."""
    responses = operation["responses"]
    if "application/json" in responses.get("422", {}).get("content", {}):
        del responses["422"]
    for status in _ALWAYS:
        responses.setdefault(str(status), problems(status)[status])
