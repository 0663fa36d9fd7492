"""Whether a client would rather have a page to look at than data (RFC 9110, 12.5.1)."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from starlette.datastructures import Headers
from starlette.routing import Match
from starlette.types import Scope

from fleetmap.errors import FleetmapError
from fleetmap_server.http.html import element
from fleetmap_server.http.page_layout import page
from fleetmap_server.problems import BadRequestError, UnauthorizedError, problem_of


class PageRoute(APIRoute):
    """A route that is there only for those who ask for HTML; to everybody else the next one with its path is.

    What goes wrong becomes a page too.
    """

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """As every route does, but only for who would rather have HTML."""
        if scope["type"] == "http" and not prefers_html(Headers(scope=scope).get("accept", "")):
            return Match.NONE, {}
        return super().matches(scope)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """As every route has one, with errors that a person can read."""
        handle = super().get_route_handler()

        async def explain(request: Request) -> Response:
            try:
                return await handle(request)
            except UnauthorizedError:
                raise  # the browser is to ask for the token
            except (FleetmapError, RequestValidationError) as error:
                return _problem_page(error)

        return explain


def prefers_html(accept: str) -> bool:
    """Whether HTML is asked for by name, and nothing that is JSON, or anything at all, rather."""
    wanted = dict.fromkeys(("text/html", "application/xhtml+xml"), 0.0)
    others = 0.0
    for media_range in accept.split(","):
        name, *parameters = (field.strip().lower() for field in media_range.split(";"))
        quality = _quality(parameters)
        if name in wanted:
            wanted[name] = max(wanted[name], quality)
        elif name == "*/*" or (name.startswith("application/") and (name.endswith("json") or name[-1] == "*")):
            others = max(others, quality)
    return max(wanted.values()) > 0.0 and max(wanted.values()) >= others


def _problem_page(error: FleetmapError | RequestValidationError) -> Response:
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        error = BadRequestError(f"'{first['loc'][-1]}' does not hold: {first['msg']}")
    problem = problem_of(error)
    return page(problem.title, element("h1", problem.title), element("p", problem.detail), status=problem.status)


def _quality(parameters: list[str]) -> float:
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                return min(max(float(value), 0.0), 1.0)
            except ValueError:
                return 0.0
    return 1.0
