"""The door for protobuf: messages by the descriptors that the recording itself holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from fleetmap.drives.mcap_file import Topic
from fleetmap.errors import DriveError


class ProtobufDecoder:
    """Decodes the messages of one topic."""

    def __init__(self, topic: Topic) -> None:
        """Raises DriveError if the recording's descriptors make no message type."""
        self._topic = topic
        self._parse = _parser_of(topic)

    def decode(self, data: bytes, log_time_ns: int) -> Any:
        """The message as an object with the fields of its descriptor.

        Raises:
            DriveError: the bytes do not fit the descriptor.
        """
        try:
            return self._parse(data)
        except Exception as error:  # a parser fed with damaged bytes
            raise DriveError(
                f"a message of {self._topic.name} (log time {log_time_ns} ns) is no"
                f" {self._topic.message_type} in protobuf: {error}"
            ) from error


def field_names(topic: Topic) -> frozenset[str]:
    """The fields of a topic's messages; none where its descriptors cannot be understood."""
    try:
        message = _parser_of(topic)(b"")
    except Exception:  # a topic that nobody asked for may be as broken as it likes
        return frozenset()
    return frozenset(message.DESCRIPTOR.fields_by_name)


def _parser_of(topic: Topic) -> Callable[[bytes], Any]:
    schema = Schema(id=1, data=topic.schema_data, encoding=topic.schema_encoding, name=topic.message_type)
    try:
        parser = DecoderFactory().decoder_for(topic.message_encoding, schema)
    except Exception as error:  # a parser fed with foreign bytes
        raise _unclear(topic, " ".join(str(error).split())) from error
    if parser is None:
        raise _unclear(topic, f"its schema is in {topic.schema_encoding or 'nothing'}, not in protobuf")
    return parser


def _unclear(topic: Topic, reason: str) -> DriveError:
    return DriveError(
        f"the message definition of {topic.name} ({topic.message_type}) cannot be understood: {reason}"
    )
