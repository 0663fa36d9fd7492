"""Finds the messages of an MCAP file that cannot be trusted to say itself where they lie, in one pass over it.

Such a file has no index, was not finished (its recorder lost power), or is damaged. Chunks are verified by their
checksum. Where the chain of records breaks, the last record that nothing verified is given up as well (its length
may be the false one), and the scan looks for the next place that can only be a record: a chunk whose lengths agree
with one another, the end of the data, or, in a file without chunks, a message of a known channel before another
record.
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from dataclasses import replace
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from fleetmap.drives.mcap_index import MAGIC, Block, Gap, McapIndex
from fleetmap.drives.mcap_records import (
    MESSAGE_HEADER_BYTES,
    RECORD_HEADER_BYTES,
    Bytes,
    ChunkHeader,
    DamagedRecordError,
    MessageSpan,
    chunk_data,
    chunk_header,
    definition,
    definitions_in,
    legible_chunk_data,
    message_header,
    message_spans,
    record_header,
    whole_message_spans,
)

_DATA_END_START = rb"\x0f\x04\0{7}"
_CHUNK_START = re.compile(rb"\x06(?=.{36}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))|" + _DATA_END_START, re.DOTALL)
_MESSAGE_START = re.compile(rb"\x05(?=.{4}\0{4})|" + _DATA_END_START, re.DOTALL)
_LONGEST_START_BYTES = 48
_CHUNK_HEADER_BYTES = 48  # the longest, in its record's content
_RUN_BYTES = 1 << 20  # messages outside chunks are read together up to this size
_WINDOW_BYTES = 1 << 20


def scan(file: IO[bytes]) -> McapIndex:
    """Index a file from its first to its last byte, with what cannot be read listed as gaps."""
    return _Scan(file).run()


class _Scan:
    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = file.seek(0, 2)
        self._index = McapIndex(is_scanned=True)
        self._counts: Counter[int] = Counter()
        self._channel_sets: dict[frozenset[int], frozenset[int]] = {}  # thousands of blocks hold the same few
        self._doubtful: list[Schema | Channel] = []  # from damaged chunks, for messages that need them
        self._run: list[tuple[int, int, MessageSpan]] = []  # begin and end of neighbouring messages outside chunks
        self._suspect: int | None = None  # the last record, unless verified
        self._is_chunked = False

    def run(self) -> McapIndex:
        offset: int | None = len(MAGIC)
        self._index.unfinished_bytes = 0  # until the footer is found
        while offset is not None and offset < self._size:
            offset = self._step(offset)
        self._close_run()
        for found in self._doubtful:
            known: dict[int, Schema] | dict[int, Channel]
            known = self._index.schemas if isinstance(found, Schema) else self._index.channels
            known.setdefault(found.id, found)  # type: ignore[arg-type]
        self._index.message_counts = dict(self._counts)
        return self._index

    def _step(self, offset: int) -> int | None:
        """Enter the record at an offset into the index; where to go on, or None at the end."""
        is_cut = self._size - offset < RECORD_HEADER_BYTES
        try:
            opcode, length = record_header(self._read(offset, RECORD_HEADER_BYTES))
            end = offset + RECORD_HEADER_BYTES + length
            if opcode == Opcode.CHUNK:
                return self._take_chunk(offset, length)
            is_cut = end > self._size
            if is_cut:
                raise DamagedRecordError("the file ends inside a record")
            self._take(opcode, offset, length)
        except DamagedRecordError as error:
            return self._resume(offset, str(error), is_cut)
        if opcode == Opcode.FOOTER and self._read(end, len(MAGIC)) == MAGIC:
            self._index.unfinished_bytes = None
            return None
        self._suspect = offset
        return end

    def _take(self, opcode: int, offset: int, length: int) -> None:
        begin = offset + RECORD_HEADER_BYTES
        if opcode == Opcode.MESSAGE:
            if self._run and begin + length - self._run[0][0] > _RUN_BYTES:
                self._close_run()
            header = message_header(self._read(begin, MESSAGE_HEADER_BYTES), 0, length)
            self._run.append((offset, begin + length, header))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(definition(opcode, self._read(begin, length)))
        elif opcode == Opcode.DATA_END:
            self._check_data(offset, int.from_bytes(self._read(begin, 4), "little"))

    def _take_chunk(self, offset: int, length: int) -> int | None:
        begin = offset + RECORD_HEADER_BYTES
        header = chunk_header(self._read(begin, _CHUNK_HEADER_BYTES), length)
        self._close_run()
        self._is_chunked, self._suspect = True, None
        content = memoryview(self._read(begin, length))
        if len(content) < length:
            self._take_cut_chunk(offset, header, content)
            return None
        try:
            data = chunk_data(content)
            spans = message_spans(data)
            found = definitions_in(data)
        except DamagedRecordError as error:
            self._add_gap(Gap(offset, begin + length, header.start_ns, header.end_ns, str(error)))
            self._doubtful += definitions_in(legible_chunk_data(header, content))
        else:
            for each in found:
                self._define(each)
            self._add_block(offset, begin + length, spans, is_chunk=True)
        return begin + length

    def _take_cut_chunk(self, offset: int, header: ChunkHeader, content: Bytes) -> None:
        data = legible_chunk_data(header, content)
        spans = whole_message_spans(data)
        for found in definitions_in(data):
            self._define(found)
        self._add_block(offset, self._size, spans, is_chunk=True, is_cut=True)
        self._index.unfinished_bytes = len(data) - spans[-1].end if spans else self._size - offset

    def _resume(self, offset: int, reason: str, is_cut: bool) -> int | None:
        """Where the chain of records goes on behind the damage at an offset; None if nowhere."""
        suspect = self._suspect
        found = self._next_record(offset if suspect is None else suspect + 1)
        begin = offset
        if suspect is not None and (found is None or found < offset):
            begin = suspect
        if self._run and self._run[-1][0] == suspect and not (found is None and is_cut):
            begin = self._run.pop()[0]
        self._suspect = None
        if found is None:
            self._index.unfinished_bytes = self._size - (offset if is_cut else begin)
            return None
        self._close_run()
        self._add_gap(Gap(begin, found, None, None, reason))
        return found

    def _next_record(self, begin: int) -> int | None:
        pattern = _MESSAGE_START if self._index.channels and not self._is_chunked else _CHUNK_START
        for window_begin in range(begin, self._size, _WINDOW_BYTES):
            window = self._read(window_begin, _WINDOW_BYTES + _LONGEST_START_BYTES)
            for match in pattern.finditer(window):
                if match.start() < _WINDOW_BYTES and self._is_record(window_begin + match.start()):
                    return window_begin + match.start()
        return None

    def _is_record(self, offset: int) -> bool:
        """Whether a place that looks like a record can be nothing else."""
        start = self._read(offset, RECORD_HEADER_BYTES + _CHUNK_HEADER_BYTES)
        begin, next_begin = RECORD_HEADER_BYTES, RECORD_HEADER_BYTES
        try:
            opcode, length = record_header(start)
            if opcode == Opcode.CHUNK:
                chunk_header(start[begin:], length)
                return True
            is_known = opcode != Opcode.MESSAGE or self._is_of_known_channel(start, length)
            next_begin += offset + length
            next_opcode, next_length = record_header(start := self._read(next_begin, _LONGEST_START_BYTES))
            return is_known and (next_opcode != Opcode.MESSAGE or self._is_of_known_channel(start, next_length))
        except DamagedRecordError:
            return False

    def _is_of_known_channel(self, record: Bytes, length: int) -> bool:
        return message_header(record, RECORD_HEADER_BYTES, length).channel_id in self._index.channels

    def _close_run(self) -> None:
        if self._run:
            spans = [span for _, _, span in self._run]
            self._add_block(self._run[0][0], self._run[-1][1], spans, is_chunk=False)
            self._run = []

    def _add_block(
        self, begin: int, end: int, spans: list[MessageSpan], *, is_chunk: bool, is_cut: bool = False
    ) -> None:
        if not spans:
            return
        times_ns = [span.log_time_ns for span in spans]
        self._counts.update(span.channel_id for span in spans)
        ids = frozenset(span.channel_id for span in spans)
        ids = self._channel_sets.setdefault(ids, ids)
        self._index.blocks.append(
            Block(begin, end - begin, min(times_ns), max(times_ns), ids, is_chunk=is_chunk, is_cut=is_cut)
        )

    def _add_gap(self, gap: Gap) -> None:
        """Nothing readable between two gaps makes them one, unless both are chunks of their own."""
        gaps = self._index.gaps
        if gaps and gap.begin <= gaps[-1].end and gap.start_ns is None:
            gaps[-1] = replace(gaps[-1], end=gap.end)
        else:
            gaps.append(gap)

    def _define(self, found: Schema | Channel) -> None:
        if isinstance(found, Schema):
            self._index.schemas[found.id] = found
        else:
            self._index.channels[found.id] = found

    def _check_data(self, end: int, expected_crc: int) -> None:
        """Messages outside chunks have no checksum of their own: that of all data says whether they are sound."""
        if expected_crc == 0 or self._index.gaps or (self._is_chunked and not self._run):
            return
        crc = 0
        for begin in range(0, end, _WINDOW_BYTES):
            crc = zlib.crc32(self._read(begin, min(_WINDOW_BYTES, end - begin)), crc)
        self._index.is_doubtful = crc != expected_crc

    def _read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)
