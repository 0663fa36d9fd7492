"""What a power cut, a bad disk or a broken copy leaves of a recording is read, and what is lost is told."""

from __future__ import annotations

import logging
import tracemalloc
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from fleetmap.drives import open_drive
from fleetmap.drives.mcap_file import McapFile
from fleetmap.errors import DriveError

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000
IMAGES = "/front/image/compressed"
UNINDEXED = {"index_types": IndexType.MESSAGE, "repeat_channels": False, "repeat_schemas": False}


def all_messages(path):
    mcap = McapFile(path)
    return list(mcap.messages(*mcap.topics))


def chunks_of(path):
    with path.open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    return sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)


def overwrite(path, offset, data):
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(data)


def warnings_of(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def outside(messages, *chunks):
    """The messages that none of these chunks holds; chunks of the test recordings do not overlap in time."""
    spans = [(chunk.message_start_time, chunk.message_end_time) for chunk in chunks]
    return [m for m in messages if not any(start <= m.log_time_ns <= end for start, end in spans)]


@pytest.fixture
def quiet_street(record, small_camera, pictures):
    """Thirty images with fixes between them, in chunks of a few messages that do not overlap in time."""

    def build(name="quiet.mcap", **options):
        with record(name, **{"chunk_size": 6000, **options}) as recorder:
            for index in range(30):
                stamp_ns = T0_NS + index * FRAME_NS
                recorder.camera_info("/front/camera_info", stamp_ns, small_camera, "cam")
                recorder.jpeg(IMAGES, stamp_ns + 1, pictures[index % 10], "cam")
                recorder.fix("/gps/fix", stamp_ns + FRAME_NS // 3, (49.0 + 1e-6 * index, 8.4, 120.0), "gnss")
        return Path(recorder.path)

    return build


# --- recordings that were not finished


@pytest.mark.parametrize("options", [{"compression": CompressionType.NONE}, {"use_chunking": False}, UNINDEXED])
def test_all_whole_messages_before_the_end_are_read_wherever_it_is(street, tmp_path, options):
    path = street(**{"compression": CompressionType.NONE, **options})
    whole, data = all_messages(path), path.read_bytes()
    ends = [data.index(message.data) + len(message.data) for message in whole]
    cut_path = tmp_path / "cut.mcap"
    for cut in np.linspace(min(ends), len(data) - 1, 80).astype(int):
        cut_path.write_bytes(data[:cut])
        expected = [message for message, end in zip(whole, ends, strict=True) if end <= cut]
        assert all_messages(cut_path) == expected, f"cut at {cut} of {len(data)} bytes"


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_of_a_cut_compressed_recording_every_whole_chunk_is_read(quiet_street, tmp_path, compression):
    path = quiet_street(compression=compression)
    whole, data, chunks = all_messages(path), path.read_bytes(), chunks_of(path)
    assert len(chunks) > 5
    cut_path = tmp_path / "cut.mcap"
    ends = [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]
    for cut in np.linspace(ends[0], len(data) - 1, 60).astype(int):
        cut_path.write_bytes(data[:cut])
        found = all_messages(cut_path)
        last_end_ns = max(c.message_end_time for c, end in zip(chunks, ends, strict=True) if end <= cut)
        assert found == whole[: len(found)]
        assert len(found) >= sum(message.log_time_ns <= last_end_ns for message in whole)


def test_a_cut_recording_is_a_drive_with_one_warning_that_counts(street, caplog):
    path = street(compression=CompressionType.NONE)
    data = path.read_bytes()
    image_7 = data.index(all_messages_of(path, IMAGES)[7].data)
    path.write_bytes(data[: image_7 + 100])
    drive = open_drive(path)
    assert len(list(drive.frames())) == drive.frame_count == 7
    assert len(drive.gnss_fixes()) == 7
    assert drive.antenna().source == "static transform"
    assert len(list(drive.frames())) == 7
    assert len(list(open_drive(path).frames())) == 7
    (warning,) = warnings_of(caplog)
    assert f"recording {path} was not finished" in warning
    assert " 131 bytes at its end are left out; 23 messages are read" in warning  # 100 and the message's header


def all_messages_of(path, topic):
    return list(McapFile(path).messages(topic))


def test_zeros_at_the_end_are_what_a_file_system_leaves_after_a_power_cut(quiet_street, tmp_path, caplog):
    path = quiet_street()
    whole, data, chunks = all_messages(path), path.read_bytes(), chunks_of(path)
    cut_path = tmp_path / "cut.mcap"
    cut = chunks[4].chunk_start_offset + 1000
    cut_path.write_bytes(data[:cut] + bytes(50_000))
    expected = [message for message in whole if message.log_time_ns < chunks[4].message_start_time]
    assert all_messages(cut_path) == expected
    (warning,) = warnings_of(caplog)
    assert "was not finished" in warning


def test_a_file_that_ends_right_but_lacks_its_second_half_was_not_finished(quiet_street, caplog):
    path = quiet_street()
    whole, data = all_messages(path), path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + data[-8:])
    found = all_messages(path)
    assert 0.3 * len(whole) < len(found) < 0.6 * len(whole)
    assert found == whole[: len(found)]
    assert "was not finished" in warnings_of(caplog)[0]


@pytest.mark.parametrize("kept", [3, 8, 30, 60])
@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"compression": CompressionType.NONE}])
def test_a_recording_cut_before_its_first_message_is_refused_with_one_line(street, caplog, kept, options):
    path = street(**options)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DriveError, match=r"is truncated: no message in it can be read; copy it again"):
        open_drive(path)
    assert warnings_of(caplog) == []


