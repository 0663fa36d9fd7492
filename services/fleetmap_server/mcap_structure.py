"""The server's own look at a recording while it arrives: is it one whole MCAP file, and does it hold anything.

Only the frame of the file is read: magic, the header of every record, the summary at its end. What
is inside chunks is passed over, so gigabytes take as long as reading them, and memory does not grow with the file.
The worker that maps the recording reads everything.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import NoReturn

from fleetmap.errors import DriveError

MAGIC = b"\x89MCAP0\r\n"
RECORD_LIMIT_BYTES = 1 << 30  # as for everybody who reads recordings here

_RECORD_HEADER = struct.Struct("<BQ")  # opcode, length
_MESSAGE_START = struct.Struct("<HIQ")  # channel, sequence, log time
_CHUNK_START = struct.Struct("<QQQII")  # start, end, uncompressed bytes, their checksum, length of the compression
_CHUNK_INDEX_START = struct.Struct("<QQQQ")  # start, end, offset, length
_STATISTICS_START = struct.Struct("<QHIIIIQQ")  # messages, schemas, channels, attachments, ..., start, end
_SUMMARY_OFFSET = struct.Struct("<BQQ")  # opcode, start, length
_FOOTER = struct.Struct("<QQI")  # start of the summary, of its offsets, checksum
_CHANNEL_INDEX_START = struct.Struct("<HI")  # channel, bytes of its entries
_INDEX_ENTRY_BYTES = 16
_FIRST_PRIVATE_OPCODE = 0x80
_LONGEST_COMPRESSION_BYTES = 64


class _Op(IntEnum):
    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


_ANYWHERE = frozenset((_Op.SCHEMA, _Op.CHANNEL)) | frozenset(range(_FIRST_PRIVATE_OPCODE, 0x100))
_IN_DATA = _ANYWHERE | {_Op.MESSAGE, _Op.CHUNK, _Op.MESSAGE_INDEX, _Op.ATTACHMENT, _Op.METADATA, _Op.DATA_END}
_IN_SUMMARY = _ANYWHERE | {
    *(_Op.STATISTICS, _Op.CHUNK_INDEX, _Op.ATTACHMENT_INDEX, _Op.METADATA_INDEX),
    *(_Op.SUMMARY_OFFSET, _Op.FOOTER),
}
_KNOWN = _IN_DATA | _IN_SUMMARY | {_Op.HEADER}


@dataclass(frozen=True)
class McapStructure:
    """What the frame of a recording tells, None where it does not; times are log times."""

    size_bytes: int
    channels: int | None
    messages: int | None
    start_ns: int | None
    end_ns: int | None


def check_mcap(pieces: Iterable[bytes]) -> McapStructure:
    """Read a recording from its first to its last byte, in pieces of any size.

    Raises:
        DriveError: it is no MCAP file, is cut or padded, contradicts itself, or holds no message.
    """
    stream = _Stream(pieces)
    if (start := stream.take_at_most(len(MAGIC))) != MAGIC:
        raise DriveError(
            f"it is no MCAP recording: it begins with {start.hex(' ') or 'nothing'}; send an .mcap file"
        )
    walk = _Walk(stream)
    walk.header()
    walk.data()
    walk.summary()
    walk.end()
    return walk.result()


class _Walk:
    """From record to record; each section is one method."""

    def __init__(self, stream: _Stream) -> None:
        self._stream = stream
        self._data_end = 0  # offset of the first byte behind the data section
        self._channels = 0  # outside chunks
        self._messages = 0  # outside chunks, and in the indexes of chunks
        self._filled_chunks = 0
        self._times_ns: tuple[int, int] | None = None
        self._statistics: tuple[int, ...] | None = None

    def header(self) -> None:
        self._pass_over(self._record(frozenset({_Op.HEADER})))

    def data(self) -> None:
        while True:
            record = self._record(_IN_DATA)
            if record.opcode == _Op.MESSAGE:
                _, _, time_ns = self._fields(record, _MESSAGE_START)
                self._saw(time_ns, time_ns)
                self._messages += 1
            elif record.opcode == _Op.CHUNK:
                self._chunk(record)
            elif record.opcode == _Op.MESSAGE_INDEX:
                _, length = self._fields(record, _CHANNEL_INDEX_START)
                self._messages += length // _INDEX_ENTRY_BYTES
            self._channels += record.opcode == _Op.CHANNEL
            self._pass_over(record)
            if record.opcode == _Op.DATA_END:
                self._data_end = self._stream.offset
                return

    def summary(self) -> None:
        self._stream.crc = 0
        while True:
            record = self._record(_IN_SUMMARY)
            if record.opcode == _Op.FOOTER:
                self._footer(record)
                return
            if record.opcode == _Op.CHUNK_INDEX:
                _, _, offset, length = self._fields(record, _CHUNK_INDEX_START)
                self._within(record, "a chunk", len(MAGIC), offset, length, self._data_end)
            elif record.opcode == _Op.STATISTICS:
                self._statistics = self._fields(record, _STATISTICS_START)
            elif record.opcode == _Op.SUMMARY_OFFSET:
                _, offset, length = self._fields(record, _SUMMARY_OFFSET)
                self._within(record, "a part of the summary", self._data_end, offset, length, record.offset)
            self._pass_over(record)

    def end(self) -> None:
        offset = self._stream.offset
        if self._stream.take_at_most(len(MAGIC)) != MAGIC:
            self._fail(offset, "the file does not end with MCAP's magic")
        offset = self._stream.offset
        if more := self._stream.skip_rest():
            self._fail(offset, f"{more} bytes follow behind the end of the recording")

    def result(self) -> McapStructure:
        times_ns = self._times_ns or (None, None)
        channels: int | None = self._channels
        messages: int | None = self._messages
        if self._statistics is not None:
            messages, _, channels, *_, start_ns, end_ns = self._statistics
            times_ns = (start_ns, end_ns)
        elif self._filled_chunks:  # what they hold may be told nowhere outside them
            channels, messages = channels or None, messages or None
        if channels == 0 or messages == 0:
            raise DriveError("the recording holds no message on any channel; record it again")
        return McapStructure(self._stream.offset, channels, messages, *times_ns)

    def _chunk(self, record: _Record) -> None:
        start_ns, end_ns, _, _, name_bytes = self._fields(record, _CHUNK_START)
        if name_bytes > _LONGEST_COMPRESSION_BYTES:
            self._fail(record.offset, "a chunk's header makes no sense")
        (data_bytes,) = struct.unpack("<Q", self._take(record, name_bytes + 8)[name_bytes:])
        if data_bytes != record.end - self._stream.offset or start_ns > end_ns:
            self._fail(record.offset, "a chunk's lengths or times contradict one another")
        if end_ns > 0:  # the format's way of saying that it holds messages
            self._filled_chunks += 1
            self._saw(start_ns, end_ns)

    def _footer(self, record: _Record) -> None:
        before_crc = self._take(record, _FOOTER.size - 4)
        crc = self._stream.crc
        (expected_crc,) = struct.unpack("<I", self._take(record, 4))
        summary_start, offsets_start = struct.unpack("<QQ", before_crc)
        for start in (summary_start, offsets_start):
            if start:
                self._within(record, "the summary", self._data_end, start, 0, record.offset)
        if expected_crc and summary_start in (0, self._data_end) and crc != expected_crc:
            self._fail(self._data_end, "the summary's checksum does not hold")
        self._pass_over(record)

    def _record(self, allowed: frozenset[int]) -> _Record:
        """The next record's header; fails for what cannot be one, or does not belong in this section."""
        offset = self._stream.offset
        header = self._stream.take_at_most(_RECORD_HEADER.size)
        if len(header) < _RECORD_HEADER.size:
            self._fail(offset, "the file ends where a record belongs: it was cut, or never finished")
        opcode, length = _RECORD_HEADER.unpack(header)
        if opcode not in _KNOWN or length > RECORD_LIMIT_BYTES:
            self._fail(offset, f"no record has opcode {opcode} and {length} bytes")
        if opcode not in allowed:
            self._fail(offset, f"a record with opcode {opcode} does not belong there")
        return _Record(opcode, offset, offset + _RECORD_HEADER.size + length)

    def _fields(self, record: _Record, layout: struct.Struct) -> tuple[int, ...]:
        return layout.unpack(self._take(record, layout.size))

    def _take(self, record: _Record, size: int) -> bytes:
        if self._stream.offset + size > record.end:
            self._fail(record.offset, f"a record with opcode {record.opcode} is too short for what it says")
        data = self._stream.take_at_most(size)
        if len(data) < size:
            self._fail_cut(record)
        return data

    def _pass_over(self, record: _Record) -> None:
        self._stream.skip(record.end - self._stream.offset)
        if self._stream.offset < record.end:
            self._fail_cut(record)

    def _within(self, record: _Record, what: str, begin: int, offset: int, length: int, end: int) -> None:
        if not begin <= offset <= offset + length <= end:
            self._fail(
                record.offset, f"it says {what} lies at {offset}, {length} bytes long, outside {begin} to {end}"
            )

    def _saw(self, start_ns: int, end_ns: int) -> None:
        before = self._times_ns or (start_ns, end_ns)
        self._times_ns = (min(before[0], start_ns), max(before[1], end_ns))

    def _fail_cut(self, record: _Record) -> NoReturn:
        self._fail(
            record.offset,
            f"the record there should end at byte {record.end}, the file ends at {self._stream.offset}",
        )

    def _fail(self, offset: int, reason: str) -> NoReturn:
        raise DriveError(
            f"the recording is damaged at byte {offset}: {reason}; "
            "'fleetmap convert' writes what can be read of it into a sound file"
        )


