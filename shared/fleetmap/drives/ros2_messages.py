"""The door for rosbags: ROS messages from and to bytes, with the definitions a recording brings along.

ROS 2 messages are in CDR. What ``mcap convert`` makes of a ROS 1 bag keeps ROS 1's own encoding; it is read too.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fleetmap.drives.mcap_file import Topic
from fleetmap.errors import DriveError

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_IDL_RULER = "=" * 80 + "\n"


class MessageDecoder:
    """Decodes the messages of one topic by the definition that the recording itself holds."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._message_type = ros2_name(topic.message_type)
        self._is_ros1 = topic.message_encoding == "ros1"
        self._typestore = _typestore_of(topic)

    def decode(self, data: bytes, log_time_ns: int) -> Any:
        """The message as an object with the fields of its definition.

        Raises:
            DriveError: the bytes do not fit the definition.
        """
        if data.startswith(_ZSTD_MAGIC):
            raise DriveError(
                f"the messages of {self._topic.name} are compressed one by one; unpack the recording with"
                " 'ros2 bag convert' (compression of whole chunks is fine)"
            )
        try:
            if self._is_ros1:
                return self._typestore.deserialize_ros1(data, self._message_type)
            return self._typestore.deserialize_cdr(data, self._message_type)
        except Exception as error:  # generated code: damaged bytes can raise anything
            raise DriveError(
                f"a message of {self._topic.name} (log time {log_time_ns} ns) is no"
                f" {self._topic.message_type} in {'ROS 1 encoding' if self._is_ros1 else 'CDR'}: {error}"
            ) from error


def ros2_name(message_type: str) -> str:
    """ROS 1 calls a type ``sensor_msgs/Image`` that ROS 2 calls ``sensor_msgs/msg/Image``."""
    package, _, name = message_type.partition("/")
    return message_type if "/" in name or not name else f"{package}/msg/{name}"


def stamp_ns_of(header: Any) -> int:
    """A std_msgs/Header's stamp in nanoseconds since the epoch."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def frame_id_of(header: Any) -> str:
    """A std_msgs/Header's frame, without the leading slash of older recordings."""
    return str(header.frame_id).lstrip("/")


@lru_cache(maxsize=1)
def standard_typestore() -> Typestore:
    """The definitions that ROS 2 Humble ships."""
    return get_typestore(Stores.ROS2_HUMBLE)


@lru_cache(maxsize=16)
def definition_text(message_type: str) -> str:
    """A standard type's definition with all it depends on, as MCAP's ``ros2msg`` schemas want it."""
    return standard_typestore().generate_msgdef(message_type, ros_version=2)[0]


def encode(message: Any) -> bytes:
    """A message made from the standard typestore's types, as little-endian CDR."""
    return bytes(standard_typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


def _typestore_of(topic: Topic) -> Typestore:
    """One store per definition: two recorders' definitions of one type may differ within one file."""
    if not topic.schema_text.strip():
        return get_typestore(Stores.ROS1_NOETIC) if topic.message_encoding == "ros1" else standard_typestore()
    try:
        return _typestore_by(topic.schema_text, topic.schema_encoding, ros2_name(topic.message_type))
    except Exception as error:  # a parser fed with foreign text
        raise DriveError(
            f"the message definition of {topic.name} ({topic.message_type}) cannot be understood:"
            f" {' '.join(str(error).split())}"
        ) from error


@lru_cache(maxsize=32)  # a topic is often opened anew, and parsing takes 10 ms
def _typestore_by(schema_text: str, schema_encoding: str, message_type: str) -> Typestore:
    typestore = get_typestore(Stores.EMPTY)
    if schema_encoding == "ros2idl":
        for document in _idl_documents(schema_text):
            typestore.register(get_types_from_idl(document))
    else:
        typestore.register(get_types_from_msg(schema_text, message_type))
    typestore.get_msgdef(message_type)
    return typestore


def _idl_documents(bundle: str) -> list[str]:
    """rosbag2 bundles IDL files, each under a ruler and a line ``IDL: package/msg/Name``; includes are inside."""
    without_includes = "".join(
        line for line in bundle.splitlines(keepends=True) if not line.startswith("#include")
    )
    if not bundle.startswith(_IDL_RULER):
        return [without_includes]
    return [part.partition("\n")[2] for part in without_includes.split(_IDL_RULER)[1:]]
