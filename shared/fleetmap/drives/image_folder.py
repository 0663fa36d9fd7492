"""A folder of images and a table of times and positions -> MCAP: what phones and dash cams give."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from fleetmap.camera import Camera
from fleetmap.drive import GnssFix
from fleetmap.drives.conversion import (
    Conversion,
    Progress,
    StampedImage,
    checked_stamp_ns,
    conclude,
    fix_messages,
    image_messages,
    mount_antenna,
    silent,
    write_in_time_order,
)
from fleetmap.drives.image_folder_exif import time_taken_ns
from fleetmap.drives.image_folder_tables import (
    PositionDefaults,
    Table,
    read_fixes,
    read_image_stamps,
    read_table,
)
from fleetmap.drives.image_folder_times import clock_text, time_in_name_ns
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.errors import DriveError, InputError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
_FRAME_ID = "camera"
_EXIF_BYTES = 200_000  # the EXIF segment, at most 64 kB, is among a JPEG's first


@dataclass(frozen=True)
class ImageClock:
    """Where the images' times come from.

    The first that is given: a table of names and times; a constant rate; a column of image names in the table of
    positions; times in the files' names; EXIF.
    """

    table: Path | None = None
    rate_hz: float | None = None
    start_ns: int | None = None  # of the first image, in the order of names; with rate_hz
    offset_s: float = 0.0  # added to every image's time


def convert_image_folder(
    folder: Path,
    positions: Path,
    output: Path,
    *,
    camera: Camera,
    clock: ImageClock | None = None,
    defaults: PositionDefaults | None = None,
    antenna_in_camera_m: tuple[float, float, float] | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Conversion:
    """Write images as they are, and positions as NavSatFix.

    Args:
        folder: JPEG and PNG files are copied byte by byte; BMP, TIFF and WebP become PNG.
        positions: a CSV file; see fleetmap.drives.image_folder_tables.
        output: the MCAP file.
        camera: the calibration of all images.
        clock: where the images' times come from.
        defaults: what the table of positions leaves open.
        antenna_in_camera_m: the GNSS antenna right, down, forward of the camera; None: where the camera is.
        force: replace an existing output.
        progress: called with the stage, the images done, and all of them.

    Raises:
        DriveError: no images, images without time, a damaged table, or times that do not overlap.
        CalibrationError: images of another size than the camera's.
        OutputExistsError: the output is there already and ``force`` is not given.
    """
    clock, defaults = clock or ImageClock(), defaults or PositionDefaults()
    table = read_table(positions)
    fixes = read_fixes(table, defaults)
    images = _stamped(_list_images(folder), table, clock)
    _check_overlap(images, fixes, positions)
    with DriveWriter(output, camera, force=force, camera_frame_id=_FRAME_ID) as writer:
        gnss_frame_id = mount_antenna(writer, _FRAME_ID, antenna_in_camera_m)
        write_in_time_order(
            image_messages(writer, images, camera, progress), fix_messages(writer, fixes, gnss_frame_id)
        )
    return conclude(writer, output, remarks=_remarks(table, fixes, defaults))


def _list_images(folder: Path) -> list[Path]:
    """Image files in the order of their names; numbers in names count as numbers."""
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    except OSError as error:
        raise DriveError(f"cannot list images in {folder}: {error.strerror or error}") from error
    if not found:
        raise DriveError(f"{folder} holds no images ({', '.join(IMAGE_SUFFIXES)})")
    return sorted(found, key=_natural_order)


def _natural_order(path: Path) -> tuple[list[tuple[int, str]], str]:
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], path.name


def _stamped(images: list[Path], positions: Table, clock: ImageClock) -> list[StampedImage]:
    """The images in time order."""
    if not math.isfinite(clock.offset_s):
        raise InputError(f"an image clock offset of {clock.offset_s} s makes no sense")
    if clock.table is not None:
        stamps_ns = _stamps_of_table(images, read_table(clock.table))
    elif clock.rate_hz is not None:
        stamps_ns = _stamps_at_rate(len(images), clock.rate_hz, clock.start_ns)
    elif "image" in positions.columns:
        stamps_ns = _stamps_of_table(images, positions)
    else:
        stamps_ns = _stamps_of_files(images)
    offset_ns = round(clock.offset_s * 1e9)
    stamped = [
        StampedImage(checked_stamp_ns(stamp_ns + offset_ns, str(path)), path)
        for path, stamp_ns in zip(images, stamps_ns, strict=True)
    ]
    stamped.sort(key=lambda image: image.stamp_ns)
    _refuse_equal_times(stamped)
    return stamped


def _refuse_equal_times(images: list[StampedImage]) -> None:
    """Frames of one video often bear the video's time, and bursts of photos whole seconds."""
    for first, second in pairwise(images):
        if first.stamp_ns == second.stamp_ns:
            raise DriveError(
                f"{first.path} and {second.path.name} have the same time, {clock_text(first.stamp_ns)};"
                " give --image-times CSV, or --rate-hz and --start"
            )


