"""The records of an MCAP file, checked: whatever is not as the format says is a DamagedRecordError.

The format: https://mcap.dev/spec. Chunks are decoded here rather than by the mcap package, because that one trusts
lengths, and gives up a whole file for one damaged chunk.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

RECORD_HEADER_BYTES = 9  # opcode and length
RECORD_LIMIT_BYTES = 1 << 30
_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE_HEADER = struct.Struct("<HIQQ")
_CHUNK_HEADER = struct.Struct("<QQQII")
MESSAGE_HEADER_BYTES = _MESSAGE_HEADER.size
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_FIRST_PRIVATE_OPCODE = 0x80
_PIECE_BYTES = 4096  # a damaged chunk is decompressed in such pieces, to keep what comes before the damage

Bytes = bytes | memoryview


class DamagedRecordError(Exception):
    """These bytes are not what the format says; the message says why."""


@dataclass(frozen=True)
class ChunkHeader:
    """A chunk's record up to its data."""

    start_ns: int
    end_ns: int
    uncompressed_bytes: int
    uncompressed_crc: int  # 0 where there is none
    compression: str  # "", "lz4" or "zstd"
    data_offset: int  # from the start of the record's content
    data_bytes: int


@dataclass(frozen=True)
class MessageSpan:
    """Where a message's data lies in the bytes that it was found in."""

    channel_id: int
    log_time_ns: int
    begin: int
    end: int


def record_header(data: Bytes, offset: int = 0) -> tuple[int, int]:
    """Opcode and length of the record at an offset. Raises DamagedRecordError for what can be neither."""
    if len(data) < offset + RECORD_HEADER_BYTES:
        raise DamagedRecordError("it ends inside a record's header")
    opcode, length = _RECORD_HEADER.unpack_from(data, offset)
    if (opcode not in _OPCODES and opcode < _FIRST_PRIVATE_OPCODE) or length > RECORD_LIMIT_BYTES:
        raise DamagedRecordError(f"no record starts with opcode {opcode} and a length of {length} bytes")
    return opcode, length


def message_header(data: Bytes, offset: int, length: int) -> MessageSpan:
    """The message whose content starts at an offset. Raises DamagedRecordError if it is too short to be one."""
    if length < MESSAGE_HEADER_BYTES or len(data) < offset + MESSAGE_HEADER_BYTES:
        raise DamagedRecordError("a message is shorter than its header")
    channel_id, _, log_time_ns, _ = _MESSAGE_HEADER.unpack_from(data, offset)
    return MessageSpan(channel_id, log_time_ns, offset + MESSAGE_HEADER_BYTES, offset + length)


def definition(opcode: int, content: Bytes) -> Schema | Channel:
    """The schema or channel of a record's content. Raises DamagedRecordError if it is none."""
    stream = ReadDataStream(BytesIO(bytes(content)))
    try:
        found: Schema | Channel = Schema.read(stream) if opcode == Opcode.SCHEMA else Channel.read(stream)
    except Exception as error:  # a parser fed with damaged bytes
        raise DamagedRecordError(f"a definition cannot be read ({type(error).__name__})") from error
    return found


def chunk_header(content: Bytes, length: int) -> ChunkHeader:
    """The header of a chunk record of a length, from its content or the beginning of it.

    Raises:
        DamagedRecordError: the lengths in it contradict one another, or it is larger than any chunk may be.
    """
    if len(content) < _CHUNK_HEADER.size + 8:
        raise DamagedRecordError("it ends inside a chunk's header")
    start_ns, end_ns, size, crc, name_bytes = _CHUNK_HEADER.unpack_from(content)
    data_offset = _CHUNK_HEADER.size + name_bytes + 8
    if name_bytes > 4 or len(content) < data_offset:
        raise DamagedRecordError("a chunk's header makes no sense")
    (data_bytes,) = struct.unpack_from("<Q", content, data_offset - 8)
    compression = bytes(content[_CHUNK_HEADER.size : data_offset - 8]).decode("ascii", errors="replace")
    if data_offset + data_bytes != length or start_ns > end_ns:
        raise DamagedRecordError("a chunk's lengths contradict one another")
    if compression not in ("", "lz4", "zstd"):
        raise DamagedRecordError(f"a chunk's compression '{compression}' is not known")
    if size > RECORD_LIMIT_BYTES:
        raise DamagedRecordError(f"a chunk has {size} bytes; {RECORD_LIMIT_BYTES} are read at most")
    return ChunkHeader(start_ns, end_ns, size, crc, compression, data_offset, data_bytes)


