"""PROTOCOL.md and the code that implements it say the same."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel

from fleetmap import jobs, localization, manifest
from fleetmap.transport import protocol
from fleetmap.transport.operations import OPERATIONS

TEXT = Path(protocol.__file__).with_name("PROTOCOL.md").read_text()
SECTIONS: dict[str, str] = dict(
    re.findall(r"^### `([^`]+)`\n(.*?)(?=^##|\Z)", TEXT, flags=re.MULTILINE | re.DOTALL)
)


def table(body: str) -> dict[str, bool]:
    """The names in a table's first column, and whether each is marked as needed."""
    rows = re.findall(r"^\| `([^`]+)` \| (yes)? ?\|", body, flags=re.MULTILINE)
    assert len(rows) == len(dict(rows)) == body.count("\n| `")
    return {name: needed == "yes" for name, needed in rows}


def fields(model: type[BaseModel]) -> dict[str, bool]:
    return {name: field.is_required() for name, field in model.model_fields.items()}


def messages() -> dict[str, type[BaseModel]]:
    """All that a server can answer or announce, with what is inside."""
    found: dict[str, type[BaseModel]] = {}
    waiting: list[object] = [protocol.Problem, protocol.Announcement]
    waiting += [kind for operation in OPERATIONS.values() for kind in (operation.answer, operation.payload)]
    while waiting:
        kind = waiting.pop()
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind.__name__ not in found:
            found[kind.__name__] = kind
            waiting += [field.annotation for field in kind.model_fields.values()]
        waiting += get_args(kind)
    return found


def test_every_operation_and_every_message_has_its_section_and_nothing_else_has():
    assert set(SECTIONS) == set(OPERATIONS) | set(messages())
    assert len(SECTIONS) == TEXT.count("\n### ")


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_is_documented_as_it_is(name):
    operation, body = OPERATIONS[name], SECTIONS[name]
    words = " ".join(body.split())
    assert table(body) == fields(operation.request)
    assert f"Right: {operation.right}." in words
    assert ("Bulk." in words) == operation.bulk
    answer = "bytes" if operation.answer is None else f"`{operation.answer.__name__}`"
    assert f"Answer: {answer}" in words
    payload = operation.payload
    said = re.search(r"Payload: `?(\w+)", words)
    assert (said and said[1]) == (payload.__name__ if isinstance(payload, type) else payload)


@pytest.mark.parametrize("name", messages())
def test_a_message_is_documented_as_it_is(name):
    assert table(SECTIONS[name]) == fields(messages()[name])


def test_limits_are_documented_as_they_are():
    told = dict(re.findall(r"^\| `([A-Z_]+)` \| (\d+) \|$", TEXT, flags=re.MULTILINE))
    assert len(told) == 10
    for name, value in told.items():
        room = next(room for room in (protocol, jobs, localization, manifest) if name in vars(room))
        assert vars(room)[name] == int(value)


def test_keys_are_documented_as_they_are():
    for key in (
        protocol.HELLO_KEY,
        protocol.server_key("SERVER_ID", "OPERATION"),
        f"{protocol.ANNOUNCED_PREFIX}/MAP_ID",
        f"{protocol.SERVERS_PREFIX}/SERVER_ID",
        f"{protocol.VEHICLES_PREFIX}/VEHICLE_ID",
    ):
        assert f"\n| `{key}` |" in TEXT
    assert f"`{protocol.ANY_VERSION_HELLO}`" in TEXT
    assert f"version {protocol.PROTOCOL_VERSION}\n" in TEXT.splitlines(keepends=True)[0]
