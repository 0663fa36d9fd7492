"""Who may do what over HTTP, asked before every route."""

from __future__ import annotations

from fastapi import Request

from fleetmap.transport.operations import Right
from fleetmap_server.access import Access, token_of
from fleetmap_server.logs import name_caller

_FOR_EVERYBODY = frozenset({"/healthz", "/readyz"})
_READING_POSTS = frozenset({"/search", "/localize"})  # questions too long for an address
_FOR_WRITERS = "/drives/uploads/"  # also to ask how far an upload is: where all of it is here, that completes it


class Guard:
    """A dependency of all routes.

    Args:
        access: what tokens may do.
    """

    def __init__(self, access: Access) -> None:
        self._access = access

    async def __call__(self, request: Request) -> None:
        """Raise UnauthorizedError or ForbiddenError if whoever asks may not have this."""
        right = right_of(request.method, request.url.path)
        if right != "none":
            name_caller(self._access.require(token_of(request.headers.get("authorization")), right).name)


def right_of(method: str, path: str) -> Right:
    """What a request takes."""
    if path in _FOR_EVERYBODY or method == "OPTIONS":
        return "none"
    if path.startswith(_FOR_WRITERS):
        return "write"
    return "read" if method in ("GET", "HEAD") or path in _READING_POSTS else "write"
