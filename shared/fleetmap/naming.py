"""What maps and drives are called, where nobody says."""

from __future__ import annotations

import re
from pathlib import Path

from fleetmap.errors import InputError

_NOT_IN_NAMES = re.compile(r"[\x00-\x1f\x7f/\\\ud800-\udfff]")
_MAX_NAME = 255


def map_id_from(name: str) -> str:
    """A map id made of a file's or folder's name.

    Raises:
        InputError: nothing of the name can be used.
    """
    identity = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-_")[:64]
    if not identity:
        raise InputError(f"no map id can be made of '{name}'; give one with --map-id")
    return identity


def drive_name(recording: Path) -> str:
    """What the server is to call a recording: the file's name, or that of the rosbag2 folder that holds it."""
    name = recording.resolve().name + (".mcap" if recording.is_dir() else "")
    return _NOT_IN_NAMES.sub("_", name)[-_MAX_NAME:]
