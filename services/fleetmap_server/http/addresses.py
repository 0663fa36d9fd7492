"""The server's own address as the client wrote it, and links made of it."""

from __future__ import annotations

from typing import Any

from fastapi import Request
from starlette.datastructures import URL

from fleetmap_server.http.stac_documents import GEOJSON, link
from fleetmap_server.problems import BadRequestError


def base_address(request: Request) -> str:
    """Scheme, host and mount point, without a slash at the end. Raises BadRequestError for a nonsensical Host."""
    return str(_checked(request).base_url).rstrip("/")


def page_links(request: Request, token: str | None, body: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """Links from a page of items to itself, to the next page and to the landing page.

    Args:
        request: that the page answers.
        token: of the next page; None if this is the last.
        body: of the request, if it was a POST.
    """
    url = _checked(request).url
    links = [link("root", f"{base_address(request)}/", "application/json", "the landing page")]
    if body is None:
        links.append(link("self", str(url), GEOJSON, "this page"))
        if token is not None:
            links.append(_next(url.include_query_params(token=token)) | {"method": "GET"})
    elif token is not None:
        links.append(_next(url) | {"method": "POST", "body": {**body, "token": token}})
    return links


def _next(url: URL) -> dict[str, Any]:
    return link("next", str(url), GEOJSON, "the next page")


def _checked(request: Request) -> Request:
    try:
        _ = request.url.hostname, request.url.port, request.base_url
    except ValueError as error:
        raise BadRequestError(f"the Host header does not hold: {error}") from error
    return request