@dataclass(frozen=True)
class _Record:
    opcode: int
    offset: int  # of its header
    end: int  # of the first byte behind it


class _Stream:
    """Bytes of a file one after the other, of which only one piece is held."""

    def __init__(self, pieces: Iterable[bytes]) -> None:
        self._pieces: Iterator[bytes] = iter(pieces)
        self._piece = memoryview(b"")
        self.offset = 0
        self.crc: int | None = None  # of all bytes from where it was set to 0

    def take_at_most(self, size: int) -> bytes:
        """The next bytes; fewer at the end of the file."""
        return b"".join(self._next(size))

    def skip(self, size: int) -> None:
        """Go on behind the next bytes, or to the end of the file."""
        for _ in self._next(size):
            pass

    def skip_rest(self) -> int:
        """Go to the end of the file; how many bytes that was."""
        begin = self.offset
        while self._refill():
            self.skip(len(self._piece))
        return self.offset - begin

    def _next(self, size: int) -> Iterator[memoryview]:
        while size > 0 and self._refill():
            part, self._piece = self._piece[:size], self._piece[size:]
            size -= len(part)
            self.offset += len(part)
            if self.crc is not None:
                self.crc = zlib.crc32(part, self.crc)
            yield part

    def _refill(self) -> bool:
        """Whether there is a byte to read."""
        while not self._piece:
            piece = next(self._pieces, None)
            if piece is None:
                return False
            self._piece = memoryview(piece)
        return True