def test_a_recording_cut_before_its_first_image_is_refused_with_one_line(street, caplog):
    path = street(compression=CompressionType.NONE)
    first_image = path.read_bytes().index(all_messages_of(path, IMAGES)[0].data)
    path.write_bytes(path.read_bytes()[:first_image])
    with pytest.raises(DriveError, match="holds no ROS 2 images"):
        open_drive(path)
    assert warnings_of(caplog) == []


# --- recordings with damage inside


@pytest.mark.parametrize(
    "options", [{}, UNINDEXED, {"compression": CompressionType.NONE}, {"use_statistics": False}]
)
def test_a_damaged_chunk_is_left_out_and_named_once(quiet_street, caplog, options):
    reference = quiet_street("reference.mcap", **{**options, "index_types": IndexType.ALL})
    path, chunks = quiet_street(**options), chunks_of(reference)
    whole = all_messages(path)
    middle = chunks[3].chunk_start_offset + chunks[3].chunk_length // 2
    overwrite(path, middle, b"\xff" * 16)
    mcap = McapFile(path)
    expected = outside(whole, chunks[3])
    assert 0 < len(whole) - len(expected) < 20
    for _ in range(2):
        for topic in mcap.topics:
            assert list(mcap.messages(topic)) == [message for message in expected if message.topic == topic]
    assert sum(topic.message_count for topic in mcap.topics.values()) == len(expected)
    (warning,) = warnings_of(caplog)
    begin, end = chunks[3].chunk_start_offset, chunks[3].chunk_start_offset + chunks[3].chunk_length
    place = f"(bytes {begin} to {end}, "
    assert f"recording {path} is damaged: 1 chunk cannot be read and is left out {place}" in warning
    start_s, end_s = ((t - T0_NS) * 1e-9 for t in (chunks[3].message_start_time, chunks[3].message_end_time))
    assert f"{start_s:.1f} to {end_s:.1f} s after its start); {len(expected)} messages are read" in warning


@pytest.mark.parametrize("options", [{}, UNINDEXED])
@pytest.mark.parametrize("length", [0, 50, 3000, 2**20, 2**62, 2**64 - 1])
def test_a_chunk_with_a_false_length_costs_that_chunk_and_nothing_else(quiet_street, caplog, options, length):
    reference = quiet_street("reference.mcap", **{**options, "index_types": IndexType.ALL})
    path, chunks = quiet_street(**options), chunks_of(reference)
    whole = all_messages(path)
    overwrite(path, chunks[2].chunk_start_offset + 1, length.to_bytes(8, "little"))
    expected = outside(whole, chunks[2])
    found = all_messages(path)
    assert found in (expected, whole)
    assert (found == whole) == (warnings_of(caplog) == [])
    if found == expected:
        assert "1 chunk cannot be read" in warnings_of(caplog)[0]


