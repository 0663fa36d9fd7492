"""Runs a tool without the internet: the schemas that STAC's core needs come out of pystac's package.

    python offline.py MODULE ARGUMENTS...

runs a module as ``python -m`` does, with every request to a host that is not this machine answered from there, or
refused with its address.
"""

from __future__ import annotations

import json
import runpy
import sys
from urllib.parse import urlsplit

import requests
import schemathesis
from pystac.validation.local_validator import get_local_schema_cache
from requests.adapters import HTTPAdapter


class OfflineAdapter(HTTPAdapter):
    """Answers for all hosts but this machine."""

    def __init__(self) -> None:
        super().__init__()
        self._schemas = {address.partition("#")[0]: schema for address, schema in get_local_schema_cache().items()}

    def send(self, request, *arguments, **options):
        if urlsplit(request.url).hostname in ("127.0.0.1", "localhost"):
            return super().send(request, *arguments, **options)
        schema = self._schemas.get(request.url.partition("#")[0])
        if schema is None:
            raise requests.ConnectionError(f"{request.url} is not on this machine", request=request)
        answer = requests.Response()
        answer.status_code, answer.url, answer.request = 200, request.url, request
        answer._content = json.dumps(schema).encode()
        answer.headers["Content-Type"] = "application/json"
        return answer


def stay_offline() -> None:
    """From now on, sessions of ``requests`` in this process reach this machine only."""
    opened = requests.Session.__init__

    def open_offline(session, *arguments, **options):
        opened(session, *arguments, **options)
        session.mount("https://", OfflineAdapter())
        session.mount("http://", OfflineAdapter())

    requests.Session.__init__ = open_offline


if __name__ == "__main__":
    stay_offline()
    schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")  # of tus
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
