"""What a recording holds and what it lacks, without giving up at the first thing that is missing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleetmap.camera import Camera
from fleetmap.drive import Antenna, GnssFix
from fleetmap.drives.mcap_drive import McapDrive, read_fixes
from fleetmap.drives.mcap_file import McapFile, Topic
from fleetmap.drives.opening import find_mcap
from fleetmap.drives.topic_choice import choose_gnss_topic
from fleetmap.drives.topic_reading import kind_of
from fleetmap.errors import FleetmapError, InputError
from fleetmap.geodesy import UtmGrid

_LENGTH_STEP_M = 5.0  # fixes closer together than this say more about noise than about the way driven


@dataclass(frozen=True)
class TopicInfo:
    """One topic of the recording."""

    name: str
    message_type: str
    message_count: int
    rate_hz: float | None  # over the time of the images
    use: str | None  # what fleetmap reads from it; None for a type that it does not know


@dataclass(frozen=True)
class ImagesInfo:
    """The chosen image topic."""

    topic: str
    frame_id: str
    count: int
    width_px: int | None  # of the first image; None where it cannot be decoded
    height_px: int | None
    rate_hz: float | None
    longest_gap_s: float | None


@dataclass(frozen=True)
class GnssInfo:
    """The chosen NavSatFix topic. Sigmas are medians of what the receiver reports."""

    topic: str
    message_count: int
    fix_count: int  # valid ones
    rate_hz: float | None
    longest_gap_s: float | None
    horizontal_sigma_m: float | None  # per axis
    vertical_sigma_m: float | None
    length_m: float | None  # driven between the first and the last fix


@dataclass(frozen=True)
class AntennaInfo:
    """See fleetmap.drive.Antenna."""

    position_in_cam_m: tuple[float, float, float]
    source: str


@dataclass(frozen=True)
class DriveInfo:
    """All that ``fleetmap info`` prints."""

    path: str
    size_bytes: int
    topics: tuple[TopicInfo, ...]
    images: ImagesInfo | None
    camera: Camera | None
    gnss: GnssInfo | None
    antenna: AntennaInfo | None
    start_ns: int | None  # of images, else of fixes
    duration_s: float | None
    missing: tuple[str, ...]  # one line each; empty for a recording that can be mapped


@dataclass(frozen=True)
class DriveContents:
    """An opened recording, for those who look further into it."""

    info: DriveInfo
    drive: McapDrive | None  # None without images
    stamps_ns: tuple[int, ...]  # of the images in the order of the recording
    fixes: tuple[GnssFix, ...]
    antenna: Antenna | None  # None without images or fixes


def look_through(path: Path, *, image_topic: str | None = None, gnss_topic: str | None = None) -> DriveContents:
    """Look through a recording; what it lacks is listed, not raised.

    Raises:
        DriveError: it cannot be read at all, or a topic that was asked for is not there.
    """
    file = find_mcap(path)
    mcap = McapFile(file)
    missing: list[str] = []
    fixes, gnss = _look_at_gnss(mcap, gnss_topic, missing)
    drive = _try_open(file, image_topic, gnss_topic, missing)
    image_stamps_ns: list[int] = []
    images, camera, antenna = None, None, None
    if drive is not None:
        image_stamps_ns = drive.frame_stamps_ns()
        camera = _look_at_camera(drive, missing)
        images = _look_at_images(drive, camera, image_stamps_ns, missing)
        antenna = _look_at_antenna(drive, missing) if gnss else None
    stamps_ns = image_stamps_ns or [fix.stamp_ns for fix in fixes]
    duration_s = (max(stamps_ns) - min(stamps_ns)) * 1e-9 if stamps_ns else None
    info = DriveInfo(
        path=str(file),
        size_bytes=file.stat().st_size,
        topics=tuple(_topic_info(topic, duration_s) for topic in mcap.topics.values()),
        images=images,
        camera=camera,
        gnss=gnss,
        antenna=_antenna_info(antenna) if antenna else None,
        start_ns=min(stamps_ns, default=None),
        duration_s=duration_s,
        missing=tuple(missing),
    )
    return DriveContents(info, drive, tuple(image_stamps_ns), tuple(fixes), antenna)


def _topic_info(topic: Topic, duration_s: float | None) -> TopicInfo:
    rate_hz = (topic.message_count - 1) / duration_s if duration_s and topic.message_count > 1 else None
    kind = kind_of(topic)
    return TopicInfo(topic.name, topic.message_type, topic.message_count, rate_hz, kind.name if kind else None)


def _try_open(file: Path, image_topic: str | None, gnss_topic: str | None, missing: list[str]) -> McapDrive | None:
    try:
        return McapDrive(file, image_topic=image_topic, gnss_topic=gnss_topic)
    except InputError as error:
        if image_topic is not None:
            raise
        missing.append(f"images: {error}")
        return None


def _look_at_camera(drive: McapDrive, missing: list[str]) -> Camera | None:
    try:
        return drive.camera
    except InputError as error:
        missing.append(f"calibration: {error}")
        return None


def _look_at_images(
    drive: McapDrive, camera: Camera | None, stamps_ns: list[int], missing: list[str]
) -> ImagesInfo:
    try:
        height, width = drive.decode_first_image().shape
    except InputError as error:
        missing.append(f"readable images: {error}")
        height = width = None
    if camera is not None and width is not None and (width, height) != (camera.width_px, camera.height_px):
        missing.append(
            f"calibration for the images' size: they have {width}x{height} pixels,"
            f" their calibration says {camera.width_px}x{camera.height_px}"
        )
    steps_ns = np.diff(stamps_ns)
    if np.any(steps_ns <= 0):
        late = int(np.argmax(steps_ns <= 0)) + 1
        missing.append(f"images in time order: image {late} is not later than the one before it")
    rate_hz, longest_gap_s = _rhythm(stamps_ns)
    return ImagesInfo(
        drive.image_topic, drive.image_frame_id, len(stamps_ns), width, height, rate_hz, longest_gap_s
    )


def _look_at_gnss(
    mcap: McapFile, gnss_topic: str | None, missing: list[str]
) -> tuple[list[GnssFix], GnssInfo | None]:
    try:
        topic = choose_gnss_topic(mcap, gnss_topic)
    except InputError as error:
        if gnss_topic is not None:
            raise
        missing.append(f"GNSS: {error}")
        return [], None
    if topic is None:
        missing.append("GNSS: no NavSatFix; the drive can be localised in a map, but not mapped")
        return [], None
    fixes = read_fixes(mcap, topic)
    if not fixes:
        missing.append(f"GNSS: none of the {mcap.topics[topic].message_count} messages on {topic} is a valid fix")
    return fixes, _gnss_info(mcap, topic, fixes)


def _gnss_info(mcap: McapFile, topic: str, fixes: list[GnssFix]) -> GnssInfo:
    rate_hz, longest_gap_s = _rhythm([fix.stamp_ns for fix in fixes])
    variances = np.array([np.diag(fix.covariance_enu_m2) for fix in fixes]).reshape(-1, 3)
    return GnssInfo(
        topic=topic,
        message_count=mcap.topics[topic].message_count,
        fix_count=len(fixes),
        rate_hz=rate_hz,
        longest_gap_s=longest_gap_s,
        horizontal_sigma_m=float(np.median(np.sqrt(variances[:, :2].mean(axis=1)))) if fixes else None,
        vertical_sigma_m=float(np.median(np.sqrt(variances[:, 2]))) if fixes else None,
        length_m=_length_m(fixes) if fixes else None,
    )


def _look_at_antenna(drive: McapDrive, missing: list[str]) -> Antenna | None:
    try:
        antenna = drive.antenna()
    except FleetmapError as error:
        missing.append(f"antenna: {error}")
        return None
    if antenna.source == "assumed at the camera":
        missing.append("antenna: no static transform says where it is; give --antenna-offset X,Y,Z when mapping")
    return antenna


def _antenna_info(antenna: Antenna) -> AntennaInfo:
    x, y, z = (float(value) for value in antenna.position_in_cam_m)
    return AntennaInfo((x, y, z), antenna.source)


def _rhythm(stamps_ns: list[int]) -> tuple[float | None, float | None]:
    """Mean rate and longest gap; None for fewer than two stamps."""
    ordered = np.sort(np.array(stamps_ns, dtype=np.int64))
    if len(ordered) < 2 or ordered[-1] == ordered[0]:
        return None, None
    return float((len(ordered) - 1) / ((ordered[-1] - ordered[0]) * 1e-9)), float(np.diff(ordered).max() * 1e-9)


def _length_m(fixes: list[GnssFix]) -> float:
    """Ground metres along the fixes, in steps long enough that noise does not add up."""
    lat, lon = fixes[0].lat_deg, fixes[0].lon_deg
    grid = UtmGrid.at(lat, lon)
    points = grid.from_geodetic(
        np.array([fix.lat_deg for fix in fixes]),
        np.array([fix.lon_deg for fix in fixes]),
        np.array([fix.height_m for fix in fixes]),
    )
    length, kept = 0.0, points[0]
    for point in points[1:]:
        step = float(np.linalg.norm(point[:2] - kept[:2]))
        if step >= _LENGTH_STEP_M:
            length, kept = length + step, point
    return float(length + np.linalg.norm(points[-1, :2] - kept[:2])) / grid.point_scale_factor(lat, lon)