@pytest.mark.parametrize("options", [{}, UNINDEXED])
def test_damage_across_chunks_costs_the_chunks_it_touches(quiet_street, caplog, options):
    reference = quiet_street("reference.mcap", **{**options, "index_types": IndexType.ALL})
    path, chunks = quiet_street(**options), chunks_of(reference)
    whole = all_messages(path)
    begin, end = chunks[2].chunk_start_offset + 200, chunks[4].chunk_start_offset + 200
    overwrite(path, begin, np.random.default_rng(0).bytes(end - begin))
    overwrite(path, chunks[6].chunk_start_offset, bytes(9))
    assert all_messages(path) == outside(whole, *chunks[2:5], chunks[6])
    assert len(warnings_of(caplog)) == 1


def test_the_last_chunk_may_be_the_damaged_one(quiet_street, caplog):
    path = quiet_street()
    whole, chunks = all_messages(path), chunks_of(path)
    overwrite(path, chunks[-1].chunk_start_offset, bytes(200))
    assert all_messages(path) == outside(whole, chunks[-1])
    (warning,) = warnings_of(caplog)
    assert "is damaged: 1 chunk" in warning
    assert "was not finished" not in warning


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_definitions_in_a_damaged_chunk_still_serve_the_messages_behind_it(tmp_path, caplog, compression):
    stamps_ns = range(T0_NS, T0_NS + 20)
    reference = large_recording(tmp_path / "reference.mcap", stamps_ns, compression=compression)
    path = large_recording(tmp_path / "large.mcap", stamps_ns, compression=compression, **UNINDEXED)
    whole, first = all_messages(path), chunks_of(reference)[0]
    overwrite(path, first.chunk_start_offset + first.chunk_length - 50, b"\xff" * 40)
    found = all_messages(path)
    assert 10 < len(found) < 20
    assert found == outside(whole, first)
    assert "1 chunk cannot be read" in warnings_of(caplog)[0]


def test_a_summary_that_points_to_wrong_places_is_not_believed(quiet_street):
    path = quiet_street()
    whole, data, chunks = all_messages(path), path.read_bytes(), chunks_of(path)
    begin = chunks[3].chunk_start_offset
    end = begin + chunks[3].chunk_length
    path.write_bytes(data[:begin] + data[end:])  # all later chunks lie elsewhere than the index says
    found = all_messages(path)
    assert found == outside(whole, chunks[3])


def test_a_false_length_outside_chunks_costs_its_message_and_perhaps_the_one_before(street, caplog):
    path = street(use_chunking=False)
    whole, data = all_messages(path), path.read_bytes()
    for victim, length in ((5, 2**40), (12, 30), (20, 100_000)):
        content = data.index(whole[victim].data) - 22
        overwrite(path, content - 8, length.to_bytes(8, "little"))
    found = all_messages(path)
    assert found == [message for number, message in enumerate(whole) if number not in (4, 5, 12, 19, 20)]
    (warning,) = warnings_of(caplog)
    assert "is damaged: 3 stretches cannot be read and are left out" in warning


def test_without_chunks_the_checksum_of_all_data_is_looked_at(street, caplog):
    path = street(use_chunking=False, enable_data_crcs=True)
    image = all_messages_of(path, IMAGES)[4]
    assert warnings_of(caplog) == []
    overwrite(path, path.read_bytes().index(image.data) + 300, b"\x00\x01\x02\x03")
    assert len(all_messages(path)) == 31
    (warning,) = warnings_of(caplog)
    assert "its checksum does not fit" in warning


