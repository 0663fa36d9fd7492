"""How much is asked for at once: what the link carries in a moment, and never more than may be under way."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetmap.transport.pace import Pace
from fleetmap.transport.protocol import CHUNK_BYTES, MAX_CHUNK_BYTES, UPLOAD_CHUNK_BYTES, WINDOW_CHUNKS

BATCH_BYTES, QUEUE_BATCHES = 65_000, 16


def carried(bytes_per_s: float, answers: int = 30) -> Pace:
    """The pace after so many chunks over a link of this rate, one behind the other."""
    pace, now_s = Pace(), 0.0
    for _ in range(answers):
        size_bytes = pace.download_chunk_bytes
        pace.note_answer(size_bytes, now_s, now_s + size_bytes / bytes_per_s)
        now_s += size_bytes / bytes_per_s
    return pace


@pytest.mark.parametrize("bytes_per_s", [40e3, 100e3, 400e3])
def test_a_chunk_occupies_a_slow_link_for_half_a_second(bytes_per_s):
    assert carried(bytes_per_s).download_chunk_bytes == pytest.approx(0.5 * bytes_per_s, rel=0.3)


def test_a_link_that_hardly_carries_anything_is_still_asked_for_something():
    assert carried(100.0).download_chunk_bytes == carried(100.0).upload_chunk_bytes == 16 * 1024


def test_chunks_and_window_are_those_of_the_protocol_where_a_link_is_neither_slow_nor_fast():
    pace = carried(10e6)
    assert (pace.download_chunk_bytes, pace.download_window_chunks) == (CHUNK_BYTES, WINDOW_CHUNKS)
    assert pace.upload_chunk_bytes == UPLOAD_CHUNK_BYTES


def test_a_fast_link_is_found_out_within_a_megabyte_or_two():
    pace = carried(500e6, answers=12)
    assert (pace.download_chunk_bytes, pace.download_window_chunks) == (MAX_CHUNK_BYTES, 3)


def test_one_stall_takes_a_fast_link_back_to_what_fits_the_queue():
    pace = carried(500e6)
    pace.note_answer(MAX_CHUNK_BYTES, 1e6, 1e6 + 1.0)
    assert pace.download_chunk_bytes * pace.download_window_chunks <= CHUNK_BYTES * WINDOW_CHUNKS


def test_a_lost_chunk_begins_anew_however_fast_the_link_was():
    pace = carried(500e6)
    pace.note_loss()
    assert pace.download_chunk_bytes == Pace().download_chunk_bytes


def test_chunks_get_smaller_with_every_one_that_is_lost():
    pace, sizes = Pace(), []
    for _ in range(4):
        sizes.append(pace.download_chunk_bytes)
        pace.note_loss()
    assert sizes[1:] == sorted(sizes[1:], reverse=True)
    assert sizes[-1] < sizes[0]


@given(st.lists(st.tuples(st.integers(0, MAX_CHUNK_BYTES), st.floats(0.0, 100.0), st.booleans()), max_size=40))
def test_whatever_a_link_does_what_is_under_way_fits_the_queue_unless_the_link_is_fast(answers):
    pace, now_s = Pace(), 0.0
    for size_bytes, duration_s, is_lost in answers:
        if is_lost:
            pace.note_loss()
        else:
            pace.note_answer(size_bytes, now_s, now_s + duration_s)
        now_s += duration_s
        chunk_bytes, window = pace.download_chunk_bytes, pace.download_window_chunks
        batches = -(-(chunk_bytes + 2048) // BATCH_BYTES)
        assert 16 * 1024 <= chunk_bytes <= MAX_CHUNK_BYTES
        assert batches * window <= QUEUE_BATCHES or (chunk_bytes, window) == (MAX_CHUNK_BYTES, 3)
        assert 16 * 1024 <= pace.upload_chunk_bytes <= UPLOAD_CHUNK_BYTES
