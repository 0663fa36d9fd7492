"""What the localizer answered as files for others to read, by the ending of their names."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path

from fleetmap.errors import InputError
from fleetmap_localizer.pose_estimate import NoPose, PoseEstimate

_Writer = Callable[[Path, Sequence[PoseEstimate | NoPose]], None]

# Imported when a file is written: a vehicle that starts should not wait for what others' formats need.
_WRITERS = {
    ".tum": "tum_file:write_tum",
    ".csv": "csv_file:write_csv",
    ".geojson": "geojson_file:write_geojson",
    ".mcap": "mcap_file:write_mcap",
}


def require_pose_file_name(path: Path) -> None:
    """Raise InputError unless the name ends like a file that can be written."""
    if path.suffix.lower() not in _WRITERS:
        raise InputError(f"cannot write poses to {path}: the name must end in {', '.join(_WRITERS)}")


def write_pose_file(
    path: Path, answers: Sequence[PoseEstimate | NoPose], *, predicted_in_tum: bool = False
) -> bool:
    """Write time-ordered answers, whole or not at all; False if there was nothing to write.

    Without a single pose only a CSV is written: it says why there is none. TUM text cannot mark predicted poses
    as such, so it holds them only if asked to.

    Raises:
        InputError: the name's ending is not known.
        StorageError: the file cannot be written.
    """
    require_pose_file_name(path)
    suffix = path.suffix.lower()
    if suffix == ".tum" and not predicted_in_tum:
        answers = [each for each in answers if isinstance(each, PoseEstimate) and each.kind == "measured"]
    if suffix != ".csv" and not any(isinstance(each, PoseEstimate) for each in answers):
        return False
    _writer(suffix)(path, answers)
    return True


def _writer(suffix: str) -> _Writer:
    module, name = _WRITERS[suffix].split(":")
    writer: _Writer = getattr(importlib.import_module(f"{__name__}.{module}"), name)
    return writer