@pytest.mark.parametrize(
    ("options", "most_refused"),
    [({}, 20), (UNINDEXED, 75), ({"use_chunking": False}, 20), ({"compression": CompressionType.NONE}, 20)],
    ids=["indexed", "topics named in the first chunk only", "without chunks", "uncompressed"],
)
def test_random_damage_raises_nothing_but_drive_errors_and_no_checked_message_is_wrong(
    street, tmp_path, options, most_refused
):
    path = street(**{"chunk_size": 6000, **options})
    data, rng = path.read_bytes(), np.random.default_rng(7)
    whole = {(message.topic, message.log_time_ns): message.data for message in all_messages(path)}
    refusals = []
    for number in range(150):
        spoiled = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(8, len(data)))
            spoiled[at : at + int(rng.integers(1, 40))] = rng.bytes(int(rng.integers(1, 40)))
        damaged = tmp_path / f"damaged_{number}.mcap"
        damaged.write_bytes(spoiled)
        try:
            found = all_messages(damaged)
        except DriveError as error:
            refusals.append(str(error))
            continue
        stamps = [message.log_time_ns for message in found]
        assert stamps == sorted(stamps)
        if options.get("use_chunking", True):
            assert all(whole[message.topic, message.log_time_ns] == message.data for message in found)
    assert not any("\n" in refusal for refusal in refusals)
    assert len(refusals) < most_refused


# --- order and memory


@pytest.mark.parametrize("options", [UNINDEXED, {"use_chunking": False}])
def test_a_recording_without_an_index_comes_in_log_time_order_too(record, small_camera, pictures, options):
    with record(**options) as recorder:
        recorder.camera_info("/camera_info", T0_NS, small_camera, "cam")
        for index in (3, 0, 9, 1, 2, 7, 8, 4, 6, 5):
            recorder.jpeg("/image", T0_NS + index * FRAME_NS, pictures[index], "cam")
    stamps = [frame.stamp_ns for frame in open_drive(recorder.path).frames()]
    assert stamps == [T0_NS + index * FRAME_NS for index in range(10)]


def large_recording(path, stamps_ns, *, is_finished=True, **options):
    """One message of 200 kB a stamp."""
    noise = np.random.default_rng(0).bytes(200_000)
    with path.open("wb") as file:
        writer = Writer(file, **{"compression": CompressionType.NONE, **options})
        writer.start("ros2")
        channel_id = writer.register_channel("/blob", "cdr", writer.register_schema("x/msg/Blob", "ros2msg", b""))
        for stamp_ns in stamps_ns:
            writer.add_message(channel_id, stamp_ns, noise, stamp_ns)
        if is_finished:
            writer.finish()
    return path


def memory_peak_of_reading(path):
    tracemalloc.start()
    try:
        count = sum(1 for _ in McapFile(path).messages("/blob"))
        return count, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "options",
    [{}, {"is_finished": False}, {"index_types": IndexType.NONE}, {"use_chunking": False}],
    ids=["indexed", "unfinished", "unindexed", "without chunks"],
)
def test_reading_holds_a_few_chunks_at_most(tmp_path, options):
    path = large_recording(tmp_path / "large.mcap", range(T0_NS, T0_NS + 500), **options)
    assert path.stat().st_size > 98_000_000
    count, peak_bytes = memory_peak_of_reading(path)
    assert 495 <= count <= 500
    assert 1_000_000 < peak_bytes < 8_000_000


def test_chunks_that_all_overlap_in_time_do_not_fill_the_memory(tmp_path):
    backwards = range(T0_NS + 700, T0_NS, -1)
    stamps_ns = [stamp for stamp in backwards for stamp in (T0_NS, stamp)]  # each chunk reaches back to the start
    path = large_recording(tmp_path / "large.mcap", stamps_ns[:1000])
    count, peak_bytes = memory_peak_of_reading(path)
    assert count == 1000
    assert 64_000_000 < peak_bytes < 80_000_000


def test_a_chunk_that_claims_an_absurd_size_is_damage_not_a_full_memory(quiet_street, caplog):
    path = quiet_street(compression=CompressionType.ZSTD)
    whole, chunks = all_messages(path), chunks_of(path)
    overwrite(path, chunks[1].chunk_start_offset + 9 + 16, (2**50).to_bytes(8, "little"))
    assert all_messages(path) == outside(whole, chunks[1])
    assert "1 chunk cannot be read" in warnings_of(caplog)[0]


def test_the_records_of_a_whole_file_are_those_the_mcap_package_finds(quiet_street):
    path = quiet_street(**UNINDEXED)
    records = StreamReader(BytesIO(path.read_bytes())).records
    expected = [record.data for record in records if type(record).__name__ == "Message"]
    assert [message.data for message in all_messages(path)] == expected
