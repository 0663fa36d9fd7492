"""The door for mcap: what topics a file holds, and its raw messages, streamed in log-time order."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from mcap.records import Channel, Schema

from fleetmap.drives.mcap_index import (
    MAGIC,
    DamagedBlockError,
    Gap,
    McapIndex,
    Position,
    index_of_summary,
    messages_in_order,
)
from fleetmap.drives.mcap_scan import scan
from fleetmap.errors import DriveError

_log = logging.getLogger(__name__)

_NAMED_GAPS = 3  # a warning lists no more of them
_told: set[tuple[str, int, int]] = set()  # damaged files that were warned about: some are opened more than once


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    message_type: str  # such as sensor_msgs/msg/Image
    message_encoding: str  # "cdr" for ROS 2
    schema_encoding: str  # "ros2msg" or "ros2idl"
    schema_data: bytes  # a text for ROS 2, a binary descriptor for protobuf
    message_count: int

    @property
    def schema_text(self) -> str:
        """The schema as text."""
        return self.schema_data.decode("utf-8", errors="replace")


@dataclass(frozen=True)
class RawMessage:
    """One message as it lies in the file."""

    topic: str
    log_time_ns: int
    data: bytes


class McapFile:
    """An MCAP file. Messages are streamed: a chunk at a time, and of chunks that overlap in time about 64 MB.

    A file without an index is scanned once, when it is opened. So is one whose end is missing, and, as soon as a
    damaged chunk is met, one with an index; then one warning says what is left out.
    """

    def __init__(self, path: Path) -> None:
        """Read the summary, or scan the file where it has none.

        Raises:
            DriveError: not there, empty, not an MCAP, or unfinished or damaged so that no message is left.
        """
        self.path = path
        with self._opened() as file:
            _check_start(path, file)
            self._index = index_of_summary(file) or scan(file)
        self._check_something_is_left()
        self.topics = _topics_of(self._index)

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """The messages of some topics, in log-time order.

        Raises:
            DriveError: the file cannot be read any more, or nothing in it can.
        """
        after: Position | None = None
        with self._opened() as file:
            while True:
                self._tell_what_is_missing()
                index = self._index
                ids = {channel.id for channel in index.channels.values() if channel.topic in topics}
                try:
                    for position, channel_id, data in messages_in_order(file, index, ids, after):
                        after = position
                        yield RawMessage(index.channels[channel_id].topic, position[0], data)
                    return
                except DamagedBlockError:
                    self._rescan(file)

    def _rescan(self, file: IO[bytes]) -> None:
        self._index = scan(file)
        self._check_something_is_left()
        self.topics = _topics_of(self._index)

    def _check_something_is_left(self) -> None:
        index = self._index
        if index.message_count or (index.unfinished_bytes is None and not index.gaps):
            return
        state = "damaged" if index.unfinished_bytes is None else "truncated"
        reason = f"; {index.gaps[0].reason}" if index.gaps else ""
        raise DriveError(f"recording {self.path} is {state}: no message in it can be read{reason}; copy it again")

    def _tell_what_is_missing(self) -> None:
        """One warning a file, as soon as its messages are asked for."""
        state = self.path.stat()
        file = (str(self.path.resolve()), state.st_size, state.st_mtime_ns)
        if file not in _told and (losses := _losses(self._index)):
            _told.add(file)
            _log.warning(
                "recording %s %s; %d messages are read", self.path, "; it ".join(losses), self._index.message_count
            )

    @contextmanager
    def _opened(self) -> Iterator[IO[bytes]]:
        try:
            with self.path.open("rb") as file:
                yield file
        except OSError as error:
            raise DriveError(f"cannot read recording {self.path}: {error.strerror or error}") from error


def _check_start(path: Path, file: IO[bytes]) -> None:
    start = file.read(len(MAGIC))
    if not start:
        raise DriveError(f"recording {path} is empty (0 bytes); record or convert it again")
    if start != MAGIC[: len(start)]:
        raise DriveError(f"{path} is not an MCAP file; fleetmap reads MCAP recordings")


def _losses(index: McapIndex) -> list[str]:
    """What cannot be read, each as the end of a sentence about the recording."""
    losses = []
    if index.gaps:
        are_chunks = any(block.is_chunk for block in index.blocks)
        one, many = ("chunk", "chunks") if are_chunks else ("stretch", "stretches")
        count = len(index.gaps)
        what = f"1 {one} cannot be read and is" if count == 1 else f"{count} {many} cannot be read and are"
        places = "; ".join(_place(index, gap) for gap in index.gaps[:_NAMED_GAPS])
        more = "; ..." if len(index.gaps) > _NAMED_GAPS else ""
        losses.append(f"is damaged: {what} left out ({places}{more})")
    elif index.is_doubtful:
        losses.append("is damaged: its checksum does not fit, and some of its messages may be wrong")
    if index.unfinished_bytes is not None:
        losses.append(
            "was not finished (its recorder lost power, or the copy is incomplete):"
            f" {index.unfinished_bytes} bytes at its end are left out"
        )
    return losses


def _place(index: McapIndex, gap: Gap) -> str:
    """Where a gap is, in bytes and in seconds since the recording's first message that can be read."""
    before = max((b for b in index.blocks if b.offset < gap.begin), key=lambda b: b.offset, default=None)
    behind = min((b for b in index.blocks if b.offset > gap.begin), key=lambda b: b.offset, default=None)
    start_ns = gap.start_ns if gap.start_ns is not None else before.end_ns if before else None
    end_ns = gap.end_ns if gap.end_ns is not None else behind.start_ns if behind else None
    place = f"bytes {gap.begin} to {gap.end}"
    if start_ns is None or end_ns is None or end_ns < start_ns:
        return place
    first_ns = min(block.start_ns for block in index.blocks)
    return f"{place}, {(start_ns - first_ns) * 1e-9:.1f} to {(end_ns - first_ns) * 1e-9:.1f} s after its start"


def _topics_of(index: McapIndex) -> dict[str, Topic]:
    topics: dict[str, Topic] = {}
    for channel in index.channels.values():
        known = topics.get(channel.topic) or _topic(index.schemas.get(channel.schema_id), channel)
        count = known.message_count + index.message_counts.get(channel.id, 0)
        topics[channel.topic] = replace(known, message_count=count)
    return dict(sorted(topics.items()))


def _topic(schema: Schema | None, channel: Channel) -> Topic:
    return Topic(
        name=channel.topic,
        message_type=schema.name if schema else "",
        message_encoding=channel.message_encoding,
        schema_encoding=schema.encoding if schema else "",
        schema_data=schema.data if schema else b"",
        message_count=0,
    )