def _stamps_of_table(images: list[Path], table: Table) -> list[int]:
    stamps = read_image_stamps(table)
    names = {path.name for path in images}
    absent = next(((name, line) for name, (line, _) in stamps.items() if name not in names), None)
    if absent is not None:
        raise DriveError(f"{table.path} line {absent[1]} names {absent[0]}, which is not in {images[0].parent}")
    unnamed = next((path for path in images if path.name not in stamps), None)
    if unnamed is not None:
        raise DriveError(f"{unnamed} has no time: {table.path} has no row for it")
    return [stamps[path.name][1] for path in images]


def _stamps_at_rate(count: int, rate_hz: float, start_ns: int | None) -> list[int]:
    if not (math.isfinite(rate_hz) and 0.001 <= rate_hz <= 10_000.0):
        raise InputError(f"a rate of {rate_hz} images per second makes no sense")
    if start_ns is None:
        raise InputError("--rate-hz needs --start, the time of the first image")
    return [start_ns + round(index * 1e9 / rate_hz) for index in range(count)]


def _stamps_of_files(images: list[Path]) -> list[int]:
    """Times in all names, or else in all files' EXIF."""
    for time_of in (lambda path: time_in_name_ns(path.stem), _time_in_exif_ns):
        stamps_ns = [time_of(path) for path in images]
        known = [stamp_ns for stamp_ns in stamps_ns if stamp_ns is not None]
        if len(known) == len(images):
            return known
        if known:
            raise DriveError(
                f"{images[stamps_ns.index(None)]} has no time, although {len(known)} other images have"
            )
    raise DriveError(
        f"{images[0]} has no time, neither in its name nor in EXIF;"
        " give --image-times CSV, or --rate-hz and --start"
    )


def _time_in_exif_ns(path: Path) -> int | None:
    try:
        with path.open("rb") as file:
            start = file.read(_EXIF_BYTES)
    except OSError as error:
        raise DriveError(f"cannot read {path}: {error.strerror or error}") from error
    return time_taken_ns(start) if start.startswith(b"\xff\xd8") else None


def _check_overlap(images: list[StampedImage], fixes: list[GnssFix], positions: Path) -> None:
    """Clocks that disagree are the usual mistake: a time zone, or a camera whose clock was never set."""
    first, last = images[0].stamp_ns, images[-1].stamp_ns
    if first <= fixes[-1].stamp_ns and fixes[0].stamp_ns <= last:
        return
    raise DriveError(
        f"the images were taken from {clock_text(first)} to {clock_text(last)}, the positions of {positions} from"
        f" {clock_text(fixes[0].stamp_ns)} to {clock_text(fixes[-1].stamp_ns)}: no overlap;"
        " shift the images with --image-clock-offset-s"
    )


def _remarks(table: Table, fixes: list[GnssFix], defaults: PositionDefaults) -> tuple[str, ...]:
    remarks = []
    if "height" not in table.columns:
        chosen = "0" if defaults.height_m is None else f"{defaults.height_m:g}"
        remarks.append(f"{table.path} has no heights: all fixes are written at {chosen} m above the ellipsoid")
    if "image" not in table.columns and len(fixes) < len(table.rows):
        remarks.append(f"{len(table.rows) - len(fixes)} rows of {table.path} have no position")
    return tuple(remarks)
