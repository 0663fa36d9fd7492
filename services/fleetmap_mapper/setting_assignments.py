"""Settings as people write them: ``quality.min_posed_ratio=0.9``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from fleetmap.errors import InputError
from fleetmap_mapper.settings import MapperSettings


def with_assignments(settings: MapperSettings, assignments: Sequence[str]) -> MapperSettings:
    """The settings with some of them changed, the last word of each counting.

    Raises:
        InputError: no such setting, or not a value it can have; in one line that says what it could be.
    """
    fields = settings.model_dump()
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals:
            raise InputError(f"'{assignment}' sets nothing; write GROUP.NAME=VALUE, such as quality.weak_gap_s=1")
        group, _, key = name.strip().rpartition(".")
        holder = fields.get(group) if group else fields
        if not isinstance(holder, dict) or key not in holder or isinstance(holder[key], dict):
            raise InputError(f"there is no mapper setting '{name.strip()}'; {_choices(settings, group)}")
        holder[key] = _value(text, assignment)
    try:
        return MapperSettings.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"])
        raise InputError(f"the mapper setting '{place}' cannot be {first['input']!r}: {first['msg']}") from error


def _value(text: str, assignment: str) -> Any:
    """A plain YAML value: a number, a word, true, null."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"the value of '{assignment}' cannot be read; write GROUP.NAME=VALUE") from error


def _choices(settings: MapperSettings, group: str) -> str:
    """What there is in the group that was meant, or which groups there are."""
    held = getattr(settings, group, None)
    if isinstance(held, BaseModel):
        return f"'{group}' has {', '.join(type(held).model_fields)}"
    names = [name for name in MapperSettings.model_fields if isinstance(getattr(settings, name), BaseModel)]
    return f"the groups are {', '.join(names)}"
