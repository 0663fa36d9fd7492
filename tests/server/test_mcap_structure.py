"""The frame of a recording: whole files pass, whatever was cut, padded or changed in it does not."""

from __future__ import annotations

import io
import struct
import tracemalloc
from collections.abc import Iterator
from contextlib import suppress

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from fleetmap.errors import DriveError
from fleetmap_server.mcap_structure import MAGIC, McapStructure, check_mcap

FIRST_NS, STEP_NS, MESSAGES = 1_700_000_000_000_000_000, 10_000_000, 120
LAST_NS = FIRST_NS + (MESSAGES - 1) * STEP_NS


def recording(messages: int = MESSAGES, channels: int = 2, **options: object) -> bytes:
    file = io.BytesIO()
    writer = Writer(file, **{"chunk_size": 3000, **options})
    writer.start(profile="ros2", library="a recorder")
    schema = writer.register_schema("sensor_msgs/msg/Thing", "ros2msg", b"uint8[] data")
    ids = [writer.register_channel(f"/topic{number}", "cdr", schema) for number in range(channels)]
    writer.add_metadata("vehicle", {"name": "one"})
    for number in range(messages):
        stamp_ns = FIRST_NS + number * STEP_NS
        writer.add_message(ids[number % channels], stamp_ns, bytes([number % 251]) * 100, stamp_ns)
    writer.add_attachment(FIRST_NS, FIRST_NS, "notes.txt", "text/plain", b"rain")
    writer.finish()
    return file.getvalue()


WHOLE = recording()


def in_pieces(data: bytes, size: int) -> Iterator[bytes]:
    return (data[begin : begin + size] for begin in range(0, len(data), size))


def record_offsets(data: bytes) -> list[int]:
    offsets, offset = [], len(MAGIC)
    while offset < len(data) - len(MAGIC):
        offsets.append(offset)
        offset += 9 + struct.unpack_from("<Q", data, offset + 1)[0]
    return offsets


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"use_chunking": False},
        {"use_statistics": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
        {"index_types": IndexType.NONE},
        {"enable_crcs": False, "enable_data_crcs": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("piece_bytes", [1, 7, 1 << 20])
def test_whole_recordings_pass_whatever_their_recorder_left_out(options, piece_bytes):
    data = recording(**options)
    found = check_mcap(in_pieces(data, piece_bytes))
    assert (found.size_bytes, found.start_ns, found.end_ns) == (len(data), FIRST_NS, LAST_NS)
    assert found.messages == MESSAGES
    if options.get("use_statistics", True) or not options.get("use_chunking", True):
        assert found.channels == 2


def test_chunks_without_index_nor_statistics_count_by_their_times():
    data = recording(index_types=IndexType.NONE, use_statistics=False)
    assert check_mcap([data]) == McapStructure(len(data), None, None, FIRST_NS, LAST_NS)


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"use_statistics": False}], ids=str)
def test_a_recording_without_messages_is_refused(options):
    with pytest.raises(DriveError, match="no message"):
        check_mcap([recording(messages=0, **options)])


@given(st.integers(0, len(WHOLE) - 1))
@example(8)
@example(len(WHOLE) - 1)
@example(len(WHOLE) - 8)
def test_cut_anywhere_it_is_refused(length):
    with pytest.raises(DriveError) as refusal:
        check_mcap([WHOLE[:length]])
    if length >= len(MAGIC):
        assert "damaged at byte" in str(refusal.value)


def test_a_cut_recording_is_told_where():
    offset = record_offsets(WHOLE)[4]
    with pytest.raises(DriveError, match=rf"damaged at byte {offset}: .* the file ends at {offset + 20};"):
        check_mcap([WHOLE[: offset + 20]])
    with pytest.raises(DriveError, match=rf"damaged at byte {offset}: the file ends where a record belongs"):
        check_mcap([WHOLE[:offset]])


@given(st.binary(min_size=1, max_size=50))
@example(MAGIC)
@example(WHOLE)
def test_padded_it_is_refused(more):
    with pytest.raises(DriveError, match=f"damaged at byte {len(WHOLE)}: {len(more)} bytes follow"):
        check_mcap([WHOLE, more])


@given(st.sampled_from(record_offsets(WHOLE)), st.integers(1, 8), st.integers(1, 255))
def test_with_another_length_of_any_record_it_is_refused(offset, byte, flip):
    data = bytearray(WHOLE)
    data[offset + byte] ^= flip
    with pytest.raises(DriveError):
        check_mcap([bytes(data)])


@given(st.lists(st.tuples(st.integers(0, len(WHOLE) - 1), st.integers(1, 255)), min_size=1, max_size=20))
def test_whatever_is_changed_it_is_judged(flips):
    data = bytearray(WHOLE)
    for place, flip in flips:
        data[place] ^= flip
    with suppress(DriveError):
        found = check_mcap(in_pieces(bytes(data), 1000))
        assert found.size_bytes == len(WHOLE)
        assert found.messages


@given(st.binary(max_size=300))
def test_nothing_else_passes_for_a_recording(content):
    with pytest.raises(DriveError):
        check_mcap([content])
    with pytest.raises(DriveError):
        check_mcap([MAGIC + content])
    with pytest.raises(DriveError):
        check_mcap([WHOLE[: record_offsets(WHOLE)[1]] + content])


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", b"#ROSBAG V2.0\n", MAGIC[:5]], ids=str)
def test_a_foreign_file_is_refused_with_what_it_begins_with(content):
    with pytest.raises(DriveError, match=f"no MCAP recording: it begins with {content[:8].hex(' ') or 'nothing'}"):
        check_mcap([content])


def test_an_index_that_points_outside_the_data_is_refused():
    data = bytearray(recording(enable_crcs=False))
    (first, *_) = [offset for offset in record_offsets(bytes(data)) if data[offset] == 0x08]
    struct.pack_into("<Q", data, first + 9 + 16, len(data))  # the chunk's offset
    with pytest.raises(DriveError, match=f"damaged at byte {first}: it says a chunk lies at {len(data)}"):
        check_mcap([bytes(data)])


def test_a_large_recording_is_passed_over_without_being_held():
    piece = bytes(1 << 20)
    first = record_offsets(WHOLE)[1]
    attachment = struct.pack("<BQ", 0x09, 300 << 20)

    def pieces() -> Iterator[bytes]:
        yield WHOLE[:first] + attachment
        yield from (piece for _ in range(300))
        yield WHOLE[first:]

    tracemalloc.start()
    try:
        with pytest.raises(DriveError, match="it says a part of the summary lies at"):  # it moved by 300 MB
            check_mcap(pieces())
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < len(piece)
