"""A recording checked on this side, and sent to the map server."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

from fleetmap.drives.opening import find_mcap
from fleetmap.errors import DriveError, StorageError
from fleetmap.jobs import DriveSummary
from fleetmap_cli.drive_summary import reasons_against, summarise_drive
from fleetmap_cli.progress import StageBar
from fleetmap_server.mcap_structure import check_mcap

_HASHED_BYTES = 1 << 20


def check_recording(recording: Path, *, force: bool) -> DriveSummary:
    """What ``fleetmap info`` finds in a recording, with a progress bar.

    Raises:
        DriveError: it cannot be read; or it is not good enough to map, unless ``force``.
    """
    with StageBar() as bar:
        summary = summarise_drive(recording, bar)
    if summary.verdict == "no" and not force:
        raise DriveError(
            f"{recording} is not good enough to map: {reasons_against(summary)}; --force sends it all the same"
        )
    return summary


def sha256_of(recording: Path, progress: Callable[[int, int], None]) -> str:
    """The hash that names a drive; on the way its file is looked at as the server will.

    Raises:
        DriveError: the server would refuse it, at the end of the upload.
        StorageError: the file cannot be read.
    """
    file = find_mcap(recording)
    digest, size_bytes = hashlib.sha256(), file.stat().st_size

    def hashed_pieces() -> Iterator[bytes]:
        done_bytes = 0
        with file.open("rb") as opened:
            while block := opened.read(_HASHED_BYTES):
                digest.update(block)
                done_bytes += len(block)
                progress(done_bytes, size_bytes)
                yield block

    try:
        check_mcap(hashed_pieces())
    except DriveError as error:
        raise DriveError(f"{file}: {error}") from error
    except OSError as error:
        raise StorageError(f"cannot read {file}: {error.strerror}") from error
    return digest.hexdigest()
