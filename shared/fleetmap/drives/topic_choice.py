"""Which topics of a recording make up the drive of one camera."""

from __future__ import annotations

import logging

from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.messages import (
    CALIBRATIONS,
    FIXES,
    IMAGES,
    INERTIAL,
    SPEEDS,
    CalibrationMessage,
    CompressedPicture,
    ImageMessage,
    RawPicture,
)
from fleetmap.drives.topic_reading import first_value, read_values, topics_of
from fleetmap.errors import CalibrationError, DriveError

_log = logging.getLogger(__name__)

_DEPTH_ENCODINGS = ("16UC1", "32FC1")  # REP 118: millimetres, metres
_COMMAND_NAMES = ("cmd", "command", "setpoint")


def choose_image_topic(mcap: McapFile, wanted: str | None) -> str:
    """The only topic with a camera's images, or the wanted one; depth images do not count.

    Raises:
        DriveError: no images, several topics and none wanted, or the wanted one is not there.
    """
    candidates = topics_of(mcap, IMAGES)
    if not candidates:
        raise DriveError(
            f"{mcap.path} holds no ROS 2 images (CompressedImage or Image in CDR) and no Foxglove images"
            f" (CompressedImage, RawImage or CompressedVideo in protobuf); it holds {_held(mcap)}"
        )
    if wanted is not None:
        chosen = _wanted(mcap, wanted, candidates, "images")
        if is_depth(first_value(mcap, IMAGES, chosen)):
            raise DriveError(f"{chosen} in {mcap.path} holds depth images, not a camera's; choose another topic")
        return chosen
    of_cameras = [topic for topic in candidates if _is_of_camera(mcap, topic, has_rivals=len(candidates) > 1)]
    if not of_cameras:
        raise DriveError(f"{mcap.path} holds depth images only ({', '.join(candidates)}), no camera's images")
    if len(of_cameras) > 1:
        raise DriveError(
            f"{mcap.path} holds {len(of_cameras)} image topics: {', '.join(of_cameras)};"
            " choose one with --image-topic"
        )
    return of_cameras[0]


def choose_gnss_topic(mcap: McapFile, wanted: str | None) -> str | None:
    """The only topic with GNSS fixes, or the wanted one; None in a recording without GNSS.

    Raises:
        DriveError: several topics and none wanted, or the wanted one is not there.
    """
    candidates = topics_of(mcap, FIXES)
    if wanted is not None:
        return _wanted(mcap, wanted, candidates, "GNSS fixes")
    if len(candidates) > 1:
        raise DriveError(
            f"{mcap.path} holds {len(candidates)} GNSS topics: {', '.join(candidates)};"
            " choose one with --gnss-topic"
        )
    return candidates[0] if candidates else None


def choose_imu_topic(mcap: McapFile) -> str | None:
    """The topic with inertial measurements, of several the one with the highest rate; None without any."""
    return _of_highest_rate(mcap, topics_of(mcap, INERTIAL))


def choose_speed_topic(mcap: McapFile) -> str | None:
    """The topic with the vehicle's speed, of several the one with the highest rate; None without any.

    Commanded speeds do not count, nor do velocities in a GNSS receiver's frame: those are east, north and up.
    """
    gnss_frames = {first_value(mcap, FIXES, topic).frame_id for topic in topics_of(mcap, FIXES)}
    candidates = []
    for topic in topics_of(mcap, SPEEDS):
        first = next(read_values(mcap, SPEEDS, topic), None)
        is_command = any(name in topic.lower() for name in _COMMAND_NAMES)
        if first is not None and not is_command and first.frame_id not in gnss_frames - {""}:
            candidates.append(topic)
    return _of_highest_rate(mcap, candidates)


def choose_calibration(mcap: McapFile, image_topic: str, image_frame_id: str) -> tuple[str, CalibrationMessage]:
    """The calibration topic that belongs to an image topic, and its first message.

    The one with the same frame, else the sibling by name, else the only one there is.

    Raises:
        CalibrationError: none there, or several and none belongs to the image.
    """
    found = {topic: first_value(mcap, CALIBRATIONS, topic) for topic in topics_of(mcap, CALIBRATIONS)}
    if not found:
        raise CalibrationError(
            f"{mcap.path} holds no calibration: no CameraInfo or CameraCalibration for {image_topic};"
            " record its camera_info topic too"
        )
    same_frame = [name for name, calibration in found.items() if image_frame_id == calibration.frame_id != ""]
    siblings = [name for name in _sibling_topics(image_topic) if name in found]
    siblings_in_frame = [name for name in siblings if name in same_frame]
    if len(same_frame) == 1 or siblings_in_frame:
        chosen = (siblings_in_frame or same_frame)[0]
    elif siblings and not same_frame:
        chosen = siblings[0]
    elif len(found) == 1:
        chosen = next(iter(found))
        _log.warning(
            "%s: images of frame '%s' use the only calibration there is, %s of frame '%s'",
            mcap.path.name, image_frame_id, chosen, found[chosen].frame_id,
        )  # fmt: skip
    else:
        raise CalibrationError(
            f"{mcap.path}: no calibration of {', '.join(found)} belongs to {image_topic}"
            f" (by frame '{image_frame_id}', or by name {_sibling_topics(image_topic)[0]})"
        )
    return chosen, found[chosen]


def is_depth(image: ImageMessage) -> bool:
    """Whether an image holds distances: raw, or compressed by ROS' compressed_depth_image_transport."""
    match image.picture:
        case RawPicture(encoding=encoding):
            return encoding in _DEPTH_ENCODINGS
        case CompressedPicture(format=recorded):
            return "compressedDepth" in recorded or recorded.partition(";")[0].strip() in _DEPTH_ENCODINGS
    return False


def _is_of_camera(mcap: McapFile, topic: str, *, has_rivals: bool) -> bool:
    try:
        return not is_depth(first_value(mcap, IMAGES, topic))
    except DriveError as error:
        if not has_rivals:
            raise
        _log.warning("%s: %s is left out: %s", mcap.path.name, topic, error)
        return False


def _of_highest_rate(mcap: McapFile, candidates: list[str]) -> str | None:
    return max(candidates, key=lambda topic: mcap.topics[topic].message_count, default=None)


def _sibling_topics(image_topic: str) -> list[str]:
    """`/x/image/compressed` -> `/x/camera_info`, `/x/calibration` (as Foxglove has it), `/x/image/camera_info`."""
    base = image_topic.removesuffix("/compressed")
    folder = base.rpartition("/")[0]
    siblings = [f"{folder}/camera_info", f"{folder}/calibration"]
    return [*siblings, f"{base}/camera_info"] if base != image_topic else siblings


def _held(mcap: McapFile) -> str:
    held = []
    for topic in mcap.topics.values():
        is_usual = topic.message_encoding in ("cdr", "protobuf")
        kind = (topic.message_type or "no type") + ("" if is_usual else f" in {topic.message_encoding or '?'}")
        held.append(f"{topic.name} ({kind})")
    return ", ".join(held) or "nothing"


def _wanted(mcap: McapFile, wanted: str, candidates: list[str], what: str) -> str:
    topic = "/" + wanted.lstrip("/")
    if topic in candidates:
        return topic
    if wanted in candidates:
        return wanted
    offer = f"; it has {', '.join(candidates)}" if candidates else ", nor on any other topic"
    raise DriveError(f"{mcap.path} has no {what} on {wanted}{offer}")
