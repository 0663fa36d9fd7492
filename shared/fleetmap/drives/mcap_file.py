"""The door for mcap: what topics a file holds, and its raw messages, streamed in log-time order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.summary import Summary

from fleetmap.errors import DriveError

_MAGIC = b"\x89MCAP0\r\n"
_RECORD_SIZE_LIMIT = 1 << 30

_McapMessage = tuple[Schema | None, Channel, Message]


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    message_type: str  # such as sensor_msgs/msg/Image
    message_encoding: str  # "cdr" for ROS 2
    schema_encoding: str  # "ros2msg" or "ros2idl"
    schema_text: str
    message_count: int


@dataclass(frozen=True)
class RawMessage:
    """One message as it lies in the file."""

    topic: str
    log_time_ns: int
    data: bytes


class McapFile:
    """A complete MCAP file. Messages are streamed: at most a few chunks are in memory at a time."""

    def __init__(self, path: Path) -> None:
        """Check both ends and read the summary.

        Raises:
            DriveError: not there, empty, not an MCAP, truncated, or damaged.
        """
        self.path = path
        with _opened(path) as file:
            _check_both_ends(path, file)
            self._is_indexed, topics = self._read_summary(file)
        self.topics = topics if topics is not None else self._scan_topics()

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """The messages of some topics, in log-time order (in file order if the file has no index).

        Raises:
            DriveError: the file is damaged.
        """
        for _, channel, message in self._stream(topics):
            yield RawMessage(channel.topic, message.log_time, message.data)

    def _read_summary(self, file: IO[bytes]) -> tuple[bool, dict[str, Topic] | None]:
        """Whether chunks can be found by an index, and the topics if the summary counts their messages."""
        try:
            summary = SeekingReader(file, record_size_limit=_RECORD_SIZE_LIMIT).get_summary()
        except Exception as error:  # a parser fed with foreign bytes
            raise _damaged(self.path, error) from error
        if summary is None or not summary.channels:
            return False, None
        names_all_schemas = all(c.schema_id in summary.schemas for c in summary.channels.values() if c.schema_id)
        is_indexed = bool(summary.chunk_indexes) and names_all_schemas
        return is_indexed, _topics_of(summary) if summary.statistics and names_all_schemas else None

    def _scan_topics(self) -> dict[str, Topic]:
        """Topics and counts of a file that ends without them: one pass over all messages."""
        topics: dict[str, Topic] = {}
        for schema, channel, _ in self._stream(None):
            counted = topics.get(channel.topic) or _topic(schema, channel, 0)
            topics[channel.topic] = replace(counted, message_count=counted.message_count + 1)
        return topics

    def _stream(self, topics: tuple[str, ...] | None) -> Iterator[_McapMessage]:
        with _opened(self.path) as file:
            reader: SeekingReader | NonSeekingReader
            if self._is_indexed:
                reader = SeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_SIZE_LIMIT)
            else:
                reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_SIZE_LIMIT)
            messages = reader.iter_messages(topics, log_time_order=self._is_indexed)
            while True:
                try:
                    message = next(messages)
                except StopIteration:
                    return
                except Exception as error:  # decompressors and parsers fed with damaged bytes
                    raise _damaged(self.path, error) from error
                yield message


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise DriveError(f"cannot read recording {path}: {error.strerror or error}") from error


def _check_both_ends(path: Path, file: IO[bytes]) -> None:
    start = file.read(len(_MAGIC))
    if not start:
        raise DriveError(f"recording {path} is empty (0 bytes); record or convert it again")
    if start != _MAGIC[: len(start)]:
        raise DriveError(f"{path} is not an MCAP file; fleetmap reads MCAP recordings with ROS 2 messages")
    size = file.seek(0, 2)
    file.seek(max(0, size - len(_MAGIC)))
    if size < 2 * len(_MAGIC) or file.read() != _MAGIC:
        raise DriveError(
            f"recording {path} is truncated (it does not end like an MCAP file); copy it again,"
            " or repair it with 'mcap recover'"
        )
    file.seek(0)


def _topics_of(summary: Summary) -> dict[str, Topic]:
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    topics: dict[str, Topic] = {}
    for channel in summary.channels.values():
        known = topics.get(channel.topic) or _topic(summary.schemas.get(channel.schema_id), channel, 0)
        topics[channel.topic] = replace(known, message_count=known.message_count + counts.get(channel.id, 0))
    return dict(sorted(topics.items()))


def _topic(schema: Schema | None, channel: Channel, message_count: int) -> Topic:
    return Topic(
        name=channel.topic,
        message_type=schema.name if schema else "",
        message_encoding=channel.message_encoding,
        schema_encoding=schema.encoding if schema else "",
        schema_text=schema.data.decode("utf-8", errors="replace") if schema else "",
        message_count=message_count,
    )


def _damaged(path: Path, error: Exception) -> DriveError:
    reason = f"{type(error).__name__}: {error}".rstrip(": ").splitlines()[0]
    return DriveError(f"recording {path} is damaged ({reason}); copy it again, or repair it with 'mcap recover'")
