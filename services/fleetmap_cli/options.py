"""Options that several verbs share."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import update_wrapper
from pathlib import Path
from typing import Any

import click

from fleetmap.errors import InputError
from fleetmap.transport import DEFAULT_ENDPOINT, DEFAULT_PATIENCE_S, MapClient
from fleetmap.transport.protocol import MAX_TOKEN_BYTES


class Numbers(click.ParamType[tuple[float, ...]]):
    """A fixed count of comma-separated numbers, such as ``-1.5,0,2``."""

    def __init__(self, names: str) -> None:
        self.name = names
        self._count = len(names.split(","))

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers, or click's usage error (exit code 2) naming what was expected."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(field) for field in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(abs(number) < float("inf") for number in numbers):
            self.fail(f"'{value}' is not {self.name}: {self._count} numbers with commas between", param, ctx)
        return numbers


class Gap(click.ParamType[tuple[float, float]]):
    """A stretch of time such as ``11:10``."""

    name = "START_S:LENGTH_S"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        """Start and length, or click's usage error (exit code 2) naming what was expected."""
        if isinstance(value, tuple):
            return value
        try:
            start_s, length_s = (float(field) for field in str(value).split(":"))
        except ValueError:
            start_s = length_s = -1.0
        if not (0.0 <= start_s < float("inf") and 0.0 < length_s < float("inf")):
            self.fail(f"'{value}' is not {self.name}: two numbers of seconds with a colon between", param, ctx)
        return start_s, length_s


XYZ = Numbers("X,Y,Z")
LAT_LON = Numbers("LAT,LON")
QUATERNION = Numbers("QX,QY,QZ,QW")


@dataclass(frozen=True)
class ServerAccess:
    """Which map server, and the token that it may want."""

    endpoint: str  # or several, with commas between
    token: str | None = field(default=None, repr=False)
    is_given: bool = True  # otherwise the endpoint is the default
    patience_s: float = DEFAULT_PATIENCE_S  # how long it may be away in the middle of something

    def connect(self, **settings: Any) -> MapClient:
        """A connection, made as ``MapClient`` says."""
        return MapClient(self.endpoint, token=self.token, **{"patience_s": self.patience_s, **settings})


_PATIENCE = click.option(
    "--patience-s",
    type=click.FloatRange(min=0.0),
    default=DEFAULT_PATIENCE_S,
    show_default=True,
    envvar="FLEETMAP_PATIENCE_S",
    show_envvar=True,
    help="How long the map server may be away in the middle of something before it is given up.",
)


def server_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--server``, ``--token-file`` and ``--patience-s``, handed to a command as ``server: ServerAccess``."""
    text = "The map server; several that have the same maps with commas between, tried in turn."
    return _server_options(command, text, default=DEFAULT_ENDPOINT, show_default=True)


def waiting_server_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The same for a command that waits for a server as long as it takes, so that nobody is to say how long."""
    text = "The map server, waited for when it is away; several that have the same maps with commas between."
    return _server_options(command, text, has_patience=False, default=DEFAULT_ENDPOINT, show_default=True)


def optional_server_options(text: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The same for a command that can do without a server; ``server.is_given`` says whether it has to.

    Args:
        text: what the help of ``--server`` says.
    """
    return lambda command: _server_options(command, text)


def _server_options(
    command: Callable[..., Any], text: str, *, has_patience: bool = True, **settings: Any
) -> Callable[..., Any]:
    def with_access(
        *arguments: Any,
        server: str | None,
        token_file: Path | None,
        patience_s: float = DEFAULT_PATIENCE_S,
        **more: Any,
    ) -> Any:
        token = read_token(token_file) if token_file is not None else _token_of_environment()
        access = ServerAccess(server or DEFAULT_ENDPOINT, token, server is not None, patience_s)
        return command(*arguments, server=access, **more)

    wrapped = update_wrapper(with_access, command)
    if has_patience:
        wrapped = _PATIENCE(wrapped)
    wrapped = click.option(
        "--token-file",
        type=click.Path(path_type=Path, dir_okay=False),
        help="A file with the token that the map server wants, if it wants one.  [default: FLEETMAP_TOKEN]",
    )(wrapped)
    return click.option("--server", metavar="tcp/HOST:PORT", help=text, **settings)(wrapped)


def read_token(file: Path) -> str:
    """The token in a file, without the white space around it.

    Raises:
        InputError: the file cannot be read, or holds no token.
    """
    try:
        text = file.read_text().strip()
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"cannot read the token in {file}: {getattr(error, 'strerror', None) or error}"
        ) from error
    return _checked_token(text, str(file))


def _token_of_environment() -> str | None:
    text = os.environ.get("FLEETMAP_TOKEN", "").strip()
    return _checked_token(text, "FLEETMAP_TOKEN") if text else None


def _checked_token(text: str, where: str) -> str:
    if not text.isprintable() or " " in text or not 0 < len(text.encode()) <= MAX_TOKEN_BYTES:
        raise InputError(f"{where} holds no token: one word of 1 to {MAX_TOKEN_BYTES} bytes")
    return text
