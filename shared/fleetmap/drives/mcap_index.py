"""Where an MCAP file's messages lie: the blocks it is read in, and what the summary at its end says about them."""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import IO

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Schema
from mcap.summary import Summary

from fleetmap.drives.mcap_records import (
    RECORD_HEADER_BYTES,
    RECORD_LIMIT_BYTES,
    Bytes,
    DamagedRecordError,
    MessageSpan,
    chunk_data,
    chunk_header,
    legible_chunk_data,
    message_spans,
    record_header,
    whole_message_spans,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER_CONTENT_BYTES = 20  # summary_start, summary_offset_start, summary_crc
_ENDING_BYTES = RECORD_HEADER_BYTES + _FOOTER_CONTENT_BYTES + len(MAGIC)
_HELD_LIMIT_BYTES = 64_000_000

Position = tuple[int, int, int]  # log time, offset of the block, number of the message in it: the order of reading


@dataclass(frozen=True)
class Block:
    """A stretch of the file that is read at once: a chunk, or neighbouring messages outside chunks."""

    offset: int
    size_bytes: int
    start_ns: int
    end_ns: int
    channel_ids: frozenset[int] | None  # None where the index does not say
    is_chunk: bool
    is_cut: bool = False  # the file ends inside it; its whole messages count


@dataclass(frozen=True)
class Gap:
    """A stretch of the file that cannot be read."""

    begin: int
    end: int
    start_ns: int | None  # what is known about its messages' log times
    end_ns: int | None
    reason: str


@dataclass
class McapIndex:
    """What a file holds, and where."""

    blocks: list[Block] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)  # by channel
    gaps: list[Gap] = field(default_factory=list)
    unfinished_bytes: int | None = None  # at the end of a file that was not finished
    is_scanned: bool = False  # every block has been read once
    is_doubtful: bool = False  # the data's checksum does not fit, and nothing says where

    @property
    def message_count(self) -> int:
        """Messages of known topics."""
        return sum(count for id_, count in self.message_counts.items() if id_ in self.channels)


class DamagedBlockError(Exception):
    """A block of a file that the summary promised to be whole."""


def index_of_summary(file: IO[bytes]) -> McapIndex | None:
    """What the summary says; None where it is missing, damaged, or says too little to find and count messages."""
    size_bytes = file.seek(0, 2)
    summary_start = _sound_summary_start(file, size_bytes)
    if summary_start is None:
        return None
    file.seek(0)
    try:
        summary = SeekingReader(file, record_size_limit=RECORD_LIMIT_BYTES).get_summary()
    except Exception:  # a parser fed with damaged bytes; the file is scanned instead
        return None
    if summary is None or not summary.chunk_indexes or not summary.channels or not summary.statistics:
        return None
    if any(c.schema_id and c.schema_id not in summary.schemas for c in summary.channels.values()):
        return None
    blocks = _blocks_of(summary)
    if any(block.offset + block.size_bytes > summary_start for block in blocks):
        return None
    counts = dict(summary.statistics.channel_message_counts)
    return McapIndex(blocks, summary.schemas, summary.channels, counts)


def messages_in_order(
    file: IO[bytes], index: McapIndex, channel_ids: Collection[int], after: Position | None
) -> Iterator[tuple[Position, int, bytes]]:
    """Position, channel and data of some channels' messages behind a position, by log time.

    Blocks are read when their first message is due. Of blocks that overlap in time, more than 64 MB are not held:
    then messages come as early as they are known, perhaps before one of a block that is read later.

    Raises:
        DamagedBlockError: a block is not what the index says, and the index was not scanned from the file.
    """
    wanted = frozenset(channel_ids)
    waiting = [b for b in index.blocks if b.channel_ids is None or not wanted.isdisjoint(b.channel_ids)]
    waiting.sort(key=lambda block: (block.start_ns, block.offset), reverse=True)
    held: list[tuple[Position, int, bytes]] = []
    held_bytes = 0
    while waiting or held:
        if waiting and held_bytes <= _HELD_LIMIT_BYTES and (not held or waiting[-1].start_ns <= held[0][0][0]):
            block = waiting.pop()
            if after is not None and block.end_ns < after[0]:
                continue
            for message in _messages_of(file, index, block, wanted):
                if after is None or message[0] > after:
                    heapq.heappush(held, message)
                    held_bytes += len(message[2])
            continue
        message = heapq.heappop(held)
        held_bytes -= len(message[2])
        yield message


def _block_messages(file: IO[bytes], block: Block) -> tuple[Bytes, list[MessageSpan]]:
    """A block's bytes, decompressed, and where in them its messages lie.

    Raises:
        DamagedRecordError: not one whole message after the other.
    """
    file.seek(block.offset)
    raw = memoryview(file.read(block.size_bytes))
    if len(raw) < block.size_bytes:
        raise DamagedRecordError("the file ends inside it")
    if not block.is_chunk:
        return raw, message_spans(raw)
    opcode, length = record_header(raw)
    if opcode != Opcode.CHUNK:
        raise DamagedRecordError("there is no chunk where the index says")
    content = raw[RECORD_HEADER_BYTES:]
    if block.is_cut:
        data = legible_chunk_data(chunk_header(content, length), content)
        return data, whole_message_spans(data)
    data = chunk_data(content)
    return data, message_spans(data)


def _messages_of(
    file: IO[bytes], index: McapIndex, block: Block, wanted: frozenset[int]
) -> Iterator[tuple[Position, int, bytes]]:
    try:
        data, spans = _block_messages(file, block)
    except DamagedRecordError as error:
        if index.is_scanned:  # it went bad since; what can be told has been told
            return
        raise DamagedBlockError from error
    for number, span in enumerate(spans):
        if span.channel_id in wanted:
            position = (span.log_time_ns, block.offset, number)
            yield position, span.channel_id, bytes(data[span.begin : span.end])


def _sound_summary_start(file: IO[bytes], size_bytes: int) -> int | None:
    """Where the summary starts, if the file ends as a finished one does and its checksum fits."""
    file.seek(max(0, size_bytes - _ENDING_BYTES))
    ending = file.read()
    if len(ending) < _ENDING_BYTES or not ending.endswith(MAGIC) or ending[0] != Opcode.FOOTER:
        return None
    footer = ending[RECORD_HEADER_BYTES:]
    summary_start = int.from_bytes(footer[:8], "little")
    summary_crc = int.from_bytes(footer[16:20], "little")
    footer_offset = size_bytes - _ENDING_BYTES
    if not len(MAGIC) < summary_start < footer_offset or footer_offset - summary_start > RECORD_LIMIT_BYTES:
        return None
    file.seek(summary_start)
    checked_bytes = file.read(size_bytes - summary_start - len(MAGIC) - 4)
    return summary_start if summary_crc in (0, zlib.crc32(checked_bytes)) else None


def _blocks_of(summary: Summary) -> list[Block]:
    known: dict[frozenset[int], frozenset[int]] = {}  # thousands of chunks hold the same few channels
    blocks = []
    for chunk in summary.chunk_indexes:
        ids = frozenset(chunk.message_index_offsets)
        times = chunk.message_start_time, chunk.message_end_time
        place = chunk.chunk_start_offset, chunk.chunk_length
        blocks.append(Block(*place, *times, known.setdefault(ids, ids) or None, is_chunk=True))
    return blocks
