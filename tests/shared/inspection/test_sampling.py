"""Which images are looked at."""

from __future__ import annotations

import numpy as np

from fleetmap.inspection.gnss_quality import GnssTrack
from fleetmap.inspection.sampling import pairs_to_follow


def stamps(count, rate_hz):
    return (np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def test_a_short_drive_is_followed_throughout():
    assert pairs_to_follow(stamps(300, 10.0), None) == [(index, index + 1) for index in range(299)]


def test_a_fast_camera_is_followed_at_ten_images_a_second():
    assert pairs_to_follow(stamps(300, 30.0), None)[:2] == [(0, 3), (3, 6)]


def test_a_long_drive_is_followed_at_its_turns_and_spot_checked_elsewhere():
    """Half an hour straight on, with one corner after 1000 s."""
    times_s = np.arange(0.0, 1800.0, 1.0)
    east, north = np.minimum(8.0 * times_s, 8000.0), np.maximum(8.0 * times_s - 8000.0, 0.0)
    positions = np.column_stack([east, north, np.zeros(1800)])
    track = GnssTrack((times_s * 1e9).astype(np.int64), positions, np.full(1800, 0.05))
    pairs = pairs_to_follow(stamps(18_000, 10.0), track)
    assert 300 < len(pairs) <= 800
    assert pairs == sorted(set(pairs))
    assert {(index, index + 1) for index in range(9_900, 10_100)} <= set(pairs)
    assert pairs[0][0] == 0
    assert pairs[-1][1] > 17_900


def test_without_two_images_there_is_nothing_to_follow():
    assert pairs_to_follow(stamps(1, 10.0), None) == []
