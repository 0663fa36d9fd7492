"""Where map servers listen: one Zenoh endpoint, or several that serve the same maps."""

from __future__ import annotations

import re

from fleetmap.errors import InputError

DEFAULT_PATIENCE_S = 60.0  # a link that stands still for half a minute is waited for
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

_ENDPOINT = re.compile(r"tcp/(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):(?P<port>[0-9]{1,5})")


def check_endpoint(text: str) -> str:
    """The endpoint itself, if it is one.

    Raises:
        InputError: not of the form ``tcp/HOST:PORT``.
    """
    match = _ENDPOINT.fullmatch(text)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise InputError(f"{text!r} is no Zenoh endpoint; write tcp/HOST:PORT, for instance {DEFAULT_ENDPOINT}")
    return text


def check_endpoints(text: str) -> tuple[str, ...]:
    """One or more endpoints with commas between; raises as ``check_endpoint``."""
    return tuple(check_endpoint(one) for one in text.split(","))