def chunk_data(content: Bytes) -> Bytes:
    """The records of a chunk, decompressed, with size and checksum verified. Raises DamagedRecordError."""
    header = chunk_header(content, len(content))
    packed = content[header.data_offset :]
    try:
        data = _decompressed(header, packed)
    except Exception as error:  # decompressors fed with damaged bytes
        raise DamagedRecordError(f"a chunk cannot be decompressed ({type(error).__name__})") from error
    if len(data) != header.uncompressed_bytes:
        raise DamagedRecordError(f"a chunk has {len(data)} bytes, not its {header.uncompressed_bytes}")
    if header.uncompressed_crc and zlib.crc32(data) != header.uncompressed_crc:
        raise DamagedRecordError("a chunk's checksum does not fit")
    return data


def legible_chunk_data(header: ChunkHeader, content: Bytes) -> Bytes:
    """As much of a cut or damaged chunk as can be decompressed, unverified."""
    packed = content[header.data_offset :]
    if not header.compression:
        return packed
    unpack = _decompressor(header.compression)
    data = bytearray()
    with suppress(Exception):  # decompressors fed with damaged bytes: what came before them stays
        for begin in range(0, len(packed), _PIECE_BYTES):
            data += unpack.decompress(packed[begin : begin + _PIECE_BYTES])
            if len(data) > header.uncompressed_bytes:
                break
    return bytes(data)


def records_of_chunk(data: Bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset of the content and its length, record after record of a chunk's data.

    Raises:
        DamagedRecordError: from there on, the bytes are no whole records.
    """
    offset = 0
    while offset < len(data):
        opcode, length = record_header(data, offset)
        offset += RECORD_HEADER_BYTES
        if offset + length > len(data):
            raise DamagedRecordError("a chunk ends inside a record")
        yield opcode, offset, length
        offset += length


def message_spans(data: Bytes) -> list[MessageSpan]:
    """The messages of a chunk's data. Raises DamagedRecordError if not everything is whole."""
    records = records_of_chunk(data)
    return [message_header(data, offset, length) for opcode, offset, length in records if opcode == Opcode.MESSAGE]


def whole_message_spans(data: Bytes) -> list[MessageSpan]:
    """The messages up to where the data end or stop making sense."""
    spans: list[MessageSpan] = []
    with suppress(DamagedRecordError):
        for opcode, offset, length in records_of_chunk(data):
            if opcode == Opcode.MESSAGE:
                spans.append(message_header(data, offset, length))
    return spans


def definitions_in(data: Bytes) -> list[Schema | Channel]:
    """The schemas and channels of a chunk's data, up to where it ends or stops making sense."""
    found: list[Schema | Channel] = []
    with suppress(DamagedRecordError):
        for opcode, offset, length in records_of_chunk(data):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                found.append(definition(opcode, data[offset : offset + length]))
    return found


def _decompressed(header: ChunkHeader, packed: Bytes) -> Bytes:
    if not header.compression or not packed:
        return packed
    if header.compression == "lz4":
        data: bytes = _decompressor("lz4").decompress(packed, max_length=header.uncompressed_bytes + 1)
        return data
    if zstandard.frame_content_size(packed) not in (-1, header.uncompressed_bytes):
        raise ValueError("the compressed size contradicts the chunk's")
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=header.uncompressed_bytes)


def _decompressor(compression: str) -> Any:
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor()
    return zstandard.ZstdDecompressor().decompressobj()
