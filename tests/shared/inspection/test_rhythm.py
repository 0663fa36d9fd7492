"""How regularly stamps follow each other."""

from __future__ import annotations

import pytest

from fleetmap.inspection.rhythm import rhythm_of

MS = 1_000_000


def test_an_even_rhythm_has_no_gaps():
    rhythm = rhythm_of([index * 100 * MS for index in range(50)])
    assert (rhythm.rate_hz, rhythm.longest_gap_s) == (pytest.approx(10.0), pytest.approx(0.1))
    assert (rhythm.gap_count, rhythm.missing_share, rhythm.late_count) == (0, 0.0, 0)


def test_missing_images_are_counted():
    stamps = [index * 100 * MS for index in range(50) if not 20 <= index < 25 and index != 40]
    rhythm = rhythm_of(stamps)
    assert rhythm.rate_hz == pytest.approx(10.0)
    assert rhythm.gap_count == 1  # a single one may be the camera's own jitter
    assert rhythm.missing_share == pytest.approx(5 / 49)
    assert rhythm.longest_gap_s == pytest.approx(0.6)


def test_doubled_and_late_stamps_are_counted():
    rhythm = rhythm_of([0, 100 * MS, 100 * MS, 300 * MS, 200 * MS, 400 * MS])
    assert rhythm.late_count == 2
    assert rhythm.gap_count == 0


@pytest.mark.parametrize("stamps", [[], [5], [5, 5]])
def test_fewer_than_two_stamps_have_no_rhythm(stamps):
    assert rhythm_of(stamps) is None
