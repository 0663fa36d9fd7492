"""What a recording's topics are good for, and their messages as values: the table of all that fleetmap reads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from fleetmap.drives import foxglove_messages, foxglove_values, ros2_values
from fleetmap.drives.mcap_file import McapFile, Topic
from fleetmap.drives.messages import Kind, Reading, Readings, T
from fleetmap.drives.ros2_messages import MessageDecoder, ros2_name
from fleetmap.errors import DriveError


class _Decoder(Protocol):
    def decode(self, data: bytes, log_time_ns: int) -> Any: ...


@dataclass(frozen=True)
class _Encoding:
    decoder: type[MessageDecoder] | type[foxglove_messages.ProtobufDecoder]
    readings: Readings


_ROS_READINGS: Readings = {**ros2_values.READINGS, **foxglove_values.ROS_READINGS}
_ENCODINGS = {
    "cdr": _Encoding(MessageDecoder, _ROS_READINGS),
    "ros1": _Encoding(MessageDecoder, _ROS_READINGS),
    "protobuf": _Encoding(foxglove_messages.ProtobufDecoder, foxglove_values.PROTOBUF_READINGS),
}


def kind_of(topic: Topic) -> Kind[Any] | None:
    """What a topic holds; None for what fleetmap does not read."""
    reading = _reading_of(topic)
    return reading.kind if reading else None


def topics_of(mcap: McapFile, kind: Kind[Any]) -> list[str]:
    """The topics that hold at least one message of a kind."""
    return [topic.name for topic in mcap.topics.values() if topic.message_count and kind_of(topic) == kind]


def read_values(mcap: McapFile, kind: Kind[T], topic: str) -> Iterator[T]:
    """The messages of a topic of some kind as values, in the order of the recording.

    Raises:
        DriveError: a message that is not what its type says.
    """
    description = mcap.topics[topic]
    reading: Reading[T] | None = _reading_of(description)
    if reading is None or reading.kind != kind:
        raise DriveError(f"{topic} in {mcap.path} holds {description.message_type or 'nothing'}, no {kind.name}")
    decoder: _Decoder = _ENCODINGS[description.message_encoding].decoder(description)
    for raw in mcap.messages(topic):
        message = decoder.decode(raw.data, raw.log_time_ns)
        try:
            values = list(reading.values_of(message))
        except (AttributeError, TypeError, ValueError) as error:  # a definition of that name with other fields
            raise DriveError(
                f"a message of {topic} in {mcap.path} (log time {raw.log_time_ns} ns) is no"
                f" {description.message_type} as fleetmap knows it: {error}"
            ) from error
        yield from values


def first_value(mcap: McapFile, kind: Kind[T], topic: str) -> T:
    """What the first message of a topic says.

    Raises:
        DriveError: it says nothing, or is not what its type says.
    """
    value = next(read_values(mcap, kind, topic), None)
    if value is None:
        raise DriveError(
            f"{topic} in {mcap.path} holds no {kind.name}; the file is damaged, or the messages empty"
        )
    return value


def _reading_of(topic: Topic) -> Reading[Any] | None:
    encoding = _ENCODINGS.get(topic.message_encoding)
    if encoding is None:
        return None
    name = ros2_name(topic.message_type) if topic.message_encoding == "ros1" else topic.message_type
    if topic.message_encoding == "protobuf" and _is_imu(topic):
        return foxglove_values.IMU_READING
    return encoding.readings.get(name)


def _is_imu(topic: Topic) -> bool:
    """Foxglove has no schema for inertial data, but others have, with the fields of sensor_msgs/Imu."""
    calls_itself_imu = topic.message_type.rpartition(".")[2].lower().startswith("imu")
    return calls_itself_imu and foxglove_messages.field_names(topic) >= foxglove_values.IMU_FIELDS
