"""Who may read and who may write: bearer tokens of which only the SHA-256 is kept, in a file of one line each.

    # role  name           SHA-256 of the token, as `printf %s "$TOKEN" | sha256sum` prints it
    write   mapper         5e884898da28047151d0e56f8dc6292773603d0d6aabbdd62a11ef721d1542d8
    read    vehicle-12     2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b
    read    *

``write`` includes ``read``. The line with ``*`` and no hash says what those may do who have no token; without it
they may do nothing. Without a file everybody may do everything.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from fleetmap.errors import InputError
from fleetmap.transport.operations import Right
from fleetmap.transport.protocol import MAX_TOKEN_BYTES
from fleetmap_server.problems import ForbiddenError, UnauthorizedError

Role = Literal["none", "read", "write"]

_RANKS: dict[str, int] = {"none": 0, "read": 1, "write": 2}
_LINE = re.compile(
    r"(?P<role>none|read|write)\s+(?:(?P<anyone>\*)|(?P<name>[A-Za-z0-9._@-]{1,64})\s+(?P<hash>[0-9a-f]{64}))"
)


@dataclass(frozen=True)
class Caller:
    """Whoever sent a request."""

    name: str | None  # None: no token
    role: Role

    def may(self, right: Right) -> bool:
        """Whether this is allowed."""
        return _RANKS[self.role] >= _RANKS[right]


@dataclass(frozen=True)
class Access:
    """What tokens may do; see the module. By default everybody may do everything."""

    anyone: Role = "write"
    holders: Mapping[str, Caller] = field(default_factory=dict)  # by the SHA-256 of the token

    @property
    def is_open(self) -> bool:
        """Whether everybody may read."""
        return self.anyone != "none"

    def caller(self, token: str | None) -> Caller:
        """Who has this token. Raises UnauthorizedError where nobody has it."""
        if token is None or not self.holders:
            return Caller(None, self.anyone)
        holder = None
        if len(token) <= MAX_TOKEN_BYTES:
            holder = self.holders.get(hashlib.sha256(token.encode(errors="replace")).hexdigest())
        if holder is None:
            raise UnauthorizedError("the server does not know this token; ask its operator for one, or give none")
        return holder

    def require(self, token: str | None, right: Right) -> Caller:
        """Who has this token, if that may do this.

        Raises:
            UnauthorizedError: nobody has it, or none was given and it takes one.
            ForbiddenError: it may not.
        """
        if right == "none":
            return Caller(None, "none")
        caller = self.caller(token)
        if caller.may(right):
            return caller
        if caller.name is None:
            raise UnauthorizedError(f"to {right} here takes a token; give --token-file, or FLEETMAP_TOKEN")
        raise ForbiddenError(f"the token of '{caller.name}' may not {right} here; ask the server's operator")


def read_access(file: Path) -> Access:
    """The access file.

    Raises:
        InputError: it cannot be read, or a line says something else.
    """
    try:
        lines = file.read_text().splitlines()
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"cannot read the access file {file}: {getattr(error, 'strerror', None) or error}"
        ) from error
    anyone: Role = "none"
    holders: dict[str, Caller] = {}
    for number, line in enumerate(lines, start=1):
        if not (words := line.partition("#")[0].strip()):
            continue
        match = _LINE.fullmatch(words)
        if match is None:
            raise InputError(
                f"{file}, line {number}: write ROLE NAME SHA256_OF_TOKEN, or ROLE *; roles: none, read, write"
            )
        role: Role = match["role"]  # type: ignore[assignment]  # the pattern has just these
        if match["anyone"]:
            anyone = role
        elif match["hash"] in holders:
            raise InputError(
                f"{file}, line {number}: another line has the same token; give each holder one of its own"
            )
        else:
            holders[match["hash"]] = Caller(match["name"], role)
    return Access(anyone, holders)


def token_of(authorization: str | None) -> str | None:
    """The token in an HTTP ``Authorization`` header: Bearer, or Basic with the token as password (RFC 6750, 7617).

    Raises:
        UnauthorizedError: it is neither.
    """
    if authorization is None:
        return None
    scheme, _, value = authorization.strip().partition(" ")
    if scheme.lower() == "bearer" and value.strip():
        return value.strip()
    if scheme.lower() == "basic":
        try:
            _, colon, password = base64.b64decode(value.strip(), validate=True).decode().partition(":")
        except (binascii.Error, UnicodeError):
            colon = password = ""
        if colon and password:
            return password
    raise UnauthorizedError(
        "the Authorization header is neither 'Bearer TOKEN' nor Basic with the token as password"
    )
