"""Which topics of a recording make up the drive of one camera."""

from __future__ import annotations

import logging
from typing import Any

from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.ros2_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    NAV_SAT_FIX,
    MessageDecoder,
    frame_id_of,
)
from fleetmap.errors import CalibrationError, DriveError

_log = logging.getLogger(__name__)

_DEPTH_ENCODINGS = ("16UC1", "32FC1")  # REP 118: millimetres, metres


def first_message(mcap: McapFile, topic: str) -> Any:
    """The first message of a topic that has some."""
    raw = next(iter(mcap.messages(topic)), None)
    if raw is None:
        raise DriveError(f"{mcap.path} promises messages on {topic} but holds none; the file is damaged")
    return MessageDecoder(mcap.topics[topic]).decode(raw.data, raw.log_time_ns)


def topics_of_type(mcap: McapFile, *message_types: str) -> list[str]:
    """Topics in CDR that hold at least one message of a type."""
    return [
        topic.name
        for topic in mcap.topics.values()
        if topic.message_type in message_types and topic.message_encoding == "cdr" and topic.message_count
    ]


def choose_image_topic(mcap: McapFile, wanted: str | None) -> str:
    """The only image topic, or the wanted one; depth images do not count beside others.

    Raises:
        DriveError: no images, several topics and none wanted, or the wanted one is not there.
    """
    candidates = topics_of_type(mcap, COMPRESSED_IMAGE, IMAGE)
    if wanted is not None:
        return _wanted(mcap, wanted, candidates, "images")
    if not candidates:
        held = ", ".join(f"{topic.name} ({topic.message_type})" for topic in mcap.topics.values()) or "nothing"
        raise DriveError(f"{mcap.path} holds no ROS 2 images (CompressedImage or Image in CDR); it holds {held}")
    if len(candidates) > 1:
        candidates = [topic for topic in candidates if not _holds_depth(mcap, topic)] or candidates
    if len(candidates) > 1:
        raise DriveError(
            f"{mcap.path} holds {len(candidates)} image topics: {', '.join(candidates)};"
            " choose one with --image-topic"
        )
    return candidates[0]


def choose_gnss_topic(mcap: McapFile, wanted: str | None) -> str | None:
    """The only NavSatFix topic, or the wanted one; None in a recording without GNSS.

    Raises:
        DriveError: several topics and none wanted, or the wanted one is not there.
    """
    candidates = topics_of_type(mcap, NAV_SAT_FIX)
    if wanted is not None:
        return _wanted(mcap, wanted, candidates, "NavSatFix messages")
    if len(candidates) > 1:
        raise DriveError(
            f"{mcap.path} holds {len(candidates)} GNSS topics: {', '.join(candidates)};"
            " choose one with --gnss-topic"
        )
    return candidates[0] if candidates else None


def choose_calibration(mcap: McapFile, image_topic: str, image_frame_id: str) -> tuple[str, Any]:
    """The CameraInfo topic that belongs to an image topic, and its first message.

    The one with the same frame, else the sibling by name, else the only one there is.

    Raises:
        CalibrationError: none there, or several and none belongs to the image.
    """
    infos = {topic: first_message(mcap, topic) for topic in topics_of_type(mcap, CAMERA_INFO)}
    if not infos:
        raise CalibrationError(
            f"{mcap.path} holds no calibration: no CameraInfo for {image_topic}; record its camera_info topic too"
        )
    same_frame = [name for name, info in infos.items() if image_frame_id == frame_id_of(info.header) != ""]
    siblings = [name for name in _sibling_info_topics(image_topic) if name in infos]
    siblings_in_frame = [name for name in siblings if name in same_frame]
    if len(same_frame) == 1 or siblings_in_frame:
        chosen = (siblings_in_frame or same_frame)[0]
    elif siblings and not same_frame:
        chosen = siblings[0]
    elif len(infos) == 1:
        chosen = next(iter(infos))
        _log.warning(
            "%s: images of frame '%s' use the only calibration there is, %s of frame '%s'",
            mcap.path.name, image_frame_id, chosen, frame_id_of(infos[chosen].header),
        )  # fmt: skip
    else:
        raise CalibrationError(
            f"{mcap.path}: no CameraInfo of {', '.join(infos)} belongs to {image_topic}"
            f" (by frame '{image_frame_id}', or by name {_sibling_info_topics(image_topic)[0]})"
        )
    return chosen, infos[chosen]


def _holds_depth(mcap: McapFile, topic: str) -> bool:
    is_raw = mcap.topics[topic].message_type == IMAGE
    return is_raw and str(first_message(mcap, topic).encoding) in _DEPTH_ENCODINGS


def _sibling_info_topics(image_topic: str) -> list[str]:
    """`/x/image/compressed` -> `/x/camera_info`, `/x/image/camera_info`; `/x/image` -> `/x/camera_info`."""
    base = image_topic.removesuffix("/compressed")
    siblings = [f"{base.rpartition('/')[0]}/camera_info"]
    return [*siblings, f"{base}/camera_info"] if base != image_topic else siblings


def _wanted(mcap: McapFile, wanted: str, candidates: list[str], what: str) -> str:
    topic = "/" + wanted.lstrip("/")
    if topic in candidates:
        return topic
    if wanted in candidates:
        return wanted
    offer = f"; it has {', '.join(candidates)}" if candidates else ", nor on any other topic"
    raise DriveError(f"{mcap.path} has no {what} on {wanted}{offer}")
