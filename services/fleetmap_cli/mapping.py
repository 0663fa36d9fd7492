"""From a recording's file to a map package's folder, and on to the server for the mapper agent."""

from __future__ import annotations

import hashlib
import shutil
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from fleetmap import __version__
from fleetmap.drives import open_drive
from fleetmap.drives.opening import find_mcap
from fleetmap.errors import InputError
from fleetmap.landmark_choice import localizable_part
from fleetmap.manifest import Manifest, Provenance, check_map_id
from fleetmap.map_package import check_target, open_package, write_package
from fleetmap.naming import map_id_from
from fleetmap.trajectory import write_trajectory
from fleetmap_cli.options import ServerAccess
from fleetmap_cli.progress import StageBar
from fleetmap_cli.verbs.publish import publish_package
from fleetmap_cli.watching import STATE_FOLDER, UnfitMapError
from fleetmap_mapper.image_mask import read_mask
from fleetmap_mapper.mapper import Progress, map_drive
from fleetmap_mapper.settings import MapperSettings


@dataclass(frozen=True)
class DriveChoice:
    """Which parts of a recording to map, see fleetmap.drives.open_drive, and of its images, see read_mask."""

    image_topic: str | None = None
    gnss_topic: str | None = None
    antenna_offset_m: tuple[float, float, float] | None = None
    mask: Path | None = None  # white where images may be used


def map_recording(
    recording: Path,
    output: Path,
    *,
    settings: MapperSettings,
    choice: DriveChoice,
    map_id: str | None = None,
    trajectory: Path | None = None,
    drive_name: str | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> Manifest:
    """Map a recording, write the package and, on request, the trajectory of all its images.

    ``drive_name`` is what the manifest calls the drive, its own name by default; ``progress`` hears of the stages
    in place of a bar on stderr.

    Raises:
        FleetmapError: as open_drive, map_drive and write_package do; nothing half-written is left.
    """
    check_target(output, force)
    identity = map_id or map_id_from(output.resolve().name)
    check_map_id(identity)
    drive = open_drive(
        recording,
        image_topic=choice.image_topic,
        gnss_topic=choice.gnss_topic,
        antenna_offset_m=choice.antenna_offset_m,
    )
    mask = read_mask(choice.mask, drive.camera) if choice.mask is not None else None
    with nullcontext(progress) if progress is not None else StageBar() as told:
        mapped = map_drive(drive, settings, told, mask)
    stamps_ns = mapped.trajectory.stamps_ns
    provenance = Provenance(
        drive=drive_name or drive.name,
        drive_sha256=_sha256(find_mcap(recording)),
        fleetmap_version=__version__,
        settings=settings.model_dump(mode="json"),
        start_ns=int(stamps_ns[0]),
        end_ns=int(stamps_ns[-1]),
        created_ns=time.time_ns(),
    )
    manifest = write_package(
        output,
        mapped.visual_map,
        map_id=identity,
        quality=mapped.quality,
        provenance=provenance,
        road_quality=mapped.road_quality,
        localizable=localizable_part(mapped.visual_map, settings.cells.budget_mb_per_km),
        force=force,
    )
    if trajectory is not None:
        write_trajectory(trajectory, mapped.trajectory)
    return manifest


def map_and_publish(
    recording: Path, *, server: ServerAccess, settings: MapperSettings, choice: DriveChoice
) -> None:
    """One drive of the mapper agent. A map whose publishing failed is kept and not made again.

    Raises:
        UnfitMapError: the map's own quality check advises against publishing it.
    """
    output = recording.parent / STATE_FOLDER / "maps" / recording.name
    if not _is_map_of(output, recording):
        map_recording(
            recording, output, settings=settings, choice=choice, map_id=map_id_from(recording.stem), force=True
        )
    package = open_package(output)
    if not package.manifest.quality.publishable:
        raise UnfitMapError("; ".join(package.manifest.quality.warnings))
    publish_package(package, server)
    shutil.rmtree(output, ignore_errors=True)  # the server has it now


def _is_map_of(folder: Path, recording: Path) -> bool:
    if not folder.exists():
        return False
    try:
        return open_package(folder).manifest.provenance.drive_sha256 == _sha256(find_mcap(recording))
    except InputError:
        return False


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
