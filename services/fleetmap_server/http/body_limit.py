"""Requests that are read into memory as a whole, kept small."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_SEARCH_BYTES = 1024 * 1024


class BodyLimit:
    """Refuses more than a limit with status 413 while it comes in.

    Args:
        app: what is behind it.
        limits_bytes: of each path where it watches; uploads go elsewhere and have limits of their own.
    """

    def __init__(self, app: ASGIApp, limits_bytes: Mapping[str, int]) -> None:
        self._app = app
        self._limits_bytes = limits_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        limit_bytes = self._limits_bytes.get(scope["path"]) if scope["type"] == "http" else None
        if limit_bytes is None:
            await self._app(scope, receive, send)
            return
        received_bytes = 0

        async def receive_some() -> Message:
            nonlocal received_bytes
            message = await receive()
            received_bytes += len(message.get("body", b""))
            if received_bytes > limit_bytes:
                raise HTTPException(413, f"at most {limit_bytes} bytes are taken here; send less")
            return message

        await self._app(scope, receive_some, send)
